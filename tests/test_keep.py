# SPDX-License-Identifier: Apache-2.0
"""Monitors that decide after the episodes which of them get a video."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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

import mjrec
from conftest import Corridor
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.recorder import kept_videos
from mjrec.recorder.selection import UNDECIDED
from mjrec.recorder.tracking import FinishedVideo, Tracker
from mjrec.rendering.finish import finish
from mjrec.rendering.recordings import recorded_episodes

# Of the walks of `Walk`, in their order.
RETURNS = [5.0, 2.0, 4.0, 1.0, 4.0, 2.0, 3.0, 6.0]


class Walk(Corridor):
    """A corridor whose episodes have given lengths, which are their returns."""

    def __init__(
        self,
        returns: Sequence[float] = RETURNS,
        *,
        success: Sequence[bool | None] = (),
        **arguments: Any,
    ) -> None:
        super().__init__(**arguments)
        self.returns = list(returns)
        self.success = list(success)

    def reset(self, **options: Any) -> Any:
        self.length = int(self.returns.pop(0))
        return super().reset(**options)

    def step(self, action: Any) -> Any:
        observation, _, terminated, truncated, info = super().step(action)
        said = self.success.pop(0) if terminated and self.success else None
        if said is not None:
            info = {"is_success": said}
        return observation, 1.0, terminated, truncated, info


class Limited(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Ends an episode after as many steps as its return is to be."""

    def __init__(self, env: Any, returns: Sequence[float] = RETURNS) -> None:
        super().__init__(env)
        self.lengths = [int(number) for number in returns]

    def reset(self, **options: Any) -> Any:
        self.left = self.lengths.pop(0)
        return self.env.reset(**options)

    def step(self, action: Any) -> Any:
        observation, _, _, _, info = self.env.step(action)
        self.left -= 1
        return observation, 1.0, False, self.left == 0, info


def pendulum(returns: Sequence[float] = RETURNS, **arguments: Any) -> Any:
    """Return a small environment whose pictures can be deferred."""
    size = {"width": 64, "height": 64}
    env = gymnasium.make("InvertedPendulum-v5", **size, **arguments)
    return Limited(env, returns)


def run(env: Any, episodes: int) -> None:
    """Run whole episodes."""
    for _ in range(episodes):
        env.reset(seed=0)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass


def held(directory: Path, pattern: str) -> list[int]:
    """Return the numbers of the episodes of which there is a file, so far."""
    return sorted(int(path.stem[-6:]) for path in directory.glob(pattern))


def h5_of(directory: Path) -> list[int]:
    """Return the numbers of the episodes with a finished trajectory."""
    return held(directory, "*.h5")


def logs_of(directory: Path) -> list[int]:
    """Return the numbers of the episodes in flight."""
    return [int(path.stem[-6:]) for path in in_flight(directory)]


def facts_of(directory: Path, episode: int) -> dict[str, Any]:
    """Return the facts of a trajectory."""
    finished = directory.glob("*.h5")
    ending = f".episode{episode:06d}.h5"
    [path] = {p for p in (*finished, *in_flight(directory)) if p.name.endswith(ending)}
    with open_trajectory(path) as reader:
        return dict(reader.header.facts)


def render(directory: Path) -> None:
    """Render what is pending."""
    outcomes = finish(directory, recorded_episodes(directory), workers=1)
    assert [each.failure for each in outcomes if each.failure] == []


# --- what is kept --------------------------------------------------------------------


def test_worst_of_live_episodes(tmp_path: Path, names: Any) -> None:
    """Never more videos than so many, and in the end just the worst, said to be so."""
    with mjrec.Monitor(Walk(), tmp_path, keep="worst:2") as env:
        for number in range(8):
            run(env, 1)
            so_far = sorted(range(number + 1), key=lambda k: (RETURNS[k], k))[:2]
            assert videos_in(tmp_path) == sorted(so_far)
    assert videos_in(tmp_path) == [1, 3]
    # Video, metadata, hashes and trajectory of each.
    assert len(names(tmp_path)) == 4 * 2 + 3
    assert not list(tmp_path.glob(".*"))
    details = manifest_of(tmp_path)["mjrec"]
    assert details["schedule"] == {"name": "keep:worst:2", "recorded": [1, 3]}
    bytes_held = details["keep"].pop("most_bytes_held")
    assert bytes_held > 3 * 500
    assert details["keep"] == {
        "rule": "worst:2",
        "decided": True,
        "chosen": [1, 3],
        "finished": 8,
    }
    assert len(manifest_of(tmp_path)["videos"]) == 2
    chosen = {"rule": "worst:2", "decided": True, "finished": 8}
    assert metadata_of(tmp_path, 1)["selection"] == chosen
    assert metadata_of(tmp_path, 3)["selection"] == chosen
    assert len(frames_in(tmp_path, 1)) == 3
    assert len(journal_of(tmp_path)) == 8


def test_worst_of_deferred_episodes(tmp_path: Path) -> None:
    """Two logs are there at every reset, and nothing is rendered before the end."""
    with mjrec.Monitor(pendulum(), tmp_path, keep="worst:2", workers=1) as env:
        for number in range(8):
            run(env, 1)
            so_far = sorted(range(number + 1), key=lambda k: (RETURNS[k], k))[:2]
            assert logs_of(tmp_path) == sorted(so_far)
            assert videos_in(tmp_path) == []
    assert videos_in(tmp_path) == h5_of(tmp_path) == [1, 3]
    assert logs_of(tmp_path) == []
    manifest = manifest_of(tmp_path)
    assert manifest["mjrec"]["schedule"]["recorded"] == [1, 3]
    assert manifest["mjrec"]["pending"] == []
    assert len(manifest["videos"]) == 2
    for number in (1, 3):
        metadata = metadata_of(tmp_path, number)
        assert metadata["selection"]["rule"] == "worst:2"
        assert metadata["selection"]["decided"]
        assert len(frames_in(tmp_path, number)) == RETURNS[number] + 1


def test_bytes_that_were_held_are_those_of_the_logs(tmp_path: Path) -> None:
    """What falls out as it ends was never held."""
    with mjrec.Monitor(pendulum([3, 3, 3, 3]), tmp_path, keep="best:2", workers=0) as e:
        run(e, 4)
        sizes = {path.stat().st_size for path in tmp_path.glob("*.log")}
    most = manifest_of(tmp_path)["mjrec"]["keep"]["most_bytes_held"]
    assert 2 * min(sizes) <= most <= 2 * max(sizes)


def test_disk_holds_no_more_candidates_than_may_be_chosen(tmp_path: Path) -> None:
    """Three and the running one, however long the run is; each goes when it is out."""
    returns = [1 + (7 * number) % 5 for number in range(150)]
    with mjrec.Monitor(pendulum(returns), tmp_path, keep="worst:3", workers=0) as env:
        for _ in returns:
            run(env, 1)
            assert len(list(tmp_path.glob("*.spans"))) <= 4
            assert len(list(tmp_path.glob("openaigym.states.*"))) <= 4 * 3
    assert len(h5_of(tmp_path)) == 3


def test_failures_are_what_the_environment_calls_so(tmp_path: Path) -> None:
    """Decided at the end of each; after so many no states are recorded any more."""
    success = [True, False, True, False, False, True, False, False]
    with mjrec.Monitor(
        Walk(success=success), tmp_path, keep="failures:2", mode="training"
    ) as env:
        run(env, 3)
        assert videos_in(tmp_path) == [1]
        run(env, 5)
        assert not env.video_recorder.enabled
    assert videos_in(tmp_path) == [1, 3]
    assert metadata_of(tmp_path, 1)["selection"] == {
        "rule": "failures:2",
        "decided": True,
        "finished": 2,
    }
    assert manifest_of(tmp_path)["mjrec"]["keep"]["chosen"] == [1, 3]


def test_failures_that_are_rendered_later_are_handed_over_at_once(
    tmp_path: Path,
) -> None:
    """Where nothing is said of success an episode that was terminated has failed."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=4)
    with mjrec.Monitor(env, tmp_path, keep="failures", workers=0) as env:
        terminated = []
        for seed in range(6):
            env.reset(seed=seed)
            done = False
            while not done:
                action = env.action_space.high * (seed % 2)
                _, _, *flags, _ = env.step(action)
                done = any(flags)
            terminated += [seed] * flags[0]
            assert logs_of(tmp_path) == terminated
    assert 0 < len(terminated) < 6
    assert h5_of(tmp_path) == terminated
    assert facts_of(tmp_path, terminated[0])["candidate"] is False
    pending = manifest_of(tmp_path)["mjrec"]["pending"]
    assert [entry["episode_id"] for entry in pending] == terminated


def test_median_holds_all_states_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Once, and how many bytes it were stands in the manifest."""
    caplog.set_level(logging.INFO, "mjrec")
    with mjrec.Monitor(pendulum(), tmp_path, keep="median", workers=0) as env:
        run(env, 7)
        assert logs_of(tmp_path) == [*range(7)]
        size = sum(path.stat().st_size for path in tmp_path.glob("*.log"))
    assert caplog.text.count("stay on the disk") == 1
    # 1 2 2 3 4 4 5: the middle is episode 6.
    assert h5_of(tmp_path) == [6]
    assert manifest_of(tmp_path)["mjrec"]["keep"]["most_bytes_held"] == size


def longest_two(episodes: Sequence[Any]) -> list[int]:
    """Choose by length."""
    return [e.episode_id for e in sorted(episodes, key=lambda e: -e.length)[:2]]


def test_function_chooses_among_finished_episodes(tmp_path: Path) -> None:
    """Live as well; its name stands in the manifest."""
    with mjrec.Monitor(Walk(), tmp_path, keep=longest_two) as env:
        run(env, 8)
        assert videos_in(tmp_path) == [*range(8)]
    assert videos_in(tmp_path) == [0, 7]
    assert manifest_of(tmp_path)["mjrec"]["schedule"]["name"] == "keep:longest_two"


def test_live_videos_take_their_trajectories_with_them(tmp_path: Path) -> None:
    """Both go, and both stay."""
    env = pendulum([3, 2, 4, 1], render_mode="rgb_array")
    with mjrec.Monitor(env, tmp_path, keep="worst:1", render="live") as env:
        for number in range(4):
            run(env, 1)
            assert logs_of(tmp_path) == videos_in(tmp_path)
            assert len(logs_of(tmp_path)) == 1, number
    assert videos_in(tmp_path) == h5_of(tmp_path) == [3]
    selection = facts_of(tmp_path, 3)["video"]["selection"]
    assert selection == metadata_of(tmp_path, 3)["selection"]
    assert selection["decided"]


def test_evaluation_keeps_every_trajectory(tmp_path: Path) -> None:
    """Those of episodes that fell out promise no video any more."""
    with mjrec.Monitor(
        pendulum([3, 2, 4, 1]), tmp_path, keep="best:1", mode="evaluation", workers=0
    ) as env:
        run(env, 4)
    assert h5_of(tmp_path) == [0, 1, 2, 3]
    assert [bool(facts_of(tmp_path, k)["video"]) for k in range(4)] == [
        *(False, False, True, False)
    ]
    render(tmp_path)
    assert videos_in(tmp_path) == [2]
    assert metadata_of(tmp_path, 2)["selection"]["rule"] == "best:1"


def test_trajectories_that_nobody_wants_go_with_their_videos(tmp_path: Path) -> None:
    """With `trajectory_callable` it is that which decides, here about each."""
    with mjrec.Monitor(
        pendulum([3, 2, 4, 1]),
        tmp_path,
        keep="best:1",
        trajectory_callable=lambda episode: episode == 1,
        workers=1,
    ) as env:
        run(env, 4)
    assert videos_in(tmp_path) == [2]
    assert h5_of(tmp_path) == [1]
    assert logs_of(tmp_path) == []


def test_episodes_that_were_not_completed_are_never_chosen(tmp_path: Path) -> None:
    """Neither one that was reset nor the one that was closed; their recordings go."""
    with mjrec.Monitor(
        pendulum([3, 1, 4, 9]),
        tmp_path,
        keep="worst:3",
        workers=0,
        allow_early_reset=True,
    ) as env:
        run(env, 1)
        env.reset()
        env.reset()
        env.step(env.action_space.sample())
        env.reset()
        env.step(env.action_space.sample())
    assert h5_of(tmp_path) == [0]
    assert logs_of(tmp_path) == []
    assert manifest_of(tmp_path)["mjrec"]["keep"]["chosen"] == [0]


def test_live_episodes_that_were_not_completed_leave_nothing(tmp_path: Path) -> None:
    """Not even an unfinished file."""
    with mjrec.Monitor(
        Walk([3, 5]), tmp_path, keep="worst:3", allow_early_reset=True
    ) as env:
        run(env, 1)
        env.reset()
        env.step(0)
    assert videos_in(tmp_path) == [0]
    assert not list(tmp_path.glob("*000001*"))
    assert not list(tmp_path.glob(".*"))


class Listener(Tracker):
    """Notes which videos it is told of, and of which episodes."""

    def __init__(self) -> None:
        self.videos: list[int] = []
        self.lengths: list[int] = []

    def video(self, run: Any, video: FinishedVideo) -> None:
        assert video.path.exists()
        assert video.episode is not None
        self.videos.append(video.episode_id)
        self.lengths.append(video.episode.length)


@parametrize("kind", ["live", "deferred"])
def test_trackers_are_told_of_the_chosen_only(tmp_path: Path, kind: str) -> None:
    """Which is when they are chosen."""
    listener = Listener()
    env = Walk() if kind == "live" else pendulum()
    with mjrec.Monitor(
        env, tmp_path, keep="worst:2", workers=1, trackers=listener
    ) as env:
        run(env, 8)
        assert listener.videos == []
    assert sorted(listener.videos) == [1, 3]
    assert sorted(listener.lengths) == [1, 2]


def test_second_names_are_given_to_the_chosen_only(tmp_path: Path) -> None:
    """They are links, which would keep what was deleted."""
    with mjrec.Monitor(Walk(), tmp_path, keep="worst:2", name_prefix="w") as env:
        run(env, 8)
        assert not list(tmp_path.glob("w-*"))
    names = sorted(path.name for path in tmp_path.glob("w-*.mp4"))
    assert names == ["w-episode-1.mp4", "w-episode-3.mp4"]


# --- ends ----------------------------------------------------------------------------


def test_who_does_not_wait_leaves_the_chosen_pending(tmp_path: Path) -> None:
    """What fell out is gone then too."""
    env = mjrec.Monitor(pendulum(), tmp_path, keep="worst:2", workers=1)
    run(env, 8)
    env.close(wait=False)
    pending = manifest_of(tmp_path)["mjrec"]["pending"]
    assert [entry["episode_id"] for entry in pending] == [1, 3]
    render(tmp_path)
    assert videos_in(tmp_path) == [1, 3]
    assert metadata_of(tmp_path, 1)["selection"]["finished"] == 8
    assert manifest_of(tmp_path)["mjrec"]["pending"] == []


def test_exception_leaves_the_chosen_pending(tmp_path: Path) -> None:
    """And the episode in which it was raised goes."""
    env = mjrec.Monitor(pendulum(), tmp_path, keep="best:1", workers=1)
    with contextlib.suppress(ZeroDivisionError), env:
        run(env, 3)
        env.reset()
        env.step(env.action_space.sample())
        raise ZeroDivisionError
    assert logs_of(tmp_path) == [0]
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == 1


def confused(episodes: Sequence[Any]) -> list[int]:
    """Return a number that is none of an episode."""
    return [len(episodes)]


@parametrize("workers", [0, 1])
def test_function_that_cannot_choose_loses_nothing(
    tmp_path: Path, workers: int
) -> None:
    """One error names it; all is closed, and all videos are pending."""
    inner = pendulum()
    with (
        pytest.raises(mjrec.InvalidArgument, match=r"confused returned 3, .* 0, 1, 2"),
        mjrec.Monitor(inner, tmp_path, keep=confused, workers=workers) as env,
    ):
        run(env, 3)
    assert not list(tmp_path.glob(".*"))
    details = manifest_of(tmp_path)["mjrec"]
    assert [entry["episode_id"] for entry in details["pending"]] == [0, 1, 2]
    assert details["schedule"]["recorded"] == [0, 1, 2]
    assert not details["keep"]["decided"]
    assert details["keep"]["chosen"] == []
    assert "returned 3" in details["keep"]["failure"]
    env.close()
    render(tmp_path)
    assert videos_in(tmp_path) == [0, 1, 2]
    assert metadata_of(tmp_path, 0)["selection"] == {
        "rule": "confused",
        "decided": False,
    }


def test_live_videos_stay_where_a_function_cannot_choose(tmp_path: Path) -> None:
    """They are there already."""
    env = mjrec.Monitor(walk := Walk(), tmp_path, keep=confused)
    run(env, 3)
    with pytest.raises(mjrec.InvalidArgument, match="confused"):
        env.close()
    assert walk.closed
    assert videos_in(tmp_path) == [0, 1, 2]
    assert len(manifest_of(tmp_path)["videos"]) == 3


def test_who_does_not_wait_for_a_function_that_cannot_choose(tmp_path: Path) -> None:
    """Is told the same, and nothing is lost either."""
    env = mjrec.Monitor(pendulum(), tmp_path, keep=confused, workers=1)
    run(env, 3)
    with pytest.raises(mjrec.InvalidArgument, match="confused"):
        env.close(wait=False)
    pending = manifest_of(tmp_path)["mjrec"]["pending"]
    assert [entry["episode_id"] for entry in pending] == [0, 1, 2]
    assert not list(tmp_path.glob(".*"))


def test_interrupted_deletion_is_taken_up_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C before what has fallen out is gone: it goes when the monitor closes."""
    env = mjrec.Monitor(pendulum(), tmp_path, keep="worst:1", workers=0)
    run(env, 1)

    def interrupted(trajectory: Path) -> None:
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(kept_videos, "drop_recording", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(env, 1)
    assert logs_of(tmp_path) == [0, 1]
    env.close()
    assert h5_of(tmp_path) == [1]
    assert logs_of(tmp_path) == []


def test_interrupted_choice_is_taken_up_again(tmp_path: Path) -> None:
    """Ctrl-C while the function runs: what closes the monitor asks it once more."""
    calls = []

    def choose(episodes: Sequence[Any]) -> list[int]:
        calls.append(len(episodes))
        if len(calls) == 1:
            raise KeyboardInterrupt
        return [0]

    env = mjrec.Monitor(Walk(), tmp_path, keep=choose)
    run(env, 3)
    with pytest.raises(KeyboardInterrupt):
        env.close()
    assert calls == [3, 3]
    assert videos_in(tmp_path) == [0]
    assert not list(tmp_path.glob(".*"))


@parametrize("on_error", ["warn", "raise"])
def test_full_disk_at_the_end_loses_no_chosen_video(
    tmp_path: Path, on_error: str
) -> None:
    """What cannot be said of it in its log is not said; it is pending all the same."""
    env = mjrec.Monitor(
        pendulum(), tmp_path, keep="worst:2", workers=0, on_error=on_error
    )
    run(env, 8)
    size = max(path.stat().st_size for path in tmp_path.glob("*.spans"))
    # Enough for all but what is added to the longer list.
    with file_size_limit(size + 20):
        if on_error == "raise":
            with pytest.raises(mjrec.FileNotWritten):
                env._recorder.finish()
        else:
            env._recorder.finish()
    env.close()
    details = manifest_of(tmp_path)["mjrec"]
    assert [entry["episode_id"] for entry in details["pending"]] == [1, 3]
    assert details["schedule"]["recorded"] == [1, 3]
    assert not list(tmp_path.glob("*episode00000[024567]*"))
    render(tmp_path)
    assert videos_in(tmp_path) == [1, 3]


PROGRAM = """
import os, signal, sys
import gymnasium, mjrec
sys.path.insert(0, sys.argv[3])
from test_keep import pendulum, run, Walk
env = Walk() if sys.argv[2] == "live" else pendulum()
env = mjrec.Monitor(env, sys.argv[1], keep="worst:2", workers=1,
                    write_upon_reset=True)
run(env, 5)
env.reset(seed=0)
env.step(env.action_space.sample())
os.write(1, b"in mid-run\\n")
signal.pause()
"""


def killed_in_mid_run(directory: Path, kind: str) -> None:
    """Let a process record five episodes and one step, and kill it."""
    here = str(Path(__file__).parent)
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(directory), kind, here],
        stdout=subprocess.PIPE,
        bufsize=0,
        env={**os.environ, "PYTHONPATH": here},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"in mid-run\n"
        process.send_signal(signal.SIGKILL)


@parametrize("recovers", [True, False])
def test_killed_run_leaves_its_candidates_pending(
    tmp_path: Path, recovers: bool
) -> None:
    """And nothing of what had fallen out; nobody calls them the worst."""
    killed_in_mid_run(tmp_path, "deferred")
    # One step is not a second old: the log of the episode in flight may be missing.
    assert set(logs_of(tmp_path)) - {5} == {1, 3}
    if recovers:
        mjrec.recover(tmp_path)
        details = manifest_of(tmp_path)["mjrec"]
        pending = {entry["episode_id"] for entry in details["pending"]}
        assert pending - {5} == {1, 3}
        assert details["schedule"]["name"] == "keep:worst:2"
        assert details["keep"]["rule"] == "worst:2"
        assert not details["keep"]["decided"]
        assert details["keep"]["chosen"] == []
    render(tmp_path)
    assert set(videos_in(tmp_path)) - {5} == {1, 3}
    assert metadata_of(tmp_path, 1)["selection"] == {
        "rule": "worst:2",
        "decided": False,
    }


def test_killed_run_leaves_its_live_candidates(tmp_path: Path) -> None:
    """Their videos are there, and recovery lists them."""
    killed_in_mid_run(tmp_path, "live")
    mjrec.recover(tmp_path)
    assert set(videos_in(tmp_path)) - {5} == {1, 3}
    manifest = manifest_of(tmp_path)
    assert {name[-10:-4] for name, _ in manifest["videos"]} >= {"000001", "000003"}
    assert manifest["mjrec"]["schedule"]["name"] == "keep:worst:2"
    assert metadata_of(tmp_path, 3)["selection"]["decided"] is False


@pytest.mark.thorough
def test_renderer_beside_an_open_monitor_leaves_candidates_alone(
    tmp_path: Path,
) -> None:
    """What may still fall out is nobody's but its monitor's."""
    command = [sys.executable, "-m", "mjrec", "render", str(tmp_path)]
    with mjrec.Monitor(pendulum(), tmp_path, keep="worst:2", workers=0) as env:
        run(env, 3)
        subprocess.run(command, check=True, capture_output=True)
        assert logs_of(tmp_path) == [1, 2]
        assert videos_in(tmp_path) == []
        run(env, 5)
    assert videos_in(tmp_path) == []
    render(tmp_path)
    assert videos_in(tmp_path) == [1, 3]


# --- what cannot be ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"keep": "wurst:3"}, "no keep rule 'wurst:3'. There are: best:N"),
        ({"keep": "worst:0"}, "1 or more"),
        ({"keep": 3}, "must be one of"),
        ({"keep": "worst:3", "video_callable": False}, "video_callable before"),
        ({"keep": "worst:3", "video_callable": lambda e: True}, "give one of them"),
        ({"keep": "worst:3", "render": "off"}, "there are none"),
        ({"keep": "worst:3", "video_length": 3}, "counted in steps"),
        ({"keep": "worst:3", "step_trigger": lambda s: True}, "counted in steps"),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_made(
    tmp_path: Path, options: dict[str, Any], what: str
) -> None:
    """The directory is not even there."""
    with pytest.raises(mjrec.InvalidArgument, match=what):
        mjrec.Monitor(Walk(), tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


def test_environment_without_pictures_is_an_error(tmp_path: Path) -> None:
    """There would be nothing to keep."""
    with pytest.raises(mjrec.NoPictures):
        mjrec.Monitor(Walk(render_mode=None), tmp_path / "run", keep="worst:1")
    assert not (tmp_path / "run").exists()


def test_nothing_was_finished(tmp_path: Path) -> None:
    """The manifest says that it was decided among none."""
    mjrec.Monitor(Walk(), tmp_path, keep="median").close()
    text = json.dumps(manifest_of(tmp_path)["mjrec"]["keep"], sort_keys=True)
    assert json.loads(text) == {
        "rule": "median",
        "decided": True,
        "chosen": [],
        "finished": 0,
        "most_bytes_held": 0,
    }


def test_what_is_decided_elsewhere_is_left_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also what was not completed: whoever chooses may want failures."""
    env = pendulum(RETURNS[:2])
    with caplog.at_level(logging.WARNING):
        monitor = mjrec.Monitor(
            env, tmp_path, keep=UNDECIDED, mode="evaluation", workers=0
        )
        with monitor:
            play_one(monitor)
            monitor.reset(seed=1)
            monitor.step(monitor.action_space.sample())
    assert caplog.text == ""
    logs = in_flight(tmp_path)
    assert len(logs) == 2
    for log, complete in zip(logs, (True, False), strict=True):
        with open_trajectory(log) as reader:
            facts = reader.header.facts
        assert (facts["candidate"], facts["complete"]) == (True, complete)
    keep = manifest_of(tmp_path)["mjrec"]["keep"]
    assert (keep["decided"], keep["left_open"], keep["chosen"]) == (False, True, [])


def play_one(env: Any) -> None:
    """Run one episode."""
    env.reset(seed=0)
    done = False
    while not done:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        done = terminated or truncated
