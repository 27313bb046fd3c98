# SPDX-License-Identifier: Apache-2.0
"""Many monitors record into one directory at once."""

import copy
import pickle
import threading

import gymnasium
import pytest
from recordings import frames_of

import mjrec
from mjrec import Monitor, NotPicklable

WRITERS = 8
EPISODES = 3
STEPS = 4


def check(directory):
    """Check that there is everything of everyone, and nothing twice."""
    infixes = {path.name.split(".")[2] for path in directory.glob("*.jsonl")}
    assert len(infixes) == WRITERS
    results = mjrec.load_results(directory)
    assert results is not None
    assert results["episode_lengths"] == [STEPS] * (WRITERS * EPISODES)
    assert len(list(directory.glob("*.manifest.json"))) == WRITERS
    assert not list(directory.glob("*.part*"))


def test_eight_threads(tmp_path, make_corridor):
    """Each with a monitor of its own, and an encoder at work in each."""
    errors = []
    barrier = threading.Barrier(WRITERS)

    def record():
        try:
            env = make_corridor(STEPS, size=(16, 16))
            barrier.wait(30)
            with Monitor(env, tmp_path, lambda _: True, resume=True) as monitor:
                for _ in range(EPISODES):
                    monitor.reset()
                    for _ in range(STEPS):
                        monitor.step(0)
        except BaseException as error:
            errors.append(error)
            raise

    threads = [threading.Thread(target=record) for _ in range(WRITERS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert errors == []
    check(tmp_path)
    videos = list(tmp_path.glob("*.mp4"))
    assert len(videos) == WRITERS * EPISODES
    assert {len(frames_of(video)) for video in videos} == {STEPS + 1}


@pytest.mark.parametrize("send", [pickle.dumps, copy.copy, copy.deepcopy])
def test_a_monitor_is_not_sent_to_another_process(send, tmp_path):
    """The error says where to make it instead."""
    with Monitor(
        gymnasium.make("InvertedPendulum-v5"), tmp_path, video_callable=False
    ) as monitor:
        with pytest.raises(NotPicklable, match="inside the function") as caught:
            send(monitor)
        assert isinstance(caught.value, TypeError)
