# SPDX-License-Identifier: Apache-2.0
"""What trackers are told."""

import gymnasium
import numpy as np
from recordings import frames_of, manifest_of

import mjrec
from mjrec.recorder.tracking import Tracker


class Listening(Tracker):
    """Writes down all that it is told, and fails where it is told to."""

    def __init__(self, fails=()):
        self.told, self.fails = [], fails

    def begin(self, run):
        self.note("begin", run)

    def episode(self, run, episode):
        self.note("episode", run, episode)

    def video(self, run, video):
        assert video.path.exists()
        assert video.metadata_path.exists()
        self.note("video", run, video)

    def end(self, run):
        self.note("end", run)

    def note(self, what, run, facts=None):
        self.told.append((what, run, facts))
        if what in self.fails:
            raise ConnectionError("no server")

    def of(self, what):
        return [facts for told, _, facts in self.told if told == what]


def record(directory, *trackers, **options):
    """Record two episodes of three steps; return the monitor, closed."""
    view = {"height": 32, "width": 32, "render_mode": "rgb_array"}
    made = gymnasium.make("InvertedPendulum-v5", max_episode_steps=3, **view)
    options = {"trackers": trackers, **options}
    with mjrec.Monitor(made, directory, lambda _: True, **options) as env:
        for seed in range(2):
            env.reset(seed=seed)
            for _ in range(3):
                env.step(np.zeros(1))
    return env


def test_tracker_is_told_every_episode_and_live_video(tmp_path):
    """In order, with the facts of each, and of which run."""
    tracker = Listening()
    env = record(tmp_path, tracker, render="live")
    assert [what for what, *_ in tracker.told] == [
        *("begin", "episode", "video", "episode", "video", "end")
    ]
    first, second = tracker.of("episode")
    assert (first.episode_id, first.length, first.reward) == (0, 3, 3.0)
    assert (first.truncated, first.seed, second.seed) == (True, 0, 1)
    assert (first.total_steps, second.total_steps) == (3, 6)
    assert [video.episode for video in tracker.of("video")] == [first, second]
    assert {(run.infix, run.directory, run.env_id) for _, run, _ in tracker.told} == {
        (env.infix, tmp_path, "InvertedPendulum-v5")
    }


def test_tracker_is_told_deferred_videos_when_they_are_there(tmp_path):
    """At the latest in close; each once, whole; of pending ones never."""
    tracker, pending = Listening(), Listening()
    record(tmp_path, tracker)
    videos = tracker.of("video")
    assert [video.episode_id for video in videos] == [0, 1]
    assert [len(frames_of(video.path)) for video in videos] == [4, 4]
    assert tracker.told[-1][0] == "end"
    record(tmp_path / "pending", pending, workers=0)
    assert len(pending.of("episode")) == 2
    assert not pending.of("video")


def test_tracker_that_raises_is_dismissed_and_the_rest_goes_on(tmp_path, caplog):
    """The log has why, the manifest too, and the others are told all."""
    failing, listening = Listening(("episode", "end")), Listening()
    record(tmp_path, failing, listening, render="live")
    assert [what for what, *_ in failing.told] == ["begin", "episode", "end"]
    assert len(listening.of("episode")) == 2
    assert "Listening failed" in caplog.text
    [fault] = manifest_of(tmp_path)["mjrec"]["faults"]
    reason = "Listening: no server"
    assert fault == {"episode_id": 0, "what": "tracker", "reason": reason}
