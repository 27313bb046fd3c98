# SPDX-License-Identifier: Apache-2.0
"""Test Weights & Biases offline by reading the files it writes."""

import dataclasses

import pytest
import wandb
from finished_files import episode, record
from wandb_files import axes, history

from mjrec.trackers import WandbTracker


@pytest.fixture(autouse=True)
def quiet(monkeypatch):
    """Keep wandb away from accounts and the console, and end every run."""
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("WANDB_CONSOLE", "off")
    yield
    if wandb.run is not None:
        wandb.run.finish()
    wandb.teardown()


@pytest.fixture
def finished(tmp_path, make_corridor, play):
    return record(tmp_path / "recordings", make_corridor(10), play)


def offline(directory):
    return {"project": "p", "mode": "offline", "dir": str(directory)}


def log_of(directory):
    wandb.teardown()  # This flushes finished runs.
    [path] = directory.glob("wandb/offline-run-*/*.wandb")
    return path


def logged(directory, key):
    return [row[key] for row in history(log_of(directory)) if key in row]


def test_scalars_have_the_steps_of_the_run_as_their_axis(finished, tmp_path):
    """Evaluation and sub-environments have their own keys."""
    tracker, run = WandbTracker(**offline(tmp_path)), finished.run
    second = dataclasses.replace(run, infix="1.4711", env_index=3)
    for each in (run, second):
        tracker.begin(each)
    tracker.episode(run, episode(0, success=True))
    tracker.episode(run, episode(1))
    tracker.episode(run, episode(2, type="e"))
    tracker.end(run)
    # The tracker's run ends when its last monitor ends.
    tracker.episode(second, episode(3))
    tracker.end(second)
    assert wandb.run is None
    assert logged(tmp_path, "training/return") == [0.0, 1.5]
    assert logged(tmp_path, "training/length") == [10, 10]
    assert logged(tmp_path, "training/success") == [1]
    assert logged(tmp_path, "training/total_steps")[:2] == [10, 20]
    assert logged(tmp_path, "evaluation/return") == [3.0]
    assert logged(tmp_path, "training/env3/return") == [4.5]
    over = axes(log_of(tmp_path))
    assert over["training/*"] == "training/total_steps"
    assert over["training/env3/*"] == "training/env3/total_steps"


def test_late_video_is_logged_at_its_own_step(finished, tmp_path):
    """The video file is copied byte for byte."""
    tracker, run = WandbTracker(**offline(tmp_path)), finished.run
    tracker.begin(run)
    for number in range(3):
        tracker.episode(run, episode(number))
    tracker.video(run, finished.video)
    tracker.episode(run, episode(3))
    tracker.end(run)
    assert logged(tmp_path, "training/return") == [0.0, 1.5, 3.0, 4.5]
    [video] = logged(tmp_path, "training/video")
    assert video["_type"] == "video-file"
    assert video["caption"] == "episode 0"
    files = log_of(tmp_path).parent / "files"
    copied = files / video["path"]
    assert copied.read_bytes() == finished.video.path.read_bytes()
    assert axes(log_of(tmp_path))["training/video"] == "training/video_total_steps"
    [row] = [row for row in history(log_of(tmp_path)) if "training/video" in row]
    assert row["training/video_total_steps"] == 10


@pytest.mark.parametrize("how", ["given", "active", "beside"])
def test_foreign_run_stays_open(how, finished, tmp_path):
    """A tracker with options starts and ends a separate run."""
    for name in ("theirs", "ours"):
        (tmp_path / name).mkdir()
    theirs = wandb.init(**offline(tmp_path / "theirs"))
    options = offline(tmp_path / "ours") if how == "beside" else {}
    tracker = WandbTracker(theirs if how == "given" else None, **options)
    tracker.begin(finished.run)
    tracker.episode(finished.run, episode(1))
    tracker.end(finished.run)
    theirs.log({"loss": 0.5})
    theirs.finish()
    assert logged(tmp_path / "theirs", "loss") == [0.5]
    place = tmp_path / ("ours" if how == "beside" else "theirs")
    assert logged(place, "training/return") == [1.5]
