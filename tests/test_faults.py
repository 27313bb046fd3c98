# SPDX-License-Identifier: Apache-2.0
"""A recording that fails: the simulation stops, or goes on, as the user wants."""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from full_disk import file_size_limit
from recordings import (
    frames_in,
    in_flight,
    journal_of,
    manifest_of,
    metadata_of,
    stats_of,
)

import mjrec
from mjrec import EncoderError, FileNotWritten, InvalidArgument, Monitor, RenderError

Pendulum = Callable[..., Any]


@pytest.fixture
def pendulum(tmp_path: Path) -> Pendulum:
    """Make monitored pendulums that stay up for eight steps."""

    def make(**options: Any) -> Any:
        env = gymnasium.make(
            "InvertedPendulum-v5",
            render_mode="rgb_array",
            height=32,
            width=48,
            max_episode_steps=8,
        )
        return Monitor(env, tmp_path / "run", lambda _: True, **options)

    return make


def run(monitor: Any, steps: int = 8) -> None:
    """Take the first steps of an episode."""
    monitor.reset(seed=0)
    go_on(monitor, steps)


def go_on(monitor: Any, steps: int) -> None:
    """Take some more."""
    for _ in range(steps):
        monitor.step(monitor.action_space.sample() * 0)


@contextlib.contextmanager
def not_drawn(monitor: Any, why: str) -> Iterator[None]:
    """Let the environment's render() raise."""

    def render(*_: object) -> None:
        raise RuntimeError(why)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(monitor.unwrapped, "render", render)
        yield


def raised(
    on_error: str, kind: type[Exception], match: str
) -> contextlib.AbstractContextManager[object]:
    """Expect an error where it is to be raised, and none where it is to be told."""
    if on_error == "raise":
        return pytest.raises(kind, match=match)
    return contextlib.nullcontext()


def remove(directory: Path) -> None:
    """Remove a directory, though a thread may be writing a model there."""
    while directory.exists():
        shutil.rmtree(directory, ignore_errors=True)


def faults_of(directory: Path) -> list[tuple[int | None, str]]:
    found = manifest_of(directory)["mjrec"]["faults"]
    assert all(fault["reason"] for fault in found)
    return [(fault["episode_id"], fault["what"]) for fault in found]


def test_a_run_without_faults_says_so(pendulum: Pendulum, tmp_path: Path) -> None:
    """With an empty list."""
    with pendulum(render="live", on_error="warn") as monitor:
        run(monitor)
    assert faults_of(tmp_path / "run") == []


def test_a_schedule_that_raises_breaks_no_finished_video(tmp_path: Path) -> None:
    """The episode before is over, and its video was whole."""

    def schedule(episode: int) -> bool:
        if episode == 1:
            raise RuntimeError("no idea")
        return True

    env = gymnasium.make(
        "InvertedPendulum-v5",
        render_mode="rgb_array",
        height=32,
        width=48,
        max_episode_steps=8,
    )
    run_path = tmp_path / "run"
    with Monitor(env, run_path, schedule, render="live", on_error="warn") as monitor:
        run(monitor)
        first = monitor.video_recorder
        run(monitor)
        assert not first.broken
        run(monitor)
    assert [len(frames_in(run_path, episode)) for episode in (0, 2)] == [9, 9]
    details = manifest_of(run_path)["mjrec"]
    assert details["broken"] == []
    assert [fault["reason"] for fault in details["faults"]] == ["no idea"]


@pytest.mark.parametrize("value", ["ignore", None, True])
def test_on_error_is_one_of_two(value: Any, pendulum: Pendulum) -> None:
    """Nothing else, and the message says what there is."""
    with pytest.raises(InvalidArgument, match='"raise", or "warn"'):
        pendulum(on_error=value)


def test_dead_encoder(
    pendulum: Pendulum,
    tmp_path: Path,
    kill_ffmpeg: Callable[[], int],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The episode's statistics are there, and the next has its video."""
    monitor = pendulum(render="live", on_error="warn")
    run(monitor, 4)
    assert kill_ffmpeg() == 1
    go_on(monitor, 4)
    run(monitor)
    monitor.close()
    assert faults_of(tmp_path / "run") == [(0, "video")]
    assert metadata_of(tmp_path / "run", 0)["broken"] is True
    assert len(frames_in(tmp_path / "run", 1)) == 9
    assert stats_of(tmp_path / "run")["episode_lengths"] == [8, 8]
    assert [r.levelno for r in caplog.records if "Not recorded whole" in r.message] == [
        logging.WARNING
    ]


def test_dead_encoder_is_an_error_by_default(
    pendulum: Pendulum, kill_ffmpeg: Callable[[], int]
) -> None:
    """And the monitor goes on all the same, for whoever catches it."""
    monitor = pendulum(render="live")
    run(monitor, 4)
    assert kill_ffmpeg() == 1
    with pytest.raises(EncoderError):
        go_on(monitor, 4)
    monitor.close()


def test_environment_that_cannot_be_drawn_any_more(
    pendulum: Pendulum, tmp_path: Path
) -> None:
    """What its render() raises ends the video, not the simulation."""
    monitor = pendulum(render="live", on_error="warn")
    run(monitor, 4)

    with not_drawn(monitor, "the window is gone"):
        go_on(monitor, 4)
    monitor.close()
    assert faults_of(tmp_path / "run") == [(0, "video")]
    metadata = metadata_of(tmp_path / "run", 0)
    assert metadata["broken_reason"] == "the window is gone"
    assert len(frames_in(tmp_path / "run", 0)) == 5


@pytest.mark.parametrize("on_error", ["raise", "warn"])
def test_full_disk_while_an_episode_is_recorded(
    on_error: str, pendulum: Pendulum, tmp_path: Path
) -> None:
    """Its trajectory ends there; what was recorded before is whole."""
    monitor = pendulum(workers=0, on_error=on_error)
    run(monitor)
    # A thread stores it, and this is not about that.
    while not list((tmp_path / "run").glob("*.mjb.gz")):
        time.sleep(0.01)
    with file_size_limit(200), raised(on_error, FileNotWritten, "states"):
        run(monitor)
    while not monitor.stats_recorder.done:
        monitor.step(monitor.action_space.sample() * 0)
    run(monitor)
    monitor.close()
    assert stats_of(tmp_path / "run")["episode_lengths"] == [8, 8, 8]
    if on_error == "warn":
        assert (1, "trajectory") in faults_of(tmp_path / "run")
    whole = mjrec.load_trajectory(next((tmp_path / "run").glob("*episode000002.h5")))
    assert len(whole.rewards) == 8


@pytest.mark.parametrize("on_error", ["raise", "warn"])
def test_full_disk_at_the_journal(
    on_error: str, pendulum: Pendulum, tmp_path: Path
) -> None:
    """The statistics come from memory at the close; the journal has whole lines."""
    monitor = pendulum(render="off", trajectory_callable=False, on_error=on_error)
    run(monitor)
    size = sum(p.stat().st_size for p in (tmp_path / "run").glob("*.jsonl"))
    with file_size_limit(size + 20), raised(on_error, OSError, "episodes"):
        run(monitor)
    run(monitor)
    monitor.close()
    assert stats_of(tmp_path / "run")["episode_lengths"] == [8, 8, 8]
    assert [entry["episode_id"] for entry in journal_of(tmp_path / "run")] == [0, 2]
    if on_error == "warn":
        assert faults_of(tmp_path / "run") == [(1, "journal")]


@pytest.mark.parametrize("render", ["live", "deferred"])
def test_directory_that_is_removed_during_the_run(
    render: str, pendulum: Pendulum, tmp_path: Path
) -> None:
    """The simulation goes on to its end; that no results can be written is an error."""
    monitor = pendulum(render=render, workers=0, on_error="warn")
    run(monitor)
    remove(tmp_path / "run")
    run(monitor)
    run(monitor, 3)
    with pytest.raises(FileNotWritten, match=r"stats\.json"):
        monitor.close()
    assert not (tmp_path / "run").exists()
    (tmp_path / "run").mkdir()
    monitor.close()
    assert stats_of(tmp_path / "run")["episode_lengths"] == [8, 8]


def test_disk_that_has_no_room_at_all(pendulum: Pendulum, tmp_path: Path) -> None:
    """What nothing was written of is not promised, and the results come later."""
    monitor = pendulum(workers=0, on_error="warn")
    with file_size_limit(0):
        run(monitor)
        with pytest.raises(FileNotWritten):
            monitor.close()
    monitor.close()
    assert stats_of(tmp_path / "run")["episode_lengths"] == [8]
    assert (0, "trajectory") in faults_of(tmp_path / "run")
    assert manifest_of(tmp_path / "run")["mjrec"]["pending"] == []
    assert in_flight(tmp_path / "run") == []


@pytest.mark.parametrize("on_error", ["raise", "warn"])
def test_first_picture_that_cannot_be_drawn(
    on_error: str, pendulum: Pendulum, tmp_path: Path
) -> None:
    """States are recorded all the same; the metadata says what became of the video."""
    monitor = pendulum(render="live", on_error=on_error)
    why = "no window yet"
    with not_drawn(monitor, why), raised(on_error, RuntimeError, why):
        run(monitor)
    run(monitor)
    monitor.close()
    if on_error == "raise":
        # The reset after it has replaced the one that was never whole.
        assert len(frames_in(tmp_path / "run", 0)) == 9
    else:
        assert len(frames_in(tmp_path / "run", 1)) == 9
        assert faults_of(tmp_path / "run") == [(0, "video")]
        assert metadata_of(tmp_path / "run", 0)["broken_reason"] == "no window yet"
        assert len(list((tmp_path / "run").glob("*.h5"))) == 2


def test_a_reset_is_allowed_after_a_picture_that_failed(
    pendulum: Pendulum, tmp_path: Path
) -> None:
    """There is no other way on for whoever catches the error."""
    monitor = pendulum(render="live")
    run(monitor, 4)
    with (
        not_drawn(monitor, "the window is gone"),
        pytest.raises(RuntimeError, match="the window is gone"),
    ):
        go_on(monitor, 1)
    run(monitor)
    monitor.close()
    metadata = metadata_of(tmp_path / "run", 0)
    assert metadata["exception"]["message"] == "the window is gone"


def test_directory_that_is_removed_is_an_error_by_default(
    pendulum: Pendulum, tmp_path: Path
) -> None:
    """At the first thing that cannot be written, which it names."""
    monitor = pendulum(workers=0)
    run(monitor)
    remove(tmp_path / "run")
    with pytest.raises(FileNotWritten, match="states"):
        run(monitor)
    with pytest.raises(FileNotWritten):
        monitor.close()
    (tmp_path / "run").mkdir()
    monitor.close()
    assert stats_of(tmp_path / "run")["episode_lengths"] == [8]


def test_directory_that_is_made_anew_is_noticed(
    pendulum: Pendulum, tmp_path: Path
) -> None:
    """At the end of the next episode: the journal is another one, or none."""
    monitor = pendulum(render="off", trajectory_callable=False)
    run(monitor)
    remove(tmp_path / "run")
    (tmp_path / "run").mkdir()
    with pytest.raises(FileNotWritten, match="removed while it was written"):
        run(monitor)
    run(monitor)
    monitor.close()
    assert stats_of(tmp_path / "run")["episode_lengths"] == [8, 8, 8]


@pytest.mark.parametrize("on_error", ["raise", "warn"])
def test_videos_that_cannot_be_rendered(
    on_error: str,
    pendulum: Pendulum,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """They stay pending, and the trajectories are there."""
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    monitor = pendulum(workers=1, on_error=on_error)
    run(monitor)
    if on_error == "raise":
        with pytest.raises(RenderError):
            monitor.close()
    else:
        monitor.close()
        assert "could not be rendered" in caplog.text
    details = manifest_of(tmp_path / "run")["mjrec"]
    assert [pending["episode_id"] for pending in details["pending"]] == [0]
    assert list((tmp_path / "run").glob("*.h5"))


def test_wrong_use_is_an_error_in_any_case(pendulum: Pendulum) -> None:
    """A step before the first reset is nothing to go on from."""
    monitor = pendulum(render="off", on_error="warn")
    with pytest.raises(mjrec.ResetNeeded):
        monitor.step(0)
    monitor.close()


def test_faults_are_plain_json(pendulum: Pendulum, tmp_path: Path) -> None:
    """As everything in the manifest."""
    with pendulum(render="off", on_error="warn") as monitor:
        run(monitor)
        with file_size_limit(0):
            run(monitor)
    text = next((tmp_path / "run").glob("*.manifest.json")).read_text()
    assert json.loads(text)["mjrec"]["faults"]
