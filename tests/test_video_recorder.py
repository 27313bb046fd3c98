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
    """Gives a list of things as frames."""

    render_mode = "rgb_array"

    def __init__(self, *frames, **metadata):
        self.frames = list(frames)
        self.metadata = metadata

    def render(self):
        frame = self.frames.pop(0)
        if isinstance(frame, Exception):
            raise frame
        return frame


def grey(brightness=90):
    return np.full((8, 10, 3), brightness, np.uint8)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "v.mp4"


def test_every_capture_is_a_frame(corridor, path):
    """The reset's and the last one are in the file, in order; nothing comes later."""
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
    # gym's keys; no absolute path that a move makes stale.
    encoder = metadata["encoder_version"]
    assert encoder["backend"] == "ffmpeg"
    assert encoder["version"].startswith("ffmpeg version")
    assert encoder["cmdline"][-1] == "v.mp4"
    assert given == {"episode_id": 1}


class Repeat(gymnasium.Wrapper):
    """Repeats actions, which makes the step longer, whatever is declared."""

    def step(self, action):
        self.env.step(action)
        return self.env.step(action)


@pytest.mark.parametrize(
    ("env_id", "wrapper", "options", "fps", "speed"),
    [
        ("HalfCheetah-v5", None, {}, "20", 1.0),
        ("HalfCheetah-v5", Repeat, {}, "10", 1.0),
        ("Humanoid-v5", None, {}, "200/3", 1.0),
        # `fps` is written, and selects no frames.
        ("HalfCheetah-v5", None, {"fps": 10}, "10", 0.5),
    ],
)
def test_rate_is_the_simulated_time_of_a_step(
    *, env_id, wrapper, options, fps, speed, path
):
    """Exact, also in the file."""
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
def test_rate_without_simulation_is_the_declared_one(path, declared, fps, caplog):
    """Also of a single frame; where none is, a warning names the argument for it."""
    with VideoRecorder(Frames(grey(), **declared), path) as recorder:
        recorder.capture_frame()
    assert recorder.finished
    assert metadata_of(recorder)["fps"] == fps
    assert len(frames_of(recorder.path)) == 1
    assert ("fps=" in caplog.text) is (not declared)


def test_a_frame_list_is_drained_in_order(make_corridor, path):
    """All the frames of a step are recorded, and the rate fits them."""
    env = make_corridor(render_mode="rgb_array_list")
    # Three frames for each tenth of a second.
    times, shown = iter([0.0, 0.1, 0.2]), iter(range(1, 10))
    env.render = lambda: [grey(25 * next(shown)) for _ in range(3)]
    recorder = VideoRecorder(env, path, clock=lambda: next(times))
    metadata = record(recorder, env, 2)
    recorded = [round(float(frame.mean()) / 25) for frame in frames_of(recorder.path)]
    assert recorded == list(range(1, 10))
    assert (metadata["frame_count"], metadata["fps"]) == (9, "30")
    runs = [[0, 0], [0, 0], [0, 1], [1, 1], [1, 2], [2, 2], [2, 2]]
    assert metadata["frame_steps"] == runs
    assert metadata["playback_speed"] == 1.0


def test_a_text_environment_becomes_an_asciicast(make_corridor, tmp_path):
    """Frames of the mode ansi are text, shown at the declared rate."""
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
def test_a_recorder_without_frames_does_nothing(make_corridor, path, mode, enabled):
    """It leaves nothing, as in gym; none is drawn where it is not enabled."""
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
def test_a_bad_frame_keeps_the_good_ones(path, bad, reason, caplog):
    """The video ends there, playable; one warning and the metadata say why."""
    recorder = VideoRecorder(Frames(grey(), grey(120), bad, grey(), bad), path)
    for _ in range(5):
        recorder.capture_frame()
    recorder.close()
    assert recorder.broken
    assert not recorder.functional
    assert len(frames_of(recorder.path)) == 2
    assert metadata_of(recorder)["broken"] is True
    [said] = [t for r in caplog.records if "was bad" in (t := r.getMessage())]
    assert re.search(reason, said)


def test_without_a_frame_there_is_only_metadata(path):
    """An error of render() is raised unchanged, and breaks nothing."""
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
    ("mode", "options", "words"),
    [
        ("rgb_array", {"path": "v.mp4", "fps": 0}, "fps must be"),
        ("rgb_array", {"path": "v.mp4", "base_path": "v"}, "not both"),
        ("rgb_array", {"path": "v.avi"}, r"end in \.mp4"),
        ("ansi", {"path": "v.mp4"}, r"end in \.json"),
    ],
)
def test_impossible_options_are_an_error(make_corridor, mode, options, words):
    """At construction, before anything is written."""
    with pytest.raises(InvalidArgument, match=words):
        VideoRecorder(make_corridor(render_mode=mode), **options)


def test_a_relative_path_is_fixed_and_a_missing_one_is_made(
    corridor, tmp_path, monkeypatch
):
    """A later chdir parts nothing; without a path it is in a new directory."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    recorder = VideoRecorder(corridor, "v.mp4")
    monkeypatch.chdir(tmp_path / "elsewhere")
    record(recorder, corridor, 1)
    assert {p.name for p in tmp_path.glob("v.*")} == {"v.mp4", "v.meta.json"}
    recorder = VideoRecorder(corridor)
    record(recorder, corridor, 1)
    assert len(frames_of(recorder.path)) == 2
