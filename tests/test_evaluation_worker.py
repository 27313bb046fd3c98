# SPDX-License-Identifier: Apache-2.0
"""What a worker of an evaluation does with its jobs."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.envs.registration import registry
from recordings import in_flight, videos_in

import mjrec
from conftest import Corridor
from evaluated import FOLDER, PENDULUM, facts_of, plan_of, run_job, states_of, worker_of
from mjrec.environments.episode_seeds import episode_seeds
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.ledger import read_ledgers
from mjrec.evaluation.plan import EvaluationPlan
from mjrec.messages import unpacked
from mjrec.recorder.options import RecorderOptions
from mjrec.sessions import Session, record_session
from mjrec.signals import Terminated

ID = "MjrecEvaluated-v0"


@pytest.fixture
def register() -> Iterator[Callable[..., str]]:
    """Register an environment's class, and forget it afterwards."""

    def register_class(entry_point: Any) -> str:
        gymnasium.register(ID, entry_point=entry_point, disable_env_checker=True)
        return ID

    yield register_class
    registry.pop(ID, None)


def run_all(
    directory: Path, plan: EvaluationPlan, policy: Any = None
) -> dict[tuple[int, int], EpisodeResult]:
    """Run all batches of a plan, one for each seed, and return the results."""
    payload = None if policy is None else cloudpickle.dumps(policy)
    if policy is not None:
        plan = dataclasses.replace(plan, policy="mine", is_object=True)
    worker = worker_of(directory, plan, payload)
    for seed in plan.seeds:
        worker(run_job(plan, seed))
    return read_ledgers(directory / FOLDER)


def outcome(result: EpisodeResult) -> tuple[Any, ...]:
    """Return what does not depend on where and when an episode ran."""
    return (result.total_reward, result.length, result.terminated, result.failure)


def test_a_task_is_checked_without_a_step(tmp_path: Path) -> None:
    """What it is, and whether its pictures can wait; nothing is written."""
    worker = worker_of(tmp_path, plan_of())
    assert worker({"kind": "check", "task": PENDULUM}) == {
        "env_id": PENDULUM,
        "step_limit": 8,
        "deferrable": True,
        "reason": None,
        "velocities": 2,
    }
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("task", "policy", "words"),
    [
        ("InvertedPendulm-v5", "zero", "InvertedPendulm"),
        (PENDULUM, "no_such_module:policy", "no_such_module"),
    ],
)
def test_what_is_not_there_is_told_by_the_check(
    tmp_path: Path, task: str, policy: str, words: str
) -> None:
    """As an error of ours that can be raised elsewhere."""
    worker = worker_of(tmp_path, plan_of(policy=policy))
    error = unpacked(worker({"kind": "check", "task": task})["error"])
    assert isinstance(error, mjrec.UnknownName)
    assert words in str(error)


# The second draws its springs when it is made.
@pytest.mark.parametrize("task", [PENDULUM, "dm_control/lqr-lqr_2_1"])
def test_a_unit_is_the_episode_that_a_session_records(
    tmp_path: Path, task: str
) -> None:
    """Bit for bit, whichever batch it is in, and whatever ran before it."""
    if task.startswith("dm_control/"):
        pytest.importorskip("dm_control")
    recorded = tmp_path / "session"
    session = Session(
        environment=task,
        directory=recorded,
        seed=4,
        episodes=3,
        schedule="all",
        made=EnvironmentOptions(max_steps=8, height=32, width=32),
        monitor=RecorderOptions(workers=0),
    )
    with closing(record_session(session)) as episodes:
        expected = list(episodes)
    plan = plan_of(task, seeds=(4,))
    worker = worker_of(tmp_path, plan)
    for batch in ((2,), (1, 0)):
        assert worker(run_job(plan, 4, *batch))["episodes"] == len(batch)
    results = read_ledgers(tmp_path / FOLDER)
    for episode in range(3):
        result = results[4, episode]
        found = states_of(tmp_path / FOLDER, result.monitor, result.episode_id)
        assert np.array_equal(found, states_of(recorded, "*", episode))
        assert result.total_reward == expected[episode].reward
        assert result.length == expected[episode].length


def test_what_is_done_is_not_repeated(tmp_path: Path, names: Any) -> None:
    """A job that is begun again does the rest, and nothing where all is done."""
    plan = plan_of(seeds=(0,))
    worker = worker_of(tmp_path, plan)
    worker(run_job(plan, 0, 1))
    first = read_ledgers(tmp_path / FOLDER)[0, 1]
    assert worker(run_job(plan, 0, again=True))["episodes"] == 2
    before = names(tmp_path / FOLDER)
    assert worker(run_job(plan, 0, again=True))["episodes"] == 0
    assert names(tmp_path / FOLDER) == before
    assert read_ledgers(tmp_path / FOLDER)[0, 1] == first


def test_by_the_suites_protocol_there_is_one_random_stream(tmp_path: Path) -> None:
    """Seeded with the run's seed itself, then reset and reset; actions as ever."""
    plan = plan_of(seeds=(5,), protocol="suite")
    results = run_all(tmp_path, plan)
    env = gymnasium.make(PENDULUM)
    for episode in range(3):
        observation, _ = env.reset(seed=None if episode else 5)
        result = results[5, episode]
        state = states_of(tmp_path / FOLDER, result.monitor, result.episode_id)[0]
        # Behind the time.
        assert state[1:5].tolist() == observation.tolist()
    env.close()


def test_a_random_stream_that_was_cut_is_begun_again(tmp_path: Path) -> None:
    """Its episodes go on from each other: what there was of it does not count."""
    plan = plan_of(seeds=(0,), protocol="suite")
    whole = run_all(tmp_path, plan)
    [ledger] = (tmp_path / FOLDER).glob("mjrec.evaluation.*")
    *lines, _, _ = ledger.read_text().splitlines(keepends=True)
    ledger.write_text("".join(lines))
    assert read_ledgers(tmp_path / FOLDER) == {}
    again = run_all(tmp_path, plan)
    assert {r.monitor for r in again.values()} != {r.monitor for r in whole.values()}
    assert [*map(outcome, again.values())] == [*map(outcome, whole.values())]


def _first_state(directory: Path, result: EpisodeResult) -> bytes:
    states = states_of(directory / FOLDER, result.monitor, result.episode_id)
    return bytes(states[0].tobytes())


class Stumbling:
    """Pushes gently; raises, or gives nonsense, in the third step of an episode."""

    def __init__(self, wrong: Callable[[], Any], starts: int) -> None:
        self.wrong = wrong
        self.seeds: list[int] = []
        self.wrong_seed = episode_seeds(0, starts).policy

    def reset(self, seed: int) -> None:
        """Begin an episode."""
        self.seeds = [seed]

    def __call__(self, observation: Any) -> Any:
        self.seeds.append(0)
        if len(self.seeds) == 4 and self.seeds[0] == self.wrong_seed:
            return self.wrong()
        return np.zeros(1, np.float32)


def _raise() -> None:
    raise ValueError("two\nlines")


def _leave() -> None:
    raise SystemExit(3)


@pytest.mark.parametrize(
    ("wrong", "failure"),
    [
        (_raise, "raised ValueError: two lines ("),
        (lambda: np.full(1, np.nan, np.float32), "nan"),
        (lambda: np.zeros(2, np.float32), "array([0., 0.]"),
        (_leave, "SystemExit: 3"),
    ],
)
@pytest.mark.parametrize("protocol", ["seeded", "suite"])
def test_a_policy_that_fails_loses_its_episode_only(
    tmp_path: Path, wrong: Any, failure: str, protocol: Any
) -> None:
    """Its reason is one line; its trajectory says that it is not complete."""
    plan = plan_of(seeds=(0,), protocol=protocol)
    results = run_all(tmp_path, plan, Stumbling(wrong, 1))
    failed = results[0, 1]
    assert failed.failure is not None
    assert failure in failed.failure
    assert "\n" not in failed.failure
    assert (failed.total_reward, failed.terminated, failed.length) == (None, None, 2)
    assert [results[0, n].failure for n in (0, 2)] == [None, None]
    # What comes after it is not the beginning once more.
    begun = [_first_state(tmp_path, results[0, n]) for n in range(3)]
    assert len(set(begun)) == 3
    ending = f".{failed.monitor}.episode{failed.episode_id:06d}.h5"
    folder = tmp_path / FOLDER
    [trajectory] = [p for p in in_flight(folder) if p.name.endswith(ending)]
    facts = facts_of(trajectory)
    assert (facts["complete"], facts["length"]) == (False, 2)
    assert worker_of(tmp_path, plan)(run_job(plan, 0, again=True))["episodes"] == 0


def test_an_object_is_a_policy_in_each_of_its_forms(tmp_path: Path) -> None:
    """A class is built with the environment that it is to act in."""

    class Still:
        def __init__(self, environment: Any) -> None:
            self.shape = environment.action_space.shape

        def predict(self, observation: Any) -> Any:
            return np.zeros(self.shape, np.float32), None

    plan = plan_of(seeds=(0,))
    by_name = run_all(tmp_path / "zero", dataclasses.replace(plan, policy="zero"))
    by_class = run_all(tmp_path / "class", plan, Still)
    assert [*map(outcome, by_class.values())] == [*map(outcome, by_name.values())]


def test_a_signal_is_no_failure(tmp_path: Path) -> None:
    """The trajectory stays, incomplete; nothing is noted; the episode runs again."""

    def told_to_end() -> None:
        raise Terminated(signal.SIGTERM)

    plan = plan_of(seeds=(0,))
    with pytest.raises(Terminated):
        run_all(tmp_path, plan, Stumbling(told_to_end, 1))
    assert [*read_ledgers(tmp_path / FOLDER)] == [(0, 0)]
    logs = in_flight(tmp_path / FOLDER)
    assert [facts_of(log)["complete"] for log in logs] == [True, False]
    assert worker_of(tmp_path, plan)(run_job(plan, 0, again=True))["episodes"] == 2


class Unsteady(Corridor):
    """Raises in the reset of its second episode."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        if seed == episode_seeds(0, 1).environment:
            raise OSError("no such corridor")
        return super().reset(seed=seed, options=options)


def test_a_reset_that_raises_fails_its_episode(tmp_path: Path, register: Any) -> None:
    """There is no recording of it then; those around it have theirs."""
    results = run_all(tmp_path, plan_of(register(Unsteady), seeds=(0,), keep="none"))
    failed = results[0, 1]
    assert failed.failure == "OSError: no such corridor"
    assert (failed.monitor, failed.episode_id, failed.length) == (None, None, 0)
    assert [results[0, n].total_reward for n in (0, 2)] == [1.5, 1.5]


def test_an_environment_that_cannot_be_made_any_more_fails_its_episodes(
    tmp_path: Path, register: Any
) -> None:
    """All of the batch: what was fine in the check broke later."""

    def make(**arguments: Any) -> Any:
        raise OSError("the arm is switched off")

    plan = plan_of(register(make), seeds=(0,), keep="none")
    results = run_all(tmp_path, plan)
    assert len(results) == 3
    assert all("switched off" in str(r.failure) for r in results.values())
    assert {r.monitor for r in results.values()} == {None}
    assert worker_of(tmp_path, plan)(run_job(plan, 0, again=True))["episodes"] == 0


def test_without_videos_trajectories_are_final_at_once(tmp_path: Path) -> None:
    """Also of an episode that failed; and there is nothing left to settle."""
    plan = plan_of(seeds=(0,), keep="none")
    run_all(tmp_path, plan, Stumbling(_raise, 2))
    folder = tmp_path / FOLDER
    assert len(list(folder.glob("*.h5"))) == 3
    assert not in_flight(folder)
    left = worker_of(tmp_path, plan)({"kind": "recover", "folder": FOLDER})
    assert left == {"monitors": []}


def test_what_is_drawn_live_is_chosen_beforehand(tmp_path: Path, register: Any) -> None:
    """By the number over all seeds, where the rule needs no returns."""
    plan = plan_of(register(Corridor), keep="cubic", height=None, width=None)
    worker = worker_of(tmp_path, plan)
    checked = worker({"kind": "check", "task": ID})
    assert not checked["deferrable"]
    assert checked["reason"]
    results = run_all(tmp_path, plan)
    chosen = {results[unit].episode_id for unit in ((0, 0), (0, 1))}
    assert set(videos_in(tmp_path / FOLDER)) == chosen


def test_what_is_drawn_live_cannot_wait_for_returns(
    tmp_path: Path, register: Any
) -> None:
    """It is said, with the rules that can be, and no episode is called a failure."""
    plan = plan_of(register(Corridor), keep="best", height=None, width=None)
    with pytest.raises(mjrec.InvalidArgument, match="'all', 'cubic' or 'none'"):
        run_all(tmp_path, plan)
    assert read_ledgers(tmp_path / FOLDER) == {}


class Exploding(InvertedPendulumEnv):
    """Becomes unstable in its second step; has warned before each episode."""

    def reset(self, **options: Any) -> Any:
        begun = super().reset(**options)
        self.data.warning[mujoco.mjtWarning.mjWARN_INERTIA].number = 5
        return begun

    def step(self, action: Any) -> Any:
        self.steps = getattr(self, "steps", 0) + 1
        if self.steps == 2:
            self.data.qpos[0] = np.inf
        return super().step(action)


def test_warnings_of_mujoco_are_counted(tmp_path: Path, register: Any) -> None:
    """In the episode in which they came, by their names."""
    plan = plan_of(register(Exploding), seeds=(0,), keep="none", policy="zero")
    results = run_all(tmp_path, plan)
    counts = [dict(results[0, n].warnings) for n in range(3)]
    assert counts == [{"BADQPOS": 1}, {}, {}]


def test_what_cannot_be_recorded_is_no_episodes_failure(tmp_path: Path) -> None:
    """It ends the job, and is done again with the next."""
    plan = plan_of(seeds=(0,))
    (tmp_path / FOLDER).write_text("in the way")
    with pytest.raises(mjrec.DirectoryNotWritable):
        run_all(tmp_path, plan)


def test_an_episode_of_the_suite_knows_no_seed_but_the_streams(tmp_path: Path) -> None:
    """A task of the suite, evaluated as its users do."""
    pytest.importorskip("dm_control")
    from dm_control import suite

    plan = plan_of("dm_control/pendulum-swingup", seeds=(3,), protocol="suite")
    results = run_all(tmp_path, plan)
    theirs = suite.load("pendulum", "swingup", task_kwargs={"random": 3})
    for episode in range(3):
        theirs.reset()
        result = results[3, episode]
        state = states_of(tmp_path / FOLDER, result.monitor, result.episode_id)[0]
        assert state[1] == theirs.physics.data.qpos[0]
