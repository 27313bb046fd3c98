# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
import csv
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
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evaluated_files import recorded_in
from parts import parametrize
from waiting import wait_until

import mjrec
from mjrec import (
    DifferentEvaluation,
    DirectoryInUse,
    InvalidArgument,
    PolicyError,
    UnknownName,
)
from mjrec.evaluation.chunk_results import recorded_results
from mjrec.evaluation.evaluating import evaluate
from mjrec.evaluation.evaluation import Evaluation, read_results
from mjrec.evaluation.following import EvaluationProgress
from mjrec.evaluation.plan import EvaluationPlan
from mjrec.evaluation.planning import chunks_of
from mjrec.formats.bundle import finished_trajectories
from mjrec.formats.locks import try_lock
from mjrec.formats.video_metadata import metadata_path

PENDULUM = "InvertedPendulum-v5"
DOUBLE = "InvertedDoublePendulum-v5"
SIXTEEN: dict[str, Any] = {"seeds": [5], "num_seeds": None, "episodes": 16}


def run(directory: Path, **options: Any) -> Evaluation:
    """Evaluate something small."""
    small: dict[str, Any] = {
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


def contents(directory: Path) -> dict[str, bytes]:
    return {
        name: (directory / name).read_bytes()
        for name in ("results.json", "results.csv")
    }


def begun(directory: Path) -> int:
    """Return how many episodes were begun in all, by the journals."""
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_text().count('{"begun"') for path in journals)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An evaluation by one worker, without videos."""
    directory = tmp_path_factory.mktemp("evaluations") / "reference"
    run(directory, tasks=[PENDULUM, DOUBLE], workers=1)
    return directory


def test_every_episode_of_every_task_and_seed_is_there(reference: Path) -> None:
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


def test_results_do_not_depend_on_the_workers(reference: Path, tmp_path: Path) -> None:
    """Byte for byte, and neither does the choice."""
    run(tmp_path / "two", tasks=[PENDULUM, DOUBLE], workers=2)
    assert contents(tmp_path / "two") == contents(reference)


# Takes more than five seconds: 200 episodes.
def test_a_large_evaluation_is_a_few_files(tmp_path: Path) -> None:
    """Of 100 seeds with 2 episodes each at most 60; every trajectory is read back."""
    evaluation = run(tmp_path / "e", num_seeds=100, max_steps=2)
    assert sum(path.is_file() for path in evaluation.directory.rglob("*")) <= 60
    for result in evaluation.results[::40]:
        path = evaluation.file_of(result)
        assert path is not None
        assert len(mjrec.load_trajectory(path)) == 2


@pytest.mark.thorough
def test_policies_that_draw_for_themselves_are_seeded(tmp_path: Path) -> None:
    """Also from generators that nobody has given them, whatever ran before."""

    def wander(_: Any) -> Any:
        return np.random.uniform(-1, 1, 1) * random.random()

    for workers in (1, 2):
        run(tmp_path / str(workers), policy=wander, workers=workers)
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_what_takes_long_begins_first(reference: Path) -> None:
    """Whatever the order of the plan, so that no worker ends long after the others."""
    with (reference / "timing.csv").open(newline="") as file:
        begun_at = {row["task"]: float(row["start"]) for row in csv.DictReader(file)}
    # One of its two pendulums has one joint more.
    assert begun_at[DOUBLE] < begun_at[PENDULUM]


def test_the_chosen_episodes_get_videos(tmp_path: Path) -> None:
    """By rule, for each task; table, metadata and report of it agree."""
    evaluation = run(tmp_path / "e", keep="best,worst")
    read = read_results(tmp_path / "e")
    columns = read.columns[PENDULUM]
    returns = columns.total_reward.tolist()
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


def names_in(directory: Path) -> set[str]:
    """Return the names of all files below a directory."""
    return {str(path.relative_to(directory)) for path in directory.rglob("*")}


# Takes more than five seconds: two evaluations with videos.
@parametrize("engine", ["local", mjrec.LocalEngine(5)])
def test_workers_and_engines_change_nothing(tmp_path: Path, engine: Any) -> None:
    """Results, trajectories and videos are those of one worker."""
    options: dict[str, Any] = {"tasks": [PENDULUM, DOUBLE], "keep": "best,worst"}
    workers = 2 if engine == "local" else None
    there = run(tmp_path / "there", **options, engine=engine, workers=workers)
    here = run(tmp_path / "here", **options, workers=1)
    assert contents(there.directory) == contents(here.directory)
    assert there.pending == here.pending == {}
    assert recorded_in(there) == recorded_in(here)
    assert len(recorded_in(there)) == 8 + 4
    assert names_in(there.directory) == names_in(here.directory)
    listed = {video for folder in folders_of(there) for video in listed_in(folder)}
    assert listed == {path.name for path in there.videos}


def test_what_mujoco_warns_of_is_said_once(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
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


def test_what_a_model_of_ones_own_warns_of_is_counted(tmp_path: Path) -> None:
    """As in other environments; and the results say what computed them."""
    (tmp_path / "unstable.xml").write_text(UNSTABLE)
    task = str(tmp_path / "unstable.xml")
    evaluation = run(tmp_path / "e", tasks=[task], num_seeds=1, workers=1)
    assert evaluation.summaries[0].warnings["BADQACC"] > 1
    assert "scipy" in read_results(evaluation.directory).versions


@pytest.mark.thorough
def test_a_dask_cluster_changes_nothing(tmp_path: Path) -> None:
    """Results, trajectories and videos are those of one worker here."""
    import distributed

    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0"
    ) as cluster:
        address = f"dask:{cluster.scheduler_address}"
        there = run(tmp_path / "there", keep="best", engine=address, workers=None)
    here = run(tmp_path / "here", keep="best", workers=1)
    assert contents(there.directory) == contents(here.directory)
    assert recorded_in(there) == recorded_in(here)
    assert len(recorded_in(there)) == 4 + 1


class Wandering(Executor):
    """An executor whose worker does each job as on a machine with another home.

    Args:
        homes: where these are.
    """

    def __init__(self, homes: Path) -> None:
        self.homes = homes
        self.workers: dict[str, Any] = {}

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        place, job = json.loads(json.dumps(args))
        if place not in self.workers:
            work = json.loads(Path(place, "work.json").read_bytes())
            module, _, name = work["entry"].partition(":")
            make = getattr(importlib.import_module(module), name)
            self.workers[place] = make(work["settings"])
        future: Future[Any] = Future()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_STATE_HOME", str(self.homes / job["key"]))
            future.set_result({"value": self.workers[place](job["arguments"])})
        return future


@pytest.mark.dm_control
def test_machines_with_other_homes_draw_what_others_recorded(tmp_path: Path) -> None:
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


def folders_of(evaluation: Evaluation) -> list[Path]:
    return [path for path in evaluation.directory.glob("*/*") if path.is_dir()]


def listed_in(folder: Path) -> list[str]:
    manifests = map(json.loads, map(Path.read_text, folder.glob("*.manifest.json")))
    return [video for manifest in manifests for video, _ in manifest["videos"]]


@pytest.mark.thorough
def test_videos_do_not_depend_on_what_was_run_before(tmp_path: Path) -> None:
    """The camera is placed anew in each episode, not once for an environment."""
    options: dict[str, Any] = {
        "tasks": ["Reacher-v5"],
        # By one worker in batches of two, by three in batches of one.
        "episodes": 8,
        "num_seeds": 1,
        "keep": "all",
        "max_steps": 12,
    }
    one = run(tmp_path / "one", **options, workers=1)
    three = run(tmp_path / "three", **options, workers=3)
    run(tmp_path / "parts", **{**options, "episodes": 3}, workers=1)
    parts = run(tmp_path / "parts", **options, workers=1, resume=True)
    videos = [videos_in(each) for each in (one, three, parts)]
    assert len(videos[0]) == 8
    assert videos[0] == videos[1] == videos[2]


def videos_in(evaluation: Evaluation) -> dict[str, bytes]:
    """Return the videos by episode."""
    with (evaluation.directory / "timing.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    videos = {
        r["episode"]: evaluation.directory / r["folder"] / r["video"] for r in rows
    }
    return {episode: path.read_bytes() for episode, path in videos.items()}


@pytest.mark.thorough
def test_results_are_there_before_an_engine_has_drawn(tmp_path: Path) -> None:
    """What is killed or cancelled then has only videos left."""

    def interrupt(progress: EvaluationProgress) -> None:
        if progress.videos_done:
            raise KeyboardInterrupt

    options: dict[str, Any] = {"keep": "all", "workers": None}
    options["engine"] = mjrec.LocalEngine(1)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "e", **options, on_progress=interrupt)
    before = contents(tmp_path / "e")
    drawn = list(tmp_path.glob("e/*/*/*.mp4"))
    assert 1 <= len(drawn) < 4
    stamps = [path.stat().st_mtime_ns for path in drawn]
    evaluation = run(tmp_path / "e", **options, resume=True)
    assert contents(tmp_path / "e") == before
    assert len(evaluation.videos) == 4
    assert [path.stat().st_mtime_ns for path in drawn] == stamps
    assert begun(tmp_path / "e") == 4


@pytest.mark.thorough
@pytest.mark.parametrize("name", [".mjrec.work", ".mjrec.evaluation.lock"])
def test_what_an_engine_keeps_in_a_directory_is_nobodys(
    tmp_path: Path, name: str
) -> None:
    """It may be there before the evaluation is, and disturbs no reader."""
    place = tmp_path / "e" / name
    if name.endswith("lock"):
        place.parent.mkdir()
        place.touch()
    else:
        place.mkdir(parents=True)
        (place / "job.json").touch()
    evaluation = run(tmp_path / "e", keep="best")
    assert evaluation.pending == {}
    assert len(list(read_results(tmp_path / "e"))) == 4
    assert len(run(tmp_path / "e", keep="best", resume=True).results) == 4


@pytest.mark.thorough
@pytest.mark.parametrize("engine", [None, "local"])
def test_without_opengl_videos_stay_pending(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    engine: str | None,
) -> None:
    """The results are there, and how to draw the videos elsewhere is told."""
    # It needs a display, and there is none.
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.delenv("DISPLAY", raising=False)
    evaluation = run(tmp_path / "e", keep="best", engine=engine)
    assert evaluation.videos == []
    (path,) = evaluation.pending
    assert f"mjrec render {path.parent}" in caplog.text
    if engine is None:
        # Before the first episode.
        assert "No video can be drawn here" in caplog.messages[0]
    columns = read_results(tmp_path / "e").columns[PENDULUM]
    assert [*columns.videos.values()] == [path.name]
    monkeypatch.undo()
    # Whoever goes on draws what is left.
    again = run(tmp_path / "e", keep="best", resume=True, engine=engine)
    assert again.videos == [path]


@pytest.mark.thorough
def test_progress_is_told(tmp_path: Path) -> None:
    """Up to the end, and never backwards."""
    told: list[EvaluationProgress] = []
    run(tmp_path / "e", keep="best", on_progress=told.append)
    assert [each.done for each in told] == sorted(each.done for each in told)
    assert told[-1].done == told[-1].total == 4
    assert (told[-1].videos_done, told[-1].videos) == (1, 1)
    assert told[-1].failed == 0


def raising(observation: Any) -> Any:
    raise RuntimeError("out of ideas")


class Faulty:
    """Fails in its own way in episodes that begin to the right."""

    def __init__(self, env: Any) -> None:
        self.shape = env.action_space.shape

    def __call__(self, observation: Any) -> Any:
        if observation[0] > 0:
            return np.full(self.shape, np.nan)
        return np.zeros(self.shape)


class Misshapen(Faulty):
    def __call__(self, observation: Any) -> Any:
        return np.zeros(self.shape if observation[0] > 0 else (7,))


def local(kind: Any) -> Any:
    """Return a class or function that is not found by its name, but sent whole."""
    kind.__module__ = "__main__"
    return kind


@parametrize(
    ("policy", "reason"),
    [(Faulty, "nan"), (Misshapen, "must give an action of box(-3.0")],
)
def test_a_faulty_policy_fails_its_episodes_only(
    tmp_path: Path, policy: Any, reason: str
) -> None:
    """The others go on, and both are in the table."""
    evaluation = run(tmp_path / "e", policy=local(policy), episodes=4)
    failed = evaluation.failed
    assert 0 < len(failed) < len(evaluation.results) == 8
    (summary,) = evaluation.summaries
    assert (summary.failed, summary.episodes) == (len(failed), 8 - len(failed))
    with (tmp_path / "e" / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [bool(row["failure"]) for row in rows] == [
        each.failure is not None for each in evaluation.results
    ]
    assert all(reason in str(each.failure).lower() for each in failed)


class DiesOnce:
    """Kills its worker, the first time that anybody builds it twice."""

    def __init__(self, env: Any) -> None:
        self.shape = env.action_space.shape

    def __call__(self, observation: Any) -> Any:
        import os
        import pathlib

        mark = pathlib.Path(os.environ["MJREC_TEST_MARK"])
        if not mark.exists():
            mark.touch()
            os.kill(os.getpid(), 9)
        return np.zeros(self.shape)


class DiesAlways:
    """Kills its worker in episode 3 of seed 5."""

    def __init__(self, env: Any) -> None:
        self.shape = env.action_space.shape
        self.seed = 0

    def reset(self, seed: int) -> None:
        self.seed = seed

    def __call__(self, observation: Any) -> Any:
        if self.seed == 580206707:
            self.end()
        return np.zeros(self.shape)

    def end(self) -> None:
        import os

        os.kill(os.getpid(), 9)


class Hangs(DiesAlways):
    def end(self) -> None:
        import time

        time.sleep(1000)


@pytest.mark.thorough
def test_a_worker_that_dies_once_costs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Its job is begun again, and the results are as if it had lived."""
    monkeypatch.setenv("MJREC_TEST_MARK", str(tmp_path / "mark"))
    died = run(tmp_path / "died", policy=local(DiesOnce), keep="best")
    assert "A worker died" in caplog.text
    lived = run(tmp_path / "lived", policy=local(DiesOnce), keep="best")
    assert died.failed == []
    assert contents(tmp_path / "died") == contents(tmp_path / "lived")
    assert len(died.videos) == len(lived.videos) == 1


# Takes more than five seconds: three workers die, one after the other.
@parametrize("workers", [1, 2])
@pytest.mark.parametrize("protocol", ["seeded", "suite"])
def test_an_episode_that_kills_its_workers_fails_alone(
    tmp_path: Path, workers: int, protocol: str
) -> None:
    """With any number of workers; the others of its chunk are completed."""
    options: dict[str, Any] = {"policy": local(DiesAlways), "protocol": protocol}
    evaluation = run(tmp_path / "e", **options, **SIXTEEN, workers=workers)
    assert [(each.unit, each.failure) for each in evaluation.failed] == [
        ((5, 3), "3 processes died in it")
    ]
    assert {each.unit for each in evaluation.results} == {(5, n) for n in range(16)}


def test_an_episode_that_hangs_fails_after_its_time(tmp_path: Path) -> None:
    """The others are completed."""
    evaluation = run(tmp_path / "e", policy=local(Hangs), **SIXTEEN, episode_timeout=2)
    [failed] = evaluation.failed
    assert (failed.unit, failed.failure) == ((5, 3), "it took longer than 2 seconds")


SCRIPT = """
import sys
from pathlib import Path
import test_evaluating
test_evaluating.run(
    Path(sys.argv[1]), tasks=[test_evaluating.PENDULUM, test_evaluating.DOUBLE],
    policy="slow_policy:Slow", episodes=6, keep="best", resume="resume" in sys.argv,
    workers=int(sys.argv[2]), engine="local" if "engine" in sys.argv else None,
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


def slow_run(place: Path, name: str, *arguments: str) -> subprocess.Popen[bytes]:
    (place / "slow_policy.py").write_text(SLOW)
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(place / name), *arguments],
        cwd=place,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        start_new_session=True,
    )


def ended(directory: Path) -> int:
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_bytes().count(b'"evaluation": {') for path in journals)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the script gives when nobody kills it."""
    place = tmp_path_factory.mktemp("whole")
    assert slow_run(place, "whole", "1").wait() == 0
    return place / "whole"


def kill_with_workers(process: subprocess.Popen[bytes]) -> None:
    tasks = Path(f"/proc/{process.pid}/task").glob("*/children")
    workers = [int(pid) for path in tasks for pid in path.read_text().split()]
    for pid in (process.pid, *workers):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()


# Takes more than five seconds: three evaluations, one of them killed.
@parametrize(
    ("moment", "engine"),
    [
        ("drawing", ()),
        ("running", ()),
        ("running", ("engine",)),
        ("drawing", ("engine",)),
    ],
)
def test_a_killed_evaluation_goes_on_where_it_was(
    whole: Path, tmp_path: Path, moment: str, engine: tuple[str, ...]
) -> None:
    """SIGKILL of all its processes: the same bytes, and nothing is repeated."""
    killed = tmp_path / "killed"
    process = slow_run(tmp_path, "killed", "2", *engine)
    if moment == "running":
        wait_until(lambda: ended(killed) >= 5, seconds=60)
    else:
        wait_until((killed / "results.json").exists, seconds=60)
    kill_with_workers(process)
    assert (killed / "results.json").exists() is (moment == "drawing")
    assert slow_run(tmp_path, "killed", "2", "resume", *engine).wait() == 0
    assert contents(killed) == contents(whole)
    # Each once; those that the two workers were at, once more.
    assert 24 <= begun(killed) <= 26
    assert ended(killed) == 24
    assert len(list(killed.glob("*/*/*.mp4"))) == 2
    # What the killed ones left came into bundles, and is no log any more.
    kinds = ("openaigym.states.*", "openaigym.trajectory.*")
    assert not [path for kind in kinds for path in killed.rglob(kind)]
    for folder, result in recorded_results(killed):
        name = f"openaigym.trajectory.{result.monitor}.episode{result.episode_id:06d}"
        assert len(mjrec.load_trajectory(folder / f"{name}.h5")) == result.length


@pytest.mark.thorough
def test_what_is_interrupted_stays_to_be_resumed(tmp_path: Path) -> None:
    """Ctrl-C, or what else is raised, ends the workers and comes out."""

    def interrupt(progress: EvaluationProgress) -> None:
        if progress.done >= 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "e", episodes=30, on_progress=interrupt)
    before = ended(tmp_path / "e")
    assert 2 <= before < 60
    assert len(run(tmp_path / "e", episodes=30, resume=True).results) == 60
    assert ended(tmp_path / "e") == 60


@pytest.mark.thorough
def test_more_may_be_asked_for(reference: Path, tmp_path: Path) -> None:
    """More tasks, seeds and episodes; what was done is not done again."""
    run(tmp_path / "e", episodes=1)
    run(tmp_path / "e", tasks=[PENDULUM, DOUBLE], resume=True)
    assert begun(tmp_path / "e") == 8
    assert contents(tmp_path / "e") == contents(reference)


@pytest.mark.thorough
def test_nothing_is_run_when_all_is_done(reference: Path, tmp_path: Path) -> None:
    """The results are written again, the same."""
    run(tmp_path / "e", tasks=[PENDULUM, DOUBLE], resume=True)
    before = contents(tmp_path / "e")
    (tmp_path / "e" / "results.json").unlink()
    run(tmp_path / "e", tasks=[PENDULUM, DOUBLE], resume=True)
    assert contents(tmp_path / "e") == before == contents(reference)
    assert begun(tmp_path / "e") == 8


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"policy": "zero"}, "policy was 'random' and is now 'zero'"),
        ({"max_steps": 6}, "max_steps was 5"),
        ({"episodes": 1}, "episodes was 2 and is now 1"),
        ({"num_seeds": 1}, r"seeds was \(0, 1\) and is now \(0,\)"),
        ({"keep": "all"}, "keep was 'none'"),
        # Though they are the defaults.
        ({"keep": "best,median,worst"}, "keep was 'none' and is now 'best,median"),
        ({"episodes": 10, "keep": None, "protocol": "suite"}, "episodes was 2"),
        ({"protocol": "suite"}, "protocol"),
        ({"env_kwargs": {"reset_noise_scale": 0.1}}, "env_kwargs"),
    ],
)
def test_another_evaluation_is_not_gone_on_with(
    reference: Path, options: Mapping[str, Any], what: str
) -> None:
    """The differences are told, and nothing is changed."""
    before = contents(reference)
    with pytest.raises(DifferentEvaluation, match=what):
        run(reference, tasks=[PENDULUM, DOUBLE], resume=True, **options)
    assert contents(reference) == before


def test_a_directory_belongs_to_one_evaluation(reference: Path, tmp_path: Path) -> None:
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


WRONG: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"tasks": ["HalfChetah-v5"]}, UnknownName, "HalfCheetah-v5"),
    ({"tasks": ["dm_control:bench"]}, UnknownName, "dm_control:benchmarking"),
    ({"tasks": []}, InvalidArgument, "needs a task"),
    ({"policy": "no_such_module:x"}, UnknownName, "no_such_module"),
    ({"policy": "broken_policy:x"}, PolicyError, "name 'undefined' is not defined"),
    ({"policy": 3}, PolicyError, "neither can be called"),
    ({"policy": lambda o, f=sys.stdout: f}, PolicyError, "module:name"),
    ({"episodes": 0}, InvalidArgument, "episodes"),
    ({"seeds": [1, 1], "num_seeds": None}, InvalidArgument, "each once"),
    ({"seeds": [-1], "num_seeds": None}, InvalidArgument, "seed"),
    ({"seeds": [1], "num_seeds": 2}, InvalidArgument, "one of them"),
    ({"workers": 0}, InvalidArgument, "workers"),
    ({"engine": "spark"}, UnknownName, "slurm"),
    ({"engine": 3, "workers": None}, InvalidArgument, "LocalEngine"),
    ({"engine": mjrec.LocalEngine(1)}, InvalidArgument, "of its own"),
    ({"keep": "bset"}, UnknownName, "best:N"),
    ({"protocol": "seed"}, UnknownName, "suite"),
    ({"quality": "low"}, UnknownName, "draft"),
    ({"height": 0}, InvalidArgument, "height"),
    ({"max_fps": -1}, InvalidArgument, "max_fps"),
    ({"env_kwargs": {"f": print}}, InvalidArgument, "JSON.* 'f' "),
    ({"env_kwargs": {"a": 1, "f": [math.nan]}}, InvalidArgument, "'f'.*nan"),
    ({"env_kwargs": {"f": {1: 0, "1": 2}}}, InvalidArgument, "'f'.*'1' is there twice"),
    ({"env_kwargs": {"no_such": 1}}, mjrec.EnvironmentNotMade, "no_such"),
    ({"score_ranges": {"Ant-v5": (0, 1)}}, UnknownName, PENDULUM),
    ({"score_ranges": {PENDULUM: (1, 1)}}, InvalidArgument, "higher"),
]


@pytest.mark.parametrize(("options", "kind", "words"), WRONG)
def test_what_cannot_be_is_told_before_anything_is_written(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: dict[str, Any],
    kind: type[Exception],
    words: str,
) -> None:
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the rule, as of what is drawn later; each in an environment of its own."""
    (tmp_path / "flat_world.py").write_text(FLAT_WORLD)
    monkeypatch.chdir(tmp_path)
    live: dict[str, Any] = {
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


def test_what_cannot_be_drawn_has_results_without_videos(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
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
    assert len(read_results(tmp_path / "e").columns["CartPole-v1"].videos) == is_drawn
    said = [r.message for r in caplog.records if "no videos, only results" in r.message]
    assert len(said) == (not is_drawn)


def test_newly_chosen_videos_are_drawn_from_their_trajectories(tmp_path: Path) -> None:
    """After more seeds were asked for; those of before stay."""
    options: dict[str, Any] = {"keep": "median", "tasks": [DOUBLE], "episodes": 1}
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

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def __call__(self, observation: Any) -> Any:
        return np.full(1, self.weight)


def test_another_policy_is_not_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other weights, other code of a module, another file that an argument names."""
    place = tmp_path / "e"
    run(place, policy=Weighted(0.0), seeds=[0], num_seeds=None)
    options: dict[str, Any] = {"seeds": [0, 1], "num_seeds": None, "resume": True}
    with pytest.raises(DifferentEvaluation, match=r"policy \(its content\) was '\w+"):
        run(place, policy=Weighted(0.9), **options)
    assert len(run(place, policy=Weighted(0.0), **options).results) == 4
    monkeypatch.chdir(tmp_path)
    module, weights = tmp_path / "own_policy.py", tmp_path / "weights.bin"
    module.write_text("def make(env, weights):\n    return lambda o: [0.0]\n")
    weights.write_bytes(b"1")
    named: dict[str, Any] = {
        "policy": "own_policy:make()",
        "policy_kwargs": {"weights": str(weights)},
    }
    run(tmp_path / "named", **named)
    module.write_text("def make(env, weights):\n    return lambda o: [1.0]\n")
    weights.write_bytes(b"2")
    with pytest.raises(
        DifferentEvaluation, match=r"\(its code\).*its argument weights\)"
    ):
        run(tmp_path / "named", **named, resume=True)


def test_going_on_needs_nothing_but_the_directory(
    reference: Path, tmp_path: Path
) -> None:
    """The plan says the rest; what is to be more is given."""
    run(tmp_path / "e", num_seeds=1)
    same = evaluate(directory=tmp_path / "e", resume=True, workers=1)
    assert [each.unit for each in same.results] == [(0, 0), (0, 1)]
    evaluate(
        [PENDULUM, DOUBLE],
        directory=tmp_path / "e",
        resume=True,
        num_seeds=2,
        workers=1,
    )
    assert contents(tmp_path / "e") == contents(reference)


def test_force_deletes_the_evaluation_that_is_there(tmp_path: Path) -> None:
    """And nothing else."""
    run(tmp_path / "e", tasks=[PENDULUM, DOUBLE])
    (tmp_path / "e" / DOUBLE / "notes.txt").touch()
    run(tmp_path / "e", force=True, num_seeds=1)
    assert {path.name for path in (tmp_path / "e" / DOUBLE).iterdir()} == {"notes.txt"}
    assert len(list(read_results(tmp_path / "e"))) == 2


class Counted:
    """Writes down each time that it is built."""

    def __init__(self, env: Any, place: str) -> None:
        self.shape = env.action_space.shape
        (Path(place) / f"{os.getpid()}-{random.random()}").touch()

    def __call__(self, observation: Any) -> Any:
        return np.zeros(self.shape)


def test_a_policy_is_built_once_for_each_worker_and_task(tmp_path: Path) -> None:
    """Whatever the number of chunks."""
    (tmp_path / "built").mkdir()
    counted: dict[str, Any] = {"policy": Counted, "num_seeds": 8}
    run(
        tmp_path / "e",
        **counted,
        policy_kwargs={"place": str(tmp_path / "built")},
        workers=1,
    )
    assert len(list((tmp_path / "built").iterdir())) == 1


@pytest.mark.dm_control
def test_a_time_limit_of_the_environment_is_part_of_its_scale(tmp_path: Path) -> None:
    """A task of 40 steps has returns from 0 to 40."""
    pytest.importorskip("dm_control")
    kwargs = {"task_kwargs": {"time_limit": 1}}
    options: dict[str, Any] = {"num_seeds": 1, "env_kwargs": kwargs, "max_steps": None}
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
def test_chunks_follow_from_the_plan(
    seeds: Any, episodes: int, protocol: Any, names: list[str]
) -> None:
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


@pytest.mark.thorough
@pytest.mark.dm_control
def test_the_suite_has_a_scale_and_its_own_protocol(tmp_path: Path) -> None:
    """One stream for each task and seed; returns over steps are scores."""
    options: dict[str, Any] = {
        "tasks": ["dm_control/cartpole-swingup", "dm_control/pendulum-swingup"],
        "protocol": "suite",
        "keep": "median",
    }
    evaluation = run(tmp_path / "e", **options)
    assert [each.score_range for each in evaluation.summaries] == [(0.0, 5.0)] * 2
    assert evaluation.across.iqm is not None
    assert len(evaluation.videos) == 2
    first, second = evaluation.results[:2]
    assert first.total_reward != second.total_reward
    with pytest.raises(DifferentEvaluation, match="episodes"):
        run(tmp_path / "e", **options, episodes=3, resume=True)


@pytest.mark.thorough
def test_the_process_that_hands_out_loads_no_simulator(tmp_path: Path) -> None:
    """It needs no OpenGL, and a policy's memory is the workers'."""
    code = (
        "import sys; from pathlib import Path; import test_evaluating\n"
        "test_evaluating.run(Path(sys.argv[1]))\n"
        "print([m for m in ('mujoco', 'OpenGL', 'dm_control') if m in sys.modules])"
    )
    said = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "e")],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.strip() == "[]"
