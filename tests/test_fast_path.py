# SPDX-License-Identifier: Apache-2.0
"""Steps of which nothing but the state is new are recorded as all others are."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from recorded_states import assert_same, changes_in, is_fast, trajectories
from recordings import stats_of

import mjrec
from mjrec import Monitor

CHEETAH, HOPPER, PENDULUM = "HalfCheetah-v5", "Hopper-v5", "InvertedPendulum-v5"
INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION

Before = Callable[[int, Any], None]


class Changed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Does something after a step, and gives the rewards of the steps another type."""

    def __init__(
        self,
        env: Any,
        *,
        reward: Callable[[float], Any] = lambda reward: reward,
        after: dict[int, Callable[[], None]] | None = None,
    ) -> None:
        super().__init__(env)
        self.reward = reward
        self.after = after or {}
        self.number = 0

    def step(self, action: Any) -> Any:
        observation, reward, *rest = self.env.step(action)
        self.number += 1
        self.after.get(self.number, lambda: None)()
        return (observation, self.reward(float(reward)), *rest)


def make(env_id: str = CHEETAH, **options: Any) -> Any:
    return gymnasium.make(env_id, width=48, height=32, **options)


def monitored(env: Any, directory: Path, **options: Any) -> Any:
    """Return a monitor of the environment that draws nothing yet."""
    return Monitor(env, directory, lambda _: True, workers=0, **options)


def go(
    monitor: Any, count: int, *, usual: bool = True, before: Before | None = None
) -> list[Any]:
    """Take so many steps, and return what they returned."""
    results = []
    for number in range(1, count + 1):
        if not usual:
            monitor._recorder.fast = None
        if before is not None:
            before(number, monitor)
        results.append(monitor.step(monitor.action_space.sample()))
    return results


def begin(monitor: Any) -> None:
    monitor.reset(seed=0)
    monitor.action_space.seed(0)


def recorded(
    *given: Any, camera: Any = None, max_fps: Any = None, **steps: Any
) -> mjrec.Trajectory:
    """Record the first steps of an episode and return its trajectory."""
    env, directory, count = (*given, 8)[:3]
    with monitored(env, directory, camera=camera, max_fps=max_fps) as monitor:
        begin(monitor)
        go(monitor, count, **steps)
    [trajectory] = trajectories(directory)
    return trajectory


def state_of(env: Any) -> Any:
    model, data = env.unwrapped.model, env.unwrapped.data
    state = np.empty(mujoco.mj_stateSize(model, INTEGRATION))
    mujoco.mj_getState(model, data, state, INTEGRATION)
    return state


@pytest.fixture
def cheetah() -> Iterator[Any]:
    """An environment nearly all of whose steps are usual."""
    env = make(max_episode_steps=8)
    yield env
    env.close()


# --- what is recorded ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("env_id", "max_fps", "frames"),
    [
        (HOPPER, None, [0, 1, 2, 3, 4, 5]),
        # At most 10 of 25 steps a second are every third one, and the last of all.
        (PENDULUM, 10, [0, 3, 5]),
    ],
)
def test_usual_steps_are_recorded_as_others_are(
    env_id: str, max_fps: Any, frames: list[int], tmp_path: Path
) -> None:
    """States, actions, rewards, ends and frames are the same, bit for bit."""
    usual, other = (
        recorded(
            *(make(env_id, max_episode_steps=5), tmp_path / str(is_usual), 5),
            usual=is_usual,
            max_fps=max_fps,
        )
        for is_usual in (True, False)
    )
    assert len(usual) == 5
    assert usual.frame_steps.tolist() == frames
    assert_same(usual, other)


def test_states_are_those_of_the_environment(cheetah: Any, tmp_path: Path) -> None:
    """Of every step, as MuJoCo itself gives them after it."""
    states = []
    with monitored(cheetah, tmp_path) as monitor:
        begin(monitor)
        states.append(state_of(cheetah))
        for _ in range(8):
            monitor.step(monitor.action_space.sample())
            states.append(state_of(cheetah))
    [trajectory] = trajectories(tmp_path)
    np.testing.assert_array_equal(trajectory.states, states)


@pytest.mark.parametrize("max_fps", [None, 8])
def test_all_steps_but_the_first_of_the_run_are_usual(
    max_fps: int | None, cheetah: Any, tmp_path: Path
) -> None:
    """With a frame or without; the first tells what actions are and how long it is."""
    with monitored(cheetah, tmp_path, max_fps=max_fps) as monitor:
        seen = []
        for _ in range(2):
            begin(monitor)
            for _ in range(8):
                seen.append(is_fast(monitor))
                go(monitor, 1)
            assert not is_fast(monitor)
    assert seen == [False, *15 * [True]]


# --- statistics ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind",
    [
        float,
        int,
        np.float64,
        np.float32,
        np.array,
        lambda reward: np.array([reward]),
        lambda reward: reward > 0,
        # Another one in mid-episode.
        lambda reward: int(reward) if reward > 0 else np.float32(reward),
    ],
    ids=["float", "int", "float64", "float32", "0-d", "1-d", "bool", "mixed"],
)
def test_rewards_of_any_type_are_numbers(
    kind: Callable[[float], Any], tmp_path: Path
) -> None:
    """In the trajectory and, added up in their order, in the statistics."""
    env = Changed(make(max_episode_steps=8), reward=kind)
    with monitored(env, tmp_path) as monitor:
        begin(monitor)
        stats, rewards = monitor.stats_recorder, []
        for number in range(1, 9):
            [(_, reward, *_)] = go(monitor, 1)
            rewards.append(float(np.asarray(reward).item()))
            # Up to date after every step, and no number of NumPy's.
            assert (stats.steps, stats.total_steps) == (number, number)
            assert (stats.rewards, type(stats.rewards)) == (sum(rewards), float)
        [total] = monitor.get_episode_rewards()
    assert total == sum(rewards)
    assert type(total) is float
    [trajectory] = trajectories(tmp_path)
    assert trajectory.rewards.tolist() == rewards
    assert stats_of(tmp_path)["episode_rewards"] == [total]


def test_episodes_that_are_only_counted(tmp_path: Path) -> None:
    """Lengths, sums and ends are those of episodes whose states are recorded."""
    found = []
    for name, schedule in (("counted", False), ("recorded", lambda _: True)):
        env = make(HOPPER, max_episode_steps=30)
        with Monitor(env, tmp_path / name, schedule, workers=0) as monitor:
            begin(monitor)
            for steps in range(1, 101):
                assert is_fast(monitor) or steps == 1
                [(_, _, terminated, truncated, _)] = go(monitor, 1)
                assert monitor.get_total_steps() == steps
                if terminated or truncated:
                    assert not is_fast(monitor)
                    monitor.reset()
        stats = stats_of(tmp_path / name)
        found.append((stats["episode_lengths"], stats["episode_rewards"]))
    assert found[0] == found[1]
    assert not list((tmp_path / "counted").glob("*trajectory*"))


def test_a_reward_that_is_no_number_is_told(tmp_path: Path) -> None:
    """The step is not recorded, and the next one is."""
    rewards = iter([1.0, 1.0, "much", 1.0, 1.0])
    env = Changed(make(), reward=lambda _: next(rewards))
    with monitored(env, tmp_path) as monitor:
        begin(monitor)
        go(monitor, 2)
        with pytest.raises(mjrec.InvalidArgument, match="much"):
            go(monitor, 1)
        go(monitor, 2)
        assert monitor.get_total_steps() == 4
    [trajectory] = trajectories(tmp_path)
    np.testing.assert_array_equal(trajectory.states[-1], state_of(env))
    assert trajectory.rewards.tolist() == [1.0] * 4


# --- what is noticed -----------------------------------------------------------------


def test_a_changed_model_is_noticed_at_the_very_step(
    cheetah: Any, tmp_path: Path
) -> None:
    """A colour set before step 4 is that of frame 4, and another one's that of 7."""
    model = cheetah.unwrapped.model

    def paint(number: int, monitor: Any) -> None:
        if number in (4, 7):
            assert is_fast(monitor)
            model.geom_rgba[1] = (0, 0, 1, number / 10)

    trajectory = recorded(cheetah, tmp_path, before=paint)
    alphas = [trajectory.model(step).geom_rgba[1, 3] for step in (3, 4, 6, 7, 8)]
    assert alphas == pytest.approx([1, 0.4, 0.4, 0.7, 0.7])
    assert trajectory.frame_steps.tolist() == list(range(9))


@pytest.mark.parametrize("is_own", [True, False])
def test_a_camera_that_was_asked_for_may_move(is_own: bool, tmp_path: Path) -> None:
    """One's own at any step; the free one with the model, for every frame anew."""
    camera = mujoco.MjvCamera() if is_own else -1
    env = make()

    def turn(number: int, monitor: Any) -> None:
        if number in (3, 4, 7):
            assert is_fast(monitor)
            if isinstance(camera, int):
                env.unwrapped.model.vis.global_.azimuth += 30
            else:
                camera.azimuth += 10

    recorded(env, tmp_path, camera=camera, before=turn)
    moved = {"camera.azimuth"} | (set() if is_own else {"vis.global_.azimuth"})
    assert changes_in(tmp_path) == dict.fromkeys((3, 4, 7), moved)


# --- actions -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("dtype", np.linspace(-1, 1, 6, dtype=np.float64)),
        ("integers", np.array([1, 0, -1, 1, 0, 1])),
        ("list", [0.5, -0.25, 0.0, 1.0, -1.0, 0.125]),
        ("tuple", (0, 1, 0, -1, 0, 1)),
        ("byte order", np.linspace(-1, 1, 6).astype(">f4")),
        ("every second", np.linspace(-1, 1, 12, dtype=np.float32)[::2]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_actions_of_another_kind_are_recorded_as_they_are(
    kind: str, value: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In mid-episode, with no word about it; and those after them too."""
    env = make(max_episode_steps=8)
    actions = [env.action_space.sample() for _ in range(8)]
    actions[3] = actions[5] = value
    with monitored(env, tmp_path) as monitor:
        begin(monitor)
        for action in actions:
            monitor.step(action)
    [trajectory] = trajectories(tmp_path)
    np.testing.assert_array_equal(trajectory.actions, np.array(actions, np.float64))
    assert "not like those before" not in caplog.text


def test_an_action_that_the_environment_overwrites(tmp_path: Path) -> None:
    """Is recorded as it was given."""

    class Overwriting(gymnasium.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            result = self.env.step(action)
            action[:] = 7
            return result

    with monitored(Overwriting(make(max_episode_steps=8)), tmp_path) as monitor:
        begin(monitor)
        for k in range(8):
            monitor.step(np.full(6, 0.125 * k))
    [trajectory] = trajectories(tmp_path)
    assert trajectory.actions is not None
    assert trajectory.actions[:, 0].tolist() == [0.125 * k for k in range(8)]


# --- errors, and the end -------------------------------------------------------------


def interrupt_in(monitor: Any, event_number: int) -> bool:
    """Take a step, and raise behind one of the calls in it, as a signal's handler does.

    Returns:
        Whether there were so many calls.
    """
    left = event_number

    def profile(frame: Any, event: str, _: object) -> None:
        nonlocal left
        if event in ("return", "c_return") and "mjrec" in frame.f_code.co_filename:
            left -= 1
            if left == 0:
                raise KeyboardInterrupt

    sys.setprofile(profile)
    try:
        monitor.step(monitor.action_space.sample())
    except KeyboardInterrupt:
        return True
    finally:
        sys.setprofile(None)
    return False


# Takes more than five seconds: an episode for each place of an interruption.
@pytest.mark.parametrize(
    ("max_fps", "schedule"),
    [(None, lambda _: True), (8, lambda _: True), (None, False)],
    ids=["frames", "few frames", "counted"],
)
def test_an_interrupted_step_is_recorded_or_is_not(
    max_fps: Any, schedule: Any, tmp_path: Path
) -> None:
    """Wherever it is interrupted, who goes on has statistics and rows of all others."""
    numbers = itertools.count(1)
    for number in numbers:
        directory = tmp_path / str(number)
        env = make(max_episode_steps=8)
        options = {"max_fps": max_fps, "workers": 0}
        with Monitor(env, directory, schedule, **options) as monitor:
            begin(monitor)
            go(monitor, 4)
            assert is_fast(monitor)
            was_interrupted = interrupt_in(monitor, number)
            while not monitor.stats_recorder.done:
                go(monitor, 1)
            total = monitor.get_total_steps()
            [length] = monitor.get_episode_lengths()
            [reward] = monitor.get_episode_rewards()
        assert length == total
        assert length in (7, 8)
        for trajectory in trajectories(directory):
            assert len(trajectory) == length
            assert sum(trajectory.rewards.tolist()) == reward
            assert trajectory.complete
            steps = trajectory.frame_steps.tolist()
            assert steps == sorted({*steps, length})
        if not was_interrupted:
            break
    assert number > 4


def test_steps_after_the_close_go_to_the_environment(
    cheetah: Any, tmp_path: Path
) -> None:
    """Nothing more is recorded of them."""
    monitor = monitored(cheetah, tmp_path)
    begin(monitor)
    go(monitor, 4)
    monitor.close()
    time = float(cheetah.unwrapped.data.time)
    observation, reward, *_ = monitor.step(np.zeros(6))
    assert observation.shape == (17,)
    assert isinstance(reward, float)
    assert cheetah.unwrapped.data.time > time
    assert monitor.get_total_steps() == 4
    [trajectory] = trajectories(tmp_path)
    assert len(trajectory) == 4


def test_a_monitor_may_be_closed_within_a_step(tmp_path: Path) -> None:
    """As by a signal's handler that only closes it: the step returns as ever."""
    env = Changed(make())
    monitor = monitored(env, tmp_path)
    begin(monitor)
    env.after[4] = monitor.close
    go(monitor, 3)
    assert is_fast(monitor)
    [(observation, *_)] = go(monitor, 1)
    assert observation.shape == (17,)
    [trajectory] = trajectories(tmp_path)
    assert len(trajectory) == 3
