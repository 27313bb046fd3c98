# SPDX-License-Identifier: Apache-2.0
"""A `close()` that Ctrl-C interrupts leaves what SIGKILL leaves: nothing is lost."""

import contextlib
import gc
import math
import sys
from pathlib import Path

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

MOMENTS = 20
_ENTRANCE = ("close", "close_here", "call_all", "_leaving_if_interrupted")


def record(directory, render):
    """Record two episodes, and the first steps of a third."""
    size = {"width": 32, "height": 32, "max_episode_steps": 4}
    env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array", **size)
    monitor = mjrec.Monitor(env, directory, lambda _: True, render=render, workers=0)
    for steps in (4, 4, 2):
        monitor.reset(seed=0)
        for _ in range(steps):
            monitor.step(monitor.action_space.sample() * 0)
    return monitor


def close(monitor, last=math.inf):
    """Close it, press Ctrl-C behind so many calls and returns, and return their count.

    They are those of mjrec's functions.
    """
    count = 0

    def interrupt(frame, event, _):
        nonlocal count
        path = Path(frame.f_code.co_filename)
        # While HDF5 writes, signals wait.
        is_ours = "mjrec" in path.parts and path.stem != "trajectory_hdf5"
        if event in ("call", "return") and is_ours:
            count += 1
            # At its very entrance closing has not begun: the next call does all of it.
            if count >= last and frame.f_code.co_name not in _ENTRANCE:
                raise KeyboardInterrupt

    sys.setprofile(interrupt)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            monitor.close()
    finally:
        sys.setprofile(None)
        gc.collect()
    return count


# Takes more than five seconds: a run, its recovery and its videos for each moment. A
# file that was opened in just that moment is closed by the garbage collection.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@parametrize(
    ("render", "moment"),
    [(render, k) for render in ("deferred", "live") for k in range(MOMENTS)],
    default=[("deferred", 7), ("deferred", 15), ("live", 5), ("live", 15)],
    part=pytest.mark.crashes,
)
def test_finish_completes_what_ctrl_c_has_cut_short(render, moment, tmp_path):
    """All episodes are there; the monitor is closed and lets go of its files."""
    whole = close(record(tmp_path / "whole", render))
    directory = tmp_path / "cut"
    monitor = record(directory, render)
    last = whole * (moment + 0.5) // MOMENTS
    # Python takes a profiler that has raised for a broken one.
    assert close(monitor, last) >= last
    # Closed: it does nothing more, and another process may put things in order.
    before = sorted(directory.iterdir())
    monitor.close()
    assert sorted(directory.iterdir()) == before
    wait_until(lambda: not mjrec.recover(directory).open_monitors)
    wait_until(lambda: not mjrec.recover(directory).failures)
    assert not any(each.failures for each in finish(directory, workers=1))
    assert stats_of(directory)["episode_lengths"] == [4, 4]
    assert videos_in(directory) == [0, 1, 2]
    assert [len(frames_in(directory, number)) for number in range(3)] == [5, 5, 3]
    complete = [metadata_of(directory, number)["complete"] for number in range(3)]
    assert complete == [True, True, False]
    assert [
        len(mjrec.load_trajectory(p).rewards) for p in sorted(directory.glob("*.h5"))
    ] == [4, 4, 2]
    assert len(manifest_of(directory)["videos"]) == 3
    assert in_flight(directory) == []
    assert not list(directory.glob(".*"))
