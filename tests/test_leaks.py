# SPDX-License-Identifier: Apache-2.0
"""A thousand recorded episodes leave the process as it was."""

from __future__ import annotations

import gc
import os
import re
import threading
from dataclasses import dataclass
from pathlib import Path

import gymnasium
from parts import parametrize
from processes import children
from waiting import wait_until

from mjrec import Monitor, load_results

EPISODES = 1000
# Until all code is loaded, and all memory that is used again has been used.
WARM_UP = 200
# Of statistics, which grow by some hundred bytes an episode, and of Python's arenas.
MOST_GROWTH = 4 << 20


@dataclass(frozen=True)
class Held:
    """What this process holds.

    Attributes:
        memory: resident, in bytes.
        files: what its descriptors refer to.
        threads: the names of its threads.
        children: the numbers of its processes.
    """

    memory: int
    files: list[str]
    threads: list[str]
    children: set[int]


def held():
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Held(
        memory=pages * os.sysconf("SC_PAGE_SIZE"),
        files=sorted(_file(fd) for fd in Path("/proc/self/fd").iterdir()),
        threads=sorted({thread.name for thread in threading.enumerate()}),
        children=children(),
    )


def _file(descriptor):
    try:
        # Pipes and sockets have numbers of their own, and so has each log.
        name = str(descriptor.readlink()).split(":")[0]
        return re.sub(r"\.\d{6}\.(log|looks|tail)$", "", name)
    except FileNotFoundError:  # of the listing itself
        return ""


def run(monitor, episodes):
    for seed in range(episodes):
        monitor.reset(seed=seed)
        for _ in range(3):
            monitor.step(monitor.action_space.sample() * 0)


# Takes more than five seconds: a thousand episodes, so that what grows is seen.
@parametrize("workers", [1, 0])
def test_recorded_episodes_leave_nothing(workers, tmp_path):
    """Memory, files, threads and processes; each episode with its trajectory."""
    env = gymnasium.make(
        "InvertedPendulum-v5", width=32, height=32, max_episode_steps=3
    )
    before = held()
    monitor = Monitor(
        env,
        tmp_path,
        # Some videos, so that there are workers and encoders to be left behind.
        lambda episode: episode % 200 == 0,
        trajectory_callable=True,
        workers=workers,
    )
    run(monitor, WARM_UP)
    # What looks for the run's provenance has ended then; what renders stays.
    wait_until(lambda: len(children() - before.children) <= workers)
    warm = held()
    run(monitor, EPISODES - WARM_UP)
    late = held()
    assert late.memory - warm.memory < MOST_GROWTH
    assert late.files == warm.files
    assert late.threads == warm.threads
    monitor.close()
    after = held()
    assert after.files == before.files
    assert after.children <= before.children
    assert after.threads == before.threads
    results = load_results(tmp_path)
    assert results is not None
    assert results["episode_lengths"] == [3] * EPISODES
    assert len(list(tmp_path.glob("*.h5"))) == EPISODES
    assert len(list(tmp_path.glob("*.mp4"))) == (EPISODES // 200 if workers else 0)


# Takes more than five seconds: an encoder for each episode.
@parametrize("count", [60, EPISODES])
def test_live_episodes_leave_nothing(count, tmp_path, make_corridor):
    """Each has an encoder of its own."""
    before = held()
    monitor = Monitor(make_corridor(3, size=(16, 16)), tmp_path, lambda _: True)
    run(monitor, count // 3)
    warm = held()
    run(monitor, count - count // 3)
    late = held()
    assert late.memory - warm.memory < MOST_GROWTH
    assert (late.files, late.threads) == (warm.files, warm.threads)
    assert late.children == warm.children
    monitor.close()
    after = held()
    assert (after.files, after.threads) == (before.files, before.threads)
    assert after.children <= before.children
    assert len(list(tmp_path.glob("*.mp4"))) == count
