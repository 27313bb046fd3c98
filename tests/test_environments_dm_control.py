# SPDX-License-Identifier: Apache-2.0
"""dm_control's environments by their names."""

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
    """Return a task by its name, without frames unless they are asked for."""
    made = EnvironmentOptions(**{"frames": False, **options})
    return environment_from_name(f"dm_control/{task}", made)


def test_a_task_is_made_with_its_own_limit():
    """All but lqr have one; max_steps lowers it; lqr gets 1000."""
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


def test_the_run_seeds_what_is_drawn_when_a_task_is_made():
    """The springs of lqr are part of its model."""

    def springs(seed, **kwargs):
        env = named("lqr-lqr_2_1", seed=seed, kwargs=kwargs).environment
        return list(env.physics.model.jnt_stiffness)

    assert springs(1) == springs(1) != springs(2)
    assert springs(1, task_kwargs={"random": 2}) == springs(2)


def test_a_monitor_is_told_the_seed(tmp_path):
    """dm_env's reset takes none that it could see."""
    made = named("ball_in_cup-catch")
    with mjrec.Monitor(
        made.environment, tmp_path, video_callable=False, env_id="x"
    ) as monitor:
        made.begin_episode(monitor, episode_seeds(0, 0))
        assert monitor.seed == episode_seeds(0, 0).environment


def test_arguments_reach_the_task_and_the_environment():
    """In suite.load's own form."""
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
def test_what_cannot_be_says_what_can(task, options, words):
    """Names that there are, or the form of the arguments, before any episode."""
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
def test_the_view_follows_the_robot(task, options, view):
    """Or is the model's first camera, or what is asked for; none without frames."""
    made = named(task, **{"frames": True, **options})
    assert (made.env_id, made.view) == (f"dm_control/{task}", view)


def test_without_a_dm_control_that_works_the_line_to_run_is_named(
    tmp_path, monkeypatch
):
    """Whether it is not there, or does not know this mujoco."""
    (tmp_path / "dm_control.py").write_text(
        "raise ModuleNotFoundError('No module', name='dm_control')"
    )
    said = run_python(
        "-c",
        "import mjrec.environments.from_name as f\n"
        "try: f.environment_from_name('dm_control/cheetah-run')\n"
        "except Exception as error: print(type(error).__name__, error)\n",
        PYTHONPATH=str(tmp_path),
    )
    assert said.startswith("MissingDependency dm_control/cheetah-run needs dm_control")
    assert 'pip install "mjrec[dm-control]"' in said

    def load(*_, **__):
        # What dm_control 1.0.50 does with mujoco 4.0.
        raise AttributeError("'MjModel' object has no attribute 'flex_vertedge'")

    monkeypatch.setattr(suite, "load", load)
    with pytest.raises(mjrec.MissingDependency, match=r'pip install "mujoco<4"'):
        named("cheetah-run")


def test_a_recording_says_with_what_its_task_was_made():
    """Also under the limit of ours; of somebody else's environment nobody knows."""
    made = {"seed": 5, "max_steps": 3, "kwargs": {"task_kwargs": {"time_limit": 2}}}
    for env, kwargs in (
        (
            named("cartpole-swingup", **made).environment,
            {"task_kwargs": {"random": 5, "time_limit": 2}},
        ),
        (suite.load("cartpole", "swingup"), None),
    ):
        recorded = dm_control_scenes(env, env_id="dm_control/cartpole-swingup")
        assert recorded.environment["kwargs"] == kwargs


@pytest.mark.parametrize("task", ["lqr-lqr_2_1", "pendulum-swingup"])
def test_a_stream_is_what_the_suites_users_have(task):
    """Seeded once when it is loaded, then reset and reset, as `suite.load` is used."""
    theirs = suite.load(*task.split("-"), task_kwargs={"random": 7})
    made = named(task, seed=7)
    for episode in range(3):
        seeds = episode_seeds(7, episode)
        first = made.begin(made.environment, seeds, None if episode else 7)
        np.testing.assert_equal(dict(first), dict(theirs.reset().observation))


def test_a_stream_of_another_seed_is_begun_anew():
    """What the environment was made with does not matter then, nor what it drew."""
    fresh, used = (named("pendulum-swingup", seed=7) for _ in range(2))
    used.environment.reset()
    seeds = episode_seeds(9, 0)
    one, other = (each.begin(each.environment, seeds, 9) for each in (fresh, used))
    np.testing.assert_equal(dict(one), dict(other))
