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
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
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
from mjrec.engines.choice import engine_from
from mjrec.evaluation.episode_results import recorded_results
from mjrec.evaluation.evaluating import evaluate
from mjrec.evaluation.evaluation import read_results
from mjrec.evaluation.plan import EvaluationPlan
from mjrec.evaluation.planning import chunks_of
from mjrec.formats.bundle import finished_trajectories
from mjrec.formats.locks import try_lock
from mjrec.formats.video_metadata import metadata_path

PENDULUM = "InvertedPendulum-v5"
DOUBLE = "InvertedDoublePendulum-v5"
SIXTEEN = {"seeds": [5], "num_seeds": None, "episodes": 16}


def run(directory, **options):
    """Evaluate something small."""
    small = {
        "tasks": [PENDULUM],
        "policy": "random",
        "episodes": 2,
        "num_seeds": 2,
        "workers": 2,
        "keep": "none",
        "max_steps": 5,
        "height": 32,
        "width": 32,
    }
    return evaluate(**{**small, **options}, directory=directory)


def contents(directory):
    return {
        name: (directory / name).read_bytes()
        for name in ("results.json", "results.csv")
    }


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
    """In the order of the plan, each with its trajectory, and all read back."""
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


# Takes more than five seconds: 200 episodes.
def test_a_large_evaluation_is_a_few_files(tmp_path):
    """Of 100 seeds with 2 episodes each at most 60; every trajectory is read back."""
    evaluation = run(tmp_path / "e", num_seeds=100, max_steps=2)
    assert sum(path.is_file() for path in evaluation.directory.rglob("*")) <= 60
    for result in evaluation.results[::40]:
        assert len(mjrec.load_trajectory(evaluation.file_of(result))) == 2


def test_what_takes_long_begins_first(reference):
    """Whatever the order of the plan, so that no worker ends long after the others."""
    with (reference / "timing.csv").open(newline="") as file:
        begun_at = {row["task"]: float(row["start"]) for row in csv.DictReader(file)}
    # One of its two pendulums has one joint more.
    assert begun_at[DOUBLE] < begun_at[PENDULUM]


def test_the_chosen_episodes_get_videos(tmp_path):
    """By rule, for each task; table, metadata and report of it agree."""
    evaluation = run(tmp_path / "e", keep="best,worst")
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
        assert (
            hashlib.sha256(path.read_bytes()).hexdigest()
            in metadata_path(path).read_text()
        )


def names_in(directory):
    """Return the names of all files below a directory."""
    return {str(path.relative_to(directory)) for path in directory.rglob("*")}


class Large:
    """A policy that is large, and draws from generators that it was not given."""

    def __init__(self):
        self.weights = np.ones(100 << 20, np.uint8)

    def __call__(self, observation):
        return self.weights[-1] * np.random.uniform(-3, 3, 1) * random.random()


def evaluate_large(directory, **options):
    tasks, policy = [PENDULUM, DOUBLE], Large()
    return run(directory, tasks=tasks, policy=policy, keep="best,worst", **options)


@pytest.fixture(scope="module")
def by_one_worker(tmp_path_factory):
    return evaluate_large(tmp_path_factory.mktemp("one") / "e", workers=1)


@contextlib.contextmanager
def engine_called(kind, place):
    """Have an engine of two workers; nothing of it is left."""
    with contextlib.ExitStack() as stack:
        if kind == "ray":
            from ray_clusters import home_for_ray

            (place / "home").mkdir()
            stack.enter_context(home_for_ray(place / "home"))
            engine = mjrec.RayEngine(2)
        elif kind == "slurm":
            pytest.importorskip("submitit")
            engine = mjrec.SlurmEngine(2, cluster="local")
        elif kind == "dask":
            import distributed

            cluster = distributed.LocalCluster(
                n_workers=2, threads_per_worker=1, dashboard_address=":0"
            )
            scheduler = stack.enter_context(cluster).scheduler_address
            engine = engine_from(f"dask:{scheduler}")
        else:
            engine = mjrec.LocalEngine(5)
        stack.callback(engine.shutdown)
        yield engine


# Takes more than five seconds: evaluations with videos, in workers that start for it.
# Ray's own connections and pipes, of which it says so when they are collected.
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@parametrize("kind", ["two workers", "ray", "slurm", "five workers", "dask"], default=3)
def test_workers_and_engines_change_nothing(by_one_worker, tmp_path, kind):
    """Results, trajectories, videos and names are those of one worker."""
    here = by_one_worker
    if kind == "two workers":
        there = evaluate_large(tmp_path / "e", workers=2)
    else:
        with engine_called(kind, tmp_path) as engine:
            there = evaluate_large(tmp_path / "e", engine=engine, workers=None)
    assert contents(there.directory) == contents(here.directory)
    assert there.pending == here.pending == {}
    assert recorded_in(there) == recorded_in(here)
    assert len(recorded_in(there)) == 8 + len(there.videos) >= 8 + 3
    assert names_in(there.directory) == names_in(here.directory)
    listed = {video for folder in folders_of(there) for video in listed_in(folder)}
    assert listed == {path.name for path in there.videos}


def test_what_mujoco_warns_of_is_said_once(tmp_path, monkeypatch, caplog):
    """In a run, whatever the number of workers; and no file of its own is left."""
    monkeypatch.chdir(tmp_path)
    evaluation = run(tmp_path / "e", env_kwargs={"reset_noise_scale": 1e12})
    assert evaluation.summaries[0].warnings["BADQPOS"] > 1
    assert len([text for text in caplog.messages if text.startswith("MuJoCo")]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["e"]


UNSTABLE = """
<mujoco>
  <worldbody>
    <body><joint name="slide" type="slide"/><geom size="0.1"/></body>
  </worldbody>
  <actuator><motor joint="slide" gear="1e30" ctrllimited="true" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def test_what_a_model_of_ones_own_warns_of_is_counted(tmp_path):
    """As in other environments; and the results say what computed them."""
    (tmp_path / "unstable.xml").write_text(UNSTABLE)
    task = str(tmp_path / "unstable.xml")
    evaluation = run(tmp_path / "e", tasks=[task], num_seeds=1, workers=1)
    assert evaluation.summaries[0].warnings["BADQACC"] > 1
    assert "scipy" in read_results(evaluation.directory).versions


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
    evaluation = run(
        tmp_path / "out",
        tasks=["dm_control/swimmer-swimmer6"],
        engine=Wandering(tmp_path / "homes"),
        workers=None,
        keep="best",
    )
    assert not list(evaluation.directory.rglob("*.model.*.zip"))
    assert len(list(evaluation.directory.rglob("*.mp4"))) == 1
    for path in finished_trajectories(folders_of(evaluation)[0]):
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


@pytest.mark.thorough
def test_without_opengl_videos_stay_pending(tmp_path, monkeypatch, caplog):
    """That is told before the first episode, and at the end how to draw elsewhere."""
    # It needs a display, and there is none.
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.delenv("DISPLAY", raising=False)
    evaluation = run(tmp_path / "e", keep="best")
    assert evaluation.videos == []
    (path,) = evaluation.pending
    assert "Videos cannot be drawn on this machine" in caplog.messages[0]
    assert f"mjrec render {path.parent}" in caplog.text
    columns = read_results(tmp_path / "e").by_task[PENDULUM]
    assert [*columns.videos.values()] == [path.name]
    monkeypatch.undo()
    assert run(tmp_path / "e", keep="best", resume=True).videos == [path]


def folders_of(evaluation):
    return [path for path in evaluation.directory.glob("*/*") if path.is_dir()]


def listed_in(folder):
    manifests = map(json.loads, map(Path.read_text, folder.glob("*.manifest.json")))
    return [video for manifest in manifests for video, _ in manifest["videos"]]


@pytest.mark.thorough
def test_progress_is_told(tmp_path):
    """Up to the end, and never backwards."""
    told = []
    run(tmp_path / "e", keep="best", on_progress=told.append)
    assert [each.done for each in told] == sorted(each.done for each in told)
    assert told[-1].done == told[-1].total == 4
    assert (told[-1].videos_done, told[-1].videos) == (1, 1)
    assert told[-1].failed == 0


def faulty(observation):
    return np.full(1, np.nan if observation[0] > 0 else 0.0)


def test_a_faulty_policy_fails_its_episodes_only(tmp_path):
    """The others go on, and both are in the table."""
    evaluation = run(tmp_path / "e", policy=faulty, episodes=4)
    failed = evaluation.failed
    assert 0 < len(failed) < len(evaluation.results) == 8
    (summary,) = evaluation.summaries
    assert (summary.failed, summary.episodes) == (len(failed), 8 - len(failed))
    with (tmp_path / "e" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [bool(row["failure"]) for row in rows] == [
        each.failure is not None for each in evaluation.results
    ]
    assert all("nan" in str(each.failure).lower() for each in failed)


class Odd:
    """Does something in episode 3 of seed 5."""

    def __init__(self, do):
        self.do = do

    def reset(self, seed):
        self.is_odd = seed == 580206707

    def __call__(self, observation):
        if self.is_odd:
            self.do()
        return np.zeros(1)


def kill_worker(once=None):
    if once is None or not once.exists():
        if once is not None:
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.thorough
def test_a_worker_that_dies_once_costs_nothing(tmp_path, caplog):
    """Its job is begun again, and the results are as if it had lived."""
    once = Odd(functools.partial(kill_worker, tmp_path / "once"))
    died = run(tmp_path / "died", policy=once, **SIXTEEN, keep="best")
    assert "A worker died" in caplog.text
    lived = run(tmp_path / "lived", policy=once, **SIXTEEN, keep="best")
    assert died.failed == []
    assert contents(tmp_path / "died") == contents(tmp_path / "lived")
    assert len(died.videos) == len(lived.videos) == 1


# Takes more than five seconds: three workers die, one after the other.
@parametrize("workers", [1, 2])
@pytest.mark.parametrize("protocol", ["seeded", "suite"])
def test_an_episode_that_kills_its_workers_fails_alone(tmp_path, workers, protocol):
    """With any number of workers; the others of its chunk are completed."""
    options = {"policy": Odd(kill_worker), "protocol": protocol}
    evaluation = run(tmp_path / "e", **options, **SIXTEEN, workers=workers)
    assert [(each.unit, each.failure) for each in evaluation.failed] == [
        ((5, 3), "3 processes died while running it")
    ]
    assert {each.unit for each in evaluation.results} == {(5, n) for n in range(16)}


def test_an_episode_that_hangs_fails_after_its_time(tmp_path):
    """The others are completed."""
    policy = Odd(functools.partial(time.sleep, 1000))
    evaluation = run(tmp_path / "e", policy=policy, **SIXTEEN, episode_timeout=2)
    [failed] = evaluation.failed
    assert (failed.unit, failed.failure) == ((5, 3), "it took longer than 2 seconds")


SCRIPT = """
import sys
from pathlib import Path
import mjrec, test_evaluating
engine = {engine}
test_evaluating.run(
    Path(sys.argv[1]), tasks=[test_evaluating.PENDULUM, test_evaluating.DOUBLE],
    policy="slow_policy:Slow", episodes=6, keep="best", resume="resume" in sys.argv,
    workers=None if engine else 2, engine=engine,
)
"""
SLOW = """
import time
import numpy as np

class Slow:
    def __init__(self, env):
        self.shape = env.action_space.shape
    def __call__(self, observation):
        time.sleep(0.03)
        return np.sin(100 * observation[:1])
"""


def slow_run(directory, *arguments, engine=None):
    (directory.parent / "slow_policy.py").write_text(SLOW)
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT.format(engine=engine), directory, *arguments],
        cwd=directory.parent,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        start_new_session=True,
    )


def ended(directory):
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_bytes().count(b'"evaluation": {') for path in journals)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What the script gives when nobody kills it."""
    directory = tmp_path_factory.mktemp("whole") / "e"
    assert slow_run(directory).wait() == 0
    return directory


def drawn_in(directory):
    return {path: path.stat().st_mtime_ns for path in directory.glob("*/*/*.mp4")}


# Takes more than five seconds: three evaluations, one of them killed.
@parametrize(
    ("moment", "engine"),
    [
        ("drawing", None),
        ("running", None),
        ("running", "mjrec.LocalEngine(2)"),
        ("drawing", "mjrec.LocalEngine(2)"),
        ("running", "mjrec.RayEngine(2)"),
    ],
)
def test_a_killed_evaluation_goes_on_where_it_was(whole, tmp_path, moment, engine):
    """SIGKILL of all its processes: the same bytes, and nothing is repeated."""
    killed = tmp_path / "killed"
    process = slow_run(killed, engine=engine)
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
    assert slow_run(killed, "resume", engine=engine).wait() == 0
    assert contents(killed) == contents(whole)
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
        ({"max_steps": 6}, "max_steps was 5"),
        ({"episodes": 1}, "episodes was 2 and is now 1"),
        ({"num_seeds": 1}, r"seeds was \[0, 1\] and is now \[0\]"),
        ({"keep": "all"}, "keep was 'none'"),
        # Though they are the defaults.
        ({"keep": "best,median,worst"}, "keep was 'none' and is now 'best,median"),
        ({"episodes": 10, "keep": None, "protocol": "suite"}, "episodes was 2"),
        ({"protocol": "suite"}, "protocol"),
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
    ({"episodes": 0}, InvalidArgument, "episodes"),
    ({"seeds": [1, 1], "num_seeds": None}, InvalidArgument, "duplicates"),
    ({"seeds": [-1], "num_seeds": None}, InvalidArgument, "seed"),
    ({"seeds": [1], "num_seeds": 2}, InvalidArgument, "one of them"),
    ({"workers": 0}, InvalidArgument, "workers"),
    ({"engine": "spark"}, UnknownName, "slurm"),
    ({"engine": 3, "workers": None}, InvalidArgument, "LocalEngine"),
    ({"engine": mjrec.LocalEngine(1)}, InvalidArgument, "its own workers"),
    ({"keep": "bset"}, UnknownName, "best:N"),
    ({"protocol": "seed"}, UnknownName, "suite"),
    ({"quality": "low"}, UnknownName, "draft"),
    ({"height": 0}, InvalidArgument, "height"),
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

class FlatWorld(gymnasium.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    observation_space = gymnasium.spaces.Box(0, 1, (1,))
    action_space = gymnasium.spaces.Discrete(2)
    render_mode = "rgb_array"

    def __init__(self, render_mode=None):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), float(action), False, False, {}

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
    live = {
        "tasks": ["flat_world:FlatWorld-v0"],
        "height": None,
        "width": None,
        "num_seeds": 1,
        "episodes": 4,
        "keep": "best,worst",
    }
    one = run(tmp_path / "one", **live, workers=1)
    assert one.pending == {}
    assert len(one.videos) == 2
    assert {*(tmp_path / "one").rglob("*.mp4")} == {*one.videos}
    listed = {video for folder in folders_of(one) for video in listed_in(folder)}
    assert listed == {path.name for path in one.videos}
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
    assert any(newly.name in listed_in(folder) for folder in folders_of(after))


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


def test_force_deletes_the_evaluation_that_is_there(tmp_path):
    """And nothing else."""
    run(tmp_path / "e", tasks=[PENDULUM, DOUBLE])
    (tmp_path / "e" / DOUBLE / "notes.txt").touch()
    run(tmp_path / "e", force=True, num_seeds=1)
    assert {path.name for path in (tmp_path / "e" / DOUBLE).iterdir()} == {"notes.txt"}
    assert len(list(read_results(tmp_path / "e"))) == 2


class Counted:
    """Writes down each time that it is built."""

    def __init__(self, env, place):
        self.shape = env.action_space.shape
        (Path(place) / f"{os.getpid()}-{random.random()}").touch()

    def __call__(self, observation):
        return np.zeros(self.shape)


def test_a_policy_is_built_once_for_each_worker_and_task(tmp_path):
    """Whatever the number of chunks."""
    (tmp_path / "built").mkdir()
    counted = {"policy": Counted, "num_seeds": 8}
    run(
        tmp_path / "e",
        **counted,
        policy_kwargs={"place": str(tmp_path / "built")},
        workers=1,
    )
    assert len(list((tmp_path / "built").iterdir())) == 1


@pytest.mark.dm_control
def test_a_time_limit_of_the_environment_is_part_of_its_scale(tmp_path):
    """A task of 40 steps has returns from 0 to 40."""
    pytest.importorskip("dm_control")
    kwargs = {"task_kwargs": {"time_limit": 1}}
    options = {"num_seeds": 1, "env_kwargs": kwargs, "max_steps": None}
    evaluation = run(tmp_path / "e", tasks=["dm_control/walker-walk"], **options)
    assert [each.score_range for each in evaluation.summaries] == [(0.0, 40.0)]
    assert {each.length for each in evaluation.results} == {40}


@pytest.mark.parametrize(
    ("seeds", "episodes", "protocol", "names"),
    [
        (range(100), 2, "seeded", ["seeds-000-011", "seeds-096-099"]),
        ([3], 1, "seeded", ["seed-003", "seed-003"]),
        ([1], 16, "seeded", ["seed-001-episodes-000-001", "seed-001-episodes-014-015"]),
        ([1], 60, "suite", ["seed-001", "seed-001"]),
    ],
)
def test_chunks_follow_from_the_plan(seeds, episodes, protocol, names):
    """Consecutive seeds, or a part of one, each episode once; they grow by new ones."""
    plan = EvaluationPlan(
        tasks=(), policy="x", seeds=tuple(seeds), episodes=episodes, protocol=protocol
    )
    chunks = chunks_of(plan, ())
    assert [chunks[0].folder, chunks[-1].folder] == names
    assert sorted(unit for chunk in chunks for unit in chunk) == sorted(plan)
    assert max(map(len, chunks)) <= (25 if protocol == "seeded" else 60)
    more = replace(plan, seeds=(*plan.seeds, 1000), episodes=episodes + 2)
    grown = chunks_of(more, chunks)
    assert grown[: len(chunks)] == chunks
    assert sorted(unit for chunk in grown for unit in chunk) == sorted(more)
    assert len({chunk.folder for chunk in grown}) == len(grown)
