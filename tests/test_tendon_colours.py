# SPDX-License-Identifier: Apache-2.0
"""The colours of tendons are those that MuJoCo draws."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mjrec.simulation import tendon_colours
from mjrec.simulation.tendon_colours import TendonColours, has_limited_tendons

XML = """
<mujoco>
  <asset><material name="m"/></asset>
  <worldbody>
    <site name="top" pos="0 0 1"/>
    <body pos="0 0 .4"><freejoint/><geom size=".05"/><site name="a"/></body>
  </worldbody>
  <tendon>{}</tendon>
</mujoco>
"""
PATH = '<site site="top"/><site site="a"/></spatial>'
LIMITED = '<spatial limited="true" range="0 .5"'


needs_mixing = pytest.mark.skipif(
    not tendon_colours._mixes_colours(), reason="this MuJoCo mixes no colours"
)


def simulated(*tendons: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    xml = XML.format("".join(f"{tendon}>{PATH}" for tendon in tendons))
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def drawn(model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, Any]:
    """Return the colours that tendons have in MuJoCo's own scene."""
    scene = mujoco.MjvScene(model, maxgeom=1000)
    camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
    mujoco.mjv_updateScene(model, data, option, None, camera, 7, scene)
    kind = int(mujoco.mjtObj.mjOBJ_TENDON)
    geoms = [geom for geom in scene.geoms[: scene.ngeom] if geom.objtype == kind]
    return {geom.objid: geom.rgba.copy() for geom in geoms}


def check_like_drawn(model: mujoco.MjModel, data: mujoco.MjData) -> TendonColours:
    colours = TendonColours(model, data)
    colours.update()
    for tendon, rgba in drawn(model, data).items():
        assert np.array_equal(colours.rgba[tendon], rgba)
    return colours


@needs_mixing
def test_a_tendon_at_its_limit_is_mixed_to_the_last_bit() -> None:
    """The colour is what the scene has, not only near it."""
    model, data = simulated(LIMITED, "<spatial")
    model.vis.rgba.constraint[:] = (0.9, 0.123, 0.3, 1)
    for height in np.linspace(0.3, 0.499, 20):
        data.qpos[2] = height
        mujoco.mj_forward(model, data)
        colours = check_like_drawn(model, data)
        assert not np.array_equal(colours.rgba[0], model.tendon_rgba[0])
        assert np.array_equal(colours.rgba[1], model.tendon_rgba[1])


@needs_mixing
def test_only_tendons_without_a_colour_or_material_are_mixed() -> None:
    """One whose colour somebody has chosen keeps it."""
    model, data = simulated(LIMITED, f'{LIMITED} rgba="1 0 0 1"')
    colours = check_like_drawn(model, data)
    assert np.array_equal(colours.rgba[1], (1, 0, 0, 1))
    model, data = simulated(f'{LIMITED} material="m"')
    assert data.nl
    assert not has_limited_tendons(model)


@needs_mixing
def test_a_slack_cable_is_not_mixed_although_its_limit_is_active() -> None:
    """MuJoCo draws it hanging through, in the colour of the model."""
    model, data = simulated('<spatial limited="true" range="0 .605" margin=".1"')
    assert data.nl
    colours = check_like_drawn(model, data)
    assert np.array_equal(colours.rgba, model.tendon_rgba)
    model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    mujoco.mj_forward(model, data)
    colours = check_like_drawn(model, data)
    assert not np.array_equal(colours.rgba, model.tendon_rgba)


@needs_mixing
def test_a_tendon_that_comes_off_its_limit_has_its_own_colour_again() -> None:
    """Every update is of that moment, in the same array."""
    model, data = simulated(LIMITED)
    colours = check_like_drawn(model, data)
    data.qpos[2] = 0.9
    mujoco.mj_forward(model, data)
    colours.update()
    assert np.array_equal(colours.rgba, model.tendon_rgba)
    model.tendon_rgba[0] = (0, 1, 0, 1)
    colours.update()
    assert np.array_equal(colours.rgba[0], (0, 1, 0, 1))


@needs_mixing
def test_tendons_of_joints_and_without_limits_have_no_other_colour() -> None:
    """A model without any spatial, limited tendon needs no colours recorded."""
    joint = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body>
    </worldbody><tendon><fixed limited="true" range="0 1"><joint joint="j" coef="1"/>
    </fixed></tendon></mujoco>"""
    assert not has_limited_tendons(mujoco.MjModel.from_xml_string(joint))
    assert not has_limited_tendons(simulated("<spatial")[0])
    assert not has_limited_tendons(mujoco.MjModel.from_xml_string("<mujoco/>"))
    assert has_limited_tendons(simulated("<spatial", LIMITED)[0])


def test_which_cables_are_slack_is_what_mujoco_says() -> None:
    """Compared with the answer of MuJoCo's library, for random tendons."""
    own = _own_answer()
    model, data = simulated(*[LIMITED] * 6)
    every = np.arange(6, dtype=np.int32)
    random = np.random.default_rng(0)
    slack = 0
    for _ in range(2000):
        _randomize(model, random)
        found = tendon_colours._are_slack_cables(model, data, every)
        length = ctypes.c_double()
        asked = [
            own(model._address, data._address, tendon, ctypes.byref(length))
            for tendon in every.tolist()
        ]
        assert found.tolist() == [bool(answer) for answer in asked]
        slack += int(found.sum())
    assert slack > 100


def _own_answer() -> Any:
    folder = Path(mujoco.__file__).parent
    library = ctypes.CDLL(str(next(folder.glob("libmujoco.*"))))
    try:
        function = library.mjv_isCatenary
    except AttributeError:
        pytest.skip("this version of MuJoCo keeps it to itself")
    kinds = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int]
    function.argtypes = [*kinds, ctypes.POINTER(ctypes.c_double)]
    return function


def _randomize(model: mujoco.MjModel, random: np.random.Generator) -> None:
    choices = {
        "tendon_stiffness": [0, 0, 1],
        "tendon_stiffnesspoly": [0] * 12 + [1],
        "tendon_damping": [0, 0, 0, 1],
        "tendon_dampingpoly": [0] * 12 + [1],
        "tendon_frictionloss": [0, 0, 0, 0.1],
        "tendon_lengthspring": [0, 0, 0.5, 1],
        "tendon_range": [0, 0, 0.5, 0.7],
        "tendon_limited": [0, 1, 1],
    }
    for name, values in choices.items():
        if hasattr(model, name):
            array = getattr(model, name)
            array[...] = random.choice(values, size=array.shape)
    model.opt.gravity[:] = random.choice([0, -9, 1e-16], size=3)
