# SPDX-License-Identifier: Apache-2.0
import contextlib
import random

import mujoco
import numpy as np
import pytest
from rides import FRAMES, HEIGHT, WIDTH, move, record, start

from mjrec.errors import InvalidArgument
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.rendering.pool import WorkerPool
from mjrec.rendering.views import View
from mjrec.rendering.worker import trajectory_drawing
from mjrec.simulation.renderer import Canvas, SceneRenderer


@pytest.fixture(scope="module")
def ride(tmp_path_factory):
    return record(tmp_path_factory.mktemp("ride"))


@pytest.fixture
def drawing(ride):
    drawing = trajectory_drawing(ride.path, View())
    yield drawing
    drawing.close()


ORDER = [*range(FRAMES), *reversed(range(FRAMES)), 4, 4]


@pytest.mark.parametrize("order", [range(FRAMES), ORDER, [0], [4], [FRAMES - 1]])
def test_frames_are_those_that_were_seen(ride, drawing, order):
    """In any order, byte for byte, over an infinite plane; the model changes back."""
    if order is ORDER:
        random.Random(0).shuffle(ORDER)
    assert drawing.size == (HEIGHT, WIDTH)
    drawn = [drawing.draw(number) for number in order]
    assert all(frame.std() > 5 for frame in drawn)
    assert np.array_equal(drawn, [ride.frames[number] for number in order])
    for number in (FRAMES, -1):
        with pytest.raises(InvalidArgument, match="there are 9"):
            drawing.draw(number)


def test_a_grid_is_what_each_camera_shows(ride, tmp_path):
    """Byte for byte, in any order; and so it is where the log has become HDF5."""
    side = record(tmp_path, camera="side")
    path = finish_trajectory(side.path)
    cameras = [None, "rider", "side"]
    with contextlib.closing(trajectory_drawing(path, View(), cameras=cameras)) as grid:
        assert grid.size == (2 * HEIGHT, 2 * WIDTH)
        for number in (*range(FRAMES), 3, 7, 0):
            frame = grid.draw(number)
            upper, lower = frame[:HEIGHT], frame[HEIGHT:]
            np.testing.assert_array_equal(upper[:, :WIDTH], side.frames[number])
            np.testing.assert_array_equal(upper[:, WIDTH:], ride.frames[number])
            np.testing.assert_array_equal(lower[:, :WIDTH], side.frames[number])
            assert not lower[:, WIDTH:].any()


@pytest.mark.thorough
def test_a_camera_that_follows_does_not_depend_on_the_order(ride):
    """Each frame moves it: those that another worker draws count too."""
    tracking = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
    view = View(
        camera={"type": tracking, "trackbodyid": 1, "distance": 4, "elevation": -30}
    )
    with contextlib.closing(trajectory_drawing(ride.path, view)) as drawing:
        frames = [drawing.draw(number) for number in range(FRAMES)]
        for number in (4, 2, 8, 0, 0, 5, 7):
            np.testing.assert_array_equal(drawing.draw(number), frames[number])
    with WorkerPool(2) as workers:
        drawn = list(workers.frames(ride.path, range(FRAMES), view))
    np.testing.assert_array_equal(drawn, frames)
    assert len({frame.tobytes() for frame in frames}) == FRAMES


def test_the_plane_depends_on_the_picture_before(ride, tmp_path):
    """Or the tests above would show nothing of it; fresh scenes do not depend."""
    fresh = record(tmp_path, fresh=True)
    assert not np.array_equal(fresh.frames[4], ride.frames[4])

    drawing = trajectory_drawing(fresh.path, View())
    for number in (*range(FRAMES), 4, 2):
        assert np.array_equal(drawing.draw(number), fresh.frames[number])
    drawing.close()


def test_the_context_is_kept_from_drawing_to_drawing(ride):
    """The first has changed its terrain, a texture and a plane; the next sees none."""
    other = View(height=30, quality="draft")
    with contextlib.closing(Canvas()) as canvas:
        for view in (View(), other, View()):
            drawing = trajectory_drawing(ride.path, view, canvas=canvas)
            drawn = [drawing.draw(number) for number in range(FRAMES)]
            drawing.close()
            # What is not asked for is as recorded.
            assert drawn[0].shape == (view.height or HEIGHT, WIDTH, 3)
            assert np.array_equal(drawn, ride.frames) == (view != other)


MEMBERS = {"lookat": [1, 0, 0.5], "distance": 3.0, "azimuth": 70, "elevation": -20}


@pytest.mark.parametrize("camera", ["side", MEMBERS])
def test_another_view_takes_the_place_of_the_recorded_one(ride, camera):
    """Camera, by its name or its members, size and quality; visual options stay."""
    view = View(camera=camera, height=30, width=50, quality="draft")
    with contextlib.closing(trajectory_drawing(ride.path, view)) as drawing:
        drawn = [drawing.draw(number) for number in (2, 0, 1)]
    shown = camera
    if isinstance(camera, dict):
        shown = mujoco.MjvCamera()
        for name, value in camera.items():
            setattr(shown, name, value)
    model, data = start()
    with SceneRenderer(
        model,
        height=30,
        width=50,
        camera=shown,
        scene_option=inertia_shown(),
        quality="draft",
    ) as renderer:
        expected = []
        for number in range(3):
            move(model, data, number)
            expected.append(renderer.render(data))
    assert np.array_equal(drawn, [expected[2], expected[0], expected[1]])


def inertia_shown():
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = True
    return option
