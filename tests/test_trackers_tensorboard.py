# SPDX-License-Identifier: Apache-2.0
"""Test event files with TensorBoard's own reader."""

import dataclasses
import io
import json
import math
from fractions import Fraction

import pytest
from finished_files import episode, record
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mjrec.errors import DirectoryNotWritable, EncoderError, UnreadableFile
from mjrec.trackers import TensorBoardTracker
from mjrec.trackers.tensorboard import animated_gif


@pytest.fixture
def finished(tmp_path, make_corridor, play):
    """Return a finished video of eleven frames at ten frames per second."""
    return record(tmp_path / "recordings", make_corridor(10), play)


def read(directory):
    events = EventAccumulator(str(directory))
    events.Reload()
    return events


def test_scalars_are_logged_at_the_steps_of_the_run(finished):
    """Success is logged only if it is known, and evaluation has tags of its own."""
    tracker, run = TensorBoardTracker(), finished.run
    tracker.begin(run)
    tracker.episode(run, episode(0, success=True))
    tracker.episode(run, episode(1, reward=math.nan))
    tracker.episode(run, episode(2, type="e"))
    tracker.end(run)
    events = read(run.directory / "tensorboard" / "0.4711")
    returns = events.Scalars("training/return")
    assert [event.step for event in returns] == [10, 20]
    assert returns[0].value == 0.0
    assert math.isnan(returns[1].value)
    assert [e.value for e in events.Scalars("training/length")] == [10, 10]
    assert [(e.step, e.value) for e in events.Scalars("training/success")] == [(10, 1)]
    assert [(e.step, e.value) for e in events.Scalars("evaluation/return")] == [(30, 3)]


def test_video_is_logged_as_an_animated_gif(finished):
    """The GIF has all frames and is logged at the last step of its episode."""
    tracker, run = TensorBoardTracker(), finished.run
    tracker.begin(run)
    tracker.episode(run, episode(0))
    tracker.episode(run, episode(5))
    tracker.video(run, finished.video)
    # A video without an episode is logged at the latest step.
    tracker.video(run, dataclasses.replace(finished.video, episode=None, view="side"))
    tracker.end(run)
    events = read(run.directory / "tensorboard" / "0.4711")
    assert [image.step for image in events.Images("training/video_side")] == [60]
    [image] = events.Images("training/video")
    assert (image.step, image.height, image.width) == (10, 32, 48)
    gif = image.encoded_image_string
    assert gif.startswith(b"GIF89a")
    with Image.open(io.BytesIO(gif)) as opened:
        assert opened.n_frames == 11
        assert opened.info["duration"] == 100
        assert opened.info["loop"] == 0
        # The bar grows by four pixels with each step.
        for step in (0, 5, 10):
            opened.seek(step)
            frame = opened.convert("RGB")
            assert frame.getpixel((4 * step + 1, 16))[0] > 150
            assert frame.getpixel((min(4 * step + 7, 47), 16))[0] < 60
    # A long video keeps its duration but is shown with fewer frames.
    long = animated_gif(finished.video.path, frame_count=11, fps=Fraction(1, 25))
    with Image.open(io.BytesIO(long)) as opened:
        assert opened.n_frames <= 100
    [text] = events.Tensors("training/video_file")
    assert finished.video.path.name.encode() in text.tensor_proto.string_val[0]
    assert text.step == 10


def test_runs_have_their_own_names(finished, tmp_path):
    changes = [
        {"env_index": 0},
        {"env_index": 1, "infix": "1.4711"},
        {"directory": tmp_path / "evaluation"},
        {"directory": tmp_path / "b" / "evaluation"},
    ]
    runs = [dataclasses.replace(finished.run, **each) for each in changes]
    tracker = TensorBoardTracker(tmp_path / "logs")
    for run in runs:
        tracker.begin(run)
    for number, run in enumerate(runs):
        tracker.episode(run, episode(number))
        tracker.end(run)
    returns = {
        path.name: [e.value for e in read(path).Scalars("training/return")]
        for path in (tmp_path / "logs").iterdir()
    }
    assert returns == {
        "recordings.0.4711.env0": [0.0],
        "recordings.1.4711.env1": [1.5],
        "evaluation.0.4711": [3.0],
        "evaluation.0.4711-2": [4.5],
    }


def test_damaged_files_are_named(finished, tmp_path):
    """Errors of ffmpeg are raised by `end` at the latest; earlier events are kept."""
    finished.video.path.write_bytes(b"no video")
    tracker, run = TensorBoardTracker(), finished.run
    tracker.begin(run)
    tracker.episode(run, episode())
    # Events are flushed immediately, so a killed process loses none.
    assert read(run.directory / "tensorboard" / "0.4711").Scalars("training/return")
    tracker.video(run, finished.video)
    finished.video.metadata_path.write_text(json.dumps({"fps": "10"}))
    with pytest.raises(UnreadableFile, match=r"meta\.json: it has no 'frame_count'"):
        tracker.video(run, finished.video)
    with pytest.raises(EncoderError, match=r"(?s)a preview of .*mp4.*Invalid data"):
        tracker.end(run)
    events = read(run.directory / "tensorboard" / "0.4711")
    assert events.Tags()["scalars"] == ["training/return", "training/length"]
    assert events.Tags()["images"] == []
    (tmp_path / "taken").write_text("")
    with pytest.raises(DirectoryNotWritable, match="taken"):
        TensorBoardTracker(tmp_path / "taken").begin(run)
