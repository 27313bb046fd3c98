# SPDX-License-Identifier: Apache-2.0
"""A `close()` that Ctrl-C interrupts leaves what SIGKILL leaves: nothing is lost."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FrameType
from typing import Any

import gymnasium
import pytest
from parts import parametrize
from recordings import (
    frames_in,
    in_flight,
    manifest_of,
    metadata_of,
    stats_of,
    videos_in,
)
from waiting import wait_until

import mjrec
from mjrec.rendering.finish import finish

PLACES = {
    "deferred": [
        ("stop", "finishing_process"),
        ("_end_recordings", "recorder"),
        ("_take_last_frame", "recorder"),
        ("_journal_end", "recorder"),
        ("end", "span_writer"),
        ("append_line", "spans"),
        ("hand_on", "episode_recording"),
        ("finish", "capture"),
        ("close", "row_log"),
        ("remove_if_done", "spans"),
        ("wait", "finishing_process"),
        ("note_surroundings", "run_journal"),
        ("_write_last_results", "recorder"),
        ("write_stats_file", "stats_file"),
        ("write_manifest_and_stats", "manifest_and_stats"),
    ],
    "live": [
        ("_take_last_frame", "recorder"),
        ("_journal_end", "recorder"),
        ("finish", "video_sink"),
        ("close", "worker_thread"),
        ("count_frames", "video_file"),
        ("describe", "video_sink"),
        ("write_metadata", "video_metadata"),
        ("_write_last_results", "recorder"),
    ],
}


def record(directory: Path, render: str) -> Any:
    """Record two episodes, and the first steps of a third."""
    env = gymnasium.make(
        "InvertedPendulum-v5",
        render_mode="rgb_array",
        width=32,
        height=32,
        max_episode_steps=4,
    )
    monitor = mjrec.Monitor(env, directory, lambda _: True, render=render, workers=0)
    for steps in (4, 4, 2):
        monitor.reset(seed=0)
        for _ in range(steps):
            monitor.step(monitor.action_space.sample() * 0)
    return monitor


def interrupt_at(name: str, module: str, event: str) -> Any:
    """Return a profiler that raises Ctrl-C as a function is called, or has returned."""
    is_raised = False

    def profile(frame: FrameType, what: str, _: object) -> None:
        nonlocal is_raised
        code = frame.f_code
        is_there = code.co_name == name and Path(code.co_filename).stem == module
        if is_there and what == event and not is_raised:
            is_raised = True
            raise KeyboardInterrupt

    return profile


# Takes more than five seconds: a run, its recovery and its videos for each moment.
@parametrize(
    ("render", "place", "event"),
    [
        (render, place, event)
        for render, places in PLACES.items()
        for place in places
        for event in ("call", "return")
    ],
    default=[
        ("deferred", ("append_line", "spans"), "call"),
        ("deferred", ("_write_last_results", "recorder"), "call"),
        ("live", ("finish", "video_sink"), "call"),
        ("live", ("describe", "video_sink"), "return"),
    ],
    part=pytest.mark.crashes,
)
def test_finish_completes_what_ctrl_c_has_cut_short(
    render: str, place: tuple[str, str], event: str, tmp_path: Path
) -> None:
    """All episodes are there; the monitor is closed and lets go of its files."""
    monitor = record(tmp_path, render)
    sys.setprofile(interrupt_at(*place, event))
    try:
        with pytest.raises(KeyboardInterrupt):
            monitor.close()
    finally:
        sys.setprofile(None)
    # Closed: it does nothing more, and another process may put things in order.
    before = sorted(tmp_path.iterdir())
    monitor.close()
    assert sorted(tmp_path.iterdir()) == before
    wait_until(lambda: not mjrec.recover(tmp_path).open_monitors)
    wait_until(lambda: not mjrec.recover(tmp_path).failures)
    assert not any(each.failures for each in finish(tmp_path, workers=1))
    assert stats_of(tmp_path)["episode_lengths"] == [4, 4]
    assert videos_in(tmp_path) == [0, 1, 2]
    assert [len(frames_in(tmp_path, number)) for number in range(3)] == [5, 5, 3]
    assert [metadata_of(tmp_path, k)["complete"] for k in range(3)] == [
        True,
        True,
        False,
    ]
    recorded = [mjrec.load_trajectory(path) for path in sorted(tmp_path.glob("*.h5"))]
    assert [len(each.rewards) for each in recorded] == [4, 4, 2]
    assert len(manifest_of(tmp_path)["videos"]) == 3
    assert in_flight(tmp_path) == []
    assert not list(tmp_path.glob(".*"))
