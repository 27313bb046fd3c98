# SPDX-License-Identifier: Apache-2.0
"""Rendering a recording into videos, with metadata, hashes and captions."""

import hashlib
import json

import av
import pytest
from recordings import add_facts, frames_of, hashes_at
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

from mjrec import NoPictures, UnreadableFile, recover, render_videos
from mjrec.annotation import Caption, annotated
from mjrec.formats.frame_hashes import frame_hash_path
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.trajectory import packed, row_dtype
from mjrec.formats.trajectory_file import finish_trajectory, open_trajectory
from mjrec.formats.video_metadata import is_done, metadata_path
from mjrec.rendering.finish import finish
from mjrec.rendering.jobs import Progress, RecordingKey, Variant, View
from mjrec.rendering.recorded_facts import captions, video_path
from mjrec.rendering.recordings import look_at
from mjrec.rendering.render_video import render_video

STEM = "openaigym.video.0.7.video000000"
KEY = RecordingKey(INFIX, 0)


def render(trajectory, painter=None, *, variant=None, **options):
    """Render the video of an episode, and return it."""
    workers = painter or Painter()
    done = render_video([trajectory], variant, workers=workers, **options)
    return done.directory / next(iter(done.videos))


def metadata_of(video):
    return json.loads(metadata_path(video).read_text())


# One camera


@pytest.mark.parametrize(
    ("stride", "max_fps", "steps", "fps"),
    [
        (1, 20, [[0, 5]], 20),
        (1, 19, [[0, 4], [5, 5]], 10),
        (1, 1, [[0, 0], [5, 5]], 1),
        (2, None, [[0, 4], [5, 5]], 10),
    ],
)
def test_max_fps_drops_frames_and_keeps_real_time(
    stride, max_fps, steps, fps, tmp_path
):
    trajectory = write_finished(tmp_path, steps=5, stride=stride)
    video = render(trajectory, variant=Variant(max_fps=max_fps))
    metadata = metadata_of(video)
    assert metadata["frame_steps"] == steps
    assert metadata["playback_speed"] == 1.0
    with av.open(str(video)) as container:
        assert container.streams.video[0].average_rate == fps


def test_a_broken_recording_without_frames_gets_only_metadata(tmp_path, names):
    """A recording that cannot be rendered is an error, and nothing is written."""
    broken = write_log(tmp_path, frames=False, broken_reason="a marker")
    assert not render_video([broken], workers=Painter()).videos
    metadata = metadata_of(tmp_path / f"{STEM}.mp4")
    assert (metadata["empty"], metadata["broken"]) == (True, True)
    refused = write_log(tmp_path, 1, frames=False, refusal="a plugin draws")
    before = names(tmp_path)
    with pytest.raises(NoPictures, match="a plugin draws"):
        render(refused)
    assert names(tmp_path) == before


@pytest.mark.parametrize(
    "name",
    [
        *("../x.mp4", "/x.mp4", "x.mp4", f"{STEM}.meta.json", STEM[:-1] + "1.mp4"),
        *(f"{STEM}.side.mp4", 5, None),
    ],
)
def test_a_trajectory_cannot_name_a_video_of_another_episode(name, tmp_path):
    """The name in a trajectory may come from a hostile file."""
    trajectory = write_log(tmp_path, video=None)
    with pytest.raises(UnreadableFile, match="its episode"):
        video_path(trajectory, {"video": {"name": name}})


# Several cameras

FIRST, SIDE, SECOND = (f"{STEM}{part}.mp4" for part in ("", ".side", ".camera3"))


def write_with_cameras(directory, **more):
    """Write a trajectory whose video is pending, from three cameras."""
    video = {"name": FIRST, "quality": "full", "fps": None, "max_fps": None}
    cameras = [None, "side", {"distance": 2.0}]
    log = write_log(directory, scene={"label": "eye"})
    facts = {**video, "recording": "deferred", "cameras": cameras, **more}
    add_facts(log, {"video": facts})
    path = finish_trajectory(log)
    next(directory.glob("*.jsonl")).unlink()
    return path


@pytest.mark.parametrize("camera", [None, "side"])
def test_an_interruption_leaves_no_video_of_any_camera(camera, tmp_path, names):
    trajectory, painter = write_with_cameras(tmp_path), Painter()

    def interrupt(_, view, index):
        if index == 2 and view.camera == camera:
            raise KeyboardInterrupt

    painter.breaks_at = interrupt
    with pytest.raises(KeyboardInterrupt):
        render(trajectory, painter)
    assert names(tmp_path) == [trajectory.name]


def test_strict_rendering_names_all_blank_videos_and_keeps_them(tmp_path):
    """Captions do not hide that they are blank."""
    trajectory = write_with_cameras(tmp_path, annotate=True)
    done = render_video([trajectory], workers=Painter(plain=True), strict=True)
    assert set(done.blank) == set(done.videos) == {FIRST, SIDE, SECOND}
    assert is_done(tmp_path / FIRST)
    for name in (FIRST, SIDE, SECOND):
        assert metadata_of(tmp_path / name)["suspect_constant"] is True


def test_finishing_gives_each_cameras_video_its_second_name(tmp_path):
    """It restores a name that is missing or leads to a replaced file."""
    trajectory = write_with_cameras(tmp_path, also_named="rl-video-episode-0.mp4")
    second = tmp_path / "rl-video-episode-0.side.mp4"
    for rerendered in (True, True, False):
        if rerendered:
            render(trajectory)
        else:
            second.unlink()
        list(finish(tmp_path, [KEY], workers=1))
        assert (tmp_path / "rl-video-episode-0.mp4").samefile(tmp_path / FIRST)
        assert second.samefile(tmp_path / SIDE)
        assert metadata_path(second).samefile(metadata_path(tmp_path / SIDE))
        assert metadata_of(tmp_path / SIDE)["also_named"] == second.name


def test_all_cameras_are_counted_and_listed(tmp_path, painter):
    """An episode is rendered again when a video is missing."""
    write_with_cameras(tmp_path)
    manifest, seen = write_pending_manifest(tmp_path, 0), []
    [result] = finish(tmp_path, workers=1, on_progress=seen.append)
    assert list(result.videos) == [FIRST, SIDE, SECOND]
    assert seen[-1] == Progress(videos_done=3, videos=3, frames_done=15, frames=15)
    assert look_at(tmp_path, KEY) is None
    for _ in range(2):
        content = json.loads(manifest.read_text())
        assert {video for video, _ in content["videos"]} == {FIRST, SIDE, SECOND}
        assert content["mjrec"]["pending"] == []
        # Recovery writes the same manifest.
        manifest.unlink()
        recover(tmp_path)
    (tmp_path / FIRST).unlink()
    (tmp_path / SIDE).write_text("half")
    list(finish(tmp_path, [KEY], workers=1))
    assert len(frames_of(tmp_path / SIDE)) == 5


def test_rerendering_never_replaces_a_recorded_video(tmp_path, painter):
    """A recorded camera's file exists already."""
    trajectory = write_with_cameras(tmp_path)
    render(trajectory)
    before = (tmp_path / SIDE).read_bytes()
    for out in (None, tmp_path / SIDE):
        rendered = render_videos(trajectory, camera="side", out=out)
        assert f"{SIDE} is a recorded video" in rendered.failures[SIDE]
    assert (tmp_path / SIDE).read_bytes() == before
    rendered = render_videos(trajectory, camera="side", quality="draft")
    assert list(rendered.videos) == [f"{STEM}.side.draft.mp4"]


# Captions


def test_hashed_frames_have_their_captions(tmp_path):
    painter, expected = Painter((64, 96)), []
    trajectory = write_with_cameras(tmp_path, annotate=True)
    render(trajectory, painter)
    plain = painter.frames(trajectory, range(5), View(camera="side"))
    for step, frame in enumerate(plain):
        caption = Caption(episode_id=0, step=step, time=step / 20, reward=step / 2)
        image = annotated(frame, caption).tobytes()
        expected.append(hashlib.sha256(image).hexdigest())
    assert hashes_at(frame_hash_path(tmp_path / SIDE)) == expected
    assert "pillow" in metadata_of(tmp_path / SIDE)["annotated"]


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize(
    ("asked", "name"), [(None, "5fps"), (False, "5fps.plain"), (True, "5fps.annotated")]
)
def test_annotate_overrides_the_recorded_choice_and_is_in_the_name(
    recorded, asked, name, tmp_path, painter
):
    write_with_cameras(tmp_path, annotate=recorded)
    [video] = render_videos(tmp_path, fps=5, annotate=asked).videos
    assert video == f"{STEM}.{name}.mp4"
    expected = recorded if asked is None else asked
    assert ("annotated" in metadata_of(tmp_path / video)) is expected


def test_captions_show_simulated_time_or_count_steps(tmp_path):
    """Without a clock or a timestep, they show no time."""
    with open_trajectory(record_ride(tmp_path).path) as reader:
        assert [c.time for c in captions(reader, [0, 1])] == [None, None]
    with open_trajectory(write_log(tmp_path, 1, steps=3, stride=2)) as reader:
        shown = [(c.step, c.time) for c in captions(reader, [0, 1, 2])]
        assert shown == [(0, 0.0), (2, 0.1), (3, 0.15)]
        facts, snapshot = reader.facts, reader.kind("snapshot")
        clock = row_dtype(state=packed([("time", ("<f8", (1,)))]), snapshot=snapshot)
    logs, name = new_logs(tmp_path), trajectory_prefix(INFIX, 0)
    span = logs.begin(name, facts, clock)
    for step, (time, reward) in enumerate([(7.0, 0), (7.5, 0.25), (9.0, -1)]):
        add_row(span, step, reward=reward, state=time, snapshot=grey(step))
    logs.close()
    with open_trajectory(logs.path_of(name)) as reader:
        shown = [(c.time, c.reward) for c in captions(reader, [0, 1, 2])]
        assert shown == [(0.0, 0.0), (0.5, 0.25), (2.0, -0.75)]
