# SPDX-License-Identifier: Apache-2.0
import json
import re
from fractions import Fraction
from pathlib import Path

import av
import gymnasium
import numpy as np
import pytest
from recordings import frames_of

from mjrec import InvalidArgument, VideoRecorder


def metadata_of(recorder):
    return json.loads(Path(recorder.metadata_path).read_text())


def record(recorder, env, steps):
    env.reset()
    recorder.capture_frame()
    for _ in range(steps):
        env.step(env.action_space.sample())
        recorder.capture_frame()
    recorder.close()
    return metadata_of(recorder)


class Frames:
    """Renders the given frames, or raises where one is an exception."""

    render_mode = "rgb_array"

    def __init__(self, *frames, **metadata):
        self.frames = list(frames)
        self.metadata = metadata

    def render(self):
        frame = self.frames.pop(0)
        if isinstance(frame, Exception):
            raise frame
        return frame


def gray(brightness=90):
    return np.full((8, 10, 3), brightness, np.uint8)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "v.mp4"


def test_every_capture_is_a_frame(corridor, path):
    """Captures after `close` are ignored."""
    given = {"episode_id": 1}
    recorder = VideoRecorder(corridor, path, given)
    metadata = record(recorder, corridor, 3)
    recorder.capture_frame()
    recorder.close()
    shown = [int((frame[0, :, 0] > 128).sum()) for frame in frames_of(recorder.path)]
    assert shown == [4, 8, 12, 16]
    assert (metadata["frame_count"], metadata["frame_steps"]) == (4, [[0, 3]])
    assert metadata["content_type"] == "video/mp4"
    assert (recorder.functional, recorder.empty) == (True, False)
    # These are gym's keys; an absolute path would not survive a move.
    encoder = metadata["encoder_version"]
    assert encoder["backend"] == "ffmpeg"
    assert encoder["version"].startswith("ffmpeg version")
    assert encoder["cmdline"][-1] == "v.mp4"
    assert given == {"episode_id": 1}


class Repeat(gymnasium.Wrapper):
    """Repeats actions, so that a step takes longer than the environment declares."""

    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


@pytest.mark.parametrize(
    ("env_id", "wrapper", "options", "fps", "speed"),
    [
        ("HalfCheetah-v5", None, {}, "20", 1.0),
        ("HalfCheetah-v5", Repeat, {}, "10", 1.0),
        ("Humanoid-v5", None, {}, "200/3", 1.0),
        # `fps` sets the file's rate and keeps all frames.
        ("HalfCheetah-v5", None, {"fps": 10}, "10", 0.5),
    ],
)
def test_the_file_has_the_exact_rate_of_simulated_steps(
    *, env_id, wrapper, options, fps, speed, path
):
    env = gymnasium.make(env_id, render_mode="rgb_array", width=32, height=32)
    env = wrapper(env) if wrapper else env
    recorder = VideoRecorder(env, path, **options)
    metadata = record(recorder, env, 2)
    env.close()
    assert (metadata["fps"], metadata["playback_speed"]) == (fps, speed)
    assert metadata["frame_count"] == 3
    with av.open(recorder.path) as container:
        assert container.streams.video[0].average_rate == Fraction(fps)
    if env_id == "HalfCheetah-v5" and wrapper is None:
        assert metadata["timestep"] == "1/20"


@pytest.mark.parametrize(("declared", "fps"), [({"render_fps": 10}, "10"), ({}, "30")])
def test_without_a_simulation_the_declared_rate_is_used(path, declared, fps, caplog):
    """Without a declared rate, a warning names the argument."""
    with VideoRecorder(Frames(gray(), **declared), path) as recorder:
        recorder.capture_frame()
    assert recorder.finished
    assert metadata_of(recorder)["fps"] == fps
    assert len(frames_of(recorder.path)) == 1
    assert ("fps=" in caplog.text) is (not declared)


def test_all_frames_of_a_list_are_recorded_at_a_rate_that_fits(make_corridor, path):
    env = make_corridor(render_mode="rgb_array_list")
    # There are three frames for each tenth of a second.
    times, shown = iter([0.0, 0.1, 0.2]), iter(range(1, 10))
    env.render = lambda: [gray(25 * next(shown)) for _ in range(3)]
    recorder = VideoRecorder(env, path, clock=lambda: next(times))
    metadata = record(recorder, env, 2)
    recorded = [round(float(frame.mean()) / 25) for frame in frames_of(recorder.path)]
    assert recorded == list(range(1, 10))
    assert (metadata["frame_count"], metadata["fps"]) == (9, "30")
    runs = [[0, 0], [0, 0], [0, 1], [1, 1], [1, 2], [2, 2], [2, 2]]
    assert metadata["frame_steps"] == runs
    assert metadata["playback_speed"] == 1.0


def test_ansi_frames_become_an_asciicast_at_the_declared_rate(make_corridor, tmp_path):
    env = make_corridor(render_mode="ansi")
    recorder = VideoRecorder(env, base_path=tmp_path / "v")
    metadata = record(recorder, env, 2)
    assert recorder.path == str(tmp_path / "v.json")
    assert metadata["content_type"] == "video/vnd.openai.ansivid"
    assert metadata["encoder_version"] == {"backend": "TextEncoder", "version": 1}
    cast = json.loads((tmp_path / "v.json").read_text())
    assert cast["stdout"][2][1].endswith("..o\r\n")
    assert cast["stdout"][0][0] == 0.1


@pytest.mark.parametrize(("mode", "enabled"), [("human", True), ("rgb_array", False)])
def test_a_recorder_of_other_modes_or_disabled_does_nothing(
    make_corridor, path, mode, enabled
):
    """It renders and writes nothing, as in gym."""
    env = make_corridor(render_mode=mode)
    recorder = VideoRecorder(env, path, enabled=enabled)
    recorder.capture_frame()
    recorder.close()
    assert (recorder.enabled, recorder.functional) == (False, False)
    assert (recorder.path, env.rendered) == (None, 0)
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (None, "NoneType"),
        (np.zeros((8, 10, 4), np.uint8), r"shape \(8, 10, 4\)"),
        (np.zeros((8, 10, 3)), "float64"),
        (np.zeros((8, 12, 3), np.uint8), "the same size"),
    ],
)
def test_a_bad_frame_ends_the_video_and_keeps_the_frames_before(
    path, bad, reason, caplog
):
    """There is one warning with the reason, and the metadata say that it is broken."""
    recorder = VideoRecorder(Frames(gray(), gray(120), bad, gray(), bad), path)
    for _ in range(5):
        recorder.capture_frame()
    recorder.close()
    assert recorder.broken
    assert not recorder.functional
    assert len(frames_of(recorder.path)) == 2
    assert metadata_of(recorder)["broken"] is True
    [warning] = [t for r in caplog.records if "was bad" in (t := r.getMessage())]
    assert re.search(reason, warning)


def test_without_frames_only_metadata_are_written(path):
    """An error of `render` is raised unchanged and does not count as broken."""
    recorder = VideoRecorder(Frames(RuntimeError("no GL")), path, {"episode_id": 3})
    with pytest.raises(RuntimeError, match="no GL"):
        recorder.capture_frame()
    assert not recorder.broken
    recorder.close()
    recorder.close()
    assert recorder.empty
    assert metadata_of(recorder) == {
        "episode_id": 3,
        "content_type": "video/mp4",
        "empty": True,
    }


@pytest.mark.parametrize(
    ("mode", "options", "message"),
    [
        ("rgb_array", {"path": "v.mp4", "fps": 0}, "fps must be"),
        ("rgb_array", {"path": "v.mp4", "base_path": "v"}, "not both"),
        ("rgb_array", {"path": "v.avi"}, r"end in \.mp4"),
        ("ansi", {"path": "v.mp4"}, r"end in \.json"),
    ],
)
def test_the_constructor_refuses_wrong_options(make_corridor, mode, options, message):
    with pytest.raises(InvalidArgument, match=message):
        VideoRecorder(make_corridor(render_mode=mode), **options)


def test_changing_directory_moves_no_output(corridor, tmp_path, monkeypatch):
    """Without a path, the video is in a new directory."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    recorder = VideoRecorder(corridor, "v.mp4")
    monkeypatch.chdir(tmp_path / "elsewhere")
    record(recorder, corridor, 1)
    assert {p.name for p in tmp_path.glob("v.*")} == {"v.mp4", "v.meta.json"}
    recorder = VideoRecorder(corridor)
    record(recorder, corridor, 1)
    assert len(frames_of(recorder.path)) == 2
