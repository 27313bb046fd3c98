# SPDX-License-Identifier: Apache-2.0
"""Test dm_control environments made from names."""

import numpy as np
import pytest
from engine_runs import run_python

import mjrec
from mjrec.environments.episode_seeds import episode_seeds
from mjrec.environments.from_name import environment_from_name
from mjrec.environments.named_environment import EnvironmentOptions

pytest.importorskip("dm_control")

from dm_control import suite

from mjrec.environments.dm_control_scenes import dm_control_scenes
from mjrec.environments.named_environment import is_terminated, is_truncated


def named(task, **options):
    """Return the task with this name, by default without frames."""
    made = EnvironmentOptions(**{"frames": False, **options})
    return environment_from_name(f"dm_control/{task}", made)


def test_step_limit_is_smallest_or_1000():
    """Every task except lqr has a step limit of its own."""
    assert named("pendulum-swingup", max_steps=5000).step_limit == 1000
    assert named("pendulum-swingup", max_steps=5).step_limit == 5
    assert named("lqr-lqr_2_1").step_limit == 1000
    assert named("lqr-lqr_2_1", max_steps=5000).step_limit == 5000
    limited = named("ball_in_cup-catch", max_steps=4).environment
    limited.reset()
    steps = [limited.step(np.zeros(2)) for _ in range(4)]
    assert [step.last() for step in steps] == [False, False, False, True]
    assert is_truncated(steps[-1])
    assert not is_terminated(steps[-1])
    assert steps[-1].reward is not None


def test_seed_determines_random_parts_of_models():
    """The lqr task draws random springs when it is created."""

    def springs(seed, **kwargs):
        env = named("lqr-lqr_2_1", seed=seed, kwargs=kwargs).environment
        return list(env.physics.model.jnt_stiffness)

    assert springs(1) == springs(1) != springs(2)
    assert springs(1, task_kwargs={"random": 2}) == springs(2)


def test_monitor_knows_the_seed(tmp_path):
    """dm_env's `reset` takes no seed, so the monitor must get it in another way."""
    made = named("ball_in_cup-catch")
    with mjrec.Monitor(made.environment, tmp_path, False, env_id="x") as monitor:
        made.begin_episode(monitor, episode_seeds(0, 0))
        assert monitor.seed == episode_seeds(0, 0).environment


def test_arguments_reach_suite_load():
    kwargs = {
        "task_kwargs": {"time_limit": 1},
        "environment_kwargs": {"flat_observation": True},
        "visualize_reward": True,
    }
    env = named("cheetah-run", kwargs=kwargs).environment
    assert list(env.reset().observation) == ["observations"]
    assert env.task.visualize_reward


@pytest.mark.parametrize(
    ("task", "options", "words"),
    [
        ("cheeta-run", {}, "domain 'cheeta'.*cheetah.*walker"),
        ("humanoid-sit", {}, "'sit'.*stand, walk, run"),
        ("cheetah-run", {"camera": "nose", "frames": True}, "'nose'.*side, back"),
        ("cheetah-run", {"kwargs": {"time_limit": 1}}, "'time_limit'.*task_kwargs"),
        ("cheetah-run", {"kwargs": {"task_kwargs": {"q": 1}}}, "cheetah-run.*'q'"),
    ],
)
def test_invalid_requests_name_the_valid_ones(task, options, words):
    kind = mjrec.EnvironmentNotMade if "'q'" in words else mjrec.UnknownName
    with pytest.raises(kind, match=words):
        named(task, **options)


@pytest.mark.parametrize(
    ("task", "options", "view"),
    [
        ("cheetah-run", {"height": 48}, {"camera": "side", "height": 48}),
        ("ball_in_cup-catch", {}, {"camera": "cam0"}),
        ("swimmer-swimmer6", {}, {"camera": "tracking1"}),
        ("cheetah-run", {"camera": "back"}, {"camera": "back"}),
        ("cheetah-run", {"frames": False}, {}),
    ],
)
def test_default_camera_follows_the_robot_or_is_the_first(task, options, view):
    made = named(task, **{"frames": True, **options})
    assert (made.env_id, made.view) == (f"dm_control/{task}", view)


def test_unusable_dm_control_is_an_error_with_the_fix(tmp_path, monkeypatch):
    (tmp_path / "dm_control.py").write_text(
        "raise ModuleNotFoundError('No module', name='dm_control')"
    )
    text = run_python(
        "-c",
        "import mjrec.environments.from_name as f\n"
        "try: f.environment_from_name('dm_control/cheetah-run')\n"
        "except Exception as error: print(type(error).__name__, error)\n",
        PYTHONPATH=str(tmp_path),
    )
    assert text.startswith("MissingDependency dm_control/cheetah-run needs dm_control")
    assert 'pip install "mjrec[dm-control]"' in text

    def load(*_, **__):
        # dm_control 1.0.50 raises this error with mujoco 4.0.
        raise AttributeError("'MjModel' object has no attribute 'flex_vertedge'")

    monkeypatch.setattr(suite, "load", load)
    with pytest.raises(mjrec.MissingDependency, match=r'pip install "mujoco<4"'):
        named("cheetah-run")


def test_recorded_arguments_are_those_of_named_tasks():
    """The arguments of a user's own environment are unknown."""
    made = {"seed": 5, "max_steps": 3, "kwargs": {"task_kwargs": {"time_limit": 2}}}
    ours = named("cartpole-swingup", **made).environment
    known = {"task_kwargs": {"random": 5, "time_limit": 2}}
    for env, kwargs in ((ours, known), (suite.load("cartpole", "swingup"), None)):
        recorded = dm_control_scenes(env, env_id="dm_control/cartpole-swingup")
        assert recorded.environment["kwargs"] == kwargs


@pytest.mark.parametrize("task", ["lqr-lqr_2_1", "pendulum-swingup"])
def test_begin_seeds_once_as_users_of_the_suite_do(task):
    """Users of the suite pass the seed to `suite.load` and never to `reset`."""
    theirs = suite.load(*task.split("-"), task_kwargs={"random": 7})
    made = named(task, seed=7)
    for episode in range(3):
        seeds = episode_seeds(7, episode)
        first = made.begin(made.environment, seeds, None if episode else 7)
        np.testing.assert_equal(dict(first), dict(theirs.reset().observation))


def test_new_seed_overrides_earlier_state():
    """A new seed overrides the environment's own seed and earlier episodes."""
    fresh, used = (named("pendulum-swingup", seed=7) for _ in range(2))
    used.environment.reset()
    seeds = episode_seeds(9, 0)
    one, other = (each.begin(each.environment, seeds, 9) for each in (fresh, used))
    np.testing.assert_equal(dict(one), dict(other))
