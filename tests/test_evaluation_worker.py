# SPDX-License-Identifier: Apache-2.0
"""What a worker of an evaluation does with a chunk."""

import dataclasses
import json
from contextlib import closing

import cloudpickle
import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from gymnasium.envs.registration import registry

import mjrec
from conftest import Corridor
from mjrec.environments.episode_seeds import episode_seeds
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.evaluation.episode_results import read_chunk
from mjrec.evaluation.plan import Chunk, EvaluatedTask, EvaluationPlan
from mjrec.evaluation.worker import EvaluationWorker
from mjrec.formats.bundle import finished_trajectories
from mjrec.formats.json_fields import to_json
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.recorder.options import RecorderOptions
from mjrec.sessions import Session, record_session

PENDULUM = "InvertedPendulum-v5"
ID = "MjrecEvaluated-v0"


@pytest.fixture
def register():
    """Register an environment's class, and forget it afterwards."""

    def register_class(entry_point):
        gymnasium.register(ID, entry_point=entry_point, disable_env_checker=True)
        return ID

    yield register_class
    registry.pop(ID, None)


def plan_of(task=PENDULUM, **changes):
    """Return a plan for one task, with short episodes and small frames."""
    few = {"policy": "random", "seeds": (0,), "episodes": 3}
    small = {"max_steps": 8, "height": 32, "width": 32}
    tasks = (EvaluatedTask(task, "task"),)
    return EvaluationPlan(tasks=tasks, **{**few, **small, **changes})


def run_chunk(directory, plan, chunk=None, policy=None):
    """Run a chunk in this process, all of a plan if None, and return the results."""
    chunk = chunk or Chunk("chunk", plan.seeds, 0, plan.episodes)
    settings = {"directory": str(directory)}
    if policy is not None:
        plan = dataclasses.replace(plan, policy="mine", is_object=True)
        settings["payload"] = str(directory / "policy")
        directory.mkdir(exist_ok=True)
        (directory / "policy").write_bytes(cloudpickle.dumps(policy))
    task = plan.tasks[0].name
    folder = f"task/{chunk.folder}"
    job = {"kind": "run", "task": task, "folder": folder, "chunk": to_json(chunk)}
    # As they travel.
    sent = json.loads(json.dumps([{**settings, "plan": to_json(plan)}, job]))
    with closing(EvaluationWorker(sent[0])) as worker:
        worker(sent[1])
    return read_chunk(directory / folder, task).results


def states_of(folder, result):
    name = f"openaigym.trajectory.{result.monitor}.episode{result.episode_id:06d}.h5"
    with open_trajectory(folder / name) as reader:
        return reader.states(0, reader.row_count)


# The second draws its springs when it is made.
@pytest.mark.parametrize("task", [PENDULUM, "dm_control/lqr-lqr_2_1"])
def test_an_episode_is_the_one_that_a_session_records(tmp_path, task):
    """Bit for bit, whichever chunk it is in, and whatever ran before it."""
    if task.startswith("dm_control/"):
        pytest.importorskip("dm_control")
    session = Session(
        environment=task,
        directory=tmp_path / "session",
        seed=4,
        episodes=3,
        schedule="all",
        made=EnvironmentOptions(max_steps=8, height=32, width=32),
        monitor=RecorderOptions(workers=0),
    )
    with closing(record_session(session)) as episodes:
        expected = list(episodes)
    plan = plan_of(task, seeds=(3, 4))
    results = run_chunk(tmp_path, plan, Chunk("a", (3, 4), 2, 3))
    results |= run_chunk(tmp_path, plan, Chunk("b", (3, 4), 0, 2))
    for episode in range(3):
        result = results[4, episode]
        [path] = (tmp_path / "session").glob(f"*.episode{episode:06d}.h5")
        with open_trajectory(path) as reader:
            theirs = reader.states(0, reader.row_count)
        ours = states_of(tmp_path / "task" / ("b" if episode < 2 else "a"), result)
        assert np.array_equal(ours, theirs)
        assert result.total_reward == expected[episode].reward


class Stumbling:
    """Pushes gently; does something else in the third step of some episodes."""

    def __init__(self, wrong):
        self.by_seed = {episode_seeds(0, n).policy: do for n, do in wrong.items()}

    def reset(self, seed):
        self.wrong = self.by_seed.get(seed)
        self.steps = 0

    def __call__(self, observation):
        self.steps += 1
        if self.wrong is not None and self.steps == 3:
            return self.wrong()
        return np.full(1, 0.01)


def raised(error):
    raise error


@pytest.mark.parametrize(
    ("wrong", "failure"),
    [
        (lambda: raised(RuntimeError("out of\nideas")), "out of ideas"),
        (lambda: raised(SystemExit(3)), "SystemExit: 3"),
        (lambda: np.full(1, np.nan), "NaN"),
        (lambda: np.zeros(7), "action in Box"),
    ],
)
def test_a_policy_that_fails_loses_its_episode_only(tmp_path, wrong, failure):
    """Its reason is one line; its trajectory says that it is not complete."""
    plan = plan_of(keep="none")
    results = run_chunk(tmp_path, plan, policy=Stumbling({1: wrong}))
    failed = results[0, 1]
    assert failure.lower() in str(failed.failure).lower()
    assert "\n" not in str(failed.failure)
    assert (failed.total_reward, failed.terminated, failed.length) == (None, None, 2)
    assert [results[0, n].failure for n in (0, 2)] == [None, None]
    folder = tmp_path / "task" / "chunk"
    begun = {states_of(folder, results[0, n])[0].tobytes() for n in range(3)}
    # What comes after it is not the beginning once more.
    assert len(begun) == 3
    name = f"*.{failed.monitor}.episode{failed.episode_id:06d}.h5"
    [path] = (p for p in finished_trajectories(folder) if p.match(name))
    with open_trajectory(path) as reader:
        assert (reader.facts["complete"], reader.facts["length"]) == (False, 2)


@pytest.mark.parametrize("fails_first", [False, True])
def test_a_random_stream_goes_on_where_it_was(tmp_path, fails_first):
    """Episodes that are done are run again unrecorded; a signal is no failure."""
    plan = plan_of(protocol="suite", episodes=4)
    wrong = {0: lambda: raised(RuntimeError)} if fails_first else {}
    whole = run_chunk(tmp_path / "whole", plan, policy=Stumbling(wrong))
    stopped = Stumbling({**wrong, 2: lambda: raised(KeyboardInterrupt)})
    with pytest.raises(KeyboardInterrupt):
        run_chunk(tmp_path / "cut", plan, policy=stopped)
    results = run_chunk(tmp_path / "cut", plan, policy=Stumbling(wrong))
    folders = [tmp_path / name / "task" / "chunk" for name in ("whole", "cut")]
    for unit in whole:
        one, other = whole[unit], results[unit]
        for fact in ("total_reward", "length", "terminated", "failure"):
            assert getattr(one, fact) == getattr(other, fact)
        states = map(states_of, folders, (one, other))
        assert np.array_equal(*states)
    assert len(list(finished_trajectories(folders[1]))) == 5


class Unsteady(Corridor):
    """Raises in the reset of its second episode."""

    def reset(self, *, seed=None, options=None):
        if seed == episode_seeds(0, 1).environment:
            raise OSError("no such corridor")
        return super().reset(seed=seed, options=options)


def test_a_reset_that_raises_fails_its_episode(tmp_path, register):
    """There is no recording of it then; those around it have theirs."""
    results = run_chunk(tmp_path, plan_of(register(Unsteady), keep="none"))
    failed = results[0, 1]
    assert failed.failure == "OSError: no such corridor"
    assert (failed.monitor, failed.episode_id, failed.length) == (None, None, 0)
    assert [results[0, n].total_reward for n in (0, 2)] == [1.5, 1.5]


class Exploding(InvertedPendulumEnv):
    """Becomes unstable in its second step; has warned before each episode."""

    def reset(self, **options):
        begun = super().reset(**options)
        self.data.warning[mujoco.mjtWarning.mjWARN_INERTIA].number = 5
        return begun

    def step(self, action):
        self.steps = getattr(self, "steps", 0) + 1
        if self.steps == 2:
            self.data.qpos[0] = np.inf
        return super().step(action)


def test_warnings_of_mujoco_are_counted(tmp_path, register):
    """In the episode in which they came, by their names."""
    results = run_chunk(tmp_path, plan_of(register(Exploding), policy="zero"))
    counts = [dict(results[0, n].warnings) for n in range(3)]
    assert counts == [{"BADQPOS": 1}, {}, {}]


def test_what_cannot_be_recorded_is_no_episodes_failure(tmp_path):
    """It ends the job, and is done again with the next."""
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "chunk").write_text("in the way")
    with pytest.raises(mjrec.DirectoryNotWritable):
        run_chunk(tmp_path, plan_of())
