# SPDX-License-Identifier: Apache-2.0
"""Test the events that trackers receive."""

import gymnasium
import numpy as np
from recordings import frames_of, manifest_of

import mjrec
from mjrec.recorder.tracking import Tracker


class RecordingTracker(Tracker):
    """A tracker that records all events and raises an error at those in `fails`."""

    def __init__(self, fails=()):
        self.events, self.fails = [], fails

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

    def note(self, kind, run, facts=None):
        self.events.append((kind, run, facts))
        if kind in self.fails:
            raise ConnectionError("no server")

    def of(self, kind):
        return [facts for each, _, facts in self.events if each == kind]


def record(directory, *trackers, **options):
    """Record two episodes of three steps; return the closed monitor."""
    view = {"height": 32, "width": 32, "render_mode": "rgb_array"}
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=3, **view)
    options = {"trackers": trackers, **options}
    with mjrec.Monitor(env, directory, lambda _: True, **options) as env:
        for seed in range(2):
            env.reset(seed=seed)
            for _ in range(3):
                env.step(np.zeros(1))
    return env


def test_tracker_receives_episodes_and_live_videos_in_order(tmp_path):
    tracker = RecordingTracker()
    env = record(tmp_path, tracker, render="live")
    assert [kind for kind, *_ in tracker.events] == [
        *("begin", "episode", "video", "episode", "video", "end")
    ]
    first, second = tracker.of("episode")
    assert (first.episode_id, first.length, first.reward) == (0, 3, 3.0)
    assert (first.truncated, first.seed, second.seed) == (True, 0, 1)
    assert (first.total_steps, second.total_steps) == (3, 6)
    assert [video.episode for video in tracker.of("video")] == [first, second]
    runs = {(run.infix, run.directory, run.env_id) for _, run, _ in tracker.events}
    assert runs == {(env.infix, tmp_path, "InvertedPendulum-v5")}


def test_tracker_receives_each_deferred_video_once_finished(tmp_path):
    """A tracker never receives pending videos."""
    tracker, pending = RecordingTracker(), RecordingTracker()
    record(tmp_path, tracker)
    videos = tracker.of("video")
    assert [video.episode_id for video in videos] == [0, 1]
    assert [len(frames_of(video.path)) for video in videos] == [4, 4]
    assert tracker.events[-1][0] == "end"
    record(tmp_path / "pending", pending, workers=0)
    assert len(pending.of("episode")) == 2
    assert not pending.of("video")


def test_failing_tracker_is_dropped_and_others_continue(tmp_path, caplog):
    """The log and the manifest say why the tracker was dropped."""
    failing, other = RecordingTracker(("episode", "end")), RecordingTracker()
    record(tmp_path, failing, other, render="live")
    assert [kind for kind, *_ in failing.events] == ["begin", "episode", "end"]
    assert len(other.of("episode")) == 2
    assert "RecordingTracker failed" in caplog.text
    [fault] = manifest_of(tmp_path)["mjrec"]["faults"]
    reason = "RecordingTracker: no server"
    assert fault == {"episode_id": 0, "what": "tracker", "reason": reason}
