# SPDX-License-Identifier: Apache-2.0
"""The states of a simulation, as a recorder asks for them."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from touch_grid import TOUCH_GRID

from mjrec.errors import ClosedError, PicturesDiffer
from mjrec.simulation.episode_states import EpisodeStates
from mjrec.simulation.gathering import WORDS
from mjrec.simulation.integration_state import STATE_SPEC
from mjrec.simulation.model_fields import apply_fields
from mjrec.simulation.model_store import load_model
from mjrec.simulation.scene_check import differences
from mjrec.simulation.scene_view import SceneView, scene_view_from_facts
from mjrec.simulation.snapshot import restore_snapshot
from mjrec.simulation.state_source import EpisodeStart, StateSource

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
    """What an environment has, and a recorder of its states."""

    is_unmoved = False

    def __init__(self, directory: Path, xml: str = BALL, **options: Any) -> None:
        self.camera, self.option = mujoco.MjvCamera(), mujoco.MjvOption()
        self.directory = directory
        self.fresh = options.pop("fresh", False)
        self.compile(xml)
        mujoco.mjv_defaultFreeCamera(self.model, self.camera)
        self.states = EpisodeStates(
            lambda: (self.model, self.data), view=self.view, **options
        )
        self.states.open(directory)

    def compile(self, xml: str, plane: str = "2 2 .1") -> None:
        self.model = mujoco.MjModel.from_xml_string(xml.format(plane=plane))
        self.data = mujoco.MjData(self.model)
        self.step()

    def view(self) -> SceneView:
        return SceneView(
            camera=self.camera,
            option=self.option,
            max_geom=100,
            fresh=self.fresh,
            height=48,
            width=64,
            label=-1,
        )

    def step(self, count: int = 1) -> None:
        self.data.ctrl[:] = 5
        mujoco.mj_step(self.model, self.data, nstep=count)

    def begin(self) -> EpisodeStart:
        self.start = self.states.begin_episode()
        self.row = np.zeros(self.start.snapshot.size, np.uint8)
        return self.start

    def capture(self) -> Any:
        return self.states.capture_snapshot(self.row)


@pytest.fixture
def simulation(tmp_path: Path) -> Iterator[Simulation]:
    made = Simulation(tmp_path)
    yield made
    made.states.finish()
    made.states.close()


def test_it_is_a_state_source(simulation: Simulation) -> None:
    """Type checkers compare the signatures; this compares the names."""
    source: StateSource = simulation.states
    assert all(hasattr(source, n) for n in vars(StateSource) if not n.startswith("_"))


def test_a_state_is_the_integration_state(simulation: Simulation) -> None:
    """Byte for byte, its components by name."""
    start = simulation.begin()
    expected = np.empty(mujoco.mj_stateSize(simulation.model, STATE_SPEC))
    for _ in range(3):
        simulation.step()
        state = np.empty_like(expected)
        simulation.states.capture_state(state)
        mujoco.mj_getState(simulation.model, simulation.data, expected, STATE_SPEC)
        assert state.tobytes() == expected.tobytes()
    offsets = {component.name: component.offset for component in start.state}
    assert expected[offsets["qpos"]] == simulation.data.qpos[0]


@pytest.fixture
def still(tmp_path: Path) -> Iterator[Simulation]:
    """One that tells whether its view has moved."""
    made = Simulation(tmp_path, is_unmoved=lambda: made.is_unmoved)
    made.is_unmoved = True
    yield made
    made.states.finish()
    made.states.close()


def test_its_memory_holds_what_is_captured(still: Simulation) -> None:
    """State and snapshot, for as long as nothing else has changed."""
    memory = still.begin().memory
    assert memory is not None
    state = np.empty(mujoco.mj_stateSize(still.model, STATE_SPEC))
    for _ in range(3):
        still.step()
        assert memory.is_current()
        row = WORDS.take(memory.words).tobytes()
        still.states.capture_state(state)
        assert still.capture() is None
        assert row == state.tobytes() + still.row.tobytes()
    assert still.begin().memory is not None


def test_its_memory_is_not_current_while_anything_else_has_changed(
    still: Simulation,
) -> None:
    """A field of the model, the view, or what `model_changed` says."""
    memory = still.begin().memory
    assert memory is not None
    still.model.geom_rgba[0] = (1, 0, 0, 1)
    assert not memory.is_current()
    assert list(still.capture()) == ["geom_rgba"]
    assert memory.is_current()
    still.is_unmoved = False
    assert not memory.is_current()
    still.is_unmoved = True
    assert memory.is_current()
    still.states.model_changed()
    assert not memory.is_current()


def test_there_is_no_such_memory_where_a_closer_look_is_needed(
    simulation: Simulation,
) -> None:
    """Nobody tells here whether the view has moved."""
    assert simulation.begin().memory is None


def test_a_picture_follows_from_what_was_recorded(simulation: Simulation) -> None:
    """The stored model, facts and a row give the scene of that moment."""
    simulation.option.flags[int(mujoco.mjtVisFlag.mjVIS_INERTIA)] = True
    simulation.model.geom_rgba[0] = (1, 0, 0, 1)
    start = simulation.begin()
    simulation.step(7)
    assert simulation.capture() is None
    simulation.states.finish()
    assert start.refusal is None
    assert start.scene is not None
    model = load_model(simulation.directory, start.model)
    _check_scene(simulation, model, simulation.view(), start)


def _check_scene(
    simulation: Simulation,
    model: mujoco.MjModel,
    live_view: SceneView,
    start: EpisodeStart,
    fields: Any = (),
) -> None:
    assert start.scene is not None
    view = scene_view_from_facts(start.scene)
    apply_fields(model, dict(fields), camera=view.camera, option=view.option)
    data = mujoco.MjData(model)
    restore_snapshot(start.snapshot.unpack(simulation.row), model, data)
    live = _scene(simulation.model, simulation.data, live_view)
    again = _scene(model, data, view)
    assert list(differences(live, again, view.option)) == []


def _scene(
    model: mujoco.MjModel, data: mujoco.MjData, view: SceneView
) -> mujoco.MjvScene:
    scene = mujoco.MjvScene(model, maxgeom=view.max_geom)
    _update(scene, model, data, view)
    return scene


def _update(
    scene: mujoco.MjvScene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    view: SceneView,
) -> None:
    mujoco.mjv_updateScene(model, data, view.option, None, view.camera, 7, scene)


def test_changes_of_model_and_view_are_told_once(simulation: Simulation) -> None:
    """Colours, headlight, gravity, camera and option, at the next capture."""
    start = simulation.begin()
    assert simulation.capture() is None
    simulation.model.site_rgba[0] = (0, 1, 0, 1)
    simulation.model.vis.headlight.ambient[:] = 0.5
    simulation.model.opt.gravity[2] = -1
    simulation.model.stat.extent = 3
    simulation.camera.lookat[0] = 2
    simulation.option.flags[int(mujoco.mjtVisFlag.mjVIS_TRANSPARENT)] = True
    changed = simulation.capture()
    assert changed.keys() == {
        *("site_rgba", "vis.headlight.ambient", "opt.gravity", "stat.extent"),
        *("camera.lookat", "option.flags"),
    }
    assert simulation.capture() is None
    simulation.states.finish()
    model = load_model(simulation.directory, start.model)
    _check_scene(simulation, model, simulation.view(), start, changed)


def test_a_texture_is_looked_at_when_somebody_says_so(simulation: Simulation) -> None:
    """And at the next reset, without a word."""
    simulation.begin()
    simulation.model.tex_data[5] ^= 1
    assert simulation.capture() is None
    simulation.states.model_changed()
    assert simulation.capture().keys() == {"tex_data"}
    assert simulation.capture() is None
    assert simulation.begin().model_fields.keys() == {"tex_data"}
    assert simulation.capture() is None
    simulation.model.tex_data[5] ^= 1
    assert simulation.begin().model_fields == {}


def test_the_model_is_stored_once_and_differences_are_told(
    simulation: Simulation,
) -> None:
    """Every episode says in what its model is other than the stored one."""
    first = simulation.begin()
    assert first.model_fields == {}
    simulation.model.body_pos[1] = (1, 2, 3)
    second = simulation.begin()
    assert second.model == first.model
    assert second.model_fields["body_pos"][1].tolist() == [1, 2, 3]
    assert simulation.capture() is None
    simulation.states.finish()
    assert len(list(simulation.directory.iterdir())) == 1


def test_a_model_that_consists_of_other_things_is_stored_anew(
    simulation: Simulation,
) -> None:
    """What cannot be set from a recording is never a difference in one."""
    first = simulation.begin()
    simulation.model.geom_type[1] = int(mujoco.mjtGeom.mjGEOM_BOX)
    second = simulation.begin()
    assert second.model != first.model
    assert second.model_fields == {}
    simulation.model.geom_type[1] = int(mujoco.mjtGeom.mjGEOM_SPHERE)
    with pytest.raises(PicturesDiffer, match="geom_type of the model has changed"):
        simulation.capture()


def test_a_recompiled_model_is_another_one(simulation: Simulation) -> None:
    """As in composer environments, at every reset; captures follow the new data."""
    first = simulation.begin()
    simulation.compile(BALL.replace('size=".1"', 'size=".2"'))
    second = simulation.begin()
    assert second.model != first.model
    simulation.step(3)
    simulation.capture()
    values = second.snapshot.unpack(simulation.row)
    assert np.array_equal(values["geom_xpos"], simulation.data.geom_xpos)
    simulation.compile(BALL)
    assert simulation.begin().model == first.model


def test_another_model_in_mid_episode_is_an_error(simulation: Simulation) -> None:
    """What is recorded would be of two models."""
    simulation.begin()
    simulation.compile(BALL)
    with pytest.raises(PicturesDiffer, match="gone over to another model"):
        simulation.capture()
    with pytest.raises(PicturesDiffer, match="gone over to another model"):
        simulation.states.capture_state(np.empty(8))


def test_other_data_of_the_same_model_is_followed(simulation: Simulation) -> None:
    """Captures are of the data that the environment has at that moment."""
    start = simulation.begin()
    simulation.data = mujoco.MjData(simulation.model)
    simulation.data.qpos[0] = 0.75
    mujoco.mj_forward(simulation.model, simulation.data)
    assert simulation.capture() is None
    values = start.snapshot.unpack(simulation.row)
    assert np.array_equal(values["geom_xpos"], simulation.data.geom_xpos)


FLAGS = ("CONTACTPOINT", "CONTACTFORCE", "CONTACTSPLIT", "ISLAND")


@pytest.mark.parametrize("flag", FLAGS)
def test_what_only_constraints_tell_is_refused(
    simulation: Simulation, flag: str
) -> None:
    """States are still recorded, and what changes in the model still told."""
    index = int(mujoco.mjtVisFlag.__members__[f"mjVIS_{flag}"])
    if flag == "ISLAND" and hasattr(mujoco.mjtEnableBit, "mjENBL_ISLAND"):
        simulation.model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ISLAND)
    simulation.option.flags[index] = True
    start = simulation.begin()
    assert f"mjVIS_{flag} of the visual options" in (start.refusal or "")
    assert start.scene is None
    assert start.snapshot.fields == ()
    assert start.state
    assert simulation.states.changed_fields() is None
    simulation.model.geom_rgba[0] = 0.5
    assert (simulation.states.changed_fields() or {}).keys() == {"geom_rgba"}
    with pytest.raises(PicturesDiffer, match=flag):
        simulation.capture()
    simulation.option.flags[index] = False
    assert simulation.begin().refusal is None


def test_an_option_that_snapshots_cannot_follow_is_an_error(
    simulation: Simulation,
) -> None:
    """Turned on in mid-episode it is too late for another row."""
    simulation.begin()
    inertia = int(mujoco.mjtVisFlag.mjVIS_INERTIA)
    simulation.option.flags[inertia] = True
    with pytest.raises(PicturesDiffer, match="xipos"):
        simulation.capture()
    assert simulation.begin().refusal is None
    assert simulation.capture() is None
    simulation.option.frame = int(mujoco.mjtFrame.mjFRAME_CONTACT)
    with pytest.raises(PicturesDiffer, match="mjFRAME_CONTACT"):
        simulation.capture()


def test_an_obstacle_is_a_refusal_and_in_mid_episode_an_error(tmp_path: Path) -> None:
    """Markers in a viewer, for example."""
    obstacles: list[str] = ["there is a marker"]
    simulation = Simulation(
        tmp_path, obstacle=lambda: obstacles[0] if obstacles else None
    )
    assert simulation.begin().refusal == "there is a marker"
    obstacles.clear()
    assert simulation.begin().refusal is None
    assert simulation.capture() is None
    obstacles.append("there is an arrow")
    with pytest.raises(PicturesDiffer, match=r'there is an arrow.*render="live"'):
        simulation.capture()


def test_a_plugin_that_draws_is_refused_by_name(tmp_path: Path) -> None:
    """Before it has drawn anything."""
    simulation = Simulation(tmp_path, TOUCH_GRID)
    assert "mujoco.sensor.touch_grid draws" in (simulation.begin().refusal or "")


def test_a_field_that_is_forgotten_is_refused(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first picture is compared, whatever the reason for a difference is."""
    monkeypatch.setattr("mjrec.simulation.snapshot._ALWAYS", ("geom_xmat",))
    assert "the scene is another one" in (simulation.begin().refusal or "")


def test_a_picture_is_taken_when_the_environment_would_draw(tmp_path: Path) -> None:
    """What a render callback moves is in the picture, and put back afterwards."""
    calls = []

    def at_picture(capture: Callable[[], None]) -> None:
        kept = simulation.data.geom_xpos.copy()
        simulation.data.geom_xpos[1] = (7, 8, 9)
        capture()
        calls.append(1)
        simulation.data.geom_xpos[:] = kept

    simulation = Simulation(tmp_path, at_picture=at_picture)
    start = simulation.begin()
    assert len(calls) == 1, "the check is of such a picture too"
    assert simulation.capture() is None
    values = start.snapshot.unpack(simulation.row)
    assert values["geom_xpos"][1].tolist() == [7, 8, 9]
    assert simulation.data.geom_xpos[1].tolist() != [7, 8, 9]


def _recorded_and_live(simulation: Simulation, pictures: int) -> None:
    """Compare scenes that stay, picture by picture: a live and a recorded one."""
    start = simulation.begin()
    assert start.scene is not None
    own = simulation.view()
    camera, option = copy.copy(own.camera), copy.copy(own.option)
    live_view = dataclasses.replace(own, camera=camera, option=option)
    live = mujoco.MjvScene(simulation.model, maxgeom=100)
    view = scene_view_from_facts(start.scene)
    model = copy.copy(simulation.model)
    data = mujoco.MjData(model)
    again = mujoco.MjvScene(model, maxgeom=100)
    for _ in range(pictures):
        simulation.step(30)
        changed = simulation.capture() or {}
        _update(live, simulation.model, simulation.data, live_view)
        apply_fields(model, changed, camera=view.camera, option=view.option)
        restore_snapshot(start.snapshot.unpack(simulation.row), model, data)
        _update(again, model, data, view)
        assert list(differences(live, again, view.option)) == []
    left = [camera.pos.tolist() for camera in live.camera]
    assert simulation.states.begin_episode().scene["previous_cameras"] == left  # type: ignore[index]  # there is one


def _track(simulation: Simulation) -> None:
    simulation.camera.type = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
    simulation.camera.trackbodyid = 1


def test_an_infinite_plane_remembers_the_camera_before(simulation: Simulation) -> None:
    """It is said what the last picture of the episode before has left in the scene."""
    simulation.compile(BALL, plane="0 0 1")
    simulation.camera.type = int(mujoco.mjtCamera.mjCAMERA_FIXED)
    simulation.camera.fixedcamid = 0
    scene = simulation.begin().scene
    assert scene is not None
    assert scene["previous_cameras"] is None
    _recorded_and_live(simulation, 3)


def test_pictures_before_can_be_forgotten(simulation: Simulation) -> None:
    """Then an episode begins in a scene that nothing has been drawn in."""
    simulation.compile(BALL, plane="0 0 1")
    simulation.begin()
    simulation.capture()
    after = simulation.begin().scene
    assert after is not None
    assert after["previous_cameras"] is not None
    simulation.states.forget_pictures()
    scene = simulation.begin().scene
    assert scene is not None
    assert scene["previous_cameras"] is None


def test_only_infinite_planes_in_scenes_that_stay_remember(tmp_path: Path) -> None:
    """A plane with edges does not, nor does a scene that is made for each picture."""
    for plane, fresh in (("2 2 1", False), ("0 0 1", True)):
        simulation = Simulation(tmp_path, fresh=fresh)
        simulation.compile(BALL, plane=plane)
        simulation.begin()
        simulation.capture()
        scene = simulation.begin().scene
        assert scene is not None
        assert scene["previous_cameras"] is None


def test_a_camera_that_tracks_moves_from_picture_to_picture(
    simulation: Simulation,
) -> None:
    """Each picture moves it a fifth of the way; where to is part of the recording."""
    _track(simulation)
    before = simulation.camera.lookat.copy()
    _recorded_and_live(simulation, 4)
    assert np.array_equal(simulation.camera.lookat, before), "the user's own stays"
    scene = simulation.begin().scene
    assert scene is not None
    assert scene["camera"]["lookat"] != before.tolist()


def test_nothing_is_written_to_the_simulation(simulation: Simulation) -> None:
    """Model and data are the same bytes before and after."""
    _track(simulation)
    model, data = simulation.model, simulation.data
    arrays = [getattr(data, n) for n in dir(data) if not n.startswith("_")]
    arrays = [a for a in arrays if isinstance(a, np.ndarray)]
    before = [array.tobytes() for array in arrays]
    kept = copy.copy(model)
    simulation.begin()
    simulation.capture()
    assert [array.tobytes() for array in arrays] == before
    buffers = []
    for each in (model, kept):
        buffer = np.empty(mujoco.mj_sizeModel(each), np.uint8)
        mujoco.mj_saveModel(each, None, buffer)
        buffers.append(buffer.tobytes())
    assert buffers[0] == buffers[1]


def test_an_episode_is_the_same_with_and_without_captures(tmp_path: Path) -> None:
    """Observations of a real environment do not depend on being recorded."""

    def observations(*, recorded: bool) -> list[bytes]:
        with gymnasium.make("HalfCheetah-v5") as env:
            base: Any = env.unwrapped
            observation, _ = env.reset(seed=3)
            found = [observation.tobytes()]
            simulation = Simulation(tmp_path)
            simulation.model, simulation.data = base.model, base.data
            if recorded:
                assert simulation.begin().refusal is None
            env.action_space.seed(0)
            for _ in range(20):
                observation, *_ = env.step(env.action_space.sample())
                found.append(observation.tobytes())
                if recorded:
                    assert simulation.capture() is None
            simulation.states.finish()
            return found

    assert observations(recorded=True) == observations(recorded=False)


@pytest.mark.dm_control
def test_dm_controls_objects_are_as_good_as_mujocos(tmp_path: Path) -> None:
    """Its wrappers are seen through, and its option draws no range finders."""
    suite = pytest.importorskip("dm_control.suite")
    physics = suite.load("cartpole", "balance").physics
    option = mujoco.MjvOption()
    option.flags[int(mujoco.mjtVisFlag.mjVIS_RANGEFINDER)] = False
    simulation = Simulation(tmp_path, fresh=True)
    simulation.model, simulation.data = physics.model, physics.data
    simulation.option = option
    start = simulation.begin()
    assert start.refusal is None
    assert start.scene is not None
    index = int(mujoco.mjtVisFlag.mjVIS_RANGEFINDER)
    assert start.scene["option"]["flags"][index] == 0
    physics.step()
    assert simulation.capture() is None
    values = start.snapshot.unpack(simulation.row)
    assert np.array_equal(values["geom_xpos"], physics.data.ptr.geom_xpos)


def test_what_belongs_around_a_reset_is_passed_on(tmp_path: Path) -> None:
    """It is the environment's own affair."""
    inside = []

    @contextlib.contextmanager
    def resetting() -> Iterator[None]:
        inside.append(1)
        yield

    with Simulation(tmp_path, resetting=resetting).states.resetting():
        assert inside
    with Simulation(tmp_path).states.resetting():
        pass


def test_calls_out_of_turn_are_errors(simulation: Simulation) -> None:
    """Nothing can be captured before an episode begins, or after the end."""
    out = np.zeros(8, np.uint8)
    states = simulation.states
    with pytest.raises(ClosedError, match="begin_episode"):
        states.capture_state(np.empty(8))
    with pytest.raises(ClosedError, match="begin_episode"):
        states.changed_fields()
    with pytest.raises(ClosedError, match="begin_episode"):
        states.capture_snapshot(out)
    simulation.begin()
    simulation.states.close()
    simulation.states.close()
    with pytest.raises(ClosedError, match="begin_episode"):
        simulation.capture()
    unopened = EpisodeStates(simulation.states._simulation, view=simulation.view)
    with pytest.raises(ClosedError, match="open"):
        unopened.begin_episode()


def test_no_opengl_is_needed() -> None:
    """Not even its library is loaded."""
    code = f"""
import os, pathlib, sys, tempfile
os.environ["MUJOCO_GL"] = "disable"
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_episode_states import Simulation
simulation = Simulation(pathlib.Path(tempfile.mkdtemp()))
assert simulation.begin().refusal is None
simulation.capture()
simulation.states.finish()
maps = open("/proc/self/maps").read()
assert "libEGL" not in maps and "libOSMesa" not in maps, "OpenGL was loaded"
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
