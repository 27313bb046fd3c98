# SPDX-License-Identifier: Apache-2.0
"""`evaluate`, which distributes an evaluation to workers and writes the results.

Workers record the episodes, one chunk at a time. The calling process simulates nothing
and needs OpenGL only to draw the videos at the end. It can be killed at any time: a
resumed evaluation does not repeat finished work.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..atomic_files import make_directory
from ..engines.choice import given_engine
from ..engines.jobs import WORK_FOLDER, Run, Work
from ..engines.local import LocalEngine
from ..errors import DirectoryInUse, GLError, InvalidArgument, PolicyError
from ..formats.json_fields import to_json
from ..formats.locks import try_lock
from ..formats.monitor_directory import names_in
from ..gl.choice import choose
from ..provenance import versions
from ..recorder.keep_rules import keep_rule
from ..rendering.finish import environ_for_drawing
from ..results import clear_monitor_files
from . import following
from .evaluation import RESULT_NAMES, Evaluation, read_results, write_results
from .plan import (
    NO_GL,
    PLAN_NAME,
    SEEDED,
    EvaluationPlan,
    check_continues,
    read_plan,
    write_plan,
)
from .planning import check_score_ranges, plan_from
from .statistics import Bootstrap, load_scipy
from .summaries import default_score_range, summarize_across, summarize_results

logger = logging.getLogger(__name__)

_WORKER = "mjrec.evaluation.worker:EvaluationWorker"
_LOCK_NAME = ".mjrec.evaluation.lock"

# By default, the number of threads in a library depends on the machine, and so does the
# order in which numbers are added. This would change the results. The worker processes
# keep all CPUs busy anyway.
_ONE_THREAD_EACH = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_GL = "MUJOCO_GL"

# The default of `max_fps`, for which None is a value.
NOT_GIVEN: Any = object()
_DEFAULTS: Mapping[str, Any] = {
    "episodes": 10,
    "keep": "best,median,worst",
    "protocol": SEEDED,
    "max_fps": 60,
    "quality": "full",
    "confidence": 0.95,
}

_Tell = Callable[[following.EvaluationProgress], object]


def evaluate(
    tasks: str | Sequence[str] = (),
    *,
    policy: Any = None,
    directory: str | os.PathLike[str],
    episodes: int | None = None,
    seeds: Iterable[int] | None = None,
    num_seeds: int | None = None,
    workers: int | None = None,
    keep: str | None = None,
    protocol: str | None = None,
    resume: bool = False,
    force: bool = False,
    max_steps: int | None = None,
    episode_timeout: float | None = None,
    camera: str | int | None = None,
    height: int | None = None,
    width: int | None = None,
    max_fps: float | None = NOT_GIVEN,
    quality: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    policy_kwargs: Mapping[str, Any] | None = None,
    score_ranges: Mapping[str, tuple[float, float]] | None = None,
    confidence: float | None = None,
    on_progress: _Tell | None = None,
    engine: Executor | str | None = None,
) -> Evaluation:
    """Run episodes for each task and seed, and write the results.

    The trajectory of every episode is kept, so any episode can be rendered later. An
    episode fails if the policy or the environment raises an exception, or if an action
    is NaN or has the wrong shape. The other episodes still run. If a worker dies during
    an episode, the episode is retried. After three deaths, it fails.

    A worker creates the environment and the policy once per task and resets them for
    each episode. There are two exceptions. An environment that draws its model from the
    seed (dm_control's `lqr`) is created once per seed, and an environment whose frames
    are drawn live is created once per episode.

    Ctrl-C and other exceptions stop the workers. Finished episodes are kept, and the
    same call with `resume=True` continues the evaluation.

    Args:
        tasks: environments as in `mjrec record`, sets (`dm_control:benchmarking`,
            `dm_control:all`, `dm_control:easy`, `dm_control:hard`, `dm_control:extra`,
            `gymnasium:mujoco`), or patterns (`dm_control/walker-*`).
        policy: a string as in `mjrec record` (`random`, `zero`, `module:name`,
            `module:name()`); or a function of the observation, an object with
            `predict`, or a class that is called with each environment. Objects are
            pickled and sent to each worker.
        directory: the evaluation's directory. It must be new or empty, unless `resume`
            or `force` is given.
        episodes: number of episodes per task and seed. Defaults to 10.
        seeds: the seeds.
        num_seeds: number of seeds, counted from 0, instead of `seeds`. Defaults to 5.
        workers: number of worker processes, which also render. Defaults to one per
            usable CPU. If `engine` is a name, this is the number of the engine's
            workers. The results do not depend on this number.
        keep: rule that chooses the episodes of each task for videos: `best[:N]`,
            `median`, `worst[:N]` and `failures[:N]`, joined by commas; or `cubic`,
            `all` or `none`. Defaults to `"best,median,worst"`.
        protocol: `"seeded"` (the default): episode i of seed s starts from
            `SeedSequence([s, i])`. `"suite"`: the episodes of a task and a seed s share
            one random stream, seeded with s.
        resume: continue the evaluation in the directory without rerunning finished
            episodes. Arguments that are None keep their earlier values. You may add
            tasks, seeds and (except with `"suite"`) episodes, and change
            `score_ranges`, `confidence` and `episode_timeout`. Everything else must be
            the same, including the policy's code and weights, the models of MJCF
            files, and the modules that are imported when the environments and the
            policy are created. Installed packages are not compared.
        force: delete the evaluation in the directory first.
        max_steps: truncate episodes after this many steps. None for the environment's
            limit, or 1000 steps if it has no limit.
        episode_timeout: maximum duration of an episode in seconds. An episode that
            takes longer fails, and its worker is terminated.
        camera: the camera for the videos. None for the model's tracking camera, if
            there is one.
        height: height of the videos in pixels. None for the environment's default.
        width: width of the videos in pixels. None for the environment's default.
        max_fps: maximum number of frames per second of simulated time. None for one
            frame per step. Defaults to 60.
        quality: `"full"` (the default) or `"draft"`.
        env_kwargs: keyword arguments for each environment.
        policy_kwargs: keyword arguments for the policy.
        score_ranges: for each task, the returns that correspond to scores of 0 and 1.
            Scores make tasks comparable. dm_control tasks have default ranges.
        confidence: confidence level of the intervals. Defaults to 0.95.
        on_progress: a function that is called with the progress several times a second.
        engine: an executor to use instead of child processes, or `"local"`, `"ray"` or
            `"slurm"`. Its workers also render. All workers must see the directory under
            the same path. The results do not depend on the engine.

    Returns:
        The results, which are also written to `results.json`, `results.csv` and
        `timing.csv` in the directory.

    Raises:
        MissingDependency: a task's framework, or the engine's package, is not
            installed.
        DifferentEvaluation: `resume` was given with different options.
        DirectoryInUse: another evaluation is using the directory.
        PolicyError: the policy cannot be created or sent to other processes.
        Error: an argument, a task or the policy is invalid. All of the errors above
            are raised before any episode runs.
    """
    given = given_engine(engine, workers)
    local = LocalEngine(workers)
    place = Path(directory)
    begun = _begun(place, resume=resume, force=force)
    options = _options(
        begun,
        episodes=episodes,
        keep=keep,
        protocol=protocol,
        max_steps=max_steps,
        episode_timeout=episode_timeout,
        camera=camera,
        height=height,
        width=width,
        max_fps=None,
        quality=quality,
        env_kwargs=env_kwargs or None,
        policy_kwargs=policy_kwargs or None,
        confidence=confidence,
    )
    if max_fps is not NOT_GIVEN:
        options["max_fps"] = max_fps
    how = Bootstrap(confidence=options["confidence"])
    if policy is None and begun is not None:
        if begun.is_object:
            raise PolicyError(
                f"The policy of this evaluation is an object ({begun.policy}). To "
                "continue the evaluation, pass the object again (policy=...)."
            )
        policy = begun.policy
    if policy is None:
        raise PolicyError(
            "An evaluation needs a policy: random, zero, module:name, or an object."
        )
    plan, payload = plan_from(
        tasks, policy, seeds=seeds, num_seeds=num_seeds, begun=begun, **options
    )
    ranges = check_score_ranges(score_ranges, [task.name for task in plan.tasks])
    plan = replace(plan, score_ranges={**plan.score_ranges, **ranges})
    if begun is not None:
        check_continues(place, begun, plan)
    tell = on_progress or (lambda _: None)
    with contextlib.ExitStack() as stack:
        stack.callback(local.shutdown)
        if given is not None and isinstance(engine, str):
            stack.callback(given.shutdown)
        if begun is not None:
            stack.enter_context(_held(place))
        executor = given or local
        is_here = isinstance(executor, LocalEngine)
        work = _work(plan, payload, place, chooses_gl=given is not None)
        # Quick checks run locally, so that they do not wait in a cluster's queue.
        with Run(executor if is_here else local, work) as home:
            load_scipy()
            names = [task.name for task in plan.tasks]
            needed = len(names) * len(plan.chunks)
            if begun is not None:
                chunks = following.chunks_in(place, plan)
                missing = [each.task.name for each in chunks if not each.is_complete]
                names, needed = [*dict.fromkeys(missing)], len(missing)
            plan, velocities = following.check_tasks(
                home, plan, names, workers=min(local.workers, needed) if is_here else 1
            )
            if begun is not None:
                check_continues(place, begun, plan)
            else:
                make_directory(place)
                stack.enter_context(_held(place))
                _clear(place)
                chunks = following.chunks_in(place, plan)
            write_plan(place, plan)
            # The slowest tasks come first, so that all workers finish at about the same
            # time.
            chunks.sort(key=lambda each: -velocities.get(each.task.name, 0))
            if is_here:
                progress = following.run_chunks(home, chunks, tell)
        if not is_here:
            with Run(executor, work) as run:
                progress = following.run_chunks(run, chunks, tell)
        results = following.results_of(plan, chunks)
        choice = following.choose_videos(plan, chunks, results)
        # Written before the videos are drawn, because drawing takes a long time.
        scales = {
            task.name: plan.score_ranges.get(task.name)
            or default_score_range(task.name, task.step_limit)
            for task in plan.tasks
        }
        returns = {
            name: [each.total_reward for each in own if each.total_reward is not None]
            for name, own in results.items()
        }
        evaluation = Evaluation(
            directory=place,
            plan=plan,
            summaries=[
                summarize_results(name, own, score_range=scales[name], bootstrap=how)
                for name, own in results.items()
            ],
            across=summarize_across(returns, scales, bootstrap=how),
            bootstrap=how,
            selection=choice.selection,
            # SciPy is included because it computes the statistics.
            versions=versions("scipy"),
        )
        episodes_of = [result for own in results.values() for result in own]
        write_results(evaluation, episodes_of, following.files_of(evaluation, chunks))
        videos, pending = following.draw_videos(
            choice,
            place,
            engine=given,
            workers=local.workers,
            progress=progress,
            tell=tell,
        )
    return replace(read_results(place), videos=videos, pending=pending)


def _begun(directory: Path, *, resume: bool, force: bool) -> EvaluationPlan | None:
    """Return the plan of the evaluation to resume, or None to begin a new evaluation.

    Raises:
        InvalidArgument: the directory contains an evaluation, but neither `resume` nor
            `force` was given; or it contains files that do not belong to an evaluation.
    """
    there = (directory / PLAN_NAME).exists()
    if there and resume and not force:
        return read_plan(directory)
    if not directory.exists() or (there and force):
        return None
    if not directory.is_dir():
        raise InvalidArgument(
            f"{directory} is a file, but an evaluation needs a directory."
        )
    if there:
        raise InvalidArgument(
            f"{directory} already contains an evaluation. To continue it, or to add "
            "seeds or episodes, use resume=True (--resume). To delete it, use "
            "force=True (--force). For a new evaluation, use a different directory."
        )
    names = {*names_in(directory)} - {_LOCK_NAME, WORK_FOLDER}
    if names:
        raise InvalidArgument(
            f"{directory} contains files that do not belong to an evaluation "
            f"({min(names)}{' and others' if len(names) > 1 else ''}). An evaluation "
            "needs a new or empty directory."
        )
    return None


def _options(begun: EvaluationPlan | None, **given: Any) -> dict[str, Any]:
    """Replace options that are None with their earlier values or their defaults."""
    earlier = _DEFAULTS if begun is None else vars(begun)
    return {
        name: earlier.get(name) if value is None else value
        for name, value in given.items()
    }


def _work(
    plan: EvaluationPlan, payload: bytes | None, directory: Path, *, chooses_gl: bool
) -> Work:
    return Work(
        entry=_WORKER,
        settings={
            "directory": str(directory.absolute()),
            # Each job has its own chunk.
            "plan": to_json(replace(plan, chunks=())),
            # A backend that works here may not work on an engine's machines.
            "chooses_gl": chooses_gl,
            "command": sys.orig_argv,
        },
        environ=_environ_of_workers(plan, is_elsewhere=chooses_gl),
        shared_directory=directory.absolute(),
        payload=payload,
    )


def _environ_of_workers(plan: EvaluationPlan, *, is_elsewhere: bool) -> dict[str, str]:
    wanted = dict.fromkeys(_ONE_THREAD_EACH, "1")
    if is_elsewhere:
        return {
            **{name: os.environ.get(name, value) for name, value in wanted.items()},
            **environ_for_drawing(),
        }
    if not keep_rule(plan.keep).keeps_none:
        # Checked now, so that a problem does not appear hours later. A task that is
        # drawn live needs the backend in its worker.
        try:
            wanted[_GL] = choose().backend
        except GLError as error:
            logger.warning(NO_GL, error)
    return {name: value for name, value in wanted.items() if name not in os.environ}


def _clear(directory: Path) -> None:
    """Delete only the evaluation in a directory, if there is one.

    Raises:
        DirectoryInUse: a monitor in the evaluation is still open.
    """
    if not (directory / PLAN_NAME).exists():
        return
    plan = read_plan(directory)
    for task in plan.tasks:
        folders = [directory / task.folder / chunk.folder for chunk in plan.chunks]
        for folder in folders:
            clear_monitor_files(folder)
        for folder in (*folders, directory / task.folder):
            with contextlib.suppress(OSError):
                folder.rmdir()
    for name in RESULT_NAMES:
        (directory / name).unlink(missing_ok=True)


@contextlib.contextmanager
def _held(directory: Path) -> Iterator[None]:
    """Lock the directory to exclude other evaluations."""
    lock = try_lock(directory / _LOCK_NAME)
    if lock is None:
        raise DirectoryInUse(
            f"Another evaluation is using {directory}. Wait until it has finished, or "
            "use a different directory."
        )
    with lock:
        yield
