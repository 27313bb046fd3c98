# SPDX-License-Identifier: Apache-2.0
"""A thousand recorded episodes leak no memory, files, threads or processes."""

import gc
import os
import re
import threading
from pathlib import Path

import gymnasium
import pytest
from parts import parametrize
from processes import children
from waiting import wait_until

from mjrec import Monitor, load_results

EPISODES = 1000
# Meanwhile code is loaded and reusable memory allocated.
WARM_UP = 200
# Statistics take some hundred bytes an episode, and Python's arenas vary.
MOST_GROWTH = 4 << 20


def memory():
    """Return the resident bytes of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def held():
    """Return this process's open files and the names of its threads."""
    gc.collect()
    return {
        "files": sorted(_file(fd) for fd in Path("/proc/self/fd").iterdir()),
        "threads": sorted({thread.name for thread in threading.enumerate()}),
    }


def _file(descriptor):
    try:
        # Pipes, sockets and logs have numbers that differ each time.
        name = str(descriptor.readlink()).split(":")[0]
        return re.sub(r"\.\d{6}\.(log|looks|tail)$", "", name)
    except FileNotFoundError:  # the descriptor of the listing itself
        return ""


def run(monitor, episodes):
    for seed in range(episodes):
        monitor.reset(seed=seed)
        for _ in range(3):
            monitor.step(monitor.action_space.sample() * 0)


# Takes more than five seconds: growth shows after a thousand episodes.
@pytest.mark.usefixtures("no_process_is_left")
@parametrize("workers", [1, 0])
def test_deferred_episodes_leak_nothing(workers, tmp_path):
    env = gymnasium.make(
        "InvertedPendulum-v5", width=32, height=32, max_episode_steps=3
    )
    before, others = held(), children()
    # Some episodes have videos, so that workers and encoders could leak.
    options = {"trajectory_callable": True, "workers": workers}
    monitor = Monitor(env, tmp_path, lambda episode: episode % 200 == 0, **options)
    run(monitor, WARM_UP)
    # The process that collects provenance has ended then; the renderer stays.
    wait_until(lambda: len(children() - others) <= workers)
    warm, used = held(), memory()
    run(monitor, EPISODES - WARM_UP)
    assert memory() - used < MOST_GROWTH
    assert held() == warm
    monitor.close()
    assert held() == before
    assert load_results(tmp_path)["episode_lengths"] == [3] * EPISODES
    assert len(list(tmp_path.glob("*.h5"))) == EPISODES
    assert len(list(tmp_path.glob("*.mp4"))) == (EPISODES // 200 if workers else 0)


def test_dropped_episodes_release_their_tails_without_garbage_collection(tmp_path):
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=3)
    monitor = Monitor(env, tmp_path, keep="worst:3", workers=0)
    gc.disable()
    try:
        run(monitor, 20)
        maps = Path("/proc/self/maps").read_text()
        assert len(set(re.findall(r"\S+\.tail", maps))) <= 4
    finally:
        gc.enable()
        monitor.close(wait=False)


# Takes more than five seconds: each episode has an encoder.
@pytest.mark.usefixtures("no_process_is_left")
@parametrize("count", [60, EPISODES])
def test_live_episodes_leak_nothing(count, tmp_path, make_corridor):
    before = held()
    monitor = Monitor(make_corridor(3, size=(16, 16)), tmp_path, lambda _: True)
    run(monitor, count // 3)
    warm, encoders, used = held(), children(), memory()
    run(monitor, count - count // 3)
    assert memory() - used < MOST_GROWTH
    assert (held(), children()) == (warm, encoders)
    monitor.close()
    assert held() == before
    assert len(list(tmp_path.glob("*.mp4"))) == count
