# SPDX-License-Identifier: Apache-2.0
"""Evaluating a policy: the one who hands out the work, and writes down what came of it.

The unit of work is an episode, told by task, seed and number; with the protocol
`"suite"` all episodes of a task and seed. Workers write down each as it ends, in the
task's folder. This process simulates nothing and, until videos are drawn, needs no
OpenGL: it may be killed at any time, and whoever goes on repeats nothing.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..engines.choice import given_engine
from ..engines.jobs import WORK_FOLDER, Run, Work
from ..engines.local import LocalEngine
from ..errors import (
    DirectoryInUse,
    DirectoryNotWritable,
    GLError,
    InvalidArgument,
)
from ..formats.locks import try_lock
from ..gl.choice import choose
from ..provenance import versions
from ..rendering.engine_jobs import environ_for_drawing
from ..simulation.model_trust import stored_models
from .chosen_videos import ChosenVideos, drawn_by_workers, render_chosen
from .dataclass_json import to_json
from .episode_results import EpisodeResult
from .evaluation import Evaluation, EvaluationProgress
from .following import TaskRun, check_tasks, run_tasks
from .kept_episodes import keep_rule
from .ledger import read_ledgers
from .plan import SEEDED, EvaluationPlan
from .plan_file import check_continues, read_plan, write_plan
from .planning import check_score_ranges, plan_from
from .policy_objects import SentPolicy, sent_policy
from .recorded_files import RecordedFiles
from .results_files import PLAN_NAME, ChosenEpisode, write_results
from .statistics import Bootstrap
from .summaries import (
    AcrossTasks,
    TaskSummary,
    default_score_range,
    summarize_across,
    summarize_results,
)

logger = logging.getLogger(__name__)

_WORKER = "mjrec.evaluation.worker:EvaluationWorker"
_LOCK_NAME = ".mjrec.evaluation.lock"

# Sums in another order are other numbers, and how many threads a library takes depends
# on the machine; and so many processes keep all CPUs busy.
_ONE_THREAD_EACH = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_GL = "MUJOCO_GL"

_Tell = Callable[[EvaluationProgress], object]


def evaluate(
    tasks: str | Sequence[str],
    *,
    policy: Any,
    directory: str | os.PathLike[str],
    episodes: int = 10,
    seeds: Iterable[int] | None = None,
    num_seeds: int | None = None,
    workers: int | None = None,
    keep: str = "best,median,worst",
    protocol: str = SEEDED,
    resume: bool = False,
    max_steps: int | None = None,
    camera: str | int | None = None,
    height: int | None = None,
    width: int | None = None,
    max_fps: float | None = 60,
    quality: str = "full",
    env_kwargs: Mapping[str, Any] | None = None,
    score_ranges: Mapping[str, tuple[float, float]] | None = None,
    confidence: float = 0.95,
    on_progress: _Tell | None = None,
    engine: Executor | str | None = None,
) -> Evaluation:
    """Run so many episodes of each task, and write down what came of them.

    Every episode keeps its trajectory, so that any of them can be drawn later. An
    episode in which the policy raises, or gives NaN or the wrong shape, or the
    environment raises, has failed; the others go on. An episode whose worker dies is
    begun again, and has failed when three workers have died of it.

    Ctrl-C and other exceptions end the workers; what was finished stays, and the same
    call with `resume=True` goes on.

    Args:
        tasks: environments as in `mjrec record`, sets (`dm_control:benchmarking`,
            `dm_control:all`, `dm_control:easy`, `dm_control:hard`, `dm_control:extra`,
            `gymnasium:mujoco`), or patterns (`dm_control/walker-*`).
        policy: a text as in `mjrec record` (`random`, `zero`, `module:name`,
            `module:name()`); or a function of the observation, an object with
            `predict`, or a class that is built with each environment, which is
            pickled and sent to each worker.
        directory: of the evaluation; empty or new, unless `resume`.
        episodes: how many of each task and seed.
        seeds: of the runs.
        num_seeds: how many, from 0 on, instead; 5 if neither is given.
        workers: how many processes run, and later draw; one for each usable CPU, if
            None. The results do not depend on it. Where `engine` is a name, how many
            it has.
        keep: which episodes of each task get a video: `best[:N]`, `median`,
            `worst[:N]` and `failures[:N]`, separated by commas; or `cubic`, `all` or
            `none`. See `evaluation.kept_episodes`.
        protocol: `"seeded"`: episode i of seed s starts from `SeedSequence([s, i])`.
            `"suite"`: each task and seed has one random stream, seeded with s, that
            goes on from episode to episode.
        resume: go on with the evaluation in the directory. Other tasks and seeds, and
            more episodes, may be asked for (with the protocol `"suite"` not episodes);
            what is done already is not repeated. An episode whose worker had died is.
        max_steps: ends an episode as truncated; None is the environment's own limit,
            and 1000 where it has none.
        camera: of the videos; None is the model's tracking camera where there is one.
        height: of the videos, in pixels; None is the environment's own.
        width: likewise.
        max_fps: the most frames per second of simulated time; None is every step.
        quality: `"full"` or `"draft"`.
        env_kwargs: more arguments for each environment.
        score_ranges: the returns that count as 0 and as 1, by task, for what is said
            over all tasks. Those of the dm_control suite have theirs.
        confidence: the share of intervals that hold the true value.
        on_progress: called several times a second with how far it is.
        engine: where the work runs, instead of processes of this one: an engine, or
            `"local"`, `"ray"` or `"slurm"`. Its workers draw the videos, too, those of
            a task as soon as its episodes are over. All of them see the directory
            under the same name. The results do not depend on it.

    Returns:
        What came of it, which stands in the directory too: `results.json`,
        `results.csv` and `timing.csv`.

    Raises:
        MissingDependency: the framework of a task, or what the engine needs, is not
            installed.
        DifferentEvaluation: what is resumed was begun in another way.
        DirectoryInUse: another evaluation writes into the directory.
        PolicyError: the policy cannot be built, or not be sent to other processes.
        Error: an argument, a task or the policy cannot be. All of these are told
            before anything is run or written.
    """
    how = Bootstrap(confidence=confidence)
    given = given_engine(engine, workers)
    local = LocalEngine(workers)
    place = Path(directory)
    begun = _begun(place, resume=resume)
    sent = sent_policy(policy)
    plan = plan_from(
        tasks,
        policy=sent.name,
        is_object=sent.is_object,
        episodes=episodes,
        seeds=seeds,
        num_seeds=num_seeds,
        protocol=protocol,
        keep=keep,
        max_steps=max_steps,
        camera=camera,
        height=height,
        width=width,
        max_fps=max_fps,
        quality=quality,
        env_kwargs=env_kwargs,
        folders={} if begun is None else _folders(begun),
    )
    ranges = check_score_ranges(score_ranges, [task.name for task in plan.tasks])
    if begun is not None:
        check_continues(place, begun, plan)
    tell = on_progress or (lambda _: None)
    results = _Results(plan, place, ranges=ranges, bootstrap=how)
    with contextlib.ExitStack() as stack:
        runs = _run(
            given or local,
            plan,
            sent,
            place,
            is_begun=begun is not None,
            draws=given is not None,
            # Before the videos, which take long, and may not be possible here.
            on_results=results.take,
            tell=tell,
            stack=stack,
        )
        videos = ChosenVideos()
        if any(of.chosen for of in runs):
            videos = (
                render_chosen(
                    place, runs, workers=local.workers, over=results.over, tell=tell
                )
                if given is None
                else drawn_by_workers(place, runs)
            )
            results.write()
        return results.evaluation(videos)


def _begun(directory: Path, *, resume: bool) -> EvaluationPlan | None:
    """Return the plan of the evaluation that goes on; None where a new one begins.

    Raises:
        InvalidArgument: there is something in the directory, which is not to go on or
            is no evaluation.
    """
    there = (directory / PLAN_NAME).exists()
    if resume and there:
        return read_plan(directory)
    if not directory.exists():
        return None
    if not directory.is_dir():
        raise InvalidArgument(f"{directory} is a file: an evaluation is a directory.")
    if there:
        raise InvalidArgument(
            f"{directory} holds an evaluation already. To go on with it, or to ask for "
            "more seeds or episodes: resume=True (--resume). For another one, use a "
            "directory of its own."
        )
    names = {path.name for path in directory.iterdir()} - {_LOCK_NAME, WORK_FOLDER}
    if names:
        raise InvalidArgument(
            f"{directory} holds something that is no evaluation ({min(names)} "
            f"{'and others' if len(names) > 1 else 'only'}). An evaluation needs a "
            "directory of its own, which is empty or new."
        )
    return None


def _folders(plan: EvaluationPlan) -> dict[str, str]:
    return {task.name: task.folder for task in plan.tasks}


def _run(
    engine: Executor,
    plan: EvaluationPlan,
    sent: SentPolicy,
    directory: Path,
    *,
    is_begun: bool,
    draws: bool,
    on_results: Callable[[Sequence[TaskRun]], object],
    tell: _Tell,
    stack: contextlib.ExitStack,
) -> list[TaskRun]:
    """Run all tasks; the directory is held until `stack` ends.

    Args:
        engine: whose workers run them.
        plan: what is evaluated.
        sent: the policy.
        directory: of the evaluation.
        is_begun: whether it goes on with what is there.
        draws: whether the workers draw, too.
        on_results: as of `run_tasks`.
        tell: likewise.
        stack: see above.
    """
    if is_begun:
        stack.enter_context(_held(directory))
    done = _done(plan, directory, is_begun=is_begun)
    work = Work(
        entry=_WORKER,
        settings={
            "directory": str(directory.absolute()),
            "plan": to_json(plan),
            # What works here may not work where an engine has its workers.
            "chooses_gl": draws,
            # Of what was recorded before; their homes may be others.
            "models": stored_models(
                directory / task.folder for task in plan.tasks if is_begun and draws
            ),
        },
        payload=sent.payload,
        environ=_environ_of_workers(plan, draws=draws),
        shared_directory=directory.absolute(),
    )
    is_here = isinstance(engine, LocalEngine)
    # What is quick is done here: nothing has to wait in a cluster's queue.
    with Run(engine if is_here else LocalEngine(1), work) as home:
        left = [task for task in plan.tasks if _is_left(plan, done[task.name])]
        checked = check_tasks(home, plan, left)
        if not is_begun:
            _make(directory)
            stack.enter_context(_held(directory))
        write_plan(directory, plan)
        run = home if is_here else stack.enter_context(Run(engine, work))
        # Once more: workers of a driver that was killed have gone on until now.
        done = _done(plan, directory, is_begun=is_begun)
        return run_tasks(
            run,
            home,
            plan,
            directory,
            done=done,
            checked=checked,
            draws=draws,
            on_results=on_results,
            tell=tell,
        )


def _done(
    plan: EvaluationPlan, directory: Path, *, is_begun: bool
) -> dict[str, dict[tuple[int, int], EpisodeResult]]:
    """Return the results of the episodes that are over, by task."""
    return {
        task.name: read_ledgers(directory / task.folder) if is_begun else {}
        for task in plan.tasks
    }


def _environ_of_workers(plan: EvaluationPlan, *, draws: bool) -> dict[str, str]:
    wanted = dict.fromkeys(_ONE_THREAD_EACH, "1")
    if draws:
        return {
            **{name: os.environ.get(name, value) for name, value in wanted.items()},
            **environ_for_drawing(),
        }
    if not keep_rule(plan.keep).keeps_none and _GL not in os.environ:
        # A task that is drawn live needs a backend that works.
        with contextlib.suppress(GLError):
            wanted[_GL] = choose().backend
    return {name: value for name, value in wanted.items() if name not in os.environ}


def _is_left(plan: EvaluationPlan, done: Mapping[tuple[int, int], object]) -> bool:
    return any(
        (seed, number) not in done
        for seed in plan.seeds
        for number in range(plan.episodes)
    )


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error


@contextlib.contextmanager
def _held(directory: Path) -> Iterator[None]:
    """Keep other evaluations out of the directory."""
    try:
        lock = try_lock(directory / _LOCK_NAME, f"{os.getpid()}\n")
    except OSError as error:
        raise DirectoryNotWritable(directory, error.strerror) from error
    if lock is None:
        raise DirectoryInUse(
            f"Another evaluation writes into {directory}. Wait for its end, or use "
            "another directory."
        )
    try:
        yield
    finally:
        lock.release()


class _Results:
    """What an evaluation comes to, in its directory.

    Args:
        plan: what is evaluated.
        directory: of the evaluation.
        ranges: the returns that count as 0 and as 1, by task.
        bootstrap: how intervals are made.
    """

    def __init__(
        self,
        plan: EvaluationPlan,
        directory: Path,
        *,
        ranges: Mapping[str, tuple[float, float]],
        bootstrap: Bootstrap,
    ) -> None:
        self._plan = plan
        self._directory = directory
        self._ranges = ranges
        self._bootstrap = bootstrap
        self._evaluation: Evaluation | None = None

    def take(self, runs: Sequence[TaskRun]) -> None:
        """Take in what came of the tasks, which are settled, and write it down."""
        summaries, across = _summarized(self._plan, runs, self._ranges, self._bootstrap)
        selection = {
            of.task.name: [
                ChosenEpisode(result.seed, result.episode, role)
                for result, role in of.chosen
            ]
            for of in runs
        }
        self._evaluation = Evaluation(
            directory=self._directory,
            plan=self._plan,
            results=[result for of in runs for result in of.results],
            summaries=summaries,
            across=across,
            bootstrap=self._bootstrap,
            selection=selection,
        )
        self.write()

    @property
    def over(self) -> EvaluationProgress:
        """How far an evaluation is of which only videos are left."""
        results = self._known.results
        return EvaluationProgress(
            done=len(results), failed=len(self._known.failed), total=len(results)
        )

    def evaluation(self, videos: ChosenVideos) -> Evaluation:
        """Return all of it."""
        return replace(self._known, videos=videos.there, pending=videos.pending)

    def write(self) -> None:
        """Write it down, with the files that are there now."""
        known = self._known
        files = {
            task.name: RecordedFiles(
                self._directory / task.folder,
                {(each.seed, each.episode) for each in known.selection[task.name]},
            )
            for task in self._plan.tasks
        }
        write_results(
            self._directory,
            plan=self._plan,
            results=known.results,
            summaries=known.summaries,
            across=known.across,
            bootstrap=self._bootstrap,
            selection=known.selection,
            versions=versions(),
            files=lambda result: files[result.task].of(result),
        )

    @property
    def _known(self) -> Evaluation:
        # `run_tasks` ends when all tasks have been taken in.
        assert self._evaluation is not None
        return self._evaluation


def _summarized(
    plan: EvaluationPlan,
    runs: Sequence[TaskRun],
    ranges: Mapping[str, tuple[float, float]],
    bootstrap: Bootstrap,
) -> tuple[list[TaskSummary], AcrossTasks]:
    scales = {
        task.name: ranges.get(task.name)
        or default_score_range(task.name, plan.max_steps)
        for task in plan.tasks
    }
    summaries = [
        summarize_results(
            of.task.name,
            of.results,
            score_range=scales[of.task.name],
            bootstrap=bootstrap,
        )
        for of in runs
    ]
    returns = {
        of.task.name: [
            each.total_reward for each in of.results if each.total_reward is not None
        ]
        for of in runs
    }
    return summaries, summarize_across(returns, scales, bootstrap=bootstrap)
