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

from mjrec.environments.dm_control_environments import make_dm_control
from mjrec.environments.dm_control_scenes import dm_control_scenes
from mjrec.environments.named_environment import is_terminated, is_truncated


def test_a_task_is_made_with_its_own_limit():
    """All but lqr have one; max_steps lowers it; lqr gets 1000."""

    def limit(name, **options):
        made = EnvironmentOptions(frames=False, **options)
        return environment_from_name(f"dm_control/{name}", made).step_limit

    assert limit("pendulum-swingup") == limit("lqr-lqr_2_1") == 1000
    assert limit("pendulum-swingup", max_steps=5000) == 1000
    assert limit("lqr-lqr_2_1", max_steps=5000) == 5000
    assert limit("pendulum-swingup", max_steps=5) == 5
    limited = make_dm_control(
        "dm_control/ball_in_cup-catch", EnvironmentOptions(max_steps=4)
    )
    limited.reset()
    steps = [limited.step(np.zeros(2)) for _ in range(4)]
    assert [step.last() for step in steps] == [False, False, False, True]
    assert is_truncated(steps[-1])
    assert not is_terminated(steps[-1])
    assert steps[-1].reward is not None
    assert limited.step(np.zeros(2)).first()


def test_the_run_seeds_what_is_drawn_when_a_task_is_made():
    """The springs of lqr are part of its model."""

    def springs(seed, **kwargs):
        options = EnvironmentOptions(seed=seed, kwargs=kwargs)
        env = make_dm_control("dm_control/lqr-lqr_2_1", options)
        return list(env.physics.model.jnt_stiffness)

    assert springs(1) == springs(1) != springs(2)
    assert springs(1, task_kwargs={"random": 2}) == springs(2)


def test_a_monitor_is_told_the_seed(tmp_path):
    """dm_env's reset takes none that it could see."""
    named = environment_from_name("dm_control/ball_in_cup-catch")
    env = named.environment
    with mjrec.Monitor(env, tmp_path, video_callable=False, env_id="x") as monitor:
        named.begin_episode(monitor, episode_seeds(0, 0))
        assert monitor.seed == episode_seeds(0, 0).environment


def test_arguments_reach_the_task_and_the_environment():
    """In suite.load's own form; another is an error that shows it."""
    kwargs = {
        "task_kwargs": {"time_limit": 1},
        "environment_kwargs": {"flat_observation": True},
        "visualize_reward": True,
    }
    env = make_dm_control("dm_control/cheetah-run", EnvironmentOptions(kwargs=kwargs))
    assert list(env.reset().observation) == ["observations"]
    assert env.task.visualize_reward
    with pytest.raises(mjrec.UnknownName, match=r"'time_limit'.*task_kwargs"):
        make_dm_control(
            "dm_control/cheetah-run", EnvironmentOptions(kwargs={"time_limit": 1})
        )
    with pytest.raises(mjrec.EnvironmentNotMade, match=r"cheetah-run.*'q'") as e:
        make_dm_control(
            "dm_control/cheetah-run",
            EnvironmentOptions(kwargs={"task_kwargs": {"q": 1}}),
        )
    assert isinstance(e.value.__cause__, TypeError)


def test_unknown_names_list_those_there_are():
    """Domains first, then the domain's tasks."""
    with pytest.raises(mjrec.UnknownName, match=r"domain 'cheeta'.*cheetah.*walker"):
        environment_from_name("dm_control/cheeta-run")
    with pytest.raises(mjrec.UnknownName, match=r"'sit'.*stand, walk, run"):
        environment_from_name("dm_control/humanoid-sit")


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("dm_control/cheetah-run", "side"),
        ("dm_control/ball_in_cup-catch", "cam0"),
        ("dm_control/swimmer-swimmer6", "tracking1"),
    ],
)
def test_the_view_follows_the_robot(name, camera):
    """Or is the model's first camera; the monitor is given it, and the size."""
    named = environment_from_name(name, EnvironmentOptions(height=48, width=64))
    assert named.env_id == name
    assert named.view == {"camera": camera, "height": 48, "width": 64}


def test_a_camera_that_is_asked_for_is_checked():
    """Before any episode begins; without frames there is no view."""
    named = environment_from_name(
        "dm_control/cheetah-run", EnvironmentOptions(camera="back")
    )
    assert named.view == {"camera": "back"}
    with pytest.raises(mjrec.UnknownName, match=r"'nose'.*side, back"):
        environment_from_name(
            "dm_control/cheetah-run", EnvironmentOptions(camera="nose")
        )
    named = environment_from_name(
        "dm_control/cheetah-run", EnvironmentOptions(frames=False)
    )
    assert named.view == {}


FLEX = "'MjModel' object has no attribute 'flex_vertedge'"


@pytest.mark.parametrize(
    ("suite", "fix", "cause"),
    [
        (
            "raise ModuleNotFoundError('No module', name='dm_control')",
            *('pip install "mjrec[dm-control]"', "needs dm_control"),
        ),
        # What dm_control 1.0.50 does with mujoco 4.0.
        (f'raise AttributeError("{FLEX}")', 'pip install "mujoco<4"', FLEX),
    ],
)
def test_without_a_dm_control_that_works_the_line_to_run_is_named(
    tmp_path, suite, fix, cause
):
    """Whether it is not there, or does not know this mujoco."""
    (tmp_path / "dm_control").mkdir()
    (tmp_path / "dm_control" / "__init__.py").touch()
    (tmp_path / "dm_control" / "suite.py").write_text(suite)
    said = run_python(
        "-c",
        "import mjrec.environments.from_name as f\n"
        "try: f.environment_from_name('dm_control/cheetah-run')\n"
        "except Exception as error: print(type(error).__name__, error)\n",
        PYTHONPATH=str(tmp_path),
    )
    assert said.startswith("MissingDependency dm_control/cheetah-run")
    assert fix in said
    assert cause in said


def test_a_mujoco_that_a_task_does_not_know_names_the_fix(monkeypatch):
    """Though the package can be imported."""

    def load(*_, **__):
        raise AttributeError(FLEX)

    monkeypatch.setattr(suite, "load", load)
    with pytest.raises(mjrec.MissingDependency, match=r'pip install "mujoco<4"'):
        environment_from_name("dm_control/cheetah-run")


def test_a_recording_says_with_what_its_task_was_made():
    """Also under the limit of ours; of somebody else's environment nobody knows."""
    options = EnvironmentOptions(
        seed=5, max_steps=3, kwargs={"task_kwargs": {"time_limit": 2}}
    )
    env = make_dm_control("dm_control/cartpole-swingup", options)
    recorded = dm_control_scenes(env, env_id="dm_control/cartpole-swingup")
    assert recorded.environment["kwargs"] == {
        "task_kwargs": {"random": 5, "time_limit": 2}
    }
    other = suite.load("cartpole", "swingup")
    recorded = dm_control_scenes(other, env_id="dm_control/cartpole-swingup")
    assert recorded.environment["kwargs"] is None


@pytest.mark.parametrize("task", ["lqr-lqr_2_1", "pendulum-swingup"])
def test_a_stream_is_what_the_suites_users_have(task):
    """Seeded once when it is loaded, then reset and reset, as `suite.load` is used."""
    domain, _, name = task.partition("-")
    theirs = suite.load(domain, name, task_kwargs={"random": 7})
    options = EnvironmentOptions(seed=7, frames=False)
    named = environment_from_name(f"dm_control/{task}", options)
    ours = named.environment
    for episode in range(3):
        seeds = episode_seeds(7, episode)
        first = named.begin(ours, seeds, None if episode else 7)
        expected = theirs.reset().observation
        assert {k: v.tolist() for k, v in first.items()} == {
            k: v.tolist() for k, v in expected.items()
        }


def test_a_stream_of_another_seed_is_begun_anew():
    """What the environment was made with does not matter then, nor what it drew."""
    options = EnvironmentOptions(seed=7, frames=False)
    name = "dm_control/pendulum-swingup"
    fresh, used = (environment_from_name(name, options) for _ in range(2))
    used.environment.reset()
    seeds = episode_seeds(9, 0)
    one = fresh.begin(fresh.environment, seeds, 9)
    other = used.begin(used.environment, seeds, 9)
    assert one["orientation"].tolist() == other["orientation"].tolist()
