# SPDX-License-Identifier: Apache-2.0
"""Test many monitors that record into one directory at the same time."""

import copy
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from recordings import frames_of

import mjrec
from conftest import run_episodes
from mjrec import Monitor, NotPicklable

WRITERS = 8
EPISODES = 3
STEPS = 4


def test_eight_threads_record_into_one_directory(tmp_path, make_corridor):
    barrier = threading.Barrier(WRITERS)

    def record(_):
        env = make_corridor(STEPS, size=(16, 16))
        barrier.wait(30)
        with Monitor(env, tmp_path, lambda _: True, resume=True) as monitor:
            run_episodes(monitor, EPISODES)

    with ThreadPoolExecutor(WRITERS) as threads:
        list(threads.map(record, range(WRITERS)))
    infixes = {path.name.split(".")[2] for path in tmp_path.glob("*.jsonl")}
    assert len(infixes) == len(list(tmp_path.glob("*.manifest.json"))) == WRITERS
    lengths = mjrec.load_results(tmp_path)["episode_lengths"]
    assert lengths == [STEPS] * (WRITERS * EPISODES)
    assert not list(tmp_path.glob("*.part*"))
    videos = list(tmp_path.glob("*.mp4"))
    assert len(videos) == WRITERS * EPISODES
    assert {len(frames_of(video)) for video in videos} == {STEPS + 1}


@pytest.mark.parametrize("send", [pickle.dumps, copy.copy, copy.deepcopy])
def test_monitor_cannot_be_pickled_or_copied(send, tmp_path, corridor):
    with Monitor(corridor, tmp_path, video_callable=False) as monitor:
        with pytest.raises(NotPicklable, match="inside the function") as caught:
            send(monitor)
        assert isinstance(caught.value, TypeError)
