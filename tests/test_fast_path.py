# SPDX-License-Identifier: Apache-2.0
"""Test that the recorder's fast path records the same data as its usual path."""

import itertools
import os
import signal
import sys
import types

import gymnasium
import mujoco
import numpy as np
import pytest
from processes import forked, kill_self
from recordings import stats_of

import mjrec
from mjrec import Monitor
from mjrec.formats.trajectory import added_up
from mjrec.recorder import fast_path

CHEETAH, HOPPER = "HalfCheetah-v5", "Hopper-v5"


def make(env_id=CHEETAH, steps=8, *, give=None):
    """Return an environment that allows the fast path; `give` replaces its rewards."""
    env = gymnasium.make(env_id, width=48, height=32, max_episode_steps=steps)
    if give is not None:
        env = gymnasium.wrappers.TransformReward(env, lambda r: give(float(r)))
    return env


def trajectories(directory):
    return [mjrec.load_trajectory(path) for path in sorted(directory.glob("*.h5"))]


def monitored(env, directory, schedule=None, **options):
    """Return a monitor of the environment that leaves its videos pending."""
    if not isinstance(env, gymnasium.Env):
        options |= {"env_id": "dm_control/some-task", "height": 32, "width": 48}
    schedule = (lambda _: True) if schedule is None else schedule
    return Monitor(env, directory, schedule, workers=0, **options)


def begin(monitor):
    if isinstance(monitor, gymnasium.Env):
        monitor.reset(seed=0)
        monitor.action_space.seed(0)
    else:
        monitor.reset()


def go(monitor, count, *, fast=True):
    """Take steps, with or without the fast path, and return their results."""
    results = []
    for number in range(1, count + 1):
        if not fast:
            monitor._recorder.fast = None
        if isinstance(monitor, gymnasium.Env):
            action = monitor.action_space.sample()
        else:
            spec = monitor.action_spec()
            action = np.full(spec.shape, np.cos(number))
            action = action.clip(spec.minimum, spec.maximum)
        results.append(monitor.step(action))
    return results


def recorded(env, directory, *, fast, **options):
    with monitored(env, directory, **options) as monitor:
        begin(monitor)
        go(monitor, 8, fast=fast)
    [trajectory] = trajectories(directory)
    return trajectory


def dm_control(domain, task, camera, *marks):
    """Return test parameters for a dm_control task with episodes of eight steps."""

    def new():
        suite = pytest.importorskip("dm_control.suite", reason="no dm_control")
        timestep = 0.02 if domain in ("reacher", "hopper") else 0.01
        task_kwargs = {"random": 0, "time_limit": 8 * timestep}
        return suite.load(domain, task, task_kwargs=task_kwargs)

    marks = [pytest.mark.dm_control, *marks]
    name = f"{domain} {camera!s:.4}"
    return pytest.param(new, camera, None, [*range(9)], id=name, marks=marks)


@pytest.mark.parametrize(
    ("new", "camera", "max_fps", "frames"),
    [
        (lambda: make(HOPPER), None, None, [*range(9)]),
        # A limit of 50 fps at 125 steps per second keeps every third step and the last.
        (lambda: make(HOPPER), None, 50, [0, 3, 6, 8]),
        dm_control("cheetah", "run", None),
        dm_control("cheetah", "run", mujoco.MjvCamera(), pytest.mark.thorough),
        dm_control("reacher", "easy", 0, pytest.mark.thorough),
        dm_control("hopper", "stand", None, pytest.mark.thorough),
    ],
)
def test_fast_and_full_path_record_the_same(new, camera, max_fps, frames, tmp_path):
    view = {"camera": camera, "max_fps": max_fps}
    fast, full = (
        recorded(new(), tmp_path / str(is_fast), fast=is_fast, **view)
        for is_fast in (True, False)
    )
    assert len(fast) == 8
    assert fast.frame_steps.tolist() == frames
    ends = ("terminated", "truncated", "frame_steps")
    for name in ("states", "actions", "rewards", *ends):
        np.testing.assert_array_equal(getattr(fast, name), getattr(full, name))
    np.testing.assert_equal(fast.snapshots, full.snapshots)


def test_action_shape_and_timestep_may_change_between_episodes(tmp_path):
    class Other(gymnasium.Wrapper):
        def reset(self, **options):
            result = self.env.reset(**options)
            self.unwrapped.model.opt.timestep = 0.01 / (monitor.episode_id + 1)
            return result

        def step(self, action):
            return self.env.step(np.resize(action, 6))

    shapes = [(6,), (6,), (2, 3), (6,)]
    with monitored(Other(make(steps=2)), tmp_path) as monitor:
        for shape in shapes:
            monitor.reset(seed=0)
            for value in (0.5, -0.5):
                monitor.step(np.full(shape, value))
    found = trajectories(tmp_path)
    assert [each.actions.shape for each in found] == [(2, *shape) for shape in shapes]
    assert all(each.frame_steps.tolist() == [0, 1, 2] for each in found)
    paces = [each.facts["timestep"] for each in found]
    assert paces == ["1/20", "1/40", "1/60", "1/80"]


@pytest.mark.parametrize("schedule", [None, False], ids=["recorded", "counted"])
@pytest.mark.parametrize(
    "kind",
    [
        int,
        np.float32,
        np.array,
        lambda reward: np.array([reward]),
        # With this function, the type of the reward changes within an episode.
        lambda reward: reward > 0 if reward > 0 else np.float64(reward),
    ],
    ids=["int", "float32", "0-d", "1-d", "mixed"],
)
def test_rewards_of_any_type_become_floats(kind, schedule, tmp_path):
    """Trajectories have each reward, and statistics have their sum, added in order."""
    with monitored(make(give=kind), tmp_path, schedule) as monitor:
        begin(monitor)
        stats, rewards = monitor.stats_recorder, []
        for number in range(1, 9):
            [(_, reward, *_)] = go(monitor, 1)
            rewards.append(float(np.asarray(reward).item()))
            # The statistics are updated after every step and are Python floats.
            assert (stats.steps, stats.total_steps) == (number, number)
            assert (stats.rewards, type(stats.rewards)) == (added_up(rewards), float)
        [total] = monitor.get_episode_rewards()
    assert (total, type(total)) == (added_up(rewards), float)
    recorded = [each.rewards.tolist() for each in trajectories(tmp_path)]
    assert recorded == ([rewards] if schedule is None else [])
    assert stats_of(tmp_path)["episode_rewards"] == [total]


def test_step_with_an_invalid_reward_is_not_recorded(tmp_path):
    """Later steps are recorded, and `step` returns if the monitor is closed in it."""
    rewards = iter([1.0, 1.0, "much", 1.0])

    def give(reward):
        if monitor.get_total_steps() == 3:
            monitor.close()
        return next(rewards, reward)

    env = make(give=give)
    monitor = monitored(env, tmp_path)
    begin(monitor)
    go(monitor, 2)
    with pytest.raises(mjrec.InvalidArgument, match="much"):
        go(monitor, 1)
    go(monitor, 1)
    last = env.unwrapped.data.qpos.copy()
    assert monitor._recorder.fast is not None
    [(observation, *_)] = go(monitor, 1)
    assert observation.shape == (17,)
    [trajectory] = trajectories(tmp_path)
    np.testing.assert_array_equal(trajectory.component("qpos")[-1], last)
    assert trajectory.rewards.tolist() == [1.0] * 3


def test_actions_are_recorded_as_given(tmp_path, caplog):
    """The types of actions may change, and the environment may overwrite an action."""

    class Overwriting(gymnasium.Wrapper):
        def step(self, action):
            result = self.env.step(action)
            if isinstance(action, np.ndarray):
                action[:] = 7
            return result

    usual = [np.full(6, 0.125 * k, np.float32) for k in range(6)]
    other = [
        np.linspace(-1, 1, 6),
        np.array([1, 0, -1, 1, 0, 1]),
        [0.5, -0.25, 0.0, 1.0, -1.0, 0.125],
        (0, 1, 0, -1, 0, 1),
        np.linspace(-1, 1, 6).astype(">f4"),
        np.linspace(-1, 1, 12, dtype=np.float32)[::2],
    ]
    # The first action consists of integers.
    actions = [other[3], *itertools.chain(*zip(usual, other, strict=True))]
    expected = np.array(actions, np.float64)
    with monitored(Overwriting(make(steps=len(actions))), tmp_path) as monitor:
        begin(monitor)
        for action in actions:
            monitor.step(action)
    [trajectory] = trajectories(tmp_path)
    np.testing.assert_array_equal(trajectory.actions, expected)
    assert "different type or shape" not in caplog.text


def interrupt_in(monitor, call_number):
    """Interrupt a step at a given call in mjrec; return whether it was reached."""
    left = call_number

    def profile(frame, event, _):
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


# Takes more than five seconds: it records an episode for each interruption.
@pytest.mark.parametrize(
    ("max_fps", "schedule"),
    [(None, None), (8, None), (None, False)],
    ids=["frames", "few frames", "counted"],
)
def test_interrupted_step_is_recorded_whole_or_not_at_all(max_fps, schedule, tmp_path):
    was_interrupted, number = True, 0
    while was_interrupted:
        number += 1
        directory = tmp_path / str(number)
        with monitored(make(), directory, schedule, max_fps=max_fps) as monitor:
            begin(monitor)
            go(monitor, 4)
            assert monitor._recorder.fast is not None
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
            assert added_up(trajectory.rewards.tolist()) == reward
            assert trajectory.complete
            steps = trajectory.frame_steps.tolist()
            assert steps == sorted({*steps, length})
    assert number > 4


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("moment", ["being filled", "filled"])
def test_kill_while_writing_a_row_loses_only_that_row(moment, tmp_path):
    def record(_):
        rows = itertools.count(1)
        words = fast_path.WORDS

        def take(*arguments):
            words.take(*arguments)
            if next(rows) == 7:
                if moment == "being filled":
                    kill_self()
                fast_path._sum = kill_self

        fast_path.WORDS = types.SimpleNamespace(take=take)
        monitor = monitored(make("InvertedPendulum-v5", 3), tmp_path)
        while True:
            begin(monitor)
            for _ in range(3):
                monitor.step(np.zeros(1))

    _, status = forked(record)
    assert os.WTERMSIG(status) == signal.SIGKILL
    mjrec.recover(tmp_path)
    # The first step does not use the fast path.
    assert [len(each) for each in trajectories(tmp_path)] == [3, 3, 1]
    assert [each.complete for each in trajectories(tmp_path)] == [True, True, False]
