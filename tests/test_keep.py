# SPDX-License-Identifier: Apache-2.0
"""Monitors that decide after the episodes which of them get a video."""

import logging
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest
from full_disk import file_size_limit
from parts import parametrize
from recordings import (
    frames_in,
    in_flight,
    journal_of,
    manifest_of,
    metadata_of,
    videos_in,
)
from waiting import wait_until

import mjrec
from mjrec.formats import video_sink
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.recorder.tracking import Tracker
from mjrec.rendering.finish import finish

# Of the episodes of `pendulum`, in their order.
RETURNS = [5.0, 2.0, 4.0, 1.0, 4.0, 2.0, 3.0, 6.0]


class Limited(gymnasium.Wrapper):
    """Ends an episode after as many steps as its return is to be."""

    def __init__(self, env, returns, success=()):
        super().__init__(env)
        self.lengths = [int(number) for number in returns]
        self.success = list(success)

    def reset(self, **options):
        self.left = self.lengths.pop(0)
        return self.env.reset(**options)

    def step(self, action):
        observation, _, _, _, info = self.env.step(action)
        self.left -= 1
        if not self.left and self.success:
            info = {"is_success": self.success.pop(0)}
        return observation, 1.0, False, self.left == 0, info


class OneStep(Limited):
    """Ends an episode after a step, with its return as the reward."""

    def step(self, action):
        observation, *_, info = self.env.step(action)
        return observation, float(self.left), False, True, info


def pendulum(returns=RETURNS, *, kind=Limited, **arguments):
    """Return a small environment."""
    size = {"width": 64, "height": 64, "render_mode": "rgb_array"}
    return kind(gymnasium.make("InvertedPendulum-v5", **size), returns, **arguments)


def run(env, episodes):
    """Run whole episodes."""
    for _ in range(episodes):
        env.reset(seed=0)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass


def h5_of(directory):
    """Return the numbers of the episodes with a finished trajectory."""
    return sorted(int(path.stem[-6:]) for path in directory.glob("*.h5"))


def logs_of(directory):
    """Return the numbers of the episodes in flight."""
    return [int(path.stem[-6:]) for path in in_flight(directory)]


def pending_in(directory):
    """Return the numbers of the episodes whose videos the manifest calls pending."""
    entries = manifest_of(directory)["mjrec"]["pending"]
    return [entry["episode_id"] for entry in entries]


def facts_of(directory, episode):
    """Return the facts of a trajectory."""
    found = {*directory.glob("*.h5"), *in_flight(directory)}
    [path] = [p for p in found if p.name.endswith(f".episode{episode:06d}.h5")]
    with open_trajectory(path) as reader:
        return dict(reader.facts)


def render(directory):
    """Render what is pending."""
    outcomes = finish(directory, workers=1)
    assert not any(each.failures for each in outcomes)


class Listener(Tracker):
    """Notes of which videos it is notified, and how long their episodes were."""

    def __init__(self):
        self.videos = {}

    def video(self, run, video):
        assert video.path.exists()
        assert video.episode is not None
        self.videos[video.episode_id] = video.episode.length


# --- what is kept --------------------------------------------------------------------


both_ways = pytest.mark.parametrize("way", ["live", "deferred"])


@both_ways
def test_the_worst_n_are_kept(tmp_path, way):
    """Never more candidates than N; only the chosen are drawn, named, notified."""
    listener = Listener()
    options = {"workers": 1, "trackers": listener, "name_prefix": "w"}
    with mjrec.Monitor(
        pendulum(), tmp_path, keep="worst:2", render=way, **options
    ) as monitor:
        for number in range(8):
            run(monitor, 1)
            so_far = sorted(range(number + 1), key=lambda k: (RETURNS[k], k))[:2]
            assert logs_of(tmp_path) == sorted(so_far)
            assert videos_in(tmp_path) == (sorted(so_far) if way == "live" else [])
        assert not list(tmp_path.glob("w-*"))
        assert listener.videos == {}
    assert videos_in(tmp_path) == h5_of(tmp_path) == [1, 3]
    assert not list(tmp_path.glob(".*"))
    assert not list(tmp_path.glob("*00000[024567]*"))
    named = sorted(path.name for path in tmp_path.glob("w-*.mp4"))
    assert named == ["w-episode-1.mp4", "w-episode-3.mp4"]
    assert listener.videos == {1: 2, 3: 1}
    manifest = manifest_of(tmp_path)
    assert len(manifest["videos"]) == 2
    details = manifest["mjrec"]
    assert details["schedule"] == {"name": "keep:worst:2", "recorded": [1, 3]}
    assert details["pending"] == []
    chosen = {"rule": "worst:2", "decided": True, "finished": 8}
    assert details["keep"] == {**chosen, "chosen": [1, 3]}
    for number in (1, 3):
        assert metadata_of(tmp_path, number)["selection"] == chosen
        assert facts_of(tmp_path, number)["video"]["selection"] == chosen
        assert len(frames_in(tmp_path, number)) == RETURNS[number] + 1
    assert len(journal_of(tmp_path)) == 8


@parametrize("episodes", [100, 1000])
def test_the_disk_holds_n_candidates_and_the_running_episode(tmp_path, episodes):
    """However long the run is; each goes when it is out."""
    # Most are worse than those before.
    returns = [episodes - number + 7 * number % 5 for number in range(episodes)]
    env = pendulum(returns, kind=OneStep)
    with mjrec.Monitor(env, tmp_path, keep="worst:3", workers=0) as monitor:
        for _ in returns:
            monitor.reset()
            assert len(list(tmp_path.glob("*.log"))) <= 4
            assert len(list(tmp_path.glob("openaigym.states.*"))) <= 4 * 3
            monitor.step(monitor.action_space.sample())
    worst = sorted(range(episodes), key=lambda k: (returns[k], k))[:3]
    assert h5_of(tmp_path) == sorted(worst)


@both_ways
def test_failures_are_what_the_environment_calls_so(tmp_path, way):
    """Drawn at the end of each; after N no frame is recorded any more."""
    made = pendulum(success=[True, False, True, False, False, True, False, False])
    with mjrec.Monitor(
        made, tmp_path, keep="failures:2", mode="training", render=way, workers=1
    ) as env:
        run(env, 3)
        wait_until(lambda: videos_in(tmp_path) == [1])
        run(env, 5)
        assert not env.video_recorder.enabled
    assert videos_in(tmp_path) == [1, 3]
    selection = {"rule": "failures:2", "decided": True, "finished": 2}
    assert metadata_of(tmp_path, 1)["selection"] == selection
    assert manifest_of(tmp_path)["mjrec"]["keep"]["chosen"] == [1, 3]


def longest_two(episodes):
    """Choose by length."""
    return [e.episode_id for e in sorted(episodes, key=lambda e: -e.length)[:2]]


@pytest.mark.parametrize(
    # 1 2 2 3 4 4 5 6: the lower middle is episode 6.
    ("keep", "way", "kept"),
    [("median", "deferred", [6]), (longest_two, "live", [0, 7])],
)
def test_what_is_decided_at_the_end_holds_all(keep, way, kept, tmp_path, caplog):
    """It says so once; the rule or the function's name stands in the manifest."""
    caplog.set_level(logging.INFO, "mjrec")
    with mjrec.Monitor(pendulum(), tmp_path, keep=keep, render=way, workers=1) as env:
        run(env, 8)
        assert (logs_of if way == "deferred" else videos_in)(tmp_path) == [*range(8)]
    assert caplog.text.count("kept on disk") == 1
    assert videos_in(tmp_path) == kept
    name = getattr(keep, "__name__", keep)
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["name"] == f"keep:{name}"


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        # In evaluation every trajectory stays; else `trajectory_callable` decides.
        ({"mode": "evaluation", "workers": 0}, [0, 1, 2, 3]),
        ({"trajectory_callable": lambda episode: episode == 1, "workers": 1}, [1]),
    ],
)
def test_trajectories_are_kept_as_asked(tmp_path, options, kept):
    """Whatever becomes of the videos; those that fell out promise none."""
    with mjrec.Monitor(pendulum([3, 2, 4, 1]), tmp_path, keep="best:1", **options) as e:
        run(e, 4)
    assert h5_of(tmp_path) == kept
    if not options["workers"]:
        promised = [bool(facts_of(tmp_path, k)["video"]) for k in kept]
        assert promised == [False, False, True, False]
        render(tmp_path)
    assert videos_in(tmp_path) == [2]
    assert logs_of(tmp_path) == []
    assert metadata_of(tmp_path, 2)["selection"]["rule"] == "best:1"


@both_ways
def test_incomplete_episodes_are_never_chosen(tmp_path, way):
    """Neither one that was reset nor the one that was closed; nothing of them stays."""
    options = {"render": way, "allow_early_reset": True}
    with mjrec.Monitor(
        pendulum([3, 5, 4]), tmp_path, keep="worst:3", workers=1, **options
    ) as monitor:
        run(monitor, 1)
        for _ in range(2):
            monitor.reset()
            monitor.step(monitor.action_space.sample())
    assert videos_in(tmp_path) == [0]
    assert not list(tmp_path.glob("*00000[12]*"))
    assert not list(tmp_path.glob(".*"))
    assert manifest_of(tmp_path)["mjrec"]["keep"]["chosen"] == [0]


# --- ends ----------------------------------------------------------------------------


def confused(episodes):
    """Return a number that is none of an episode."""
    return [len(episodes)]


@parametrize(
    ("way", "options"),
    [("live", {}), ("deferred", {"wait": True}), ("deferred", {"wait": False})],
    default=2,
)
def test_a_function_that_cannot_choose_loses_nothing(tmp_path, way, options):
    """One error names it; all is closed, and all videos are there or pending."""
    env = mjrec.Monitor(pendulum(), tmp_path, keep=confused, workers=1, render=way)
    run(env, 3)
    with pytest.raises(mjrec.InvalidArgument, match=r"confused returned 3, .* 0, 1, 2"):
        env.close(**options)
    env.close()
    assert not list(tmp_path.glob(".*"))
    details = manifest_of(tmp_path)["mjrec"]
    assert details["schedule"]["recorded"] == [0, 1, 2]
    assert not details["keep"]["decided"]
    assert details["keep"]["chosen"] == []
    assert "returned 3" in details["keep"]["failure"]
    if way == "deferred":
        assert pending_in(tmp_path) == [0, 1, 2]
        render(tmp_path)
    assert videos_in(tmp_path) == [0, 1, 2]
    assert len(manifest_of(tmp_path)["videos"]) == 3
    selection = {"rule": "confused", "decided": False}
    assert metadata_of(tmp_path, 0)["selection"] == selection


@parametrize("on_error", ["warn", "raise"])
def test_a_full_disk_at_the_end_loses_no_chosen_video(tmp_path, on_error):
    """What the journal has no room for waits; it is pending all the same."""
    env = mjrec.Monitor(
        pendulum(), tmp_path, keep="worst:2", workers=0, on_error=on_error
    )
    run(env, 8)
    [journal] = tmp_path.glob("*.jsonl")
    size = journal.stat().st_size
    with file_size_limit(size + 20):
        if on_error == "raise":
            with pytest.raises(mjrec.FileNotWritten):
                env._recorder.finish()
        else:
            env._recorder.finish()
    env.close()
    assert pending_in(tmp_path) == [1, 3]
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["recorded"] == [1, 3]
    assert not list(tmp_path.glob("*episode00000[024567]*"))
    render(tmp_path)
    assert videos_in(tmp_path) == [1, 3]


@pytest.mark.parametrize(("returns", "kept"), [([2, 4], 0), ([4, 2], 1)])
def test_a_full_disk_at_the_metadata_of_a_live_candidate(returns, kept, tmp_path):
    """It is written at the end with the choice, or nothing of the video is left."""

    def full(video, metadata):
        raise mjrec.FileNotWritten(video, "No space left on device")

    env = pendulum(returns)
    options = {"keep": "worst:1", "render": "live", "on_error": "warn"}
    with mjrec.Monitor(env, tmp_path, **options) as monitor:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(video_sink, "write_metadata", full)
            run(monitor, 1)
        run(monitor, 1)
    assert videos_in(tmp_path) == [kept]
    assert metadata_of(tmp_path, kept)["selection"]["decided"] is True
    assert len(manifest_of(tmp_path)["videos"]) == 1
    assert len(list(tmp_path.glob("openaigym.video.*"))) == 3
    assert not list(tmp_path.glob(".*"))


PROGRAM = """
import os, sys
import mjrec
sys.path.insert(0, sys.argv[3])
from test_keep import pendulum, run
env = mjrec.Monitor(pendulum(), sys.argv[1], keep="worst:2", workers=1,
                    render=sys.argv[2], write_upon_reset=True)
run(env, 5)
env.reset(seed=0)
env.step(env.action_space.sample())
os.kill(os.getpid(), 9)
"""


@parametrize(
    ("kind", "recovers"),
    [("deferred", True), ("live", True), ("deferred", False)],
    default=2,
)
def test_a_killed_run_leaves_its_candidates(tmp_path, kind, recovers):
    """And the running episode, and nothing of what had fallen out; undecided."""
    here = str(Path(__file__).parent)
    command = [sys.executable, "-c", PROGRAM, str(tmp_path), kind, here]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert logs_of(tmp_path) == [1, 3, 5]
    if recovers:
        mjrec.recover(tmp_path)
        details = manifest_of(tmp_path)["mjrec"]
        assert details["schedule"]["name"] == "keep:worst:2"
        assert details["keep"]["rule"] == "worst:2"
        assert not details["keep"]["decided"]
        assert details["keep"]["chosen"] == []
        assert pending_in(tmp_path) == ([] if kind == "live" else [1, 3, 5])
    render(tmp_path)
    assert set(videos_in(tmp_path)) - {5} == {1, 3}
    assert kind == "live" or videos_in(tmp_path) == [1, 3, 5]
    selection = {"rule": "worst:2", "decided": False}
    assert metadata_of(tmp_path, 1)["selection"] == selection
    listed = {name[-10:-4] for name, _ in manifest_of(tmp_path)["videos"]}
    assert listed >= {"000001", "000003"}
