# SPDX-License-Identifier: Apache-2.0
"""The check that a snapshot suffices, on the spot."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from touch_grid import TOUCH_GRID

from mjrec.formats.trajectory import RowLayout
from mjrec.simulation import self_check
from mjrec.simulation.captured_arrays import read_state, snapshot_layout
from mjrec.simulation.self_check import (
    differences,
    drawing_plugin,
    scene_difference,
    updated_scene,
)
from mjrec.simulation.snapshot import SnapshotSource
from mjrec.simulation.view import SceneView

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
    assert checked(simulation, snapshot_layout(*simulation)) is None


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
    whole = snapshot_layout(*simulation)
    kept = [(f.name, f.array) for f in whole.fields if f.name != field]
    assert len(kept) == len(whole.fields) - 1
    assert words in (checked(simulation, RowLayout.packed(kept)) or "")


def test_a_camera_of_the_model_is_checked(simulation: Simulation) -> None:
    """What a fixed camera sees depends on where it is."""
    view = free_view(simulation[0])
    view.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    view.camera.fixedcamid = 0
    whole = snapshot_layout(*simulation)
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
    before = model.tendon_rgba.copy(), read_state(model, data), data.geom_xpos.copy()
    assert checked(simulation, snapshot_layout(model, data), view) is None
    after = model.tendon_rgba, read_state(model, data), data.geom_xpos
    assert all(map(np.array_equal, before, after))
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


CABLE = """
<mujoco>
  <extension><plugin plugin="mujoco.elasticity.cable"/></extension>
  <worldbody>
    <composite type="cable" curve="s" count="5 1 1" size="1" initial="none">
      <plugin plugin="mujoco.elasticity.cable">
        <config key="twist" value="1e7"/><config key="bend" value="4e6"/>{}
      </plugin>
      <geom type="capsule" size=".005"/>
    </composite>
  </worldbody>
</mujoco>
"""

PID = """
<mujoco>
  <extension><plugin plugin="mujoco.pid"/></extension>
  <worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
  <actuator>
    <plugin joint="j" plugin="mujoco.pid"><config key="kp" value="4"/></plugin>
  </actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("xml", "found"),
    [
        # Its cells appear with the first contact, so that no frame tells.
        (TOUCH_GRID, "mujoco.sensor.touch_grid"),
        # With `vmax` it paints its geoms by their strain.
        (CABLE.format(""), None),
        (CABLE.format('<config key="vmax" value="0"/>'), None),
        (CABLE.format('<config key="vmax" value=".05"/>'), "mujoco.elasticity.cable"),
        (PID, None),
        ("<mujoco/>", None),
    ],
)
def test_plugins_that_draw_are_known_before_they_do(
    xml: str, found: str | None
) -> None:
    """Most do not; the one that may is asked how it was configured."""
    assert drawing_plugin(compiled(xml)) == found


def test_a_plugin_that_cannot_be_looked_at_counts_as_drawing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where MuJoCo's register cannot be read nothing is believed."""
    monkeypatch.setattr(self_check, "_library", lambda: None)
    assert "cannot be looked at" in (drawing_plugin(compiled(PID)) or "")


def compiled(xml: str) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        # mujoco 4 has no cable.
        pytest.skip(f"not in this version: {error}")
