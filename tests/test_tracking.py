# SPDX-License-Identifier: Apache-2.0
"""What trackers are told."""

import logging

import gymnasium
import numpy as np
from recordings import frames_of, manifest_of

import mjrec
from mjrec.recorder.tracking import Tracker


class Listening(Tracker):
    """Writes down all that it is told."""

    def __init__(self):
        self.told = []
        self.runs = []

    def begin(self, run):
        self._note(run, "begin", None)

    def episode(self, run, episode):
        self._note(run, "episode", episode)

    def video(self, run, video):
        assert video.path.exists()
        assert video.metadata_path.exists()
        self._note(run, "video", video)

    def end(self, run):
        self._note(run, "end", None)

    def _note(self, run, what, facts):
        self.runs.append(run)
        self.told.append((what, facts))

    def of(self, what):
        return [facts for told, facts in self.told if told == what]


class Failing(Tracker):
    """Has lost its server."""

    def __init__(self):
        self.calls = 0
        self.ends = 0

    def episode(self, run, episode):
        self.calls += 1
        raise ConnectionError("no server")

    def end(self, run):
        self.ends += 1
        raise ConnectionError("no server here either")


def record(directory, env_id, *, episodes=2, **options):
    """Record short episodes; return the monitor, closed."""
    size = {"height": 32, "width": 32}
    if "camera" in options:
        made = gymnasium.make(env_id, max_episode_steps=3)
        options = {**size, **options}
    else:
        made = gymnasium.make(
            env_id, max_episode_steps=3, render_mode="rgb_array", **size
        )
        options = {"render": "live", **options}
    with mjrec.Monitor(made, directory, lambda _: True, **options) as env:
        for episode in range(episodes):
            env.reset(seed=episode)
            done = False
            while not done:
                step = env.step(np.zeros(env.action_space.shape))
                *_, terminated, truncated, _ = step
                done = terminated or truncated
    return env


def test_tracker_is_told_every_episode_and_live_video(tmp_path):
    """In order, with the facts of each, and of which run."""
    tracker = Listening()
    env = record(tmp_path, "InvertedPendulum-v5", trackers=tracker)
    assert [what for what, _ in tracker.told] == [
        *("begin", "episode", "video", "episode", "video", "end")
    ]
    first, second = tracker.of("episode")
    assert (first.episode_id, first.length, first.reward) == (0, 3, 3.0)
    assert (first.truncated, first.seed, second.seed) == (True, 0, 1)
    assert (first.total_steps, second.total_steps) == (3, 6)
    assert [video.episode for video in tracker.of("video")] == [first, second]
    assert {run.infix for run in tracker.runs} == {env.infix}
    assert {run.directory for run in tracker.runs} == {tmp_path}
    assert {run.env_id for run in tracker.runs} == {"InvertedPendulum-v5"}


def test_tracker_is_told_deferred_videos_when_they_are_there(tmp_path):
    """At the latest in close; each once, whole."""
    tracker = Listening()
    record(tmp_path, "HalfCheetah-v5", render="deferred", trackers=[tracker])
    videos = tracker.of("video")
    assert [video.episode_id for video in videos] == [0, 1]
    assert [len(frames_of(video.path)) for video in videos] == [4, 4]
    assert tracker.told[-1][0] == "end"
    # Of pending ones there is nothing to upload yet.
    pending = Listening()
    options = {"render": "deferred", "workers": 0, "trackers": pending}
    record(tmp_path / "pending", "HalfCheetah-v5", **options)
    assert len(pending.of("episode")) == 2
    assert not pending.of("video")


def test_tracker_that_raises_is_dismissed_and_the_rest_goes_on(tmp_path, caplog):
    """The log has why, the manifest too, and the others are told all."""
    failing, listening = Failing(), Listening()
    with caplog.at_level(logging.ERROR, "mjrec"):
        record(tmp_path, "InvertedPendulum-v5", trackers=[failing, listening])
    assert (failing.calls, failing.ends) == (1, 1)
    assert len(listening.of("episode")) == 2
    assert "Failing failed" in caplog.text
    [fault] = manifest_of(tmp_path)["mjrec"]["faults"]
    assert fault == {"episode_id": 0, "what": "tracker", "reason": "Failing: no server"}
