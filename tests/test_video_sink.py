# SPDX-License-Identifier: Apache-2.0
"""The sink: frames in, one finished video with its metadata out."""

import json
from fractions import Fraction

import numpy as np
import pytest
from full_disk import file_size_limit
from recordings import frames_of

from mjrec import FileNotWritten
from mjrec.formats.unfinished_video import read_note
from mjrec.formats.video_metadata import StepRuns, timing_facts
from mjrec.formats.video_sink import VideoSink


def moving(number):
    frame = np.full((48, 96, 3), 90, np.uint8)
    frame[:, 5 * number : 5 * number + 20] = (200, 40, 10)
    return frame


def names(directory):
    return sorted(path.name for path in directory.iterdir())


def film(path, count=4):
    """Return a sink that has been given some frames."""
    sink = VideoSink(path, fps=Fraction(20))
    for number in range(count):
        sink.write(moving(number))
    return sink


def test_the_metadata_comes_last_and_tells_of_the_file(tmp_path):
    """Until then, no final name says that there is a video; it can be told later."""
    sink = film(tmp_path / "v.mp4")
    assert all(name.startswith(".") for name in names(tmp_path))
    sink.finish()
    assert names(tmp_path) == ["v.framehash", "v.mp4"]
    with file_size_limit(100), pytest.raises(FileNotWritten, match=r"v\.meta\.json"):
        sink.describe({"episode_id": 0})
    assert names(tmp_path) == ["v.framehash", "v.mp4"]
    written = sink.describe({"episode_id": 7})
    assert json.loads((tmp_path / "v.meta.json").read_text()) == written
    assert sink.file is not None
    assert written["file_sha256"] == sink.file.file_sha256
    assert (written["episode_id"], written["height"]) == (7, 48)
    assert len(frames_of(tmp_path / "v.mp4")) == 4


def test_discarded_it_leaves_an_older_video(tmp_path):
    """But for one that it has replaced."""
    older = film(tmp_path / "v.mp4", 2)
    older.finish()
    older.describe({})
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    film(tmp_path / "v.mp4").discard()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    newer = film(tmp_path / "v.mp4")
    newer.finish()
    # The older one's metadata would not be true of it.
    assert names(tmp_path) == ["v.framehash", "v.mp4"]
    newer.discard()
    newer.discard()
    assert names(tmp_path) == []


def test_a_note_says_what_an_unfinished_video_is(tmp_path):
    """It is there before the video is, and goes when the metadata is there."""
    timing = {"fps": "20", "timestep": "1/20", "stride": 1, "frames_per_step": 1}
    path = tmp_path / "v.mp4"
    sink = VideoSink(path, fps=Fraction(20), note=lambda: ({"seed": 3}, timing))
    assert names(tmp_path) == []
    sink.write(moving(0))
    video = read_note(path)
    assert video.path == path
    assert video.metadata == {"seed": 3}
    assert (video.facts["height"], video.facts["timestep"]) == (48, "1/20")
    assert video.temporary.exists()
    sink.finish()
    sink.describe({})
    assert names(tmp_path) == ["v.framehash", "v.meta.json", "v.mp4"]


def test_steps_are_runs_and_timing_is_in_exact_fractions():
    """The last frame is always taken; a step may have several; thirds stay thirds."""
    assert StepRuns([0, 4, 8, 10], stride=4).ranges == [[0, 8], [10, 10]]
    assert StepRuns([0, 1, 1, 2]).ranges == [[0, 1], [1, 2]]
    facts = timing_facts(
        StepRuns([0, 2, 4], stride=2),
        fps=Fraction(100, 3),
        timestep=Fraction(3, 400),
        stride=2,
    )
    assert facts == {
        "fps": "100/3",
        "timestep": "3/400",
        # Simulated seconds in a second of video.
        "playback_speed": 0.5,
        "stride": 2,
        "frame_count": 3,
        "frame_steps": [[0, 4]],
    }
