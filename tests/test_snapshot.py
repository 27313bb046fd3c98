# SPDX-License-Identifier: Apache-2.0
"""Test that restored snapshots give the same scene, even in data full of NaN."""

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjrec.errors import InvalidArgument
from mjrec.formats.trajectory import packed
from mjrec.simulation.captured_arrays import needs_constraints, snapshot_dtype
from mjrec.simulation.snapshot import (
    SnapshotSource,
    check_layout,
    differences,
    restore_snapshot,
    scene_difference,
    updated_scene,
)
from mjrec.simulation.states import read_state
from mjrec.simulation.view import SceneView

# One cable is taut, one is slack with an active limit, and one is colored.
TENDONS = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <site name="top" pos="0 0 1"/>
    <body pos="0 0 .4"><freejoint/><geom size=".05"/><site name="a"/></body>
    <body pos=".3 0 1"><freejoint/><geom size=".05"/><site name="b"/></body>
  </worldbody>
  <tendon>
    <spatial limited="true" range="0 .5"><site site="top"/><site site="a"/></spatial>
    <spatial limited="true" range="0 .305" margin=".1">
      <site site="top"/><site site="b"/></spatial>
    <spatial limited="true" range="0 .5" rgba="1 0 0 1">
      <site site="top"/><site site="a"/></spatial>
    <spatial><site site="a"/><site site="b"/></spatial>
  </tendon>
</mujoco>
"""

# Most visual options show something in this small model, which has no skin.
THINGS = """
<mujoco>
  <option timestep=".005"/>
  <asset><mesh name="m" vertex="0 0 0 .2 0 0 0 .2 0 0 0 .2"/></asset>
  <worldbody>
    <light name="l" pos="0 0 3"/>
    <camera name="c" pos="0 -3 1" xyaxes="1 0 0 0 .3 1"/>
    <geom type="plane" size="2 2 .1"/>
    <body name="arm" pos="0 0 .5">
      <joint name="hinge" axis="0 1 0"/>
      <geom name="link" type="capsule" fromto="0 0 0 .4 0 0" size=".05"/>
      <site name="tip" pos=".4 0 0"/>
      <body name="hand" pos=".5 0 0"><joint name="wrist" axis="0 0 1"/>
        <geom type="mesh" mesh="m"/></body>
    </body>
    <body name="free" pos="1 0 .099"><freejoint/><geom size=".1"/></body>
    <body name="other" pos="1 1 1"><freejoint/><geom size=".1"/></body>
  </worldbody>
  <equality>
    <connect body1="free" body2="other" anchor="0 0 0"/>
    <connect body1="hand" body2="other" anchor="0 0 0"/>
  </equality>
  <actuator>
    <general name="m" joint="hinge" dyntype="filter" dynprm="1"/>
    <motor site="tip" gear="0 0 1 0 0 0"/>
  </actuator>
</mujoco>
"""

SHOWCASE = str(Path(__file__).parents[1] / "assets/showcase.xml")


def simulated(xml):
    kind = "path" if xml == SHOWCASE else "string"
    model = getattr(mujoco.MjModel, f"from_xml_{kind}")(xml)
    data = mujoco.MjData(model)
    data.ctrl[:] = 0.7
    data.xfrc_applied[-1, :3] = (1, 2, 3)
    data.eq_active[1:] = False  # By default, all are active.
    mujoco.mj_step(model, data, nstep=250 if xml == SHOWCASE else 5)
    return model, data


def view(model, option):
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    size = {"max_geom": 1000, "height": 48, "width": 64, "label": -1}
    return SceneView(
        camera=camera, option=option or mujoco.MjvOption(), fresh=False, **size
    )


def restore_checked(row, model, data):
    check_layout(model, data, row.dtype)
    restore_snapshot(row, model, data)


def row_of(model, data, option=None):
    return SnapshotSource(model, data, snapshot_dtype(model, data, option)).taken()


def changed(row, **values):
    """Return a snapshot with some arrays replaced, or removed if given as None."""
    arrays = {name: row[name] for name in row.dtype.names} | values
    kept = {name: np.asarray(each) for name, each in arrays.items() if each is not None}
    record = np.zeros(1, packed((n, (a.dtype, a.shape)) for n, a in kept.items()))
    for name, each in kept.items():
        record[name] = each
    return record[0]


def differences_of(model, data, option=None):
    """Return the differences between the live scene and the restored one."""
    row = row_of(model, data, option)
    fresh_model = copy.copy(model)
    fresh = mujoco.MjData(fresh_model)
    for name in dir(fresh):
        value = None if name.startswith("_") else getattr(fresh, name)
        if isinstance(value, np.ndarray) and value.dtype == np.float64:
            value[...] = np.nan
    restore_snapshot(row, fresh_model, fresh)
    shown = view(model, option)
    live = updated_scene(model, data, shown)
    assert live.ngeom
    return list(
        differences(live, updated_scene(fresh_model, fresh, shown), shown.option)
    )


@pytest.mark.parametrize("xml", [TENDONS, THINGS, SHOWCASE])
def test_restored_snapshot_gives_the_same_scene(xml):
    assert differences_of(*simulated(xml)) == []


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        *(("ten_wrapadr", n, "use points up to") for n in (10**8, -1, 2**31 - 1)),
        *(("ten_wrapnum", n, "use points up to") for n in (10**8, -5)),
        *(("wrap_obj", n, "but its values range") for n in (10**8, -3)),
        ("ten_wrapadr", np.full(4, np.nan), "ten_wrapadr is .*f8"),
        ("geom_xpos", np.zeros((1, 3)), "belong to another model or version"),
        ("qpos", np.zeros(1), "which is not used for drawing"),
        ("__class__", np.zeros(1), "which is not used for drawing"),
        ("geom_xpos", None, "lack geom_xpos"),
    ],
)
def test_invalid_snapshot_is_refused(name, value, words):
    """With an invalid snapshot, MuJoCo would read out of bounds."""
    model, data = simulated(TENDONS)
    row = row_of(model, data)
    if isinstance(value, int):
        value = np.full_like(row[name], value)
    row = changed(row, **{name: value})
    with pytest.raises(InvalidArgument, match=words):
        restore_checked(row, model, data)


FLAGS = [[name] for name in mujoco.mjtVisFlag.__members__][:-1]
# These flags show nothing without another flag.
FLAGS += [["mjVIS_ACTUATOR", "mjVIS_ACTIVATION"], ["mjVIS_INERTIA", "mjVIS_SCLINERTIA"]]
FRAMES = [[name] for name in mujoco.mjtFrame.__members__][:-1]
LABELS = [[name] for name in mujoco.mjtLabel.__members__][:-1]


@pytest.mark.parametrize("xml", [THINGS, SHOWCASE], ids=["things", "showcase"])
@pytest.mark.parametrize("shown", [*FLAGS, *FRAMES, *LABELS], ids="-".join)
def test_every_flag_frame_and_label_is_exact_or_refused(shown, xml):
    option = mujoco.MjvOption()
    for name in shown:
        if name in mujoco.mjtVisFlag.__members__:
            index = int(mujoco.mjtVisFlag.__members__[name])
            option.flags[index] = not option.flags[index]
        elif name in mujoco.mjtFrame.__members__:
            option.frame = int(mujoco.mjtFrame.__members__[name])
        else:
            option.label = int(mujoco.mjtLabel.__members__[name])
    model, data = simulated(xml)
    assert data.ncon
    reason = needs_constraints(model, option)
    if reason is None:
        assert differences_of(model, data, option) == []
    else:
        assert shown[0] in reason


def test_yielded_tendon_spring_is_restored():
    """Since mujoco 4, the sag of a cable depends on its history."""
    xml = TENDONS.replace(
        "<spatial><site",
        '<spatial springlength="0 .4" stiffness="1" springyield="1"><site',
    )
    try:
        model, data = simulated(xml)
    except ValueError:
        pytest.skip("no plastic tendons before mujoco 4")
    data.plastic[1] = 0.9
    assert differences_of(model, data) == []


@pytest.mark.parametrize(
    ("xml", "field", "words"),
    [
        (SHOWCASE, "", ""),
        (SHOWCASE, "geom_xpos", "pos of geom"),
        (SHOWCASE, "light_xpos", "pos of light"),
        (SHOWCASE, "cam_xpos", "pos of light 0"),
        (SHOWCASE, "flexvert_xpos", "pos of geom"),
        (TENDONS, "wrap_xpos", "number of geoms"),
        (TENDONS, "tendon_rgba", "rgba of geom"),
        (SHOWCASE, "sensordata", "geom"),
        (SHOWCASE, "xquat", "skin"),
    ],
)
def test_self_check_notices_a_missing_field(xml, field, words):
    """Later versions of MuJoCo may read more fields; the check itself writes none."""
    model, data = simulated(xml)
    shown = view(model, None)
    if field == "cam_xpos":
        shown.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        shown.camera.fixedcamid = 0
    row = row_of(model, data)
    if field == "tendon_rgba" and (row[field] == model.tendon_rgba).all():
        pytest.skip("this MuJoCo does not color tendons at their limits")
    row = changed(row, **{field: None})
    before = model.tendon_rgba.copy(), read_state(model, data), data.geom_xpos.copy()
    found = scene_difference(model, data, row, shown)
    assert words in (found or "")
    assert (found is None) == (words == "")
    after = model.tendon_rgba, read_state(model, data), data.geom_xpos
    assert all(map(np.array_equal, before, after))
