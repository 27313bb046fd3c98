# SPDX-License-Identifier: Apache-2.0
"""A `close` interrupted by Ctrl-C loses nothing, like one interrupted by SIGKILL."""

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
    """Record two episodes and the first steps of a third."""
    size = {"width": 32, "height": 32, "max_episode_steps": 4}
    env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array", **size)
    monitor = mjrec.Monitor(env, directory, lambda _: True, render=render, workers=0)
    for steps in (4, 4, 2):
        monitor.reset(seed=0)
        for _ in range(steps):
            monitor.step(monitor.action_space.sample() * 0)
    return monitor


def close(monitor, last=math.inf):
    """Close the monitor; interrupt it after `last` calls and returns in mjrec.

    Return the number of calls and returns.
    """
    count = 0

    def interrupt(frame, event, _):
        nonlocal count
        path = Path(frame.f_code.co_filename)
        # Signals wait while HDF5 writes.
        is_ours = "mjrec" in path.parts and path.stem != "trajectory_hdf5"
        if event in ("call", "return") and is_ours:
            count += 1
            # At the entrance closing has not begun; the next `close` does all of it.
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


# Takes more than five seconds: it records, recovers and renders a run. Garbage
# collection closes a file that was opened at the moment of Ctrl-C.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@parametrize(
    ("render", "moment"),
    [(render, k) for render in ("deferred", "live") for k in range(MOMENTS)],
    default=[("deferred", 7), ("deferred", 15), ("live", 5), ("live", 15)],
    part=pytest.mark.crashes,
)
def test_an_interrupted_close_releases_all_files_and_loses_no_episode(
    render, moment, tmp_path, names
):
    whole = close(record(tmp_path / "whole", render))
    directory = tmp_path / "cut"
    monitor = record(directory, render)
    last = whole * (moment + 0.5) // MOMENTS
    # Python removes a profiler that raises, so the count ends at Ctrl-C.
    assert close(monitor, last) >= last
    # A second `close` does nothing, and another process may recover the directory.
    before = names(directory)
    monitor.close()
    assert names(directory) == before
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
