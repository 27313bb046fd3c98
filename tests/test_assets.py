# SPDX-License-Identifier: Apache-2.0
import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest

ASSETS = Path(__file__).parents[1] / "assets"
MODELS = ["showcase", "walker_on_plane", "pendulum"]


def load(name):
    return mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))


@pytest.fixture(scope="module")
def showcase():
    return load("showcase")


@pytest.mark.parametrize("name", MODELS)
def test_each_model_steps_without_a_warning(name):
    """Two hundred steps leave finite numbers and no warning of MuJoCo's."""
    model = load(name)
    data = mujoco.MjData(model)
    started = data.qpos.copy()

    mujoco.mj_step(model, data, 100)
    moved = np.abs(data.qpos - started).max()
    mujoco.mj_step(model, data, 100)

    assert [warning.number for warning in data.warning] == [0] * len(data.warning)
    assert np.isfinite(data.qpos).all()
    assert np.isfinite(data.qvel).all()
    assert moved > 0.1


def test_each_model_is_read_here():
    """A model that is added gets these tests too."""
    models = {path.stem for path in ASSETS.glob("*.xml")} - {"finger_skin"}

    assert models == set(MODELS)


def test_parts_are_what_the_script_writes():
    """Frames, mesh and skin can be made again from the committed script."""
    spec = importlib.util.spec_from_file_location(
        "make_parts", ASSETS / "make_parts.py"
    )
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    for name, content in script.parts().items():
        assert (ASSETS / name).read_bytes() == content, name
