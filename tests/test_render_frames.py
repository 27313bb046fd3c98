# SPDX-License-Identifier: Apache-2.0
import gc
import tempfile
from fractions import Fraction

import mujoco
import mujoco.rollout
import numpy as np
import pytest
from processes import children
from rides import HEIGHT, WIDTH, move, record, start
from trajectories_by_hand import write_log

import mjrec
from mjrec.errors import InvalidArgument, NoPictures, UnknownName, UnreadableFile
from mjrec.rendering.recorded_facts import chosen_frames
from mjrec.simulation.renderer import SceneRenderer

SPEC = mujoco.mjtState.mjSTATE_FULLPHYSICS
SIZE = {"height": HEIGHT, "width": WIDTH}


@pytest.fixture(scope="module")
def ride(tmp_path_factory):
    return record(tmp_path_factory.mktemp("ride"))


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The directory of temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


# Recorded episodes


def test_a_path_or_trajectory_renders_the_recorded_frames(ride):
    before = children()
    assert np.array_equal(list(mjrec.render(str(ride.path))), ride.frames)
    loaded = mjrec.load_trajectory(ride.path)
    again = list(mjrec.render(loaded, workers=2))
    assert np.array_equal(again, ride.frames)
    assert children() == before


MEMBERS = {"lookat": [1, 0, 0.5], "distance": 3.0, "azimuth": 70, "elevation": -20}


@pytest.mark.parametrize("kind", ["name", "members", "own"])
def test_arguments_override_the_recorded_view(ride, kind):
    """Recorded visual options stay."""
    shown, option = mujoco.MjvCamera(), mujoco.MjvOption()
    for name, value in MEMBERS.items():
        setattr(shown, name, value)
    option.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = True
    camera = {"name": "side", "members": MEMBERS, "own": shown}[kind]
    view = {"height": 30, "width": 50, "quality": "draft"}
    # Frames 0, 3, 6 and the last of those recorded at 10 Hz.
    drawn = list(mjrec.render(ride.path, camera=camera, max_fps=4, **view))
    assert [frame.shape for frame in drawn] == [(30, 50, 3)] * 4
    model, data = start()
    shown = "side" if kind == "name" else shown
    with SceneRenderer(model, camera=shown, scene_option=option, **view) as renderer:
        move(model, data, 0)
        assert np.array_equal(drawn[0], renderer.render(data))


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"camera": "top"}, UnknownName, r"no camera 'top'.*side, rider"),
        ({"camera": 1.5}, InvalidArgument, "camera must be a name"),
        ({"camera": {"distance": "far"}}, InvalidArgument, "distance must be a number"),
        ({"width": 0}, InvalidArgument, "width must be"),
        ({"height": 20000}, InvalidArgument, "height must be"),
        ({"camera": 7}, InvalidArgument, "Camera number 7 does not exist"),
        ({"quality": "low"}, UnknownName, "no quality 'low'"),
        ({"workers": 0}, InvalidArgument, "workers must be"),
        ({"max_fps": 0}, InvalidArgument, "positive"),
    ],
)
def test_the_call_checks_arguments_before_any_frame(
    ride, temporary, arguments, kind, message
):
    """No process or file is left."""
    before = children()
    with pytest.raises(kind, match=message):
        mjrec.render(ride.path, **arguments)
    if "max_fps" not in arguments:
        model, _ = start()
        with pytest.raises(kind, match=message):
            mjrec.render_states(model, np.zeros((2, 3)), SPEC, **{**SIZE, **arguments})
    assert children() == before
    assert list(temporary.iterdir()) == []


def test_anything_but_a_recording_with_snapshots_is_an_error(tmp_path):
    with pytest.raises(UnreadableFile, match=r"lost\.h5"):
        mjrec.render(tmp_path / "lost.h5")
    with pytest.raises(NoPictures, match="no snapshots"):
        mjrec.render(write_log(tmp_path, frames=False, scene=None))
    with pytest.raises(InvalidArgument, match="trajectory must be a path"):
        mjrec.render(3)


@pytest.mark.parametrize(
    ("count", "max_fps", "chosen"),
    [
        (9, None, [*range(9)]),
        (9, 60, [*range(9)]),
        (9, 9.99, [0, 2, 4, 6, 8]),
        (8, 5, [0, 2, 4, 6, 7]),
        (8, Fraction(1, 2), [0, 7]),
        (0, 1, []),
    ],
)
def test_max_fps_chooses_every_nth_frame_and_the_last(count, max_fps, chosen):
    facts = {"rate": "20", "stride": 2}
    assert chosen_frames(count, facts, max_fps).indices == chosen
    # A process killed before its second step has recorded no rate.
    with pytest.raises(InvalidArgument, match="Omit max_fps"):
        chosen_frames(2, {}, 30)
    assert chosen_frames(1, {}, 30).indices == [0]


# Given states


def test_states_render_as_with_mujoco_and_leave_no_file(temporary):
    model, data = start()
    states = np.empty((7, mujoco.mj_stateSize(model, int(SPEC))))
    shown = []
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for number, row in enumerate(states):
            move(model, data, number)
            mujoco.mj_getState(model, data, row, int(SPEC))
            renderer.update_scene(data, "rider")
            shown.append(renderer.render())
    view = {"camera": "rider", **SIZE}
    for workers in (1, 3):
        frames = mjrec.render_states(model, states, SPEC, workers=workers, **view)
        assert np.array_equal(list(frames), shown)
    # The generator is dropped before its end.
    frames = mjrec.render_states(model, states, SPEC, **view)
    next(frames)
    assert len(list(temporary.iterdir())) == 1
    del frames
    gc.collect()
    assert list(temporary.iterdir()) == []
