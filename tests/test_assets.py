# SPDX-License-Identifier: Apache-2.0
import runpy
from pathlib import Path

import mujoco
import numpy as np
import pytest

ASSETS = Path(__file__).parents[1] / "assets"
# The skin is not a separate model but part of the showcase.
MODELS = sorted({path.stem for path in ASSETS.glob("*.xml")} - {"finger_skin"})


@pytest.mark.parametrize("name", MODELS)
def test_model_moves_without_warnings(name):
    model = mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml"))
    data = mujoco.MjData(model)
    started = data.qpos.copy()
    mujoco.mj_step(model, data, 100)
    moved = np.abs(data.qpos - started).max()
    mujoco.mj_step(model, data, 100)
    assert not any(warning.number for warning in data.warning)
    assert np.isfinite([*data.qpos, *data.qvel]).all()
    assert moved > 0.1


def test_parts_equal_the_output_of_their_script():
    script = runpy.run_path(str(ASSETS / "make_parts.py"))
    for name, content in script["parts"]().items():
        assert (ASSETS / name).read_bytes() == content, name
