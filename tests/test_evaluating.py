# SPDX-License-Identifier: Apache-2.0
import contextlib
import csv
import functools
import hashlib
import importlib
import importlib.util
import json
import math
import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np
import pytest
from engine_runs import each_engine
from evaluated_files import recorded_in
from parts import parametrize
from processes import children
from waiting import wait_until

import mjrec
from mjrec import (
    DifferentEvaluation,
    DirectoryInUse,
    InvalidArgument,
    PolicyError,
    UnknownName,
)
from mjrec.environments.episode_seeds import episode_seeds
from mjrec.environments.named_environment import EnvironmentOptions
from mjrec.evaluation.episode_results import recorded_results
from mjrec.evaluation.evaluating import evaluate
from mjrec.evaluation.evaluation import read_results
from mjrec.formats.bundle import finished_trajectories
from mjrec.formats.locks import try_lock
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.video_metadata import metadata_path
from mjrec.recorder.options import RecorderOptions
from mjrec.sessions import Session, record_session

PENDULUM = "InvertedPendulum-v5"
DOUBLE = "InvertedDoublePendulum-v5"
SIXTEEN = {"seeds": [5], "num_seeds": None, "episodes": 16}


def run(directory, **options):
    few = {"tasks": [PENDULUM], "policy": "random", "episodes": 2, "num_seeds": 2}
    small = {"workers": 2, "keep": "none", "max_steps": 5, "height": 32, "width": 32}
    return evaluate(**{**few, **small, **options}, directory=directory)


def contents(directory):
    return {
        name: (directory / name).read_bytes()
        for name in ("results.json", "results.csv")
    }


def rows_of(name, directory):
    with (directory / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def started_episodes(directory):
    """Return the number of episodes begun, by the journals."""
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_text().count('{"begun"') for path in journals)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """An evaluation by one worker, without videos."""
    directory = tmp_path_factory.mktemp("evaluations") / "reference"
    # Leftovers of a killed run do not prevent an evaluation.
    (directory / ".mjrec.work" / "run").mkdir(parents=True)
    (directory / ".mjrec.evaluation.lock").touch()
    run(directory, tasks=[PENDULUM, DOUBLE], workers=1)
    return directory


def test_results_have_all_episodes_in_the_order_of_the_plan(reference):
    """Each has a trajectory. The task with more joints starts first."""
    results = list(read_results(reference))
    assert [(each.task, *each.unit) for each in results] == [
        (task, seed, episode)
        for task in (PENDULUM, DOUBLE)
        for seed in (0, 1)
        for episode in (0, 1)
    ]
    assert all(each.failure is None and each.length <= 5 for each in results)
    files = [p for each in reference.glob("*/*") for p in finished_trajectories(each)]
    assert len(files) == 8
    assert started_episodes(reference) == 8
    started = {row["task"]: float(row["start"]) for row in rows_of("timing", reference)}
    assert started[DOUBLE] < started[PENDULUM]


# Takes more than five seconds: 200 episodes.
def test_200_episodes_fit_into_60_files(tmp_path):
    evaluation = run(tmp_path / "e", num_seeds=100, max_steps=2)
    assert sum(path.is_file() for path in evaluation.directory.rglob("*")) <= 60
    for result in evaluation.results[::40]:
        assert len(mjrec.load_trajectory(evaluation.file_of(result))) == 2


def test_selected_episodes_get_videos(tmp_path):
    """Tables and metadata agree on them. Progress never decreases."""
    progress = []
    evaluation = run(tmp_path / "e", keep="best,worst", on_progress=progress.append)
    assert [each.done for each in progress] == sorted(each.done for each in progress)
    last = progress[-1]
    assert (last.done, last.total, last.failed) == (4, 4, 0)
    assert (last.videos_done, last.videos) == (2, 2)
    read = read_results(tmp_path / "e")
    columns = read.by_task[PENDULUM]
    returns = columns.rows["total_reward"].tolist()
    best, worst = read.selection[PENDULUM]
    assert (best.role, worst.role) == ("best", "worst")
    assert best.seed * 2 + best.episode == returns.index(max(returns))
    assert worst.seed * 2 + worst.episode == returns.index(min(returns))
    assert evaluation.pending == {}
    assert {*evaluation.videos} == {
        tmp_path / "e" / str(columns.video_path(index)) for index in columns.videos
    }
    for path in evaluation.videos:
        metadata = metadata_path(path).read_text()
        selection = json.loads(metadata)["selection"]
        assert (selection["rule"], selection["scope"]) == ("best,worst", "evaluation")
        assert hashlib.sha256(path.read_bytes()).hexdigest() in metadata


class LargePolicy:
    """Has 100 MB of weights, and draws from global random generators."""

    def __init__(self):
        self.weights = np.ones(100 << 20, np.uint8)

    def __call__(self, observation):
        return self.weights[-1] * np.random.uniform(-3, 3, 1) * random.random()


def run_large(directory, **options):
    tasks, policy = [PENDULUM, DOUBLE], LargePolicy()
    return run(directory, tasks=tasks, policy=policy, keep="best,worst", **options)


@pytest.fixture(scope="module")
def by_one_worker(tmp_path_factory):
    return run_large(tmp_path_factory.mktemp("one") / "e", workers=1)


@pytest.fixture
def engines(tmp_path_factory):
    with each_engine(tmp_path_factory.mktemp("home")) as engines:
        yield engines


# Takes more than five seconds: evaluations with videos, in new workers.
# Ray leaves connections and pipes to the garbage collector.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@parametrize(
    ("kind", "workers"),
    [("local", 5), ("ray", 2), ("slurm", 2), ("local", 2), ("dask", 2)],
    default=1,
)
def test_engines_produce_the_files_of_one_worker(
    by_one_worker, engines, tmp_path, kind, workers
):
    here, engine = by_one_worker, engines(kind, workers)
    there = run_large(tmp_path / "e", engine=engine, workers=None)
    engine.shutdown()
    assert contents(there.directory) == contents(here.directory)
    assert there.pending == here.pending == {}
    assert recorded_in(there) == recorded_in(here)
    assert len(recorded_in(there)) == 8 + len(there.videos) >= 8 + 3
    theirs, ours = (
        {path.relative_to(e.directory) for path in e.directory.rglob("*")}
        for e in (there, here)
    )
    assert theirs == ours
    assert listed_in(there.directory) == {path.name for path in there.videos}


class NewHomes(Executor):
    """Runs each job as on a machine with another home directory."""

    def __init__(self, homes):
        self.homes = homes
        self.workers = {}

    def submit(self, fn, /, *args, **kwargs):
        directory, job = json.loads(json.dumps(args))
        if directory not in self.workers:
            work = json.loads(Path(directory, "work.json").read_bytes())
            module, _, name = work["entry"].partition(":")
            make = getattr(importlib.import_module(module), name)
            self.workers[directory] = make(work["settings"])
        future = Future()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_STATE_HOME", str(self.homes / job["key"]))
            future.set_result({"value": self.workers[directory](job["arguments"])})
        return future


@pytest.mark.dm_control
def test_compiled_models_are_shared_between_home_directories(tmp_path):
    pytest.importorskip("dm_control")
    options = {"engine": NewHomes(tmp_path / "homes"), "workers": None, "keep": "best"}
    evaluation = run(tmp_path / "out", tasks=["dm_control/swimmer-swimmer6"], **options)
    assert not list(evaluation.directory.rglob("*.model.*.zip"))
    assert len(list(evaluation.directory.rglob("*.mp4"))) == 1
    folder, *_ = (path.parent for path in evaluation.directory.glob("*/*/*.h5"))
    for path in finished_trajectories(folder):
        assert mjrec.load_trajectory(path).model().nv == 8


@pytest.mark.thorough
def test_videos_do_not_depend_on_earlier_episodes(tmp_path):
    """The camera is placed again in each episode."""
    options = {"tasks": ["Reacher-v5"], "num_seeds": 1, "keep": "all", "max_steps": 12}
    # Chunks have two episodes, or three and then two.
    whole = run(tmp_path / "whole", **options, episodes=8, workers=1)
    run(tmp_path / "parts", **options, episodes=3, workers=1)
    parts = run(tmp_path / "parts", **options, episodes=8, workers=3, resume=True)
    assert len(whole.videos) == 8
    assert recorded_in(parts) == recorded_in(whole)


def listed_in(directory):
    texts = map(Path.read_text, directory.glob("*/*/*.manifest.json"))
    return {video for text in texts for video, _ in json.loads(text)["videos"]}


class FaultyPolicy:
    """Calls `faults[n]` in the third step of episode n of seed 5."""

    def __init__(self, faults):
        self.by_seed = {episode_seeds(5, n).policy: do for n, do in faults.items()}

    def reset(self, seed):
        self.fault = self.by_seed.get(seed)
        self.steps = 0

    def __call__(self, observation):
        self.steps += 1
        if self.fault is not None and self.steps == 3:
            return self.fault()
        return np.full(1, 0.01)


def fail(error):
    raise error


def test_failing_policy_loses_one_episode(tmp_path):
    """The reason is one line, and the trajectory is marked incomplete."""
    faults = {
        1: functools.partial(fail, RuntimeError("out of\nideas")),
        2: functools.partial(fail, SystemExit(3)),
        3: functools.partial(np.full, 1, np.nan),
        4: functools.partial(np.zeros, 7),
    }
    options = {**SIXTEEN, "episodes": 6, "workers": 1}
    evaluation = run(tmp_path / "e", policy=FaultyPolicy(faults), **options)
    assert [each.episode for each in evaluation.failed] == [1, 2, 3, 4]
    reasons = ("out of ideas", "SystemExit: 3", "nan", "action in Box")
    for failed, reason in zip(evaluation.failed, reasons, strict=True):
        assert reason in failed.failure
        assert "\n" not in failed.failure
        assert (failed.total_reward, failed.length) == (None, 2)
        with open_trajectory(evaluation.file_of(failed)) as reader:
            assert (reader.facts["complete"], reader.facts["length"]) == (False, 2)
    # The episode after a failed one has its own initial state.
    initial = {states_of(evaluation, each)[0].tobytes() for each in evaluation.results}
    assert len(initial) == 6
    failures = [row["failure"] for row in rows_of("results", tmp_path / "e")]
    assert failures == [each.failure or "" for each in evaluation.results]
    [summary] = evaluation.summaries
    assert (summary.failed, summary.episodes) == (4, 2)


def states_of(evaluation, result):
    with open_trajectory(evaluation.file_of(result)) as reader:
        return reader.states(0, reader.row_count)


# The second has random springs, drawn when it is made.
@pytest.mark.parametrize("task", [PENDULUM, "dm_control/lqr-lqr_2_1"])
def test_episodes_equal_those_of_a_session(tmp_path, task):
    if task.startswith("dm_control/"):
        pytest.importorskip("dm_control")
    session = Session(
        environment=task,
        directory=tmp_path / "session",
        made=EnvironmentOptions(max_steps=5, height=32, width=32),
        monitor=RecorderOptions(workers=0),
        seed=4,
        episodes=3,
        schedule="all",
    )
    with contextlib.closing(record_session(session)) as episodes:
        expected = list(episodes)
    seeds = {"seeds": [3, 4], "num_seeds": None, "episodes": 3}
    evaluation = run(tmp_path / "e", tasks=[task], **seeds, workers=1)
    for result, theirs in zip(evaluation.results[3:], expected, strict=True):
        [path] = (tmp_path / "session").glob(f"*.episode{result.episode:06d}.h5")
        with open_trajectory(path) as reader:
            states = reader.states(0, reader.row_count)
        assert np.array_equal(states_of(evaluation, result), states)
        assert result.total_reward == theirs.reward


FAULTY_ENVIRONMENT = """
import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from mjrec.environments.episode_seeds import episode_seeds

class Faulty(InvertedPendulumEnv):
    def reset(self, *, seed=None, options=None):
        if seed == episode_seeds(0, 1).environment:
            raise OSError("no such pendulum")
        self.is_faulty = seed in [episode_seeds(n, 0).environment for n in (0, 1)]
        initial = super().reset(seed=seed)
        self.data.warning[mujoco.mjtWarning.mjWARN_INERTIA].number = 5
        return initial

    def step(self, action):
        if self.is_faulty:
            self.is_faulty = False
            self.data.qpos[0] = np.inf
        return super().step(action)

gymnasium.register("Faulty-v0", Faulty)
"""


def test_errors_and_warnings_belong_to_their_episodes(tmp_path, monkeypatch, caplog):
    """A failed reset leaves no recording. MuJoCo's warning is logged once."""
    (tmp_path / "faulty.py").write_text(FAULTY_ENVIRONMENT)
    monkeypatch.chdir(tmp_path)
    evaluation = run(tmp_path / "e", tasks=["faulty:Faulty-v0"], episodes=3)
    # One for the first episode of each seed.
    assert dict(evaluation.summaries[0].warnings) == {"BADQPOS": 2}
    [failed] = evaluation.failed
    assert failed.failure == "OSError: no such pendulum"
    assert (failed.monitor, failed.episode_id, failed.length) == (None, None, 0)
    assert len([text for text in caplog.messages if text.startswith("MuJoCo")]) == 1
    assert {each.name for each in tmp_path.glob("*.*")} == {"faulty.py"}


def kill_worker():
    os.kill(os.getpid(), signal.SIGKILL)


def kill_worker_once(marker):
    if not marker.exists():
        marker.touch()
        kill_worker()
    return np.full(1, 0.01)


def block(path):
    path.mkdir(exist_ok=True)
    return np.full(1, 0.01)


def test_resume_finishes_recordings_without_repeating_episodes(tmp_path, caplog):
    chunk = tmp_path / "e" / PENDULUM / "seed-005-episode-003"
    blocked = chunk / f"openaigym.trajectories.0.{PENDULUM}-{chunk.name}.h5"
    policy = FaultyPolicy({3: functools.partial(block, blocked)})
    options = {"policy": policy, "seeds": [5], "num_seeds": None, "episodes": 4}
    results = run(tmp_path / "e", **options).results
    assert blocked.name in caplog.text
    assert len(results) == 4
    assert not [*finished_trajectories(chunk)]
    blocked.rmdir()
    assert run(tmp_path / "e", **options, resume=True).results == results
    assert started_episodes(tmp_path / "e") == 4
    assert len([*finished_trajectories(chunk)]) == 1


# Takes more than five seconds: two evaluations, and a worker that starts again.
@parametrize("protocol", ["suite", "seeded"])
def test_retry_after_a_dead_worker_gives_the_same_results(tmp_path, caplog, protocol):
    """A random stream shared by episodes continues where it was."""
    kill = functools.partial(kill_worker_once, tmp_path / "once")
    policy = FaultyPolicy({1: functools.partial(fail, RuntimeError()), 3: kill})
    options = {"policy": policy, **SIXTEEN, "protocol": protocol}
    died = run(tmp_path / "died", **options)
    assert "A worker died" in caplog.text
    lived = run(tmp_path / "lived", **options)
    assert [each.unit for each in died.failed] == [(5, 1)]
    assert contents(tmp_path / "died") == contents(tmp_path / "lived")
    assert recorded_in(died) == recorded_in(lived)


# Takes more than five seconds: three workers die, one after the other.
@parametrize("workers", [1, 2])
@pytest.mark.parametrize("protocol", ["seeded", "suite"])
def test_episode_that_kills_workers_fails_alone(tmp_path, workers, protocol):
    options = {"policy": FaultyPolicy({3: kill_worker}), "protocol": protocol}
    evaluation = run(tmp_path / "e", **options, **SIXTEEN, workers=workers)
    assert [(each.unit, each.failure) for each in evaluation.failed] == [
        ((5, 3), "3 processes died while running it")
    ]
    assert {each.unit for each in evaluation.results} == {(5, n) for n in range(16)}


def test_hanging_episode_fails_after_its_timeout(tmp_path):
    policy = FaultyPolicy({3: functools.partial(time.sleep, 1000)})
    evaluation = run(tmp_path / "e", policy=policy, **SIXTEEN, episode_timeout=2)
    [failed] = evaluation.failed
    assert (failed.unit, failed.failure) == ((5, 3), "it took longer than 2 seconds")


def slow_policy(observation):
    time.sleep(0.03)
    return np.sin(100 * observation[:1])


def evaluate_slowly(directory, engine, *more):
    """Evaluate, slowly enough to be killed; resume if `more` is given."""
    workers = {"workers": 2}
    if engine:
        workers = {"engine": getattr(mjrec, engine)(2), "workers": None}
    small = {"episodes": 6, "keep": "best", "resume": bool(more)}
    tasks, policy = [PENDULUM, DOUBLE], "test_evaluating:slow_policy"
    run(Path(directory), tasks=tasks, policy=policy, **small, **workers)


def slow_run(directory, engine="", *more):
    script = "import sys, test_evaluating as t; t.evaluate_slowly(*sys.argv[1:])"
    return subprocess.Popen(
        [sys.executable, "-c", script, directory, engine, *more],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        start_new_session=True,
    )


def ended_episodes(directory):
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_bytes().count(b'"evaluation": {') for path in journals)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "e"
    assert slow_run(directory).wait() == 0
    return directory


def video_times(directory):
    return {path: path.stat().st_mtime_ns for path in directory.glob("*/*/*.mp4")}


# Takes more than five seconds: three evaluations, one of them killed.
@parametrize(
    ("moment", "engine"),
    [
        ("drawing", ""),
        ("running", ""),
        ("running", "LocalEngine"),
        ("running", "RayEngine"),
    ],
)
def test_resume_after_sigkill_gives_the_same_bytes(
    uninterrupted, tmp_path, moment, engine
):
    """It repeats only the running episodes."""
    killed = tmp_path / "killed"
    process = slow_run(killed, engine)
    if moment == "running":
        wait_until(lambda: ended_episodes(killed) >= 5, seconds=60)
    else:
        wait_until((killed / "results.json").exists, seconds=60)
    for pid in (*children(process.pid), process.pid):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()
    assert (killed / "results.json").exists() is (moment == "drawing")
    before = video_times(killed)
    assert slow_run(killed, engine, "resume").wait() == 0
    assert contents(killed) == contents(uninterrupted)
    expected = recorded_in(read_results(uninterrupted))
    assert recorded_in(read_results(killed)) == expected
    # 24 episodes, and at most one more for each worker.
    assert 24 <= started_episodes(killed) <= 26
    assert ended_episodes(killed) == 24
    assert len(video_times(killed)) == 2
    assert before.items() <= video_times(killed).items()
    # Recordings of killed workers are bundled, and their logs deleted.
    kinds = ("openaigym.states.*", "openaigym.trajectory.*")
    assert not [path for kind in kinds for path in killed.rglob(kind)]
    for folder, result in recorded_results(killed):
        name = f"openaigym.trajectory.{result.monitor}.episode{result.episode_id:06d}"
        assert len(mjrec.load_trajectory(folder / f"{name}.h5")) == result.length


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "zero"}, "policy was 'random' and is now 'zero'"),
        ({"episodes": 1}, "episodes was 2 and is now 1"),
        ({"num_seeds": 1}, r"seeds was \[0, 1\] and is now \[0\]"),
        ({"keep": "all"}, "keep was 'none'"),
        # The default differs from the plan.
        ({"keep": "best,median,worst"}, "keep was 'none' and is now 'best,median"),
        ({"episodes": 10, "keep": None, "protocol": "suite"}, "episodes was 2"),
        ({"env_kwargs": {"reset_noise_scale": 0.1}}, "env_kwargs"),
    ],
)
def test_resume_with_other_options_changes_nothing(reference, options, message):
    before = contents(reference)
    with pytest.raises(DifferentEvaluation, match=message):
        run(reference, tasks=[PENDULUM, DOUBLE], resume=True, **options)
    assert contents(reference) == before


def test_directory_belongs_to_one_evaluation(reference, tmp_path):
    with pytest.raises(InvalidArgument, match="resume=True"):
        run(reference)
    (tmp_path / "notes.txt").touch()
    for resume in (False, True):
        with pytest.raises(InvalidArgument, match=r"notes\.txt"):
            run(tmp_path, resume=resume)
    lock = try_lock(reference / ".mjrec.evaluation.lock")
    assert lock is not None
    with pytest.raises(DirectoryInUse):
        run(reference, tasks=[PENDULUM, DOUBLE], resume=True)
    lock.release()


WRONG = [
    ({"tasks": ["HalfChetah-v5"]}, UnknownName, "HalfCheetah-v5"),
    ({"tasks": ["dm_control:bench"]}, UnknownName, "dm_control:benchmarking"),
    ({"tasks": []}, InvalidArgument, "needs a task"),
    ({"policy": "no_such_module:x"}, UnknownName, "no_such_module"),
    ({"policy": "broken_policy:x"}, PolicyError, "name 'undefined' is not defined"),
    ({"policy": 3}, PolicyError, "is not callable"),
    ({"policy": lambda o, f=sys.stdout: f}, PolicyError, "module:name"),
    ({"seeds": [1, 1], "num_seeds": None}, InvalidArgument, "duplicates"),
    ({"seeds": [1], "num_seeds": 2}, InvalidArgument, "one of them"),
    ({"engine": "spark"}, UnknownName, "slurm"),
    ({"engine": 3, "workers": None}, InvalidArgument, "LocalEngine"),
    ({"engine": mjrec.LocalEngine(1)}, InvalidArgument, "its own workers"),
    ({"keep": "bset"}, UnknownName, "best:N"),
    ({"protocol": "seed"}, UnknownName, "suite"),
    ({"max_fps": -1}, InvalidArgument, "max_fps"),
    ({"env_kwargs": {"f": print}}, InvalidArgument, "JSON.* 'f' "),
    ({"env_kwargs": {"a": 1, "f": [math.nan]}}, InvalidArgument, "'f'.*nan"),
    ({"env_kwargs": {"f": {1: 0, "1": 2}}}, InvalidArgument, "'f'.*the key '1' twice"),
    ({"env_kwargs": {"no_such": 1}}, mjrec.EnvironmentNotMade, "no_such"),
    ({"score_ranges": {"Ant-v5": (0, 1)}}, UnknownName, PENDULUM),
    ({"score_ranges": {PENDULUM: (1, 1)}}, InvalidArgument, "higher"),
]


@pytest.mark.parametrize(("options", "kind", "words"), WRONG)
def test_invalid_options_write_nothing(tmp_path, monkeypatch, options, kind, words):
    (tmp_path / "broken_policy.py").write_text("undefined\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(kind, match=words):
        run(tmp_path / "e", **options)
    assert not (tmp_path / "e").exists()


LIVE_ENVIRONMENT = """
import gymnasium
import numpy as np
from conftest import Corridor

class Noise(Corridor):
    def step(self, action):
        observation, _, *ends = super().step(action)
        return observation, float(action), *ends

    def render(self):
        return self.np_random.integers(255, size=(32, 32, 3), dtype=np.uint8)

gymnasium.register("Noise-v0", Noise)
"""


def test_keep_deletes_other_live_videos(tmp_path, monkeypatch):
    (tmp_path / "live.py").write_text(LIVE_ENVIRONMENT)
    monkeypatch.chdir(tmp_path)
    live = {"tasks": ["live:Noise-v0"], "height": None, "width": None}
    live |= {"num_seeds": 1, "episodes": 4, "keep": "best,worst"}
    one = run(tmp_path / "one", **live, workers=1)
    assert one.pending == {}
    assert len(one.videos) == 2
    assert {*(tmp_path / "one").rglob("*.mp4")} == {*one.videos}
    assert listed_in(tmp_path / "one") == {path.name for path in one.videos}
    two = run(tmp_path / "two", **live)
    assert [p.read_bytes() for p in two.videos] == [p.read_bytes() for p in one.videos]
    assert one.plan.tasks[0].folder == "live%3ANoise-v0"


def test_unrenderable_tasks_have_results_without_videos(tmp_path, caplog):
    """One line says why, and no video stays pending."""
    is_rendered = importlib.util.find_spec("pygame") is not None
    evaluation = run(
        tmp_path / "e", tasks=["CartPole-v1"], keep="best", height=None, width=None
    )
    assert not evaluation.failed
    assert len(evaluation.videos) == is_rendered
    assert not evaluation.pending
    assert len(evaluation.selection["CartPole-v1"]) == is_rendered
    columns = read_results(tmp_path / "e").by_task["CartPole-v1"]
    assert len(columns.videos) == is_rendered
    assert caplog.text.count("will have no videos") == (not is_rendered)


def test_more_seeds_can_select_other_videos(tmp_path):
    """These are rendered from trajectories, and earlier videos stay."""
    options = {"keep": "median", "tasks": [DOUBLE], "episodes": 1}
    [first] = run(tmp_path / "e", **options, num_seeds=2).videos
    earlier = video_times(tmp_path / "e")
    for count in range(3, 9):
        after = run(tmp_path / "e", **options, num_seeds=count, resume=True)
        if after.videos != [first]:
            break
    assert after.pending == {}
    [video] = after.videos
    assert video != first
    assert earlier.items() <= video_times(tmp_path / "e").items()
    assert video.name in listed_in(tmp_path / "e")


ROBOT = """
<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".5"/></body>
</worldbody><actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>
"""


class ConstantPolicy:
    def __init__(self, weight):
        self.weight = weight

    def __call__(self, observation):
        return np.full(1, self.weight)


def test_resume_with_another_policy_is_refused(tmp_path, monkeypatch):
    """The policy includes weights, code and files named by arguments."""
    directory = tmp_path / "e"
    run(directory, policy=ConstantPolicy(0.0), seeds=[0], num_seeds=None)
    options = {"seeds": [0, 1], "num_seeds": None, "resume": True}
    with pytest.raises(DifferentEvaluation, match=r"policy \(its content\) was '\w+"):
        run(directory, policy=ConstantPolicy(0.9), **options)
    assert len(run(directory, policy=ConstantPolicy(0.0), **options).results) == 4
    monkeypatch.chdir(tmp_path)
    module, weights = tmp_path / "own_policy.py", tmp_path / "weights.bin"
    module.write_text("def make(env, weights):\n    return lambda o: [0.0]\n")
    weights.write_bytes(b"1")
    named = {"policy": "own_policy:make()", "policy_kwargs": {"weights": str(weights)}}
    run(tmp_path / "named", **named)
    module.write_text("def make(env, weights):\n    return lambda o: [1.0]\n")
    weights.write_bytes(b"2")
    with pytest.raises(
        DifferentEvaluation, match=r"\(its code\).*its argument weights\)"
    ):
        run(tmp_path / "named", **named, resume=True)


def test_resume_compares_imported_modules_and_compiled_models(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    helper, robot = tmp_path / "own_gains.py", tmp_path / "robot.xml"
    text = f"import {helper.stem}\ndef act(o):\n    return [{helper.stem}.GAIN]\n"
    (tmp_path / "gain_policy.py").write_text(text)
    helper.write_text("GAIN = 0.0\n")
    robot.write_text(ROBOT)
    options = {"tasks": ["robot.xml"], "policy": "gain_policy:act", "episodes": 1}
    run(tmp_path / "e", **options, num_seeds=1)
    helper.write_text("GAIN = 1.0\n")
    robot.write_text(ROBOT.replace('"slide"', '"hinge"'))
    # A complete evaluation can be read with either.
    assert len(run(tmp_path / "e", **options, num_seeds=1, resume=True).results) == 1
    with pytest.raises(DifferentEvaluation) as raised:
        run(tmp_path / "e", **options, resume=True)
    names = {"module own_gains", "model of robot.xml"}
    assert {*raised.value.differences} == names
    helper.write_text("GAIN = 0.0\n")
    robot.write_text(f"<!-- the same -->{ROBOT}")
    run(tmp_path / "e", **options, resume=True)
    run(tmp_path / "whole", **options)
    assert contents(tmp_path / "e") == contents(tmp_path / "whole")


def test_resume_takes_the_plan_from_the_directory(reference, tmp_path):
    """Larger values extend it, and completed episodes are not repeated."""
    directory = tmp_path / "e"
    run(directory, num_seeds=1, episodes=1)
    same = evaluate(directory=directory, resume=True, workers=1)
    assert [each.unit for each in same.results] == [(0, 0)]
    more = {"tasks": [PENDULUM, DOUBLE], "num_seeds": 2, "episodes": 2}
    evaluate(**more, directory=directory, resume=True, workers=1)
    assert contents(directory) == contents(reference)
    (directory / "results.json").unlink()
    evaluate(directory=directory, resume=True, workers=1)
    assert contents(directory) == contents(reference)
    assert started_episodes(directory) == 8


def test_resume_keeps_ranges_and_confidence_unless_given(tmp_path):
    directory = tmp_path / "e"
    run(directory, score_ranges={PENDULUM: (0, 10)}, confidence=0.8, num_seeds=1)
    before = contents(directory)
    resume = functools.partial(evaluate, directory=directory, workers=1, resume=True)
    resume()
    assert contents(directory) == before
    changed = resume(confidence=0.9)
    assert changed.bootstrap.confidence == 0.9
    assert changed.summaries[0].score_range == (0, 10)
    changed = resume(score_ranges={PENDULUM: (0, 5)})
    assert changed.bootstrap.confidence == 0.9
    assert changed.summaries[0].score_range == (0, 5)


@pytest.mark.parametrize(("first", "others"), [(30, (60, None)), (None, (60,))])
def test_resume_with_another_frame_rate_is_refused(tmp_path, first, others):
    """Without one, the first is kept."""
    run(tmp_path / "e", max_fps=first, num_seeds=1, episodes=1)
    for other in others:
        with pytest.raises(DifferentEvaluation, match=f"max_fps was {first}.*{other}"):
            evaluate(directory=tmp_path / "e", max_fps=other, resume=True)
    same = evaluate(directory=tmp_path / "e", resume=True, workers=1)
    assert same.plan.max_fps == first


def test_force_deletes_only_files_of_the_evaluation(tmp_path):
    run(tmp_path / "e", tasks=[PENDULUM, DOUBLE])
    (tmp_path / "e" / DOUBLE / "notes.txt").touch()
    run(tmp_path / "e", force=True, num_seeds=1)
    assert {path.name for path in (tmp_path / "e" / DOUBLE).iterdir()} == {"notes.txt"}
    assert len(list(read_results(tmp_path / "e"))) == 2


class CountedPolicy:
    """Appends libraries' number of threads to a file when it is built."""

    def __init__(self, env, file):
        with Path(file).open("a") as built:
            built.write(os.environ["OMP_NUM_THREADS"])

    def __call__(self, observation):
        return np.zeros(1)


def test_policy_is_built_once_per_worker_and_task(tmp_path):
    """It uses one thread, so results do not depend on the number of CPUs."""
    kwargs = {"file": str(tmp_path / "built")}
    options = {"policy": CountedPolicy, "policy_kwargs": kwargs}
    run(tmp_path / "e", **options, num_seeds=8, workers=1)
    assert (tmp_path / "built").read_text() == "1"


@pytest.mark.dm_control
def test_time_limit_sets_the_score_range(tmp_path):
    """A task of 40 steps has returns from 0 to 40."""
    pytest.importorskip("dm_control")
    kwargs = {"task_kwargs": {"time_limit": 1}}
    options = {"num_seeds": 1, "env_kwargs": kwargs, "max_steps": None}
    evaluation = run(tmp_path / "e", tasks=["dm_control/walker-walk"], **options)
    assert [each.score_range for each in evaluation.summaries] == [(0.0, 40.0)]
    assert {each.length for each in evaluation.results} == {40}
