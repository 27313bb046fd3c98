# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import json
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformReward
from processes import children
from vector_environments import (
    DISABLED,
    MODES,
    NEXT_STEP,
    SAME_STEP,
    VectorCorridor,
    hashes_at,
    metadata_at,
    path_of,
    play,
    shown,
)

import mjrec
from mjrec import Error, InvalidArgument, NoPictures, ResetNeeded, ResetNotAllowed

LENGTHS = (2, 3)


@pytest.fixture
def corridors(make_corridor: Any) -> Any:
    """Make a `SyncVectorEnv` of corridors that are 2 and 3 steps long."""

    def make(mode: Any = NEXT_STEP, **arguments: Any) -> Any:
        each = [
            lambda length=length: make_corridor(length, **arguments)
            for length in LENGTHS
        ]
        return SyncVectorEnv(each, autoreset_mode=mode)

    return make


def hoppers(mode: Any, *, max_episode_steps: int = 3, count: int = 2) -> Any:
    return gymnasium.make_vec(
        "Hopper-v5",
        num_envs=count,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        render_mode="rgb_array",
        width=64,
        height=64,
        max_episode_steps=max_episode_steps,
    )


# --- whole episodes, each of its own ---------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_every_sub_environment_has_whole_videos(
    corridors: Any, tmp_path: Path, mode: Any
) -> None:
    """Each shows its reset and all its steps, the terminal one included."""
    with mjrec.Monitor(corridors(mode), tmp_path) as env:
        play(env, 8)
    for monitor, length in zip(env.monitors, LENGTHS, strict=True):
        for episode in (0, 1):
            path = path_of(monitor, episode, "mp4")
            assert shown(path) == list(range(length + 1))
            assert "final_frame" not in metadata_at(path.with_suffix(".meta.json"))


@pytest.mark.parametrize("mode", MODES)
def test_statistics_are_those_of_gymnasium(tmp_path: Path, mode: Any) -> None:
    """Lengths and returns are those that RecordEpisodeStatistics has."""
    arguments = {"vector_kwargs": {"autoreset_mode": mode}}
    inner = gymnasium.make_vec("CartPole-v1", 3, "sync", **arguments)
    with mjrec.Monitor(inner, tmp_path, video_callable=False) as env:
        counted = RecordEpisodeStatistics(env)
        ended: list[list[tuple[float, int]]] = [[], [], []]
        counted.reset(seed=1)
        counted.action_space.seed(1)
        for _ in range(80):
            *_, terminations, _, infos = counted.step(counted.action_space.sample())
            for index in np.flatnonzero(terminations):
                episode = infos["episode"]
                ended[index].append((episode["r"][index], episode["l"][index]))
            if mode == DISABLED and terminations.any():
                env.reset(options={"reset_mask": terminations.copy()})
                # Gymnasium's own reset would find no mask any more.
                counted.episode_returns[terminations] = 0
                counted.episode_lengths[terminations] = 0
                counted.prev_dones[terminations] = False
    assert sum(map(len, ended)) > 5
    assert env.get_episode_rewards() == [[r for r, _ in each] for each in ended]
    assert env.get_episode_lengths() == [[n for _, n in each] for each in ended]
    assert env.get_total_steps() == sum(m.get_total_steps() for m in env.monitors)


# Takes more than five seconds: each sub-environment is drawn alone, too.
def test_terminal_frames_are_those_of_render(tmp_path: Path) -> None:
    """In SAME_STEP the deferred frames are byte for byte those of one environment."""
    with mjrec.Monitor(hoppers(SAME_STEP), tmp_path) as env:
        play(env, 3, seed=7)
    alone = gymnasium.make("Hopper-v5", render_mode="rgb_array", width=64, height=64)
    actions = gymnasium.vector.utils.batch_space(alone.action_space, 2)
    actions.seed(7)
    drawn = [actions.sample() for _ in range(3)]
    for index, monitor in enumerate(env.monitors):
        alone.reset(seed=7 + index)
        frames = [alone.render()]
        for action in drawn:
            alone.step(action[index])
            frames.append(alone.render())
        expected = [hashlib.sha256(frame.tobytes()).hexdigest() for frame in frames]
        assert hashes_at(path_of(monitor, 0, "framehash")) == expected
    alone.close()


def test_trajectories_have_states_in_every_mode(tmp_path: Path) -> None:
    """They are of the sub-environment, with a state for the terminal step."""
    with mjrec.Monitor(
        hoppers(SAME_STEP), tmp_path, render="off", mode="evaluation"
    ) as e:
        play(e, 4, seed=2)
    for monitor in e.monitors:
        name = f"openaigym.trajectory.{monitor.infix}.episode000000.h5"
        trajectory = mjrec.load_trajectory(tmp_path / name)
        assert trajectory.states.shape[0] == 4
        assert np.isfinite(trajectory.states).all()
        assert trajectory.truncated[-1]


# Takes more than five seconds: each of 64 monitors writes files of its own.
def test_sub_environments_share_one_budget_of_tails(tmp_path: Path) -> None:
    """Each of 64 is recorded, and their logs' tails have 4 MiB together."""
    make = functools.partial(gymnasium.make, "InvertedPendulum-v5", max_episode_steps=2)
    vector = SyncVectorEnv([make] * 64)
    with mjrec.Monitor(vector, tmp_path, False, mode="evaluation", render="off") as env:
        env.reset(seed=1)
        env.step(env.action_space.sample())
        tails = [path.stat().st_size for path in tmp_path.glob("*.tail")]
        assert len(tails) == 64
        assert sum(tails) < 5 << 20
        env.step(env.action_space.sample())
    assert env.get_episode_lengths() == [[2]] * 64
    for monitor in env.monitors:
        name = f"openaigym.trajectory.{monitor.infix}.episode000000.h5"
        assert len(mjrec.load_trajectory(tmp_path / name).actions) == 2


def test_numbers_and_schedules_are_each_ones_own(
    corridors: Any, tmp_path: Path
) -> None:
    """Of 5 and 3 episodes the chosen ones have videos, in manifests of their own."""
    wanted: list[int] = []
    with mjrec.Monitor(
        corridors(SAME_STEP), tmp_path, lambda n: wanted.append(n) or n == 1
    ) as env:
        play(env, 10)
        assert [m.episode_id for m in env.monitors] == [6, 4]
    assert sorted(wanted) == [0, 0, 1, 1, 2, 2, 3, 3, 4, 5]
    for monitor in env.monitors:
        path = tmp_path / f"openaigym.manifest.{monitor.infix}.manifest.json"
        [[video, _]] = metadata_at(path)["videos"]
        assert video == path_of(monitor, 1, "mp4").name


def test_seeds_are_those_that_each_was_given(corridors: Any, tmp_path: Path) -> None:
    """A whole number counts on from one to the next, as SyncVectorEnv does."""
    with mjrec.Monitor(corridors(DISABLED), tmp_path, False) as env:
        play(env, 3, seed=40)
    seeds = []
    for monitor in env.monitors:
        journal = tmp_path / f"openaigym.episodes.{monitor.infix}.jsonl"
        entries = map(json.loads, journal.read_text().splitlines())
        seeds.append(next(e["seed"] for e in entries if "seed" in e))
    assert seeds == [40, 41]


def test_rewards_are_those_below_vector_wrappers(
    corridors: Any, tmp_path: Path
) -> None:
    """Below other wrappers the environments are found too."""
    scaled = TransformReward(corridors(), lambda rewards: 10 * rewards)
    with mjrec.Monitor(scaled, tmp_path, False) as env:
        env.reset()
        _, rewards, *_ = env.step(np.array([0, 0]))
        assert list(rewards) == [5.0, 5.0]
        env.step(np.array([0, 0]))
    assert env.get_episode_rewards() == [[1.0], []]


def test_calls_still_reach_the_sub_environments(corridors: Any, tmp_path: Path) -> None:
    """Attributes are read and set through the monitors."""
    vector = corridors()
    with mjrec.Monitor(vector, tmp_path, False):
        assert vector.get_attr("length") == LENGTHS
        vector.set_attr("marked", [1, 2])
        assert vector.call("marked") == (1, 2)
        assert len(vector.render()) == 2


def test_a_name_prefix_names_the_sub_environment(
    corridors: Any, tmp_path: Path
) -> None:
    """Links of two sub-environments have different names."""
    with mjrec.Monitor(corridors(), tmp_path, name_prefix="walk") as env:
        options = [monitor._options.name_prefix for monitor in env.monitors]
    assert options == ["walk-env-0", "walk-env-1"]


def test_mode_is_that_of_all(corridors: Any, tmp_path: Path) -> None:
    """`set_monitor_mode` is for each of them."""
    with mjrec.Monitor(corridors(), tmp_path, False) as env:
        env.set_monitor_mode("evaluation")
        play(env, 3)
    assert [m.stats_recorder.episode_types for m in env.monitors] == [["e"], ["e"]]


# --- one rendering for all ---------------------------------------------------------


@pytest.mark.thorough
def test_one_process_renders_for_all(tmp_path: Path) -> None:
    """Several sub-environments with ended episodes start one server."""
    before = children()
    with mjrec.Monitor(hoppers(SAME_STEP, count=3), tmp_path) as env:
        play(env, 3, seed=1)
        assert len(children() - before) == 1
    assert children() == before
    assert all(path_of(monitor, 0, "mp4").exists() for monitor in env.monitors)


@pytest.mark.thorough
def test_one_that_closes_leaves_the_others_their_rendering(tmp_path: Path) -> None:
    """The service stops with the last."""
    with mjrec.Monitor(hoppers(SAME_STEP), tmp_path, lambda n: n < 2) as env:
        play(env, 3, seed=1)
        env.monitors[0].close(wait=False)
        env.step(env.action_space.sample())
    assert path_of(env.monitors[1], 1, "mp4").exists()


def test_whoever_does_not_wait_leaves_videos_pending(tmp_path: Path) -> None:
    """The manifest of each says which."""
    env = mjrec.Monitor(hoppers(SAME_STEP), tmp_path, workers=0)
    play(env, 3, seed=1)
    env.close(wait=False)
    for monitor in env.monitors:
        path = tmp_path / f"openaigym.manifest.{monitor.infix}.manifest.json"
        pending = metadata_at(path)["mjrec"]["pending"]
        assert [each["episode_id"] for each in pending] == [0, 1]
    assert not list(tmp_path.glob("*.mp4"))


# --- opening and closing -------------------------------------------------------------


def test_closing_puts_the_environments_back(corridors: Any, tmp_path: Path) -> None:
    """Each is closed once, and the list is as it was."""
    vector = corridors()
    originals = list(vector.envs)
    env = mjrec.Monitor(vector, tmp_path, False)
    assert all(a is b for a, b in zip(vector.envs, env.monitors, strict=True))
    play(env, 2)
    env.close()
    env.close()
    assert vector.envs == originals
    assert [each.closed for each in originals] == [1, 1]
    assert vector.closed


def test_closing_the_inner_environment_finishes_the_recordings(
    corridors: Any, tmp_path: Path
) -> None:
    """Whoever closes what is inside the monitor loses nothing."""
    vector = corridors()
    env = mjrec.Monitor(vector, tmp_path)
    play(env, 4)
    vector.close()
    assert path_of(env.monitors[1], 0, "mp4").exists()
    env.close()


def test_a_failing_constructor_leaves_no_trace(
    corridors: Any, make_corridor: Any, tmp_path: Path
) -> None:
    """The last sub-environment cannot be drawn: nothing was made of the first."""
    vector = SyncVectorEnv([make_corridor, lambda: make_corridor(render_mode=None)])
    originals = list(vector.envs)
    target = tmp_path / "a" / "b"
    with pytest.raises(NoPictures, match="render_mode"):
        mjrec.Monitor(vector, target)
    assert vector.envs == originals
    assert [each.closed for each in originals] == [0, 0]
    assert not list(tmp_path.iterdir())
    with mjrec.Monitor(vector, target, False) as env:
        play(env, 2)


def test_a_failing_constructor_keeps_other_recordings(
    make_corridor: Any, tmp_path: Path, names: Any
) -> None:
    """With `resume`, only what this monitor has made is removed."""
    with mjrec.Monitor(make_corridor(), tmp_path) as env:
        env.reset()
    there = names(tmp_path)
    vector = SyncVectorEnv([make_corridor, lambda: make_corridor(render_mode=None)])
    with pytest.raises(NoPictures):
        mjrec.Monitor(vector, tmp_path, resume=True)
    assert names(tmp_path) == there


def test_recordings_are_resumed_together(corridors: Any, tmp_path: Path) -> None:
    """All go on after the highest number that is there."""
    with mjrec.Monitor(corridors(SAME_STEP), tmp_path, False) as env:
        play(env, 4)
    with mjrec.Monitor(corridors(SAME_STEP), tmp_path, False, resume=True) as env:
        env.reset()
        assert [m.episode_id for m in env.monitors] == [4, 4]
    with pytest.raises(mjrec.ExistingRecordings):
        mjrec.Monitor(corridors(), tmp_path)
    assert mjrec.load_results(tmp_path)["episode_lengths"]


def test_forgotten_monitors_are_closed(corridors: Any, tmp_path: Path) -> None:
    """What nobody refers to any more is finished, and the environment closed."""
    vector = corridors()
    originals = list(vector.envs)
    env = mjrec.Monitor(vector, tmp_path)
    play(env, 3)
    del env
    gc.collect()
    assert vector.envs == originals
    assert [each.closed for each in originals] == [1, 1]
    assert len(list(tmp_path.glob("*.manifest.json"))) == 2


def test_a_program_that_ends_without_closing_loses_nothing(tmp_path: Path) -> None:
    """Manifests are there, and what is not rendered is pending."""
    program = f"""if True:
        import gymnasium, mjrec
        vector = gymnasium.make_vec(
            "Hopper-v5", 2, "sync", max_episode_steps=3, width=64, height=64
        )
        env = mjrec.Monitor(vector, {str(tmp_path)!r})
        env.reset(seed=1)
        for _ in range(3):
            env.step(env.action_space.sample())
    """
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    manifests = [metadata_at(p) for p in tmp_path.glob("*.manifest.json")]
    assert len(manifests) == 2
    assert all(len(m["mjrec"]["pending"]) + len(m["videos"]) == 1 for m in manifests)


def test_after_close_nothing_is_recorded(corridors: Any, tmp_path: Path) -> None:
    """Calls go on to the environment."""
    env = mjrec.Monitor(corridors(), tmp_path, False)
    env.close()
    env.reset()
    env.step(np.array([0, 0]))
    assert env.get_total_steps() == 0


def test_it_cannot_be_pickled(corridors: Any, tmp_path: Path) -> None:
    """The error says where to make one."""
    with (
        mjrec.Monitor(corridors(), tmp_path, False) as env,
        pytest.raises(mjrec.NotPicklable, match="VectorMonitor"),
    ):
        pickle.dumps(env)


# --- errors and wrong use ------------------------------------------------------------


def test_errors_of_the_environment_are_noted_in_all_episodes(
    corridors: Any, tmp_path: Path
) -> None:
    """The videos of those that run say what has ended them."""
    vector = corridors()
    with (
        contextlib.suppress(RuntimeError),
        mjrec.Monitor(vector, tmp_path, lambda n: True) as env,
    ):
        env.reset()

        def explode(action: Any) -> None:
            raise RuntimeError("the motor burns")

        vector.envs[1].unwrapped.step = explode
        env.step(np.array([0, 0]))
    for monitor in env.monitors:
        said = metadata_at(path_of(monitor, 0, "meta.json"))
        assert said["exception"]["message"] == "the motor burns"


def test_an_early_reset_drops_the_episodes(corridors: Any, tmp_path: Path) -> None:
    """They are no part of the statistics, and their videos are incomplete."""
    with mjrec.Monitor(corridors(), tmp_path) as env:
        env.reset()
        env.step(np.array([0, 0]))
        play(env, 3)
    assert env.get_episode_lengths() == [[2], [3]]
    assert metadata_at(path_of(env.monitors[0], 0, "meta.json"))["complete"] is False


def test_an_early_reset_can_be_forbidden(corridors: Any, tmp_path: Path) -> None:
    """It is refused before anything is reset; those that are over may be reset."""
    with mjrec.Monitor(
        corridors(DISABLED), tmp_path, False, allow_early_reset=False
    ) as env:
        env.reset()
        for _ in range(2):
            env.step(np.array([0, 0]))
        with pytest.raises(ResetNotAllowed, match=r"\[1\]"):
            env.reset()
        assert [m.episode_id for m in env.monitors] == [1, 1]
        env.reset(options={"reset_mask": np.array([True, False])})
        assert [m.episode_id for m in env.monitors] == [2, 1]


def test_a_step_before_the_first_reset_is_refused(
    corridors: Any, tmp_path: Path
) -> None:
    """As for one environment."""
    with mjrec.Monitor(corridors(), tmp_path) as env, pytest.raises(ResetNeeded):
        env.step(np.array([0, 0]))


@pytest.mark.parametrize("mode", [None, "NextStep"])
def test_an_unknown_autoreset_mode_is_refused(tmp_path: Path, mode: Any) -> None:
    """The error says what to set; nothing is made."""
    target = tmp_path / "run"
    with pytest.raises(InvalidArgument, match="autoreset_mode"):
        mjrec.Monitor(VectorCorridor(mode=mode), target)
    assert not target.exists()


def test_sub_environments_of_different_names_need_a_common_one(
    corridors: Any, tmp_path: Path
) -> None:
    """Results of one directory belong to one environment."""
    vector = corridors()
    vector.envs[0].spec = gymnasium.spec("CartPole-v1")
    with pytest.raises(InvalidArgument, match=r"CartPole-v1, None.*env_id="):
        mjrec.Monitor(vector, tmp_path)
    with mjrec.Monitor(vector, tmp_path, env_id="corridors") as env:
        play(env, 2)


def test_a_list_that_is_not_stepped_is_noticed(
    make_corridor: Any, tmp_path: Path
) -> None:
    """Nothing would be recorded, and the first reset says so."""
    vector = VectorCorridor()
    vector.envs = [make_corridor(), make_corridor()]  # type: ignore[attr-defined]
    with (
        mjrec.Monitor(vector, tmp_path) as env,
        pytest.raises(Error, match="envs"),
    ):
        env.reset()


@pytest.fixture(autouse=True)
def no_process_is_left() -> Iterator[None]:
    """See that every test ends its processes."""
    before = children()
    yield
    gc.collect()
    assert children() <= before
