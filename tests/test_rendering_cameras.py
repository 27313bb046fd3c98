# SPDX-License-Identifier: Apache-2.0
"""What several cameras saw becomes a video each, or one of all side by side."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv
from recordings import frames_of
from rides import FRAMES, HEIGHT, WIDTH
from rides import record as record_ride
from trajectories_by_hand import (
    INFIX,
    Painter,
    add_row,
    grey,
    new_logs,
    write_finished,
    write_log,
    write_pending_manifest,
)

from mjrec import BlankVideo, Monitor, UnreadableFile, recover
from mjrec.annotation import Caption, annotated
from mjrec.formats.frame_hashes import frame_hash_path
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.trajectory import StateComponent
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.video_metadata import is_done, metadata_path
from mjrec.rendering import again, shared_pool
from mjrec.rendering.again import Variant, render_again
from mjrec.rendering.captions import Captions
from mjrec.rendering.drawing import trajectory_drawing
from mjrec.rendering.finishing import EpisodeFinisher, finish_pending
from mjrec.rendering.pending import EpisodeKey, look_at
from mjrec.rendering.pool import WorkerPool
from mjrec.rendering.recorded_facts import open_for_rendering
from mjrec.rendering.videos import render_video
from mjrec.rendering.views import View

STEM = "openaigym.video.0.7.video000000"
FIRST, SIDE, SECOND = (f"{STEM}{part}.mp4" for part in ("", ".side", ".camera3"))
CAMERAS = [None, "side", {"distance": 2.0}]
KEY = EpisodeKey(INFIX, 0)


class Cameras(Painter):
    """Draws what each camera shows in a brightness of its own."""

    def __init__(self, count: int = 1, **options: Any) -> None:
        super().__init__(**options)
        self.broken_camera: Any = ""
        self.tiles: list[Any] = []

    def frames(
        self,
        trajectory: Path,
        indices: Any,
        view: View | None = None,
        *,
        cameras: Any = None,
    ) -> Any:
        camera = (view or View()).camera
        self.tiles.append(cameras)
        brighter = 0 if camera is None else 5
        for number, frame in enumerate(super().frames(trajectory, indices, view)):
            if number == 2 and camera == self.broken_camera:
                raise KeyboardInterrupt
            yield frame | brighter

    def __enter__(self) -> Cameras:
        return self

    def __exit__(self, *error: object) -> None: ...


def promise(**more: Any) -> dict[str, Any]:
    """Return facts of a trajectory: what it says of its video."""
    return {"name": FIRST, "recording": "deferred", **more}


def metadata_of(video: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(metadata_path(video).read_text())
    return content


def hashes_of(video: Path) -> list[str]:
    lines = frame_hash_path(video).read_text().splitlines()
    return [line.split(",")[-1].strip() for line in lines if not line.startswith("#")]


def write_with_cameras(directory: Path, cameras: Any = CAMERAS, **more: Any) -> Path:
    return rewritten(write_finished, directory, cameras=cameras, **more)


def rewritten(write: Callable[..., Path], directory: Path, **more: Any) -> Path:
    """Write a trajectory whose video is promised with more facts."""
    # The facts behind the named ones count.
    return write(directory, video=None, scene={"label": "eye"}, promise=more)


@pytest.fixture(autouse=True)
def promises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `write_log` write what a recorder says of several cameras."""
    import trajectories_by_hand

    usual = trajectories_by_hand.TrajectoryHeader

    def header(*, facts: Mapping[str, Any], **rest: Any) -> Any:
        said = dict(facts)
        if "promise" in said:
            said["video"] = promise(**said.pop("promise"))
        return usual(facts=said, **rest)

    monkeypatch.setattr(trajectories_by_hand, "TrajectoryHeader", header)


def test_each_camera_has_a_video(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """Of all frames, with metadata and frame hashes of its own."""
    trajectory = write_with_cameras(tmp_path)
    painter = Cameras()
    file = render_video(trajectory, workers=painter)
    assert file is not None
    assert file.path.name == FIRST
    assert names(tmp_path) == sorted(
        [
            trajectory.name,
            *(
                f"{name.removesuffix('mp4')}{end}"
                for name in (FIRST, SIDE, SECOND)
                for end in ("mp4", "meta.json", "framehash")
            ),
        ]
    )
    first, side, second = (metadata_of(tmp_path / n) for n in (FIRST, SIDE, SECOND))
    assert first["camera"] == "eye"
    assert first["further_videos"] == [SIDE, SECOND]
    assert (side["camera"], second["camera"]) == ("side", {"distance": 2.0})
    assert side["first_video"] == FIRST
    assert side["frame_count"] == first["frame_count"] == 5
    assert side["file_sha256"] != first["file_sha256"]
    assert "annotated" not in first


def test_the_first_cameras_video_is_the_last(tmp_path: Path) -> None:
    """Where it is, the episode is done."""
    painter = Cameras()
    render_video(write_with_cameras(tmp_path), workers=painter)
    views = [view.camera for _, _, view in painter.asked]
    assert views == ["side", {"distance": 2.0}, None]


def test_all_side_by_side_are_one_video(tmp_path: Path) -> None:
    """The workers are asked for the grid; the first camera is as it was recorded."""
    painter = Cameras()
    trajectory = write_with_cameras(tmp_path, tiled=True)
    file = render_video(trajectory, workers=painter)
    assert file is not None
    assert painter.tiles == [(None, "side", {"distance": 2.0})]
    assert [path.name for path in tmp_path.glob("*.mp4")] == [FIRST]
    metadata = metadata_of(file.path)
    assert metadata["tiled"] is True
    assert metadata["camera"] == ["eye", "side", {"distance": 2.0}]
    assert (metadata["rows"], metadata["columns"]) == (2, 2)


@pytest.mark.parametrize("camera", [None, "side", {"distance": 2.0}])
def test_an_interruption_leaves_nothing(
    camera: Any, tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """Whichever camera's video it comes in."""
    trajectory = write_with_cameras(tmp_path)
    painter = Cameras()
    painter.broken_camera = camera
    with pytest.raises(KeyboardInterrupt):
        render_video(trajectory, workers=painter)
    assert names(tmp_path) == [trajectory.name]


def test_blank_videos_stop_no_other(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With `strict`, the first is an error when all are there."""
    trajectory = write_with_cameras(tmp_path, annotate=True)
    with pytest.raises(BlankVideo) as caught:
        render_video(trajectory, workers=Cameras(plain=True), strict=True)
    assert caught.value.path.name == SIDE
    assert is_done(tmp_path / FIRST)
    # However much is written on them.
    for name in (FIRST, SIDE, SECOND):
        assert metadata_of(tmp_path / name)["suspect_constant"] is True
    assert f"{FIRST} may show nothing" in caplog.text


def test_captions_are_on_the_frames_that_are_hashed(tmp_path: Path) -> None:
    """Hash by hash what the function gives, and the metadata says so."""
    size = (64, 96)
    trajectory = write_with_cameras(tmp_path, annotate=True)
    render_video(trajectory, workers=Cameras(size=size))
    render_video(
        trajectory, workers=Cameras(size=size), annotate=False, out=tmp_path / "p.mp4"
    )
    plain = [frame | 5 for frame in Painter(size).frames(trajectory, range(5), View())]
    import hashlib

    said = [
        Caption(episode_id=0, step=step, time=step / 20, reward=step / 2)
        for step in range(5)
    ]
    expected = [
        hashlib.sha256(annotated(frame, caption).tobytes()).hexdigest()
        for frame, caption in zip(plain, said, strict=True)
    ]
    assert hashes_of(tmp_path / SIDE) == expected
    assert "pillow" in metadata_of(tmp_path / SIDE)["annotated"]
    assert metadata_of(tmp_path / FIRST)["pictures"] == "scene"
    assert "annotated" not in metadata_of(tmp_path / "p.mp4")
    assert hashes_of(tmp_path / "p.mp4") != hashes_of(tmp_path / FIRST)


def test_captions_tell_time_by_what_is_known(tmp_path: Path) -> None:
    """The simulation's own clock, else steps of a known length, else nothing."""
    ride = record_ride(tmp_path)
    with open_trajectory(ride.path) as reader:
        assert [c.time for c in Captions(reader, [0, 1])] == [None, None]
    with open_trajectory(write_log(tmp_path, 1, steps=3, stride=2)) as reader:
        assert [(c.step, c.time) for c in Captions(reader, [0, 1, 2])] == [
            *((0, 0.0), (2, 0.1), (3, 0.15))
        ]


def test_the_clock_counts_from_the_reset(tmp_path: Path) -> None:
    """Also where the simulation's begins elsewhere, and rewards are added up."""
    with open_trajectory(write_log(tmp_path, 1)) as reader:
        header = reader.header
    clock = StateComponent("time", 0, 1)
    logs, name = new_logs(tmp_path), trajectory_prefix(INFIX, 0)
    span = logs.begin(name, dataclasses.replace(header, state=(clock,)))
    for step, (time, reward) in enumerate([(7.0, 0), (7.5, 0.25), (9.0, -1)]):
        add_row(span, step, reward=reward, state=time, snapshot=grey(step))
    logs.close()
    with open_trajectory(logs.path_of(name)) as reader:
        captions = list(Captions(reader, [0, 1, 2]))
    assert [c.time for c in captions] == [0.0, 0.5, 2.0]
    assert [c.reward for c in captions] == [0.0, 0.25, -0.75]


def test_second_names_are_given_at_the_end(tmp_path: Path) -> None:
    """Of every camera; rendered again they lead to the new files."""
    trajectory = write_with_cameras(tmp_path, also_named="rl-video-episode-0.mp4")
    for _ in range(2):
        render_video(trajectory, workers=Cameras())
        assert (tmp_path / "rl-video-episode-0.mp4").samefile(tmp_path / FIRST)
        side = tmp_path / "rl-video-episode-0.side.mp4"
        assert side.samefile(tmp_path / SIDE)
        assert metadata_path(side).samefile(metadata_path(tmp_path / SIDE))
        (tmp_path / FIRST).with_suffix(".mp4").touch()
    assert metadata_of(tmp_path / SIDE)["also_named"] == side.name


def test_the_rule_of_the_choice_is_told(tmp_path: Path) -> None:
    """Also of a video that is rendered another way: it is no typical episode."""
    trajectory = write_with_cameras(tmp_path, selection={"rule": "worst:3"})
    out = tmp_path / "x.mp4"
    render_video(trajectory, workers=Cameras())
    render_video(trajectory, workers=Cameras(), view=View(camera="top"), out=out)
    for video in (tmp_path / FIRST, tmp_path / SIDE, out):
        assert metadata_of(video)["selection"] == {"rule": "worst:3"}


@pytest.mark.parametrize(
    "said",
    [
        *({"cameras": "side"}, {"cameras": []}, {"cameras": ["a", None]}),
        *({"cameras": [1.5, "a"]}, {"cameras": ["a"] * 101}, {"tiled": 1}),
        *({"cameras": [{"lookat": "x"}, "a"]}, {"annotate": "yes"}, {"also_named": 1}),
        *({"also_named": "../a-episode-1.mp4"}, {"also_named": "openaigym-step-1.mp4"}),
    ],
)
def test_what_cannot_be_is_refused(said: dict[str, Any], tmp_path: Path) -> None:
    """A trajectory may be anybody's."""
    trajectory = rewritten(write_log, tmp_path, **said)
    with pytest.raises(UnreadableFile, match=next(iter(said))):
        open_for_rendering(trajectory)


# What finishes the episodes of a directory.


@pytest.fixture
def painter(monkeypatch: pytest.MonkeyPatch) -> Cameras:
    """Draw without processes and without OpenGL."""
    painter = Cameras()
    monkeypatch.setattr(shared_pool, "WorkerPool", lambda count: painter)
    monkeypatch.setattr(again, "WorkerPool", lambda count: painter)
    return painter


def test_all_videos_of_an_episode_are_in_the_manifest(
    tmp_path: Path, painter: Cameras
) -> None:
    """When the first is there, and it is then not pending any more."""
    write_with_cameras(tmp_path)
    manifest = write_pending_manifest(tmp_path, 0)
    [outcome] = finish_pending(tmp_path, [KEY], workers=1)
    assert outcome.further_videos == (SIDE, SECOND)
    content = json.loads(manifest.read_text())
    assert [video for video, _ in content["videos"]] == sorted([FIRST, SIDE, SECOND])
    assert content["mjrec"]["pending"] == []
    assert look_at(tmp_path, KEY) is None


def test_frames_of_all_videos_are_counted(tmp_path: Path, painter: Cameras) -> None:
    """Before, while and after they are drawn."""
    write_with_cameras(tmp_path)
    seen = []
    with EpisodeFinisher(tmp_path, workers=1, on_progress=seen.append) as finisher:
        assert finisher.add(KEY)
        assert (finisher.progress.videos, finisher.progress.frames) == (3, 15)
        finisher.finish_next()
    assert [progress.frames_done for progress in seen] == [0, *range(1, 16), 15]
    assert seen[-1].videos_done == 3


def test_an_episode_is_pending_until_the_first_video_is_there(
    tmp_path: Path, painter: Cameras
) -> None:
    """What a killed process left of the others is made anew, and parts are removed."""
    write_with_cameras(tmp_path)
    list(finish_pending(tmp_path, [KEY], workers=1))
    (tmp_path / FIRST).unlink()
    (tmp_path / SIDE).write_text("half")
    part = tmp_path / f".{SIDE}.0123abcd.part"
    others = tmp_path / f".{STEM}.front.mp4.0123abcd.part"
    for path in (part, others):
        path.write_text("half")
    list(finish_pending(tmp_path, [KEY], workers=1))
    assert len(frames_of(tmp_path / SIDE)) == 5
    assert not part.exists()
    # Somebody may be rendering the episode another way.
    assert others.exists()


def test_missing_second_names_are_given_again(tmp_path: Path, painter: Cameras) -> None:
    """Though nothing is to be rendered."""
    write_with_cameras(tmp_path, also_named="rl-video-episode-0.mp4")
    list(finish_pending(tmp_path, [KEY], workers=1))
    (tmp_path / "rl-video-episode-0.side.mp4").unlink()
    assert list(finish_pending(tmp_path, [KEY], workers=1)) == []
    assert (tmp_path / "rl-video-episode-0.side.mp4").samefile(tmp_path / SIDE)


def test_recovery_lists_all_videos(tmp_path: Path, painter: Cameras) -> None:
    """In the manifest of a monitor that left none."""
    write_with_cameras(tmp_path)
    list(finish_pending(tmp_path, [KEY], workers=1))
    recover(tmp_path)
    [manifest] = tmp_path.glob("*.manifest.json")
    videos = [video for video, _ in json.loads(manifest.read_text())["videos"]]
    assert sorted(videos) == sorted([FIRST, SIDE, SECOND])


# Rendering once more.


def test_rendering_again_replaces_no_recorded_video(
    tmp_path: Path, painter: Cameras
) -> None:
    """A camera that was recorded too has its file already."""
    trajectory = write_with_cameras(tmp_path)
    render_video(trajectory, workers=painter)
    before = (tmp_path / SIDE).read_bytes()
    for out in (None, tmp_path / SIDE):
        variant = Variant(view=View(camera="side"))
        [outcome] = render_again([trajectory], variant, workers=1, out=out)
        assert f"{SIDE} is a recorded video" in str(outcome.failure)
    assert (tmp_path / SIDE).read_bytes() == before
    variant = Variant(view=View(camera="side", quality="draft"))
    [outcome] = render_again([trajectory], variant, workers=1)
    assert outcome.name == f"{STEM}.side.draft.mp4"


@pytest.mark.parametrize(
    ("recorded", "asked", "written", "name"),
    [
        (True, None, True, f"{STEM}.5fps.mp4"),
        (False, None, False, f"{STEM}.5fps.mp4"),
        (True, False, False, f"{STEM}.5fps.plain.mp4"),
        (False, True, True, f"{STEM}.5fps.annotated.mp4"),
    ],
)
def test_captions_are_as_recorded_or_as_asked_for(
    recorded: bool,
    asked: bool | None,
    written: bool,
    name: str,
    tmp_path: Path,
    painter: Cameras,
) -> None:
    """And the name of the file says what is other."""
    trajectory = write_with_cameras(tmp_path, annotate=recorded)
    variant = Variant(fps=5, annotate=asked)
    [outcome] = render_again([trajectory], variant, workers=1)
    assert outcome.name == name
    assert ("annotated" in metadata_of(tmp_path / name)) is written


# With a simulation and OpenGL.


def test_a_grid_is_what_each_camera_shows(tmp_path: Path) -> None:
    """Byte for byte, in any order, over an infinite plane and through changes."""
    (tmp_path / "side").mkdir()
    side = record_ride(tmp_path / "side", camera="side")
    ride = record_ride(tmp_path)
    drawing = trajectory_drawing(ride.path, View(), cameras=[None, "side", "rider"])
    try:
        assert drawing.size == (2 * HEIGHT, 2 * WIDTH)
        for number in (*range(FRAMES), 3, 7, 0):
            frame = drawing.draw(number)
            recorded, other = frame[:HEIGHT, :WIDTH], frame[:HEIGHT, WIDTH:]
            np.testing.assert_array_equal(recorded, ride.frames[number])
            np.testing.assert_array_equal(other, side.frames[number])
            again = frame[HEIGHT:, :WIDTH]
            np.testing.assert_array_equal(again, ride.frames[number])
            assert not frame[HEIGHT:, WIDTH:].any()
    finally:
        drawing.close()


@pytest.mark.thorough
def test_a_camera_that_follows_does_not_depend_on_the_order(tmp_path: Path) -> None:
    """Each picture moves it: those that another worker draws count too."""
    ride = record_ride(tmp_path)
    tracking = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
    view = View(
        camera={"type": tracking, "trackbodyid": 1, "distance": 4, "elevation": -30}
    )
    drawing = trajectory_drawing(ride.path, view)
    frames = [drawing.draw(number) for number in range(FRAMES)]
    for number in (4, 2, 8, 0, 0, 5, 7):
        np.testing.assert_array_equal(drawing.draw(number), frames[number])
    drawing.close()
    with WorkerPool(2) as workers:
        drawn = list(workers.frames(ride.path, range(FRAMES), view))
    np.testing.assert_array_equal(drawn, frames)
    assert len({frame.tobytes() for frame in frames}) == FRAMES


def test_an_unknown_camera_is_named_with_those_there_are(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """And nothing is left."""
    ride = record_ride(
        tmp_path,
        facts={
            "video": {
                "name": "openaigym.video.0.1.video000000.mp4",
                "recording": "deferred",
                "cameras": ["rider", "backside"],
            }
        },
    )
    before = names(tmp_path)
    with WorkerPool(1) as workers, pytest.raises(ValueError, match="side, rider"):
        render_video(ride.path, workers=workers)
    assert names(tmp_path) == before


ROLLING = """
<mujoco>
  <option timestep=".05"/>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1"
      width="32" height="32"/>
    <material name="cloth" texture="checks" texrepeat="1.7 1.7"/>
  </asset>
  <worldbody>
    <light directional="true" dir="0 .3 -1"/>
    <camera name="side" pos="0 -5 2" xyaxes="1 0 0 0 .4 .9"/>
    <geom type="plane" size="0 0 1" material="cloth"/>
    <body pos="0 0 .3"><joint name="x" type="slide" axis="1 0 0"/><geom size=".2"/>
      <camera name="ride" pos="0 -2 1" xyaxes="1 0 0 0 .4 .9"/></body>
  </worldbody>
  <actuator><motor joint="x" gear="9000" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def record(
    env: Any, directory: Path, *, episodes: int = 1, **options: Any
) -> list[Path]:
    """Record episodes of four steps; return the videos, the first camera's first."""
    with Monitor(env, directory, workers=1, **options) as monitor:
        monitor.action_space.seed(3)
        for _ in range(episodes):
            monitor.reset(seed=0)
            for _ in range(4):
                monitor.step(monitor.action_space.sample())
    return sorted(
        directory.glob("*.mp4"), key=lambda path: (path.name.count("."), path)
    )


class Rolling(MujocoEnv):
    """A ball on an endless floor."""

    # Gymnasium 1.0 wants just these.
    metadata = {"render_modes": ["human", "rgb_array", "depth_array"]}  # noqa: RUF012  Gymnasium's way

    def __init__(self, model: Path) -> None:
        box = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        super().__init__(str(model), 1, box, width=64, height=48)

    def step(self, action: Any) -> Any:
        self.do_simulation(action, 1)
        return self._get_obs(), 1.0, False, False, {}

    def reset_model(self) -> Any:
        self.set_state(self.init_qpos, self.init_qvel)
        return self._get_obs()

    def _get_obs(self) -> Any:
        return np.concatenate([self.data.qpos, self.data.qvel])


def mjcf(directory: Path) -> Any:
    model = directory / "rolling.xml"
    model.write_text(ROLLING)
    return Rolling(model)


def ant(directory: Path) -> Any:
    return gymnasium.make("Ant-v5", max_episode_steps=4, width=64, height=48)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("make", "cameras"), [(mjcf, ["side", "ride"]), (ant, [-1, "track"])]
)
def test_a_further_video_is_that_of_a_run_with_its_camera(
    make: Any, cameras: list[Any], tmp_path: Path
) -> None:
    """Hash by hash; the whole file, too."""
    both = record(make(tmp_path), tmp_path / "both", camera=cameras)
    assert len(both) == 2
    for video, camera in zip(both, cameras, strict=True):
        [alone] = record(make(tmp_path), tmp_path / str(camera), camera=camera)
        assert hashes_of(video) == hashes_of(alone)
        assert video.read_bytes() == alone.read_bytes()
    assert hashes_of(both[0]) != hashes_of(both[1])


@pytest.mark.thorough
@pytest.mark.dm_control
def test_so_it_is_of_dm_control(tmp_path: Path) -> None:
    """Which draws every picture as if it were the first."""
    suite = pytest.importorskip("dm_control.suite")

    def run(directory: Path, camera: Any) -> list[Path]:
        env = suite.load("hopper", "hop", task_kwargs={"random": 0})
        size = {"height": 48, "width": 64}
        with Monitor(env, directory, camera=camera, workers=1, **size) as monitor:
            monitor.reset()
            for _ in range(3):
                monitor.step(np.full(monitor.action_spec().shape, 0.5))
        return sorted(directory.glob("*.mp4"), key=lambda path: path.name.count("."))

    both = run(tmp_path / "both", ["cam0", "back"])
    [alone] = run(tmp_path / "alone", "back")
    assert hashes_of(both[1]) == hashes_of(alone)
    assert hashes_of(both[0]) != hashes_of(alone)


KILLED = """
import os, sys, numpy, mjrec
from dm_control import suite
env = mjrec.Monitor(
    suite.load("cheetah", "run"), sys.argv[1], camera=["side", "back"], height=48,
    width=64, render="live", name_prefix="rl-video", env_id="dm_control/cheetah-run",
)
env.reset()
for _ in range(30):
    env.step(numpy.zeros(6))
os.kill(os.getpid(), 9)
"""


@pytest.mark.thorough
@pytest.mark.dm_control
def test_a_killed_recording_has_all_its_videos(tmp_path: Path) -> None:
    """In the manifest, and under their second names."""
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    recover(tmp_path, timeout=30)
    [manifest] = tmp_path.glob("*.manifest.json")
    videos = [video for video, _ in json.loads(manifest.read_text())["videos"]]
    assert len(videos) == 2
    assert sorted(videos) == sorted(p.name for p in tmp_path.glob("openaigym*.mp4"))
    seconds = {p.name for p in tmp_path.glob("rl-video*.mp4")}
    assert seconds == {"rl-video-episode-0.mp4", "rl-video-episode-0.back.mp4"}
