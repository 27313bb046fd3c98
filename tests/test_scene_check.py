# SPDX-License-Identifier: Apache-2.0
"""The check that a snapshot suffices, on the spot."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest

from mjrec.formats.trajectory import RowLayout
from mjrec.simulation.scene_check import differences, scene_difference, updated_scene
from mjrec.simulation.scene_view import SceneView
from mjrec.simulation.snapshot import SnapshotSource, snapshot_layout

XML = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="c" pos="0 -3 1"/>
    <site name="top" pos="0 0 1"/>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 .4"><freejoint/><geom size=".05"/><site name="a"/></body>
    <flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="1 0 1"
      radius=".01" dim="2"><edge equality="true"/></flexcomp>
  </worldbody>
  <tendon>
    <spatial limited="true" range="0 .5"><site site="top"/><site site="a"/></spatial>
  </tendon>
</mujoco>
"""

Simulation = tuple[mujoco.MjModel, mujoco.MjData]


@pytest.fixture
def simulation() -> Simulation:
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=3)
    return model, data


def free_view(model: mujoco.MjModel) -> SceneView:
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    return SceneView(
        camera=camera,
        option=mujoco.MjvOption(),
        max_geom=100,
        fresh=False,
        height=48,
        width=64,
        label=-1,
    )


def checked(
    simulation: Simulation, layout: RowLayout, view: SceneView | None = None
) -> str | None:
    model, data = simulation
    row = np.empty(layout.size, np.uint8)
    SnapshotSource(model, data, layout).take(row)
    return scene_difference(model, data, layout, row, view or free_view(model))


def test_a_whole_snapshot_suffices(simulation: Simulation) -> None:
    """Geoms, lights, cameras, flexes and tendons are the same to the last bit."""
    assert checked(simulation, snapshot_layout(simulation[0])) is None


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ("geom_xpos", "pos of geom"),
        ("light_xpos", "pos of light 1"),
        ("flexvert_xpos", "pos of geom"),
        ("wrap_xpos", "mat, pos, size of geom"),
    ],
)
def test_a_field_that_is_forgotten_is_noticed(
    simulation: Simulation, field: str, words: str
) -> None:
    """As one would be that only a later MuJoCo reads."""
    whole = snapshot_layout(simulation[0])
    kept = [(f.name, f.array) for f in whole.fields if f.name != field]
    assert len(kept) == len(whole.fields) - 1
    assert words in (checked(simulation, RowLayout.packed(kept)) or "")


def test_a_camera_of_the_model_is_checked(simulation: Simulation) -> None:
    """What a fixed camera sees depends on where it is."""
    view = free_view(simulation[0])
    view.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    view.camera.fixedcamid = 0
    whole = snapshot_layout(simulation[0])
    assert checked(simulation, whole, view) is None
    kept = [(f.name, f.array) for f in whole.fields if f.name != "cam_xpos"]
    assert checked(simulation, RowLayout.packed(kept), view)


def test_the_check_writes_to_nothing(simulation: Simulation) -> None:
    """Model, data and a camera that tracks are as before, and the picture the same."""
    model, data = simulation
    view = free_view(model)
    view.camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
    view.camera.trackbodyid = 1
    lookat = view.camera.lookat.copy()
    state = np.empty(mujoco.mj_stateSize(model, 0x1FFF))
    mujoco.mj_getState(model, data, state, 0x1FFF)
    before = copy.copy(model), state.copy(), data.geom_xpos.copy()
    assert checked(simulation, snapshot_layout(model), view) is None
    mujoco.mj_getState(model, data, state, 0x1FFF)
    assert np.array_equal(state, before[1])
    assert np.array_equal(data.geom_xpos, before[2])
    assert np.array_equal(model.tendon_rgba, before[0].tendon_rgba)
    assert np.array_equal(view.camera.lookat, lookat)


def test_scenes_of_other_states_differ(simulation: Simulation) -> None:
    """The comparison sees a change of one bit, and scenes of other sizes."""
    model, data = simulation
    view = free_view(model)
    live = updated_scene(model, data, view)
    assert list(differences(live, updated_scene(model, data, view), view.option)) == []
    data.geom_xpos[1, 0] = np.nextafter(np.float32(data.geom_xpos[1, 0]), np.inf)
    moved = updated_scene(model, data, view)
    assert list(differences(live, moved, view.option)) == ["pos of geom 2 of the scene"]
    model.light_active[0] = False
    view.option.geomgroup[0] = False
    found = " ".join(differences(live, updated_scene(model, data, view), view.option))
    assert "geoms instead of" in found
    assert "1 lights instead of 2" in found
