# SPDX-License-Identifier: Apache-2.0
"""An episode run again in its environment: what is noticed, and how far it goes."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from forged_episodes import (
    episode,
    fact,
    failed,
    forge,
    physics_of,
    record_gymnasium,
    unchecked,
    verdicts,
)
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from mujoco import rollout
from parts import parametrize

import mjrec
from mjrec.environments.made_again import make_again, recorded_environment
from mjrec.evidence.verification import Verdict
from mjrec.evidence.verifying.environment_replay import action_kinds
from mjrec.evidence.verifying.step_checks import follow_steps
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.simulation.replay import StateSteps

TELEPORTING, NAMED, OBLIVIOUS = "Teleporting-v0", "Named-v0", "Oblivious-v0"


class Teleporting(InvertedPendulumEnv):
    """Puts its cart somewhere else after every third step."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        result = super().step(action)
        if round(self.data.time / self.dt) % 3 == 0:
            self.data.qpos[0] = 0.25
        return result


class Named(InvertedPendulumEnv):
    """Takes actions by name."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.action_space = gymnasium.spaces.Dict(
            {"push": gymnasium.spaces.Box(-1, 1, (1,), np.float32)}
        )

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return super().step(action["push"])


class Oblivious(InvertedPendulumEnv):
    """Draws its reward from a generator that nobody has seeded."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, *rest = super().step(action)
        return observation, float(np.random.default_rng().uniform()), *rest


@pytest.fixture(autouse=True)
def registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register environments of a user for a while."""
    known = {**gymnasium.registry}
    monkeypatch.setattr(gymnasium.envs.registration, "registry", known)
    kinds = {TELEPORTING: Teleporting, NAMED: Named, OBLIVIOUS: Oblivious}
    for env_id, kind in kinds.items():
        gymnasium.register(env_id, entry_point=kind, max_episode_steps=10)


def recorded(tmp_path: Path, env_id: str) -> Path:
    """Record an episode of one of these environments."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = gymnasium.make(env_id, disable_env_checker=True)
        if env_id != NAMED:
            return record_gymnasium(tmp_path / "run", env, episodes=1, size=0.02)
        monitor: Any = mjrec.Monitor(
            env, tmp_path / "run", False, trajectory_callable=lambda _: True
        )
        monitor.reset(seed=1)
        for number in range(4):
            monitor.step({"push": np.array([0.01 * number])})
        monitor.close()
    return tmp_path / "run"


def test_an_environment_that_is_not_trusted_is_not_made(tmp_path: Path) -> None:
    """The reason names the way out; what does not follow by MuJoCo alone fails."""
    checks = physics_of(recorded(tmp_path, TELEPORTING))
    assert failed(checks) == ["steps"]
    reason = unchecked(checks)[-1].reason
    assert reason.startswith("would run code from the archive")
    assert f"--trust {TELEPORTING}" in reason


def test_a_trusted_environment_shows_what_it_does_besides(tmp_path: Path) -> None:
    """Where the environment gives those very states, MuJoCo alone is not asked."""
    directory = recorded(tmp_path, TELEPORTING)
    checks = physics_of(directory, trust=frozenset([TELEPORTING]))
    assert verdicts(checks) == {"pass": 8, "not checkable": 1}
    assert "does more than mj_step" in checks[1].reason


def test_a_forged_state_of_such_an_environment_fails(tmp_path: Path) -> None:
    """What the environment does not give is a failure of its steps too."""
    directory = recorded(tmp_path, TELEPORTING)

    def move(states: Any) -> None:
        states[4, 1] += 0.5

    forge(episode(directory), states=move)
    checks = physics_of(directory, trust=frozenset([TELEPORTING]))
    assert [c for c in failed(checks) if c != "pictures"] == ["steps", "states"]


def test_actions_with_names_are_put_together_again(tmp_path: Path) -> None:
    """A dictionary that was recorded as one vector is a dictionary again."""
    directory = recorded(tmp_path, NAMED)
    checks = physics_of(directory, trust=frozenset([NAMED]))
    assert failed(checks) == []
    assert verdicts(checks)["pass"] == 8


@parametrize("parts", ["push", [["push"]], [["push", [7]]], [[1, [1]]]])
def test_parts_that_do_not_fit_are_no_error(parts: Any, tmp_path: Path) -> None:
    """What a file says of its actions' parts is looked at."""
    directory = recorded(tmp_path, NAMED)
    forge(episode(directory), facts={"action_parts": parts})
    checks = physics_of(directory, trust=frozenset([NAMED]))
    assert "its actions' parts cannot be" in unchecked(checks)[-1].reason


def test_a_reward_that_nobody_can_repeat_fails(tmp_path: Path) -> None:
    """A reward that does not follow from the recording is no evidence."""
    directory = recorded(tmp_path, OBLIVIOUS)
    checks = physics_of(directory, trust=frozenset([OBLIVIOUS]))
    assert failed(checks) == ["rewards"]


def test_wrappers_that_are_not_known_are_a_doubt(tmp_path: Path) -> None:
    """An older recording may have had wrappers: a difference accuses nobody."""
    env = gymnasium.make("InvertedPendulum-v5")
    directory = record_gymnasium(tmp_path / "run", env, episodes=1, size=0.02)
    said = dict(fact(episode(directory), "environment"))
    del said["wrappers"]

    def double(rewards: Any) -> None:
        rewards *= 2

    forge(episode(directory), rewards=double, facts={"environment": said})
    checks = physics_of(directory)
    assert failed(checks) == []
    [check] = [c for c in checks if c.verdict is Verdict.NOT_CHECKABLE]
    assert "does not say which wrappers" in check.reason
    assert "after step 1 the reward is recorded as 2.0" in check.reason


def test_wrappers_that_are_known_are_named(tmp_path: Path) -> None:
    """The steps are checked, and the environment is not made."""
    env = gymnasium.wrappers.ClipAction(gymnasium.make("InvertedPendulum-v5"))
    directory = record_gymnasium(tmp_path / "run", env, episodes=1, size=0.02)
    checks = physics_of(directory)
    assert verdicts(checks) == {"pass": 4, "not checkable": 1}
    assert "ClipAction" in unchecked(checks)[0].reason
    assert "put Monitor around the environment itself" in unchecked(checks)[0].reason


def test_actions_that_the_environment_refuses_are_a_failure(tmp_path: Path) -> None:
    """What an environment raises is said, and ends the episode, not the check."""
    env = gymnasium.make("InvertedPendulum-v5")
    directory = record_gymnasium(tmp_path / "run", env, episodes=1, size=0.02)
    with open_trajectory(episode(directory)) as reader:
        count = reader.step_count
    two = np.zeros((count, 2))
    forge(episode(directory), actions=two, action=np.dtype(("<f8", (2,))))
    checks = physics_of(directory)
    assert "ends" in failed(checks)
    assert any("step 1 cannot be made: ValueError" in c.reason for c in checks)


@pytest.mark.parametrize(("kind", "count"), [(np.float32, 2), (np.float64, 1)])
def test_the_width_of_actions_is_found_out(
    kind: type, count: int, tmp_path: Path
) -> None:
    """Numbers that fit into 32 bits may have been such, and others not."""
    env = gymnasium.make("InvertedPendulum-v5")
    directory = record_gymnasium(
        tmp_path / "run", env, episodes=1, size=0.02, kind=kind
    )
    with open_trajectory(episode(directory)) as reader:
        kinds = action_kinds(reader)
    assert len(kinds) == count
    assert kinds[0] == kind


def test_steps_made_again_one_by_one_are_those_of_a_rollout(tmp_path: Path) -> None:
    """MuJoCo's own rollout, from all states at once, gives the same bits."""
    env = gymnasium.make("Hopper-v5")
    directory = record_gymnasium(tmp_path / "run", env, episodes=1, steps=8)
    with open_trajectory(episode(directory)) as reader:
        made = make_again(recorded_environment(reader.facts))
        model, _ = made.simulation()
        followed = follow_steps(reader, model, is_exact=True)
        rows = reader.states(0, reader.row_count)
        columns = {name: rows[:, where] for name, where in reader.columns.items()}
    controls = np.repeat(columns["ctrl"][1:, np.newaxis], followed.substeps, axis=1)
    starts = np.hstack([columns[name][:-1] for name in ("time", "qpos", "qvel")])
    found, _ = rollout.rollout(
        model,
        mujoco.MjData(model),
        starts,
        controls,
        initial_warmstart=np.ascontiguousarray(columns["warmstart"][:-1]),
    )
    made.close()
    ends = np.hstack([columns[name][1:] for name in ("time", "qpos", "qvel")])
    assert followed.differences.first is None
    assert found[:, -1].tobytes() == ends.tobytes()


def test_errors_do_not_add_up_on_another_machine(tmp_path: Path) -> None:
    """What differs more and more when it runs freely is compared step by step."""
    env = gymnasium.make("HalfCheetah-v5")
    directory = record_gymnasium(tmp_path / "run", env, episodes=1, steps=40)
    with open_trajectory(episode(directory)) as reader:
        made = make_again(recorded_environment(reader.facts))
        steps = StateSteps(made.simulation()[0], reader.columns)
        rows = reader.states(0, reader.row_count)
    made.close()
    other = rows.copy()
    # As from a computer whose sines are others, once.
    other[2, 1:19] += 1e-10
    for number in range(3, len(rows)):
        pair = np.stack([other[number - 1], rows[number]])
        other[number] = steps.follow(pair, [5])[0]
    assert np.abs(other - rows)[:, 1:19].max() > 1e-8
    forge(episode(directory), states=other, facts={"machine": {}})
    checks = physics_of(directory)
    assert {"steps", "states"}.isdisjoint(failed(checks))
    states = next(c for c in checks if c.claim.startswith("the recorded actions"))
    assert "from step 2 on each step begins at the recorded state" in states.reason
