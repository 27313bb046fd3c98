# SPDX-License-Identifier: Apache-2.0
"""The states of a simulation, as a recorder asks for them."""

import copy
import dataclasses

import mujoco
import numpy as np
import pytest

from mjrec.errors import PicturesDiffer
from mjrec.simulation.capture import Capture
from mjrec.simulation.fields import apply_fields
from mjrec.simulation.model_store import load_model
from mjrec.simulation.snapshot import differences, restore_snapshot
from mjrec.simulation.view import SceneView, view_from_facts

BALL = """
<mujoco>
  <asset><texture name="t" type="2d" builtin="checker" width="64" height="64"/>
    <material name="m" texture="t"/></asset>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="c" pos="0 -3 1"/>
    <geom type="plane" size="{plane}" material="m"/>
    <body name="ball" pos="0 0 .5"><joint name="x" type="slide"/>
      <joint name="turn" type="hinge"/><geom size=".1"/><site name="s"/></body>
  </worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>
"""


class Simulation:
    """What an environment has, and what takes its states down."""

    def __init__(self, directory, xml=BALL, **options):
        self.camera, self.option = mujoco.MjvCamera(), mujoco.MjvOption()
        self.directory = directory
        self.fresh = options.pop("fresh", False)
        self.is_unmoved = True
        self.compile(xml)
        mujoco.mjv_defaultFreeCamera(self.model, self.camera)
        self.states = Capture(
            lambda: (self.model, self.data), view=self.view, **options
        )
        self.states.open(directory)

    def compile(self, xml, plane="2 2 .1"):
        self.model = mujoco.MjModel.from_xml_string(xml.format(plane=plane))
        self.data = mujoco.MjData(self.model)
        self.step()

    def view(self):
        return SceneView(
            camera=self.camera,
            option=self.option,
            max_geom=100,
            fresh=self.fresh,
            height=48,
            width=64,
            label=-1,
        )

    def step(self, count=1):
        self.data.ctrl[:] = 5
        mujoco.mj_step(self.model, self.data, nstep=count)

    def begin(self):
        self.start = self.states.begin_episode()
        kind = self.start.snapshot
        self.words = np.zeros(0 if kind is None else kind.itemsize // 8, np.uint64)
        return self.start

    @property
    def row(self):
        return self.words.view(self.start.snapshot)[0]

    def begin_scene(self):
        return self.begin().scene

    def capture(self):
        return self.states.capture_snapshot(self.words)

    def captured(self, name):
        return self.row[name]

    def shown(self, flag):
        """Show what a flag is for; return its number."""
        index = int(mujoco.mjtVisFlag.__members__[f"mjVIS_{flag}"])
        self.option.flags[index] = True
        return index


@pytest.fixture
def new(tmp_path):
    made = []

    def make(*args, **options):
        made.append(Simulation(tmp_path, *args, **options))
        return made[-1]

    yield make
    for each in made:
        each.states.finish()
        each.states.close()


@pytest.fixture
def simulation(new):
    return new()


def test_changes_of_model_and_view_are_told_once(simulation):
    """And the stored model, facts, a row and these changes give the scene."""
    simulation.shown("INERTIA")
    simulation.model.geom_rgba[0] = (1, 0, 0, 1)
    start = simulation.begin()
    assert start.refusal is None
    simulation.step(7)
    assert simulation.capture() is None
    simulation.model.site_rgba[0] = (0, 1, 0, 1)
    simulation.model.vis.headlight.ambient[:] = 0.5
    simulation.model.opt.gravity[2] = -1
    simulation.model.stat.extent = 3
    simulation.camera.lookat[0] = 2
    simulation.shown("TRANSPARENT")
    changed = simulation.capture()
    assert changed.keys() == {
        *("site_rgba", "vis.headlight.ambient", "opt.gravity", "stat.extent"),
        *("camera.lookat", "option.flags"),
    }
    assert simulation.capture() is None
    simulation.states.finish()
    model = load_model(simulation.directory, start.model)
    assert start.scene is not None
    view = view_from_facts(start.scene)
    apply_fields(model, changed, camera=view.camera, option=view.option)
    data = mujoco.MjData(model)
    restore_snapshot(simulation.row, model, data)
    live = mujoco.MjvScene(simulation.model, maxgeom=100)
    update(live, simulation.model, simulation.data, simulation.view())
    again = mujoco.MjvScene(model, maxgeom=100)
    update(again, model, data, view)
    assert list(differences(live, again, view.option)) == []


def update(scene, model, data, view):
    mujoco.mjv_updateScene(model, data, view.option, None, view.camera, 7, scene)


def test_a_model_that_consists_of_other_things_is_stored_anew(simulation):
    """In mid-episode that is an error, where it is drawn, because it cannot be set."""
    first = simulation.begin()
    simulation.model.geom_type[1] = int(mujoco.mjtGeom.mjGEOM_BOX)
    second = simulation.begin()
    assert second.model != first.model
    assert second.model_fields == {}
    simulation.model.dof_Madr[0] += 1
    assert simulation.capture() is None
    simulation.model.geom_type[1] = int(mujoco.mjtGeom.mjGEOM_SPHERE)
    with pytest.raises(PicturesDiffer, match="geom_type of the model changed"):
        simulation.capture()


def test_a_recompiled_model_is_another_one(simulation):
    """As in composer environments, at every reset; in mid-episode it is an error."""
    first = simulation.begin()
    simulation.compile(BALL.replace('size=".1"', 'size=".2"'))
    second = simulation.begin()
    assert second.model != first.model
    simulation.step(3)
    simulation.capture()
    assert np.array_equal(simulation.captured("geom_xpos"), simulation.data.geom_xpos)
    simulation.compile(BALL)
    with pytest.raises(PicturesDiffer, match="switched to another model"):
        simulation.capture()
    with pytest.raises(PicturesDiffer, match="switched to another model"):
        simulation.states.capture_state(np.empty(8))
    assert simulation.begin().model == first.model


@pytest.mark.parametrize(
    "flag", ["CONTACTPOINT", "CONTACTFORCE", "CONTACTSPLIT", "ISLAND"]
)
def test_what_only_constraints_tell_is_refused(simulation, flag):
    """States are still recorded, and what changes in the model still told."""
    if flag == "ISLAND" and hasattr(mujoco.mjtEnableBit, "mjENBL_ISLAND"):
        simulation.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ISLAND)
    index = simulation.shown(flag)
    start = simulation.begin()
    assert f"mjVIS_{flag} of the visual options" in (start.refusal or "")
    assert (start.scene, start.snapshot) == (None, None)
    assert start.state
    assert simulation.states.changed_fields() is None
    simulation.model.geom_rgba[0] = 0.5
    assert (simulation.states.changed_fields() or {}).keys() == {"geom_rgba"}
    with pytest.raises(PicturesDiffer, match=flag):
        simulation.capture()
    simulation.option.flags[index] = False
    assert simulation.begin().refusal is None


def test_an_option_that_snapshots_cannot_follow_is_an_error(simulation):
    """Turned on in mid-episode it is too late for another row."""
    simulation.begin()
    simulation.shown("INERTIA")
    with pytest.raises(PicturesDiffer, match="xipos"):
        simulation.capture()
    assert simulation.begin().refusal is None
    assert simulation.capture() is None
    simulation.option.frame = int(mujoco.mjtFrame.mjFRAME_CONTACT)
    with pytest.raises(PicturesDiffer, match="mjFRAME_CONTACT"):
        simulation.capture()


def test_a_field_that_is_forgotten_is_refused(simulation, monkeypatch):
    """The first frame is compared, whatever the reason for a difference is."""
    monkeypatch.setattr("mjrec.simulation.captured_arrays.ALWAYS", ("geom_xmat",))
    assert "drawn from its snapshot differs" in (simulation.begin().refusal or "")


def check_scenes_that_stay(simulation, frames):
    """Compare scenes that stay, frame by frame: a live and a recorded one."""
    view = view_from_facts(simulation.begin_scene())
    own = simulation.view()
    camera, option = copy.copy(own.camera), copy.copy(own.option)
    live_view = dataclasses.replace(own, camera=camera, option=option)
    live = mujoco.MjvScene(simulation.model, maxgeom=100)
    model = copy.copy(simulation.model)
    data = mujoco.MjData(model)
    again = mujoco.MjvScene(model, maxgeom=100)
    for _ in range(frames):
        simulation.step(30)
        changed = simulation.capture() or {}
        update(live, simulation.model, simulation.data, live_view)
        apply_fields(model, changed, camera=view.camera, option=view.option)
        restore_snapshot(simulation.row, model, data)
        update(again, model, data, view)
        assert list(differences(live, again, view.option)) == []
    left = [camera.pos.tolist() for camera in live.camera]
    assert simulation.begin_scene()["previous_cameras"] == left


def test_an_infinite_plane_remembers_the_camera_before(simulation):
    """An episode says what the last frame before has left, until it is forgotten."""
    simulation.compile(BALL, plane="0 0 1")
    simulation.camera.type = int(mujoco.mjtCamera.mjCAMERA_FIXED)
    simulation.camera.fixedcamid = 0
    assert simulation.begin_scene()["previous_cameras"] is None
    check_scenes_that_stay(simulation, 3)
    simulation.states.forget_frames()
    assert simulation.begin_scene()["previous_cameras"] is None


def track(simulation):
    simulation.camera.type = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
    simulation.camera.trackbodyid = 1


def test_a_camera_that_tracks_moves_from_frame_to_frame(simulation):
    """Each frame moves it a fifth of the way; where to is part of the recording."""
    track(simulation)
    before = simulation.camera.lookat.copy()
    check_scenes_that_stay(simulation, 4)
    assert np.array_equal(simulation.camera.lookat, before), "the user's own stays"
    assert simulation.begin_scene()["camera"]["lookat"] != before.tolist()
