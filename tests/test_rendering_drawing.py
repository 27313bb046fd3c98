# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
import dataclasses
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from parts import parametrize
from rides import FRAMES, HEIGHT, WIDTH, Ride, move, record, start
from trajectories_by_hand import INFIX, add_row, new_logs, write_log

from mjrec.errors import InvalidArgument, NoPictures, UnknownName, UnreadableFile
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.trajectory import Array, RowLayout, TrajectoryHeader
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.rendering.drawing import Drawing, trajectory_drawing
from mjrec.rendering.views import View
from mjrec.simulation.canvas import KeptCanvas
from mjrec.simulation.renderer import SceneRenderer


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> Ride:
    return record(tmp_path_factory.mktemp("ride"))


@pytest.fixture
def drawing(ride: Ride) -> Iterator[Drawing]:
    drawing = trajectory_drawing(ride.path, View())
    yield drawing
    drawing.close()


def test_pictures_are_those_that_were_seen(ride: Ride, drawing: Drawing) -> None:
    """Byte for byte, over an infinite plane and through changes of the model."""
    drawn = [drawing.draw(number) for number in range(FRAMES)]

    assert drawing.size == (HEIGHT, WIDTH)
    assert all(frame.std() > 5 for frame in drawn)
    assert np.array_equal(drawn, ride.frames)
    assert len({frame.tobytes() for frame in drawn}) == FRAMES


def test_the_order_does_not_matter(ride: Ride, drawing: Drawing) -> None:
    """Terrain and textures change back too, and the plane is where it was."""
    order = [*range(FRAMES), *reversed(range(FRAMES)), 4, 4]
    random.Random(0).shuffle(order)
    for number in order:
        assert np.array_equal(drawing.draw(number), ride.frames[number]), number


def test_a_picture_alone_is_the_same(ride: Ride) -> None:
    """Also the first thing that is drawn."""
    for number in (0, 4, FRAMES - 1):
        drawing = trajectory_drawing(ride.path, View())
        assert np.array_equal(drawing.draw(number), ride.frames[number])
        drawing.close()


def test_the_plane_depends_on_the_picture_before(ride: Ride, tmp_path: Path) -> None:
    """Or the tests above would show nothing of it; fresh scenes do not depend."""
    fresh = record(tmp_path, fresh=True)
    assert not np.array_equal(fresh.frames[4], ride.frames[4])

    drawing = trajectory_drawing(fresh.path, View())
    for number in (*range(FRAMES), 4, 2):
        assert np.array_equal(drawing.draw(number), fresh.frames[number])
    drawing.close()


def test_the_first_picture_comes_after_those_of_episodes_before(
    ride: Ride, tmp_path: Path
) -> None:
    """A viewer keeps its scene over resets; the recording says where it stood."""
    positions = [[41.0, 17.0, 1.5], [41.0, 17.0, 1.5]]
    scene = {**scene_of(ride), "previous_cameras": positions}
    after = record(tmp_path, facts={"scene": scene})
    model, data = start()
    move(model, data, 0)
    with SceneRenderer(
        model, height=HEIGHT, width=WIDTH, camera="rider", scene_option=inertia_shown()
    ) as renderer:
        renderer.camera_positions = positions
        expected = renderer.render(data)
    assert not np.array_equal(expected, ride.frames[0])

    drawing = trajectory_drawing(after.path, View())

    for number in (0, 1, 0):
        shown = expected if number == 0 else ride.frames[number]
        assert np.array_equal(drawing.draw(number), shown)
    drawing.close()


def test_the_context_is_kept_from_drawing_to_drawing(ride: Ride) -> None:
    """The first has changed its terrain, a texture and a plane; the next sees none."""
    other = View(height=30, width=50, quality="draft")
    with contextlib.closing(KeptCanvas()) as kept:
        canvases = []
        for view in (View(), View(), other, View()):
            drawing = trajectory_drawing(ride.path, view, kept=kept)
            drawn = [drawing.draw(number) for number in range(FRAMES)]
            canvases.append(drawing._cameras[0].renderer._canvas)
            drawing.close()
            if view != other:
                assert np.array_equal(drawn, ride.frames)
    assert len(set(map(id, canvases))) == 1


def test_a_finished_recording_gives_the_same(ride: Ride, tmp_path: Path) -> None:
    """HDF5 instead of the log."""
    path = finish_trajectory(record(tmp_path).path)
    drawing = trajectory_drawing(path, View())
    drawn = [drawing.draw(number) for number in range(FRAMES)]
    drawing.close()

    assert path.suffix == ".h5"
    assert np.array_equal(drawn, ride.frames)


def test_another_view_takes_the_place_of_the_recorded_one(ride: Ride) -> None:
    """Camera, size and quality; the visual options stay."""
    view = View(camera="side", height=30, width=50, quality="draft")
    drawing = trajectory_drawing(ride.path, view)
    drawn = [drawing.draw(number) for number in (2, 0, 1)]
    drawing.close()

    model, data = start()
    with SceneRenderer(
        model,
        height=30,
        width=50,
        camera="side",
        scene_option=inertia_shown(),
        quality="draft",
    ) as renderer:
        expected = []
        for number in range(3):
            move(model, data, number)
            expected.append(renderer.render(data))
    assert np.array_equal(drawn, [expected[2], expected[0], expected[1]])


def test_one_side_alone_leaves_the_other_as_recorded(ride: Ride) -> None:
    """None is as recorded, for each by itself."""
    drawing = trajectory_drawing(ride.path, View(height=20))
    assert drawing.draw(0).shape == (20, WIDTH, 3)
    drawing.close()


def test_the_recorded_quality_is_the_default(ride: Ride, tmp_path: Path) -> None:
    """A draft stays one until asked otherwise."""
    draft = record(tmp_path, facts={"video": {"quality": "draft"}})
    pictures = {}
    for quality in (None, "draft", "full"):
        drawing = trajectory_drawing(draft.path, View(quality=quality))
        pictures[quality] = drawing.draw(1)
        drawing.close()

    assert np.array_equal(pictures[None], pictures["draft"])
    assert not np.array_equal(pictures[None], pictures["full"])
    assert np.array_equal(pictures["full"], ride.frames[1])


def test_a_camera_by_its_members(ride: Ride) -> None:
    """What an `MjvCamera` holds, as JSON has it."""
    members = {"lookat": [1, 0, 0.5], "distance": 3.0, "azimuth": 70, "elevation": -20}
    camera = mujoco.MjvCamera()
    camera.lookat[:] = members["lookat"]
    camera.distance, camera.azimuth, camera.elevation = 3, 70, -20
    model, data = start()
    move(model, data, 0)
    with SceneRenderer(
        model, height=HEIGHT, width=WIDTH, camera=camera, scene_option=inertia_shown()
    ) as renderer:
        expected = renderer.render(data)

    drawing = trajectory_drawing(ride.path, View(camera=members))
    assert np.array_equal(drawing.draw(0), expected)
    drawing.close()


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("sid", "no camera 'sid'"),
        (2, "no camera number 2"),
        ({"type": 2, "fixedcamid": 5}, "fixedcamid is 5"),
        ({"type": 1}, "trackbodyid is -1"),
        ({"type": 7}, "type is free"),
    ],
)
def test_a_camera_that_the_model_lacks(ride: Ride, camera: Any, message: str) -> None:
    """One error, and no crash of MuJoCo."""
    with pytest.raises(InvalidArgument, match=message):
        trajectory_drawing(ride.path, View(camera=camera))


def test_a_picture_that_is_not_there(drawing: Drawing) -> None:
    """It says how many there are."""
    for number in (FRAMES, -1):
        with pytest.raises(InvalidArgument, match="there are 9"):
            drawing.draw(number)


def test_a_trajectory_without_snapshots(tmp_path: Path) -> None:
    """The reason of the recording is told, and another way."""
    facts = {"scene": None, "refusal": "a plugin draws"}
    path = write_log(tmp_path, frames=False, **facts)

    with pytest.raises(NoPictures, match=r"a plugin draws.*render_states"):
        trajectory_drawing(path, View())


def test_a_missing_model_is_named(tmp_path: Path) -> None:
    """It lies beside the recording, and may have been left behind."""
    ride = record(tmp_path)
    [model] = tmp_path.glob("openaigym.model.*")
    model.unlink()
    with pytest.raises(UnreadableFile, match=r"openaigym\.model\."):
        trajectory_drawing(ride.path, View())


@pytest.mark.parametrize(
    "facts",
    [
        {"scene": {"camera": 3}},
        {"model": None},
        {"model": {"sha256": "0", "mjb": "../../etc/passwd"}},
    ],
)
def test_facts_that_cannot_be(tmp_path: Path, facts: dict[str, Any]) -> None:
    """A file may be hostile: one error that names it."""
    ride = record(tmp_path, facts=facts)
    with pytest.raises(UnreadableFile, match="Cannot read"):
        trajectory_drawing(ride.path, View())


@parametrize(
    "members",
    [
        {"type": 1, "trackbodyid": 10**6},
        {"type": 2, "fixedcamid": -7},
        {"type": 77},
        {"type": 2**40},
        {"type": float("nan")},
    ],
)
def test_a_recorded_camera_that_the_model_lacks(
    ride: Ride, tmp_path: Path, members: dict[str, Any]
) -> None:
    """Also that is told of the file, and no worker falls over it."""
    scene = scene_of(ride)
    scene["camera"] = {**scene["camera"], **members}
    path = record(tmp_path, facts={"scene": scene}).path

    with (
        pytest.raises(UnreadableFile, match="camera"),
        contextlib.closing(trajectory_drawing(path, View())) as drawing,
    ):
        drawing.draw(0)


def test_snapshots_of_another_model(ride: Ride, tmp_path: Path) -> None:
    """The arrays do not fit."""
    header = header_of(ride)
    layout = RowLayout.packed([("geom_xpos", Array("<f8", (1, 3)))])
    logs, name = new_logs(tmp_path), trajectory_prefix(INFIX, 0)
    path = logs.path_of(name)
    span = logs.begin(name, dataclasses.replace(header, snapshot=layout))
    add_row(span, 0, snapshot=0)
    logs.close()
    [model] = ride.path.parent.glob("openaigym.model.*")
    (tmp_path / model.name).write_bytes(model.read_bytes())

    drawing = trajectory_drawing(path, View())
    with pytest.raises(UnreadableFile, match="geom_xpos"):
        drawing.draw(0)
    drawing.close()


def test_a_view_is_checked_when_it_is_made() -> None:
    """Before any process or file is asked for."""
    with pytest.raises(UnknownName, match="quality"):
        View(quality="best")
    with pytest.raises(InvalidArgument, match="height"):
        View(height=0)
    with pytest.raises(UnknownName, match="lookt"):
        View(camera={"lookt": [0, 0, 0]})
    with pytest.raises(InvalidArgument, match="three numbers"):
        View(camera={"lookat": [0, 0]})


def header_of(ride: Ride) -> TrajectoryHeader:
    from mjrec.formats.trajectory_file import open_trajectory

    with open_trajectory(ride.path) as reader:
        return reader.header


def scene_of(ride: Ride) -> dict[str, Any]:
    return dict(header_of(ride).facts["scene"])


def inertia_shown() -> mujoco.MjvOption:
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = True
    return option
