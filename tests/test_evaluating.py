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
    """Evaluate something small."""
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


def begun(directory):
    """Return how many episodes were begun in all, by the journals."""
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_text().count('{"begun"') for path in journals)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """An evaluation by one worker, without videos."""
    directory = tmp_path_factory.mktemp("evaluations") / "reference"
    # What a dead run of an engine has left is in nobody's way.
    (directory / ".mjrec.work" / "run").mkdir(parents=True)
    (directory / ".mjrec.evaluation.lock").touch()
    run(directory, tasks=[PENDULUM, DOUBLE], workers=1)
    return directory


def test_every_episode_of_every_task_and_seed_is_there(reference):
    """In the order of the plan, each with its trajectory, and all read back.

    What takes long begins first, so that no worker ends long after the others.
    """
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
    assert begun(reference) == 8
    begun_at = {
        row["task"]: float(row["start"]) for row in rows_of("timing", reference)
    }
    # One of its two pendulums has one joint more.
    assert begun_at[DOUBLE] < begun_at[PENDULUM]


# Takes more than five seconds: 200 episodes.
def test_a_large_evaluation_is_a_few_files(tmp_path):
    """Of 100 seeds with 2 episodes each at most 60; every trajectory is read back."""
    evaluation = run(tmp_path / "e", num_seeds=100, max_steps=2)
    assert sum(path.is_file() for path in evaluation.directory.rglob("*")) <= 60
    for result in evaluation.results[::40]:
        assert len(mjrec.load_trajectory(evaluation.file_of(result))) == 2


def test_the_chosen_episodes_get_videos(tmp_path):
    """By rule, for each task; table, metadata and report of it agree.

    What is told of the progress goes up to the end, and never backwards.
    """
    told = []
    evaluation = run(tmp_path / "e", keep="best,worst", on_progress=told.append)
    assert [each.done for each in told] == sorted(each.done for each in told)
    assert (told[-1].done, told[-1].total, told[-1].failed) == (4, 4, 0)
    assert (told[-1].videos_done, told[-1].videos) == (2, 2)
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
        said = json.loads(metadata_path(path).read_text())["selection"]
        assert (said["rule"], said["scope"]) == ("best,worst", "evaluation")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert digest in metadata_path(path).read_text()


class Large:
    """A policy that is large, and draws from generators that it was not given."""

    def __init__(self):
        self.weights = np.ones(100 << 20, np.uint8)

    def __call__(self, observation):
        return self.weights[-1] * np.random.uniform(-3, 3, 1) * random.random()


@pytest.fixture(scope="module")
def large():
    """What evaluates it."""
    options = {"tasks": [PENDULUM, DOUBLE], "policy": Large(), "keep": "best,worst"}
    return functools.partial(run, **options)


@pytest.fixture(scope="module")
def by_one_worker(large, tmp_path_factory):
    return large(tmp_path_factory.mktemp("one") / "e", workers=1)


@pytest.fixture
def engines(tmp_path_factory):
    with each_engine(tmp_path_factory.mktemp("home")) as made:
        yield made


# Takes more than five seconds: evaluations with videos, in workers that start for it.
# Ray's own connections and pipes, of which it says so when they are collected.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@parametrize(
    ("kind", "workers"),
    [("local", 5), ("ray", 2), ("slurm", 2), ("local", 2), ("dask", 2)],
    default=3,
)
def test_workers_and_engines_change_nothing(
    by_one_worker, large, engines, tmp_path, kind, workers
):
    """Results, trajectories, videos and names are those of one worker."""
    here, engine = by_one_worker, engines(kind, workers)
    there = large(tmp_path / "e", engine=engine, workers=None)
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


class Wandering(Executor):
    """An executor whose worker does each job as on a machine with another home.

    Args:
        homes: where these are.
    """

    def __init__(self, homes):
        self.homes = homes
        self.workers = {}

    def submit(self, fn, /, *args, **kwargs):
        place, job = json.loads(json.dumps(args))
        if place not in self.workers:
            work = json.loads(Path(place, "work.json").read_bytes())
            module, _, name = work["entry"].partition(":")
            make = getattr(importlib.import_module(module), name)
            self.workers[place] = make(work["settings"])
        future = Future()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_STATE_HOME", str(self.homes / job["key"]))
            future.set_result({"value": self.workers[place](job["arguments"])})
        return future


@pytest.mark.dm_control
def test_machines_with_other_homes_draw_what_others_recorded(tmp_path):
    """Also where there is only a compiled model; and so does this machine."""
    pytest.importorskip("dm_control")
    far = {"engine": Wandering(tmp_path / "homes"), "workers": None, "keep": "best"}
    evaluation = run(tmp_path / "out", tasks=["dm_control/swimmer-swimmer6"], **far)
    assert not list(evaluation.directory.rglob("*.model.*.zip"))
    assert len(list(evaluation.directory.rglob("*.mp4"))) == 1
    folder, *_ = (path.parent for path in evaluation.directory.glob("*/*/*.h5"))
    for path in finished_trajectories(folder):
        assert mjrec.load_trajectory(path).model().nv == 8


@pytest.mark.thorough
def test_videos_do_not_depend_on_what_was_run_before(tmp_path):
    """The camera is placed anew in each episode, not once for an environment."""
    options = {"tasks": ["Reacher-v5"], "num_seeds": 1, "keep": "all", "max_steps": 12}
    # In chunks of two by one worker, and of three and then two.
    whole = run(tmp_path / "whole", **options, episodes=8, workers=1)
    run(tmp_path / "parts", **options, episodes=3, workers=1)
    parts = run(tmp_path / "parts", **options, episodes=8, workers=3, resume=True)
    assert len(whole.videos) == 8
    assert recorded_in(parts) == recorded_in(whole)


def listed_in(directory):
    """Return the names of the videos in all manifests."""
    texts = map(Path.read_text, directory.glob("*/*/*.manifest.json"))
    return {video for text in texts for video, _ in json.loads(text)["videos"]}


class Stumbling:
    """Pushes gently; does something else in the third step of episodes of seed 5."""

    def __init__(self, wrong):
        self.by_seed = {episode_seeds(5, n).policy: do for n, do in wrong.items()}

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


def test_a_policy_that_fails_loses_its_episode_only(tmp_path):
    """Its reason is one line; its trajectory says that it is not complete."""
    wrong = {
        1: functools.partial(raised, RuntimeError("out of\nideas")),
        2: functools.partial(raised, SystemExit(3)),
        3: functools.partial(np.full, 1, np.nan),
        4: functools.partial(np.zeros, 7),
    }
    options = {"policy": Stumbling(wrong), **SIXTEEN, "episodes": 6, "workers": 1}
    evaluation = run(tmp_path / "e", **options)
    assert [each.episode for each in evaluation.failed] == [1, 2, 3, 4]
    reasons = ("out of ideas", "SystemExit: 3", "nan", "action in Box")
    for failed, reason in zip(evaluation.failed, reasons, strict=True):
        assert reason in failed.failure
        assert "\n" not in failed.failure
        assert (failed.total_reward, failed.length) == (None, 2)
        with open_trajectory(evaluation.file_of(failed)) as reader:
            assert (reader.facts["complete"], reader.facts["length"]) == (False, 2)
    # What comes after one is not the beginning once more.
    begun = {states_of(evaluation, each)[0].tobytes() for each in evaluation.results}
    assert len(begun) == 6
    failures = [row["failure"] for row in rows_of("results", tmp_path / "e")]
    assert failures == [each.failure or "" for each in evaluation.results]
    [summary] = evaluation.summaries
    assert (summary.failed, summary.episodes) == (4, 2)


def states_of(evaluation, result):
    with open_trajectory(evaluation.file_of(result)) as reader:
        return reader.states(0, reader.row_count)


# The second draws its springs when it is made.
@pytest.mark.parametrize("task", [PENDULUM, "dm_control/lqr-lqr_2_1"])
def test_an_episode_is_the_one_that_a_session_records(tmp_path, task):
    """Bit for bit, whatever ran before it."""
    if task.startswith("dm_control/"):
        pytest.importorskip("dm_control")
    three = {"seed": 4, "episodes": 3, "schedule": "all"}
    session = Session(
        environment=task,
        directory=tmp_path / "session",
        made=EnvironmentOptions(max_steps=5, height=32, width=32),
        monitor=RecorderOptions(workers=0),
        **three,
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


ODD = """
import gymnasium
import mujoco
import numpy as np
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv
from mjrec.environments.episode_seeds import episode_seeds

class Odd(InvertedPendulumEnv):
    def reset(self, *, seed=None, options=None):
        if seed == episode_seeds(0, 1).environment:
            raise OSError("no such pendulum")
        self.is_odd = seed in [episode_seeds(n, 0).environment for n in (0, 1)]
        begun = super().reset(seed=seed)
        self.data.warning[mujoco.mjtWarning.mjWARN_INERTIA].number = 5
        return begun

    def step(self, action):
        if self.is_odd:
            self.is_odd = False
            self.data.qpos[0] = np.inf
        return super().step(action)

gymnasium.register("Odd-v0", Odd)
"""


def test_errors_and_warnings_are_their_episodes_own(tmp_path, monkeypatch, caplog):
    """There is no recording where a reset raises; warnings of before are no news.

    What MuJoCo warns of is said once, and no file of its own is left.
    """
    (tmp_path / "odd_world.py").write_text(ODD)
    monkeypatch.chdir(tmp_path)
    evaluation = run(tmp_path / "e", tasks=["odd_world:Odd-v0"], episodes=3)
    # Of the first episode of each seed.
    assert dict(evaluation.summaries[0].warnings) == {"BADQPOS": 2}
    [failed] = evaluation.failed
    assert failed.failure == "OSError: no such pendulum"
    assert (failed.monitor, failed.episode_id, failed.length) == (None, None, 0)
    assert len([text for text in caplog.messages if text.startswith("MuJoCo")]) == 1
    assert {each.name for each in tmp_path.glob("*.*")} == {"odd_world.py"}


def kill_worker(once=None):
    if once is None or not once.exists():
        if once is not None:
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return np.full(1, 0.01)


def block(path):
    path.mkdir(exist_ok=True)
    return np.full(1, 0.01)


def test_recordings_that_were_left_unfinished_are_finished_later(tmp_path, caplog):
    """By a resumed evaluation, also if no result is missing; no episode is repeated."""
    chunk = tmp_path / "e" / PENDULUM / "seed-005-episode-003"
    blocked = chunk / f"openaigym.trajectories.0.{PENDULUM}-{chunk.name}.h5"
    policy = Stumbling({3: functools.partial(block, blocked)})
    options = {"policy": policy, "seeds": [5], "num_seeds": None, "episodes": 4}
    results = run(tmp_path / "e", **options).results
    assert blocked.name in caplog.text
    assert len(results) == 4
    assert not [*finished_trajectories(chunk)]
    blocked.rmdir()
    assert run(tmp_path / "e", **options, resume=True).results == results
    assert begun(tmp_path / "e") == 4
    assert len([*finished_trajectories(chunk)]) == 1


# Takes more than five seconds: two evaluations, and a worker that starts again.
@parametrize("protocol", ["suite", "seeded"])
def test_a_worker_that_dies_once_costs_nothing(tmp_path, caplog, protocol):
    """Its job is begun again, and the results are as if it had lived.

    A random stream that episodes share goes on where it was.
    """
    kill = functools.partial(kill_worker, tmp_path / "once")
    once = Stumbling({1: functools.partial(raised, RuntimeError()), 3: kill})
    options = {"policy": once, **SIXTEEN, "protocol": protocol}
    died = run(tmp_path / "died", **options)
    assert "A worker died" in caplog.text
    lived = run(tmp_path / "lived", **options)
    assert [each.unit for each in died.failed] == [(5, 1)]
    assert contents(tmp_path / "died") == contents(tmp_path / "lived")
    assert recorded_in(died) == recorded_in(lived)


# Takes more than five seconds: three workers die, one after the other.
@parametrize("workers", [1, 2])
@pytest.mark.parametrize("protocol", ["seeded", "suite"])
def test_an_episode_that_kills_its_workers_fails_alone(tmp_path, workers, protocol):
    """With any number of workers; the others of its chunk are completed."""
    options = {"policy": Stumbling({3: kill_worker}), "protocol": protocol}
    evaluation = run(tmp_path / "e", **options, **SIXTEEN, workers=workers)
    assert [(each.unit, each.failure) for each in evaluation.failed] == [
        ((5, 3), "3 processes died while running it")
    ]
    assert {each.unit for each in evaluation.results} == {(5, n) for n in range(16)}


def test_an_episode_that_hangs_fails_after_its_time(tmp_path):
    """The others are completed."""
    policy = Stumbling({3: functools.partial(time.sleep, 1000)})
    evaluation = run(tmp_path / "e", policy=policy, **SIXTEEN, episode_timeout=2)
    [failed] = evaluation.failed
    assert (failed.unit, failed.failure) == ((5, 3), "it took longer than 2 seconds")


class Slow:
    """A policy that takes its time."""

    def __init__(self, env):
        self.shape = env.action_space.shape

    def __call__(self, observation):
        time.sleep(0.03)
        return np.sin(100 * observation[:1])


def evaluate_slowly(directory, engine, *more):
    """Evaluate so that there is time to kill it: `more` says whether to resume."""
    workers = {"workers": 2}
    if engine:
        workers = {"engine": getattr(mjrec, engine)(2), "workers": None}
    small = {"episodes": 6, "keep": "best", "resume": bool(more)}
    tasks, policy = [PENDULUM, DOUBLE], "test_evaluating:Slow"
    run(Path(directory), tasks=tasks, policy=policy, **small, **workers)


def slow_run(directory, engine="", *more):
    script = "import sys, test_evaluating as t; t.evaluate_slowly(*sys.argv[1:])"
    return subprocess.Popen(
        [sys.executable, "-c", script, directory, engine, *more],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        start_new_session=True,
    )


def ended(directory):
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_bytes().count(b'"evaluation": {') for path in journals)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What it gives when nobody kills it."""
    directory = tmp_path_factory.mktemp("whole") / "e"
    assert slow_run(directory).wait() == 0
    return directory


def drawn_in(directory):
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
def test_a_killed_evaluation_goes_on_where_it_was(whole, tmp_path, moment, engine):
    """SIGKILL of all its processes: the same bytes, and nothing is repeated."""
    killed = tmp_path / "killed"
    process = slow_run(killed, engine)
    if moment == "running":
        wait_until(lambda: ended(killed) >= 5, seconds=60)
    else:
        wait_until((killed / "results.json").exists, seconds=60)
    for pid in (*children(process.pid), process.pid):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()
    assert (killed / "results.json").exists() is (moment == "drawing")
    drawn = drawn_in(killed)
    assert slow_run(killed, engine, "resume").wait() == 0
    assert contents(killed) == contents(whole)
    assert recorded_in(read_results(killed)) == recorded_in(read_results(whole))
    # Each once; those that the two workers were at, once more.
    assert 24 <= begun(killed) <= 26
    assert ended(killed) == 24
    assert len(drawn_in(killed)) == 2
    assert drawn.items() <= drawn_in(killed).items()
    # What the killed ones left came into bundles, and is no log any more.
    kinds = ("openaigym.states.*", "openaigym.trajectory.*")
    assert not [path for kind in kinds for path in killed.rglob(kind)]
    for folder, result in recorded_results(killed):
        name = f"openaigym.trajectory.{result.monitor}.episode{result.episode_id:06d}"
        assert len(mjrec.load_trajectory(folder / f"{name}.h5")) == result.length


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"policy": "zero"}, "policy was 'random' and is now 'zero'"),
        ({"episodes": 1}, "episodes was 2 and is now 1"),
        ({"num_seeds": 1}, r"seeds was \[0, 1\] and is now \[0\]"),
        ({"keep": "all"}, "keep was 'none'"),
        # Though they are the defaults.
        ({"keep": "best,median,worst"}, "keep was 'none' and is now 'best,median"),
        ({"episodes": 10, "keep": None, "protocol": "suite"}, "episodes was 2"),
        ({"env_kwargs": {"reset_noise_scale": 0.1}}, "env_kwargs"),
    ],
)
def test_another_evaluation_is_not_gone_on_with(reference, options, what):
    """The differences are told, and nothing is changed."""
    before = contents(reference)
    with pytest.raises(DifferentEvaluation, match=what):
        run(reference, tasks=[PENDULUM, DOUBLE], resume=True, **options)
    assert contents(reference) == before


def test_a_directory_belongs_to_one_evaluation(reference, tmp_path):
    """It is not begun over another, nor over anything else, nor while one is at it."""
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
def test_what_cannot_be_is_told_before_anything_is_written(
    tmp_path, monkeypatch, options, kind, words
):
    """As the error that it is, with a way out."""
    (tmp_path / "broken_policy.py").write_text("undefined\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(kind, match=words):
        run(tmp_path / "e", **options)
    assert not (tmp_path / "e").exists()


FLAT_WORLD = """
import gymnasium
import numpy as np
from conftest import Corridor

class FlatWorld(Corridor):
    def step(self, action):
        observation, _, *ends = super().step(action)
        return observation, float(action), *ends

    def render(self):
        return self.np_random.integers(255, size=(32, 32, 3), dtype=np.uint8)

gymnasium.register("FlatWorld-v0", FlatWorld)
"""


def test_of_what_is_drawn_live_all_is_recorded_and_the_losers_deleted(
    tmp_path, monkeypatch
):
    """By the rule, as of what is drawn later; each in an environment of its own."""
    (tmp_path / "flat_world.py").write_text(FLAT_WORLD)
    monkeypatch.chdir(tmp_path)
    four = {"num_seeds": 1, "episodes": 4, "keep": "best,worst"}
    live = {"tasks": ["flat_world:FlatWorld-v0"], "height": None, "width": None, **four}
    one = run(tmp_path / "one", **live, workers=1)
    assert one.pending == {}
    assert len(one.videos) == 2
    assert {*(tmp_path / "one").rglob("*.mp4")} == {*one.videos}
    assert listed_in(tmp_path / "one") == {path.name for path in one.videos}
    two = run(tmp_path / "two", **live)
    assert [p.read_bytes() for p in two.videos] == [p.read_bytes() for p in one.videos]
    assert one.plan.tasks[0].folder == "flat_world%3AFlatWorld-v0"


def test_what_cannot_be_drawn_has_results_without_videos(tmp_path, caplog):
    """And one line says why; nothing fails, and nothing stays pending."""
    is_drawn = importlib.util.find_spec("pygame") is not None
    evaluation = run(
        tmp_path / "e", tasks=["CartPole-v1"], keep="best", height=None, width=None
    )
    assert not evaluation.failed
    assert len(evaluation.videos) == is_drawn
    assert not evaluation.pending
    # Nor is any announced.
    assert len(evaluation.selection["CartPole-v1"]) == is_drawn
    assert len(read_results(tmp_path / "e").by_task["CartPole-v1"].videos) == is_drawn
    said = [r.message for r in caplog.records if "will have no videos" in r.message]
    assert len(said) == (not is_drawn)


def test_newly_chosen_videos_are_drawn_from_their_trajectories(tmp_path):
    """After more seeds were asked for; those of before stay."""
    options = {"keep": "median", "tasks": [DOUBLE], "episodes": 1}
    before = run(tmp_path / "e", **options, num_seeds=2)
    [first] = before.videos
    stamps = {path: path.stat().st_mtime_ns for path in before.directory.rglob("*.mp4")}
    for count in range(3, 9):
        after = run(tmp_path / "e", **options, num_seeds=count, resume=True)
        if after.videos != [first]:
            break
    assert after.pending == {}
    [newly] = after.videos
    assert newly != first
    assert all(path.stat().st_mtime_ns == stamps[path] for path in stamps)
    assert newly.name in listed_in(tmp_path / "e")


ROBOT = """
<mujoco><worldbody><body><joint name="j" type="slide"/><geom size=".5"/></body>
</worldbody><actuator><motor joint="j" ctrlrange="-1 1"/></actuator></mujoco>
"""


class Weighted:
    """A policy with a weight."""

    def __init__(self, weight):
        self.weight = weight

    def __call__(self, observation):
        return np.full(1, self.weight)


def test_another_policy_is_not_gone_on_with(tmp_path, monkeypatch):
    """Other weights, other code of a module, another file that an argument names."""
    place = tmp_path / "e"
    run(place, policy=Weighted(0.0), seeds=[0], num_seeds=None)
    options = {"seeds": [0, 1], "num_seeds": None, "resume": True}
    with pytest.raises(DifferentEvaluation, match=r"policy \(its content\) was '\w+"):
        run(place, policy=Weighted(0.9), **options)
    assert len(run(place, policy=Weighted(0.0), **options).results) == 4
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


def test_what_policy_and_file_refer_to_is_compared_too(tmp_path, monkeypatch):
    """A module that the policy imports, and the model that an MJCF file compiles to."""
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
    # Where nothing is left to run, nothing can be mixed.
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


def test_going_on_needs_nothing_but_the_directory(reference, tmp_path):
    """What is to be more is given; what is done is not done again."""
    place = tmp_path / "e"
    run(place, num_seeds=1, episodes=1)
    same = evaluate(directory=place, resume=True, workers=1)
    assert [each.unit for each in same.results] == [(0, 0)]
    more = {"tasks": [PENDULUM, DOUBLE], "num_seeds": 2, "episodes": 2}
    evaluate(**more, directory=place, resume=True, workers=1)
    assert contents(place) == contents(reference)
    (place / "results.json").unlink()
    evaluate(directory=place, resume=True, workers=1)
    assert contents(place) == contents(reference)
    assert begun(place) == 8


def test_going_on_keeps_ranges_and_confidence(tmp_path):
    """Unless others are given; then the rest stays."""
    place, least = tmp_path / "e", {"directory": tmp_path / "e", "workers": 1}
    run(place, score_ranges={PENDULUM: (0, 10)}, confidence=0.8, num_seeds=1)
    before = contents(place)
    evaluate(**least, resume=True)
    assert contents(place) == before
    changed = evaluate(**least, resume=True, confidence=0.9)
    assert changed.bootstrap.confidence == 0.9
    assert changed.summaries[0].score_range == (0, 10)
    ranges = {PENDULUM: (0, 5)}
    changed = evaluate(**least, resume=True, score_ranges=ranges)
    assert changed.bootstrap.confidence == 0.9
    assert changed.summaries[0].score_range == (0, 5)


@pytest.mark.parametrize(("first", "others"), [(30, (60, None)), (None, (60,))])
def test_going_on_with_another_frame_rate_is_refused(tmp_path, first, others):
    """Though it is the default, or none; without one, the first is kept."""
    run(tmp_path / "e", max_fps=first, num_seeds=1, episodes=1)
    for other in others:
        with pytest.raises(DifferentEvaluation, match=f"max_fps was {first}.*{other}"):
            evaluate(directory=tmp_path / "e", max_fps=other, resume=True)
    same = evaluate(directory=tmp_path / "e", resume=True, workers=1)
    assert same.plan.max_fps == first


def test_force_deletes_the_evaluation_that_is_there(tmp_path):
    """And nothing else."""
    run(tmp_path / "e", tasks=[PENDULUM, DOUBLE])
    (tmp_path / "e" / DOUBLE / "notes.txt").touch()
    run(tmp_path / "e", force=True, num_seeds=1)
    assert {path.name for path in (tmp_path / "e" / DOUBLE).iterdir()} == {"notes.txt"}
    assert len(list(read_results(tmp_path / "e"))) == 2


class Counted:
    """Writes down how many threads libraries take, each time that it is built."""

    def __init__(self, env, file):
        with Path(file).open("a") as built:
            built.write(os.environ["OMP_NUM_THREADS"])

    def __call__(self, observation):
        return np.zeros(1)


def test_a_policy_is_built_once_for_each_worker_and_task(tmp_path):
    """Whatever the number of chunks. Results depend on no machine's number of CPUs."""
    counted = {"policy": Counted, "policy_kwargs": {"file": str(tmp_path / "built")}}
    run(tmp_path / "e", **counted, num_seeds=8, workers=1)
    assert (tmp_path / "built").read_text() == "1"


@pytest.mark.dm_control
def test_a_time_limit_of_the_environment_is_part_of_its_scale(tmp_path):
    """A task of 40 steps has returns from 0 to 40."""
    pytest.importorskip("dm_control")
    kwargs = {"task_kwargs": {"time_limit": 1}}
    options = {"num_seeds": 1, "env_kwargs": kwargs, "max_steps": None}
    evaluation = run(tmp_path / "e", tasks=["dm_control/walker-walk"], **options)
    assert [each.score_range for each in evaluation.summaries] == [(0.0, 40.0)]
    assert {each.length for each in evaluation.results} == {40}
