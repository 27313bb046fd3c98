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


class Interrupting:
    """Counts what functions of mjrec do, and presses Ctrl-C behind so many events."""

    def __init__(self, last=math.inf):
        self.count = 0
        self.last = last

    def __call__(self, frame, event, _):
        path = Path(frame.f_code.co_filename)
        # While HDF5 writes, signals wait.
        is_ours = "mjrec" in path.parts and path.stem != "trajectory_hdf5"
        if event in ("call", "return") and is_ours:
            self.count += 1
            # At its very entrance closing has not begun: the next call does all of it.
            if self.count >= self.last and frame.f_code.co_name not in _ENTRANCE:
                raise KeyboardInterrupt


def close(monitor, interrupting):
    """Close it, and be interrupted."""
    sys.setprofile(interrupting)
    try:
        with contextlib.suppress(KeyboardInterrupt):
            monitor.close()
    finally:
        sys.setprofile(None)
        gc.collect()


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
    whole = Interrupting()
    close(record(tmp_path / "whole", render), whole)
    directory = tmp_path / "cut"
    monitor = record(directory, render)
    cut = Interrupting(whole.count * (moment + 0.5) // MOMENTS)
    close(monitor, cut)
    # Python takes a profiler that has raised for a broken one.
    assert cut.count >= cut.last
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
    assert [metadata_of(directory, k)["complete"] for k in range(3)] == [
        True,
        True,
        False,
    ]
    recorded = [mjrec.load_trajectory(path) for path in sorted(directory.glob("*.h5"))]
    assert [len(each.rewards) for each in recorded] == [4, 4, 2]
    assert len(manifest_of(directory)["videos"]) == 3
    assert in_flight(directory) == []
    assert not list(directory.glob(".*"))
