# SPDX-License-Identifier: Apache-2.0
"""`keep=` chooses which episodes get a video after they have ended."""

import contextlib
import logging
import signal
from pathlib import Path

import gymnasium
import pytest
from full_disk import file_size_limit
from other_python import run_python
from parts import parametrize
from recordings import frames_in, in_flight, manifest_of, metadata_of, videos_in
from waiting import wait_until

import mjrec
from mjrec.formats import video_sink
from mjrec.recorder.tracking import Tracker

RETURNS = [5.0, 2.0, 4.0, 1.0, 4.0, 2.0, 3.0, 6.0]


class ChosenReturns(gymnasium.Wrapper):
    """End each episode when its return reaches the given value, at 1.0 a step."""

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


def pendulum(returns=RETURNS, **arguments):
    size = {"width": 64, "height": 64, "render_mode": "rgb_array"}
    env = gymnasium.make("InvertedPendulum-v5", **size)
    return ChosenReturns(env, returns, **arguments)


def finish_episode(env):
    while not any(env.step(env.action_space.sample())[2:4]):
        pass


def run(env, episodes):
    for _ in range(episodes):
        env.reset(seed=0)
        finish_episode(env)


def numbers(paths):
    """Return the episode numbers in the file names."""
    return sorted(int(path.stem[-6:]) for path in paths)


def choice_in(directory):
    """Return the recorded episodes, whether a choice was made, and the choice."""
    details = manifest_of(directory)["mjrec"]
    keep = details["keep"]
    return details["schedule"]["recorded"], keep["decided"], keep["chosen"]


live_and_deferred = pytest.mark.parametrize("mode", ["live", "deferred"])


@live_and_deferred
def test_worst_n_are_kept(tmp_path, mode):
    """There are never more than N candidates, and trackers see only chosen videos."""
    notified = {}
    tracker = Tracker()
    tracker.video = lambda _, video: notified.update(
        {video.episode_id: (video.episode.length, video.path.exists())}
    )
    options = {"workers": 1, "trackers": tracker, "name_prefix": "w", "render": mode}
    with mjrec.Monitor(pendulum(), tmp_path, keep="worst:2", **options) as monitor:
        for number in range(8):
            monitor.reset(seed=0)
            # These are two candidates and the running episode.
            assert len(list(tmp_path.glob("*.log"))) <= 3
            finish_episode(monitor)
            so_far = sorted(range(number + 1), key=lambda k: (RETURNS[k], k))[:2]
            assert numbers(in_flight(tmp_path)) == sorted(so_far)
            assert videos_in(tmp_path) == (sorted(so_far) if mode == "live" else [])
        assert not list(tmp_path.glob("w-*"))
        assert notified == {}
    assert videos_in(tmp_path) == numbers(tmp_path.glob("*.h5")) == [1, 3]
    assert not [*tmp_path.glob(".*"), *tmp_path.glob("*00000[024567]*")]
    named = sorted(path.name for path in tmp_path.glob("w-*.mp4"))
    assert named == ["w-episode-1.mp4", "w-episode-3.mp4"]
    assert notified == {1: (2, True), 3: (1, True)}
    manifest = manifest_of(tmp_path)
    assert len(manifest["videos"]) == 2
    details = manifest["mjrec"]
    assert details["schedule"] == {"name": "keep:worst:2", "recorded": [1, 3]}
    assert details["pending"] == []
    chosen = {"rule": "worst:2", "decided": True, "finished": 8}
    assert details["keep"] == {**chosen, "chosen": [1, 3]}
    for number in (1, 3):
        assert metadata_of(tmp_path, number)["selection"] == chosen
        [path] = tmp_path.glob(f"*.episode{number:06d}.h5")
        assert mjrec.load_trajectory(path).facts["video"]["selection"] == chosen
        assert len(frames_in(tmp_path, number)) == RETURNS[number] + 1
    assert len(mjrec.load_results(tmp_path)["episode_lengths"]) == 8


# Takes more than five seconds: a thousand episodes.
@pytest.mark.thorough
def test_a_thousand_episodes_take_the_disk_of_four(tmp_path):
    """The disk holds the worst three episodes so far and the running one."""
    returns = [(1019 - number) // 20 for number in range(1000)]
    in_logs = set()
    with mjrec.Monitor(
        pendulum(returns), tmp_path, keep="worst:3", workers=0
    ) as monitor:
        for number in range(1000):
            monitor.reset(seed=0)
            in_logs.add(len({p.stem for p in tmp_path.glob("openaigym.states.*")}))
            finish_episode(monitor)
            assert len(in_flight(tmp_path)) == min(number + 1, 3)
    assert max(in_logs) == 4
    assert numbers(tmp_path.glob("*.h5")) == [980, 981, 982]
    assert not list(tmp_path.glob("openaigym.states.*"))


@live_and_deferred
def test_first_n_failures_are_kept(tmp_path, mode):
    """Each failure is rendered when it ends, and recording stops after N."""
    pole = pendulum(success=[True, False, True, False, False, True, False, False])
    options = {"keep": "failures:2", "render": mode, "workers": 1}
    with mjrec.Monitor(pole, tmp_path, **options) as env:
        run(env, 3)
        wait_until(lambda: videos_in(tmp_path) == [1])
        run(env, 5)
        assert not env.video_recorder.enabled
    assert videos_in(tmp_path) == [1, 3]
    selection = {"rule": "failures:2", "decided": True, "finished": 2}
    assert metadata_of(tmp_path, 1)["selection"] == selection
    assert choice_in(tmp_path) == ([1, 3], True, [1, 3])


def longest(episodes):
    return [e.episode_id for e in sorted(episodes, key=lambda e: -e.length)[:2]]


@pytest.mark.parametrize(
    ("keep", "mode", "kept"),
    [("median", "deferred", [6]), (longest, "live", [0, 7])],
)
def test_rules_over_all_episodes_keep_all_until_close(
    keep, mode, kept, tmp_path, caplog
):
    """One message says so, and the manifest names the rule or function."""
    caplog.set_level(logging.INFO, "mjrec")
    with mjrec.Monitor(pendulum(), tmp_path, keep=keep, render=mode, workers=1) as env:
        run(env, 8)
        assert [*range(8)] == (
            numbers(in_flight(tmp_path)) if mode == "deferred" else videos_in(tmp_path)
        )
    assert caplog.text.count("kept on disk") == 1
    assert videos_in(tmp_path) == kept
    name = getattr(keep, "__name__", keep)
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["name"] == f"keep:{name}"


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        # Evaluation keeps every trajectory; otherwise `trajectory_callable` decides.
        ({"mode": "evaluation", "workers": 0}, [0, 1, 2, 3]),
        ({"trajectory_callable": lambda episode: episode == 1, "workers": 1}, [1]),
    ],
)
def test_trajectories_are_kept_apart_from_videos(tmp_path, options, kept):
    """The trajectory of an episode that was not chosen lists no video."""
    with mjrec.Monitor(pendulum([3, 2, 4, 1]), tmp_path, keep="best:1", **options) as e:
        run(e, 4)
    assert numbers(tmp_path.glob("*.h5")) == kept
    if not options["workers"]:
        paths = sorted(tmp_path.glob("*.h5"))
        planned = [mjrec.load_trajectory(path).facts["video"] for path in paths]
        assert [bool(each) for each in planned] == [False, False, True, False]
        mjrec.render_videos(tmp_path, workers=1)
    assert videos_in(tmp_path) == [2]
    assert numbers(in_flight(tmp_path)) == []
    assert metadata_of(tmp_path, 2)["selection"]["rule"] == "best:1"


@live_and_deferred
def test_incomplete_episodes_are_never_chosen(tmp_path, mode):
    """Episodes that a reset or `close` cuts short leave no files."""
    options = {"render": mode, "allow_early_reset": True, "workers": 1}
    with mjrec.Monitor(pendulum(), tmp_path, keep="worst:3", **options) as monitor:
        run(monitor, 1)
        for _ in range(2):
            monitor.reset()
            monitor.step(monitor.action_space.sample())
    assert videos_in(tmp_path) == [0]
    assert not [*tmp_path.glob(".*"), *tmp_path.glob("*00000[12]*")]
    assert choice_in(tmp_path)[2] == [0]


def confused(episodes):
    return [len(episodes)]


@parametrize(
    ("mode", "options"),
    [("live", {}), ("deferred", {"wait": True}), ("deferred", {"wait": False})],
    default=2,
)
def test_invalid_choice_loses_nothing(tmp_path, mode, options):
    """One error names the function, and all videos are rendered or pending."""
    env = mjrec.Monitor(pendulum(), tmp_path, keep=confused, workers=1, render=mode)
    run(env, 3)
    with pytest.raises(mjrec.InvalidArgument, match=r"confused returned 3, .* 0, 1, 2"):
        env.close(**options)
    env.close()
    assert not list(tmp_path.glob(".*"))
    assert choice_in(tmp_path) == ([0, 1, 2], False, [])
    details = manifest_of(tmp_path)["mjrec"]
    assert "returned 3" in details["keep"]["failure"]
    assert len(details["pending"]) == (3 if mode == "deferred" else 0)
    mjrec.render_videos(tmp_path, workers=1)
    assert videos_in(tmp_path) == [0, 1, 2]
    assert len(manifest_of(tmp_path)["videos"]) == 3
    selection = {"rule": "confused", "decided": False}
    assert metadata_of(tmp_path, 0)["selection"] == selection


@parametrize("on_error", ["warn", "raise"])
def test_full_disk_at_close_loses_no_chosen_video(tmp_path, on_error):
    """The chosen videos stay pending."""
    options = {"keep": "worst:2", "workers": 0, "on_error": on_error}
    env = mjrec.Monitor(pendulum(), tmp_path, **options)
    run(env, 8)
    [journal] = tmp_path.glob("*.jsonl")
    error = pytest.raises(mjrec.FileNotWritten)
    with (
        file_size_limit(journal.stat().st_size + 20),
        error if on_error == "raise" else contextlib.nullcontext(),
    ):
        env._recorder.finish()
    env.close()
    assert choice_in(tmp_path)[0] == [1, 3]
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == 2
    assert not list(tmp_path.glob("*episode00000[024567]*"))
    mjrec.render_videos(tmp_path, workers=1)
    assert videos_in(tmp_path) == [1, 3]


@pytest.mark.parametrize(("returns", "kept"), [([2, 4], 0), ([4, 2], 1)])
def test_full_disk_at_metadata_of_a_live_candidate(returns, kept, tmp_path):
    """The candidate gets metadata if it is chosen, and otherwise loses its files."""

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
    ("mode", "recovers"),
    [("deferred", True), ("live", True), ("deferred", False)],
    default=2,
)
def test_killed_run_leaves_candidates_and_running_episode(tmp_path, mode, recovers):
    """No choice was made, and the other episodes leave no files."""
    here = Path(__file__).parent
    run_python(PROGRAM, tmp_path, mode, here, status=-signal.SIGKILL)
    assert numbers(in_flight(tmp_path)) == [1, 3, 5]
    if recovers:
        mjrec.recover(tmp_path)
        details = manifest_of(tmp_path)["mjrec"]
        assert details["schedule"]["name"] == "keep:worst:2"
        assert details["keep"]["rule"] == "worst:2"
        assert choice_in(tmp_path)[1:] == (False, [])
        assert len(details["pending"]) == (0 if mode == "live" else 3)
    mjrec.render_videos(tmp_path, workers=1)
    assert set(videos_in(tmp_path)) - {5} == {1, 3}
    assert mode == "live" or videos_in(tmp_path) == [1, 3, 5]
    selection = {"rule": "worst:2", "decided": False}
    assert metadata_of(tmp_path, 1)["selection"] == selection
    listed = {name[-10:-4] for name, _ in manifest_of(tmp_path)["videos"]}
    assert listed >= {"000001", "000003"}
