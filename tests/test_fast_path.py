# SPDX-License-Identifier: Apache-2.0
"""Steps of which nothing but the state is new are recorded as all others are."""

from __future__ import annotations

import copy
import itertools
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from full_disk import file_size_limit
from recorded_states import assert_same, changes_in, is_fast, trajectories
from recordings import manifest_of, stats_of
from waiting import wait_until

import mjrec
from mjrec import FileNotWritten, Monitor, ResetNeeded
from mjrec.formats.spans import recordings_in_flight

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
    env: Any, directory: Path, count: int = 8, *, camera: Any = None, **steps: Any
) -> mjrec.Trajectory:
    """Record the first steps of an episode and return its trajectory."""
    with monitored(env, directory, camera=camera) as monitor:
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


@pytest.mark.parametrize("env_id", [CHEETAH, HOPPER, PENDULUM])
def test_usual_steps_are_recorded_as_others_are(env_id: str, tmp_path: Path) -> None:
    """States, actions, rewards, ends and frames are the same, bit for bit."""
    usual = recorded(make(env_id, max_episode_steps=5), tmp_path / "usual", 5)
    env = make(env_id, max_episode_steps=5)
    other = recorded(env, tmp_path / "other", 5, usual=False)
    assert len(usual) == 5
    assert usual.frame_steps.tolist() == list(range(6))
    assert_same(usual, other)


@pytest.mark.parametrize(
    "camera",
    ["track", 0, -1, mujoco.MjvCamera()],
    ids=["name", "number", "free", "own"],
)
def test_usual_steps_are_shown_by_any_camera(camera: Any, tmp_path: Path) -> None:
    """One that was asked for is no reason to look more closely."""

    def check(number: int, monitor: Any) -> None:
        assert is_fast(monitor) == (number > 1)
        assert number < 3 or monitor._recorder._subject.states._quick.is_current()

    directories = tmp_path / "usual", tmp_path / "other"
    env = make(max_episode_steps=5)
    usual = recorded(env, directories[0], 5, camera=camera, before=check)
    env = make(max_episode_steps=5)
    other = recorded(env, directories[1], 5, camera=camera, usual=False)
    assert_same(usual, other)
    assert usual.facts["scene"] == other.facts["scene"]


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
def test_steps_are_usual_from_the_second_one_on(
    max_fps: int | None, cheetah: Any, tmp_path: Path
) -> None:
    """With a frame or without, until the episode is over and the next has had one."""
    with monitored(cheetah, tmp_path, max_fps=max_fps) as monitor:
        seen = []
        for _ in range(2):
            begin(monitor)
            for _ in range(8):
                seen.append(is_fast(monitor))
                go(monitor, 1)
            assert not is_fast(monitor)
    assert seen == 2 * [False, *7 * [True]]


def test_frames_keep_to_the_rate(tmp_path: Path) -> None:
    """At most 8 of 20 steps a second are every third one, and the last of all."""
    env = make(max_episode_steps=10)
    with monitored(env, tmp_path / "few", max_fps=8) as monitor:
        begin(monitor)
        go(monitor, 10)
    [few] = trajectories(tmp_path / "few")
    assert few.frame_steps.tolist() == [0, 3, 6, 9, 10]
    all_of_them = recorded(make(max_episode_steps=10), tmp_path / "all", 10)
    np.testing.assert_array_equal(few.states, all_of_them.states)
    for name, values in all_of_them.snapshots.items():
        np.testing.assert_array_equal(few.snapshots[name], values[few.frame_steps])


@pytest.mark.parametrize(
    ("max_fps", "steps"), [(8, [0, 3, 5]), (None, [0, 1, 2, 3, 4, 5])]
)
def test_an_unfinished_episode_ends_with_a_frame(
    max_fps: int | None, steps: list[int], tmp_path: Path
) -> None:
    """With one, also where its last step is none that the rate has one for."""
    with monitored(make(), tmp_path, max_fps=max_fps) as monitor:
        begin(monitor)
        go(monitor, 5)
    [trajectory] = trajectories(tmp_path)
    assert trajectory.frame_steps.tolist() == steps
    assert not trajectory.complete


def test_observations_are_recorded_too(cheetah: Any, tmp_path: Path) -> None:
    """Each with the state that belongs to it."""
    with monitored(cheetah, tmp_path, observations=True) as monitor:
        begin(monitor)
        observations = [result[0] for result in go(monitor, 8)]
    [trajectory] = trajectories(tmp_path)
    assert trajectory.observations is not None
    np.testing.assert_array_equal(trajectory.observations[1:], observations)
    same = recorded(make(max_episode_steps=8), tmp_path / "without")
    assert_same(trajectory, same)


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
            seen = []
            for steps in range(1, 101):
                seen.append(is_fast(monitor))
                [(_, _, terminated, truncated, _)] = go(monitor, 1)
                assert monitor.get_total_steps() == steps
                if terminated or truncated:
                    assert not is_fast(monitor)
                    monitor.reset()
        stats = stats_of(tmp_path / name)
        found.append((seen, stats["episode_lengths"], stats["episode_rewards"]))
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


def test_a_change_that_was_said_is_recorded(cheetah: Any, tmp_path: Path) -> None:
    """`model_changed()` finds a mass, which no picture shows, at the next step."""
    model = cheetah.unwrapped.model
    mass = float(model.body_mass[1])

    def load(number: int, monitor: Any) -> None:
        if number == 4:
            model.body_mass[1] = 2 * mass
            monitor.model_changed()

    trajectory = recorded(cheetah, tmp_path, before=load)
    assert [trajectory.model(k).body_mass[1] for k in (3, 4, 8)] == [
        *(mass, 2 * mass, 2 * mass)
    ]
    assert trajectory.frame_steps.tolist() == list(range(9))


def test_other_data_is_recorded_from_its_first_step_on(tmp_path: Path) -> None:
    """And the first data again, where the environment goes back to it."""
    env = make(max_episode_steps=8)
    inner = env.unwrapped
    first, second = inner.data, copy.copy(inner.data)
    states = []

    def swap(number: int, _: Any) -> None:
        states.append(state_of(env))
        if number in (3, 6):
            inner.data = second if number == 3 else first
            inner.data.qpos[2] += 0.1

    trajectory = recorded(env, tmp_path, before=swap)
    np.testing.assert_array_equal(trajectory.states[:8], states)
    np.testing.assert_array_equal(trajectory.states[8, :10], state_of(env)[:10])
    positions = trajectory.snapshots["geom_xpos"]
    assert len(positions) == 9
    np.testing.assert_array_equal(positions[-1], first.geom_xpos)


def test_data_that_come_back_are_looked_at_closely(
    cheetah: Any, tmp_path: Path
) -> None:
    """What was told of a change meanwhile is told of all of them."""
    inner = cheetah.unwrapped
    first, second = inner.data, copy.copy(inner.data)
    mass = float(inner.model.body_mass[1])

    def swap(number: int, monitor: Any) -> None:
        if number == 3:
            inner.data = second
        if number == 5:
            inner.data = first
            inner.model.body_mass[1] = 2 * mass
            monitor.model_changed()

    trajectory = recorded(cheetah, tmp_path, before=swap)
    masses = [trajectory.model(k).body_mass[1] for k in (4, 5, 8)]
    assert masses == [mass, 2 * mass, 2 * mass]


def test_another_camera_is_noticed_at_the_very_step(
    cheetah: Any, tmp_path: Path
) -> None:
    """The environment's renderer may be pointed elsewhere in mid-episode."""

    def turn(number: int, monitor: Any) -> None:
        if number == 4:
            assert is_fast(monitor)
            renderer = cheetah.unwrapped.mujoco_renderer
            # Gymnasium 1.0 begins with the tracking one.
            renderer.camera_id = 0 if renderer.camera_id == -1 else -1

    recorded(cheetah, tmp_path, before=turn)
    [(step, fields)] = changes_in(tmp_path).items()
    assert step == 4
    assert "camera.fixedcamid" in fields


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


def test_an_action_of_another_shape_is_zeros(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With one warning; state and reward of the step are recorded as ever."""

    class Repeating(gymnasium.ActionWrapper[Any, Any, Any]):
        def action(self, action: Any) -> Any:
            return np.resize(action, 6)

    env = Repeating(make(max_episode_steps=8))
    actions = [np.full(6, 0.1 * k) for k in range(8)]
    actions[3] = actions[5] = np.full(2, 0.7)
    states = []
    with monitored(env, tmp_path) as monitor:
        begin(monitor)
        for action in actions:
            monitor.step(action)
            states.append(state_of(env))
    [trajectory] = trajectories(tmp_path)
    assert trajectory.actions is not None
    for k in (3, 5):
        actions[k] = np.zeros(6)
    np.testing.assert_array_equal(trajectory.actions, actions)
    np.testing.assert_array_equal(trajectory.states[1:], states)
    assert trajectory.facts["irregular_actions_from"] == 3
    assert caplog.text.count("not like those before") == 1


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


def test_an_environment_that_raises_may_go_on(tmp_path: Path) -> None:
    """The failed step is not recorded, and those after it are, again as usual ones."""

    def fail() -> None:
        raise ZeroDivisionError

    env = Changed(make(max_episode_steps=8), after={4: fail})
    with monitored(env, tmp_path) as monitor:
        begin(monitor)
        go(monitor, 3)
        with pytest.raises(ZeroDivisionError):
            go(monitor, 1)
        assert not is_fast(monitor)
        rewards = [float(result[1]) for result in go(monitor, 2)]
        assert is_fast(monitor)
        state = state_of(env)
        assert monitor.get_total_steps() == 5
    [trajectory] = trajectories(tmp_path)
    assert len(trajectory) == 5
    assert trajectory.rewards[3:].tolist() == rewards
    np.testing.assert_array_equal(trajectory.states[-1], state)


def test_an_episode_that_ends_with_an_error_says_so(tmp_path: Path) -> None:
    """Its last frame is that of the last step that was made."""

    def fail() -> None:
        raise ZeroDivisionError

    monitor = monitored(Changed(make(), after={5: fail}), tmp_path, max_fps=8)
    begin(monitor)
    with pytest.raises(ZeroDivisionError):
        go(monitor, 5)
    monitor.close()
    [trajectory] = trajectories(tmp_path)
    assert len(trajectory) == 4
    assert trajectory.facts["reason"] == "exception"
    assert trajectory.frame_steps.tolist() == [0, 3]


@pytest.mark.parametrize("on_error", ["raise", "warn"])
def test_a_disk_that_is_full_in_mid_episode(on_error: str, tmp_path: Path) -> None:
    """The trajectory ends there, the statistics do not, and the next one is whole."""
    env = make(max_episode_steps=400)
    monitor = monitored(env, tmp_path, on_error=on_error)
    begin(monitor)
    go(monitor, 400)
    wait_until(lambda: list(tmp_path.glob("*.mjb.gz")))
    monitor.reset(seed=1)
    go(monitor, 2)
    assert is_fast(monitor)
    states, errors = [], 0
    with file_size_limit(200):
        for _ in range(300):
            try:
                go(monitor, 1)
            except FileNotWritten:
                errors += 1
            states.append(state_of(env))
    assert not is_fast(monitor)
    go(monitor, 98)
    begin(monitor)
    go(monitor, 400)
    monitor.close()
    assert stats_of(tmp_path)["episode_lengths"] == [400, 400, 400]
    whole, torn, same = trajectories(tmp_path)
    assert 2 < len(torn) < 300
    np.testing.assert_array_equal(torn.states[3:], states[: len(torn) - 2])
    assert_same(same, whole)
    faults = [fault["what"] for fault in manifest_of(tmp_path)["mjrec"]["faults"]]
    assert faults.count("trajectory") == (on_error == "warn")
    assert errors == (on_error == "raise")


@pytest.mark.parametrize("schedule", [False, lambda _: True], ids=["counted", "all"])
def test_statistics_may_be_set_in_mid_episode(schedule: Any, tmp_path: Path) -> None:
    """As with gym's recorder, which is there to be used."""
    with Monitor(make(max_episode_steps=8), tmp_path, schedule, workers=0) as monitor:
        begin(monitor)
        go(monitor, 3)
        assert is_fast(monitor)
        monitor.stats_recorder.rewards = 0
        monitor.stats_recorder.steps = 100
        rewards = [float(result[1]) for result in go(monitor, 5)]
    stats = stats_of(tmp_path)
    assert stats["episode_rewards"] == [sum(rewards)]
    assert stats["episode_lengths"] == [105]


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


@pytest.mark.parametrize("way", ["done", "closed", "reset", "error"])
def test_episodes_that_are_only_counted_end_like_others(
    way: str, tmp_path: Path
) -> None:
    """Whoever ends them, and however."""
    env = Changed(make())
    monitor = Monitor(env, tmp_path, False, allow_early_reset=True)
    begin(monitor)
    go(monitor, 3)
    assert is_fast(monitor)
    if way == "done":
        monitor.stats_recorder.done = True
        with pytest.raises(ResetNeeded):
            go(monitor, 1)
    elif way == "closed":
        monitor.close()
        go(monitor, 1)
    elif way == "reset":
        begin(monitor)
        go(monitor, 1)
    else:
        env.after[4] = lambda: 1 // 0
        with pytest.raises(ZeroDivisionError):
            go(monitor, 1)
        assert not is_fast(monitor)
    assert monitor.get_total_steps() == (4 if way == "reset" else 3)
    monitor.close()
    assert stats_of(tmp_path)["episode_lengths"] == []


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_child_forked_in_mid_episode_is_told(cheetah: Any, tmp_path: Path) -> None:
    """Its step does not reach the environment, and the parent goes on."""
    told = tmp_path / "told.json"
    with monitored(cheetah, tmp_path / "run") as monitor:
        begin(monitor)
        go(monitor, 4)
        assert is_fast(monitor)
        before = state_of(cheetah).tolist()
        child = os.fork()
        if child == 0:
            try:
                monitor.step(np.zeros(6))
            except mjrec.Error as error:
                same = state_of(cheetah).tolist() == before
                told.write_text(json.dumps([str(error), same]))
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        go(monitor, 4)
    message, is_same = json.loads(told.read_text())
    assert "forked" in message
    assert is_same
    [trajectory] = trajectories(tmp_path / "run")
    assert_same(trajectory, recorded(make(max_episode_steps=8), tmp_path / "same"))


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


def test_a_reset_in_mid_episode_ends_it(cheetah: Any, tmp_path: Path) -> None:
    """The next episode begins with a step that is not usual, and is its own."""
    with monitored(cheetah, tmp_path, allow_early_reset=True) as monitor:
        begin(monitor)
        go(monitor, 4)
        begin(monitor)
        assert not is_fast(monitor)
        go(monitor, 8)
    early, whole = trajectories(tmp_path)
    assert (len(early), len(whole)) == (4, 8)
    np.testing.assert_array_equal(early.states, whole.states[:5])
    assert (early.complete, whole.complete) == (False, True)


# --- with others ---------------------------------------------------------------------


def test_steps_that_reset_begin_the_next_episode(tmp_path: Path) -> None:
    """Gymnasium's Autoreset resets in the step after the end; no episode has it."""
    env = gymnasium.wrappers.Autoreset(make(max_episode_steps=4))
    states = []
    with monitored(env, tmp_path) as monitor:
        begin(monitor)
        states.append(state_of(env))
        for _ in range(13):
            go(monitor, 1)
            states.append(state_of(env))
        assert monitor.get_episode_lengths() == [4, 4]
        assert monitor.get_total_steps() == 11
    found = trajectories(tmp_path)
    assert [len(each) for each in found] == [4, 4, 3]
    np.testing.assert_array_equal(np.concatenate([t.states for t in found]), states)


def test_clips_are_recorded_beside_trajectories(tmp_path: Path) -> None:
    """Both as ever, though no step of such a monitor is a usual one."""
    with Monitor(
        *(make(max_episode_steps=8), tmp_path / "both"),
        trajectory_callable=True,
        step_trigger=lambda step: step == 2,
        video_length=3,
        workers=0,
    ) as monitor:
        begin(monitor)
        for _ in range(8):
            go(monitor, 1)
            assert not is_fast(monitor)
    same = recorded(make(max_episode_steps=8), tmp_path / "same")
    [whole] = trajectories(tmp_path / "both")
    np.testing.assert_array_equal(whole.states, same.states)
    np.testing.assert_array_equal(whole.rewards, same.rewards)
    [recording] = [
        r for r in recordings_in_flight(tmp_path / "both") if "clip" in r.name
    ]
    clip = mjrec.load_trajectory(recording.path)
    np.testing.assert_array_equal(clip.states, same.states[2:6])
    assert clip.frame_steps.tolist() == [0, 1, 2, 3]


# --- faults --------------------------------------------------------------------------


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


def test_a_full_disk_with_a_changed_texture(tmp_path: Path) -> None:
    """The first rows of an episode may be many bytes, and none of them is there."""
    env = make(max_episode_steps=8)
    with monitored(env, tmp_path, on_error="warn") as monitor:
        begin(monitor)
        go(monitor, 8)
        wait_until(lambda: list(tmp_path.glob("*.mjb.gz")))
        texture = env.unwrapped.model.tex_data
        texture[:] = 255 - texture
        begin(monitor)
        with file_size_limit(200):
            go(monitor, 4)
        go(monitor, 4)
    assert stats_of(tmp_path)["episode_lengths"] == [8, 8]
