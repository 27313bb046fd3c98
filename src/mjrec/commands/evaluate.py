# SPDX-License-Identifier: Apache-2.0
"""`mjrec evaluate`: evaluate a policy in many environments."""

from __future__ import annotations

import fnmatch
import math
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import rich.console
import rich.markup
import rich.table
import tyro

from ..errors import InvalidArgument, UnknownName
from ..evaluation.evaluating import NOT_GIVEN
from ..evaluation.evaluating import evaluate as evaluate_policy
from ..evaluation.evaluation import Evaluation
from ..evaluation.following import EvaluationProgress
from ..evaluation.plan import PLAN_NAME
from ..evaluation.statistics import Interval
from ..evaluation.summaries import TaskSummary
from ..evaluation.task_sets import tasks_from
from ..formats.json_fields import to_json
from ..monitors.progress import ShowProgress, progress_bar
from ..plain_text import counted, listed
from ..recorder.keep_rules import keep_rule
from .not_finite import ALLOWED, not_finite_lines
from .options import NO_ENGINE, AsJson, Engine, camera_of, kwargs_of, size_of
from .terminal import (
    FAILED,
    INTERRUPTED,
    names_by,
    print_json,
    print_lines,
    printable,
    result_console,
    table,
)

T = TypeVar("T")

_SHOWN = 10
_MOST_SEEDS = 1_000_000
_COLUMNS = ("IQM", "median", "min..max", "success", "failed")


def evaluate(
    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TASK...")
    ] = (),
    /,
    *,
    policy: str | None = None,
    out: Path | None = None,
    episodes: int | None = None,
    num_seeds: int | None = None,
    workers: int | None = None,
    seeds: str | None = None,
    keep: str | None = None,
    protocol: Literal["seeded", "suite"] | None = None,
    resume: bool = False,
    force: bool = False,
    max_steps: int | None = None,
    episode_timeout: float | None = None,
    camera: str | None = None,
    size: str | None = None,
    max_fps: float | None = None,
    quality: Literal["full", "draft"] | None = None,
    env_kwargs: str | None = None,
    policy_kwargs: str | None = None,
    score_range: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    fail_under: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    allow_nan: bool = False,
    confidence: float | None = None,
    as_json: AsJson = False,
    engine_options: Engine = NO_ENGINE,
) -> int:
    """Evaluate a policy: run episodes of each task and summarize the returns.

    The exit status is 1 if an episode failed (the policy or the environment raised an
    exception, or an action was NaN or had the wrong shape), if a return is NaN or
    infinite, or if a task is below --fail-under. The results are written either way.
    mjrec evaluate --resume DIR continues an interrupted evaluation.

    Args:
        tasks: environments as in mjrec record, sets (dm_control:benchmarking,
            dm_control:all, dm_control:easy, dm_control:hard, dm_control:extra,
            gymnasium:mujoco), or quoted patterns ('dm_control/walker-*').
        policy: random, zero, module:name, module:name() or a file, as in mjrec record.
        out: the evaluation's directory, which must be empty or new.
        episodes: episodes per task and seed. Default: 10.
        num_seeds: number of seeds, counting from 0. Default: 5.
        workers: worker processes. Default: one per CPU. Results do not depend on
            this number. With --engine, the number of engine workers.
        seeds: the seeds, such as 0,1,2 or 0-99, instead of --num-seeds.
        keep: which episodes of each task get a video: best, best:N, median, worst,
            worst:N, failures, failures:N, joined by commas; or cubic, all or none.
            Default: best,median,worst.
        protocol: with seeded, episode i of seed s starts from NumPy's SeedSequence([s,
            i]); with suite, each task and seed has one random stream, seeded with s.
            Default: seeded.
        resume: continue the evaluation in the directory without repeating finished
            work. Options that you omit keep their values. You may add tasks,
            seeds and episodes.
        force: delete the evaluation in the directory first.
        max_steps: truncate episodes after this many steps. Default: the
            environment's limit, or 1000.
        episode_timeout: seconds after which an episode counts as failed.
        camera: name or number. Default: the model's tracking camera, if it has one.
        size: size of the videos, WIDTHxHEIGHT in pixels.
        max_fps: maximum frames per second of simulated time. Default: 60.
        quality: full, or draft (several times faster, with coarser edges and shadows).
            Default: full.
        env_kwargs: arguments for each environment, as a JSON object.
        policy_kwargs: arguments for the policy, as a JSON object.
        score_range: TASK=LOW:HIGH, the returns that count as scores of 0 and 1 across
            tasks. dm_control tasks have known ranges. May be repeated.
        fail_under: TASK=VALUE: exit with status 1 if the task's mean return is lower or
            one of its episodes failed. TASK may be a pattern. May be repeated.
        allow_nan: do not exit with status 1 because of NaN or infinite returns.
        confidence: confidence level of the intervals. Default: 0.95.
        as_json: print one JSON object at the end, and nothing else.
        engine_options: where to compute episodes and videos, if not in this command's
            own processes.
    """
    height, width = size_of(size)
    view_from = camera_of(camera)
    if isinstance(view_from, dict):
        raise InvalidArgument(
            "mjrec evaluate needs a camera's name or number. To use a camera in any "
            "other position, render the episodes afterwards: mjrec render DIR "
            f"--episode N --camera {shlex.quote(str(camera))}"
        )
    least = _by_task("--fail-under", fail_under, _value_of, "TASK=VALUE")
    ranges = _by_task("--score-range", score_range, _range_of, "TASK=LOW:HIGH")
    listed = None if seeds is None else _seeds_of(seeds)
    env_options = kwargs_of(env_kwargs or "{}")
    policy_options = kwargs_of(policy_kwargs or "{}", "--policy-kwargs")
    tasks, out = _tasks_and_directory(tasks, out, resume=resume)
    names = tasks_from(tasks) if tasks else ()
    if names:
        _matching(least, names)
    engine = engine_options.chosen(workers)
    console = rich.console.Console(stderr=True, quiet=as_json)
    try:
        with progress_bar(console) as show:
            evaluation = evaluate_policy(
                names,
                policy=policy,
                directory=out,
                episodes=episodes,
                seeds=listed,
                num_seeds=num_seeds,
                workers=workers if engine is None else None,
                keep=keep,
                protocol=protocol,
                resume=resume,
                force=force,
                max_steps=max_steps,
                episode_timeout=episode_timeout,
                camera=view_from,
                height=height,
                width=width,
                max_fps=NOT_GIVEN if max_fps is None else max_fps,
                quality=quality,
                env_kwargs=env_options,
                policy_kwargs=policy_options,
                score_ranges=ranges,
                confidence=confidence,
                on_progress=_shown_progress(show, console),
                engine=engine,
            )
    except KeyboardInterrupt:
        way_on = f"To continue: mjrec evaluate --resume {out}"
        interrupted = f"Interrupted. Finished episodes are in {out}. {way_on}"
        print_lines(console, [interrupted])
        return INTERRUPTED
    least = _matching(least, [task.name for task in evaluation.plan.tasks])
    short = dict(_shortfalls(evaluation, least))
    if as_json:
        print_json(_fields(evaluation, short))
    else:
        result_console().print(_table(evaluation))
        print_lines(result_console(), _lines(evaluation, short))
    is_nan = bool(evaluation.not_finite) and not allow_nan
    return FAILED if evaluation.failed or short or is_nan else 0


def _shown_progress(
    show: ShowProgress, console: rich.console.Console
) -> Callable[[EvaluationProgress], None]:
    """Return a callback that shows a bar or, in a log, prints a line every 10%."""
    said = 0

    def tell(progress: EvaluationProgress) -> None:
        nonlocal said
        done, total = progress.done, progress.total
        words = f"{done}/{total} episodes"
        failed = f", {progress.failed} failed" if progress.failed else ""
        show("running", done, total, words + failed)
        if progress.videos:
            drawn = f"{progress.videos_done}/{progress.videos} videos"
            show("rendering", progress.videos_done, progress.videos, drawn)
        tenth = 10 * done // max(1, total)
        if tenth > said and not console.is_terminal:
            said = tenth
            print_lines(console, [words])

    return tell


def _tasks_and_directory(
    tasks: tuple[str, ...], out: Path | None, *, resume: bool
) -> tuple[tuple[str, ...], Path]:
    """Return the tasks and the directory; `--resume DIR` gives only the latter."""
    if out is None and resume and tasks and (Path(tasks[-1]) / PLAN_NAME).is_file():
        return tasks[:-1], Path(tasks[-1])
    if out is None:
        raise InvalidArgument(
            "Give --out DIR for a new evaluation, or --resume DIR to continue one."
        )
    return tasks, out


def _matching(least: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """Return each task's required value; a pattern sets it for all matching tasks.

    Raises:
        UnknownName: no task matches one of the patterns.
    """
    matching: dict[str, float] = {}
    for pattern, value in least.items():
        found = [n for n in names if n == pattern or fnmatch.fnmatchcase(n, pattern)]
        if not found:
            raise UnknownName(
                "task for --fail-under in this evaluation", pattern, names
            )
        matching |= dict.fromkeys(found, value)
    return matching


def _by_task(
    option: str, given: Sequence[str], read: Callable[[str], T], form: str
) -> dict[str, T]:
    """Return the values of repeated TASK=... options, keyed by task.

    Raises:
        InvalidArgument: an option does not have the form `form`.
    """
    said: dict[str, T] = {}
    for text in given:
        # A task may be a path that contains "=".
        task, equals, value = text.rpartition("=")
        try:
            if not (task and equals):
                raise ValueError
            said[task] = read(value)
        except ValueError:
            raise InvalidArgument(f"{option} must be {form}, got {text!r}.") from None
    return said


def _value_of(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _range_of(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    return float(low), float(high)


def _seeds_of(text: str) -> list[int]:
    seeds: list[int] = []
    for part in text.split(","):
        ends = re.fullmatch(r"([0-9]{1,10})(?:-([0-9]{1,10}))?", part, re.ASCII)
        first = int(ends[1]) if ends else 0
        last = int(ends[2] or first) if ends else -1
        if not first <= last < first + _MOST_SEEDS:
            raise InvalidArgument(
                "--seeds must be whole numbers or ranges, separated by commas, such as "
                f"0,1,2 or 0-99, got {text!r}."
            )
        seeds += range(first, last + 1)
    return seeds


def _shortfalls(
    evaluation: Evaluation, least: Mapping[str, float]
) -> Iterator[tuple[str, str]]:
    """Yield each task that misses its required value, and the reason."""
    for task, value in least.items():
        summary = evaluation.summary(task)
        if summary.failed:
            yield task, f"{counted(summary.failed, 'episode')} failed"
        elif summary.mean is None:
            yield task, "it has no mean return"
        elif summary.mean < value:
            yield task, f"its mean return {summary.mean:.6g} is below {value:g}"


# --- Output -----------------------------------------------------------------------


def _table(evaluation: Evaluation) -> rich.table.Table:
    percent = f"{100 * evaluation.bootstrap.confidence:g}%"
    made = table(["task", "episodes", "mean", percent, *_COLUMNS])
    for each in evaluation.summaries:
        failed = f"[bold red]{each.failed}[/]" if each.failed else "0"
        made.add_row(
            rich.markup.escape(printable(each.task)),
            str(each.episodes),
            _number(each.mean),
            _interval(each.mean_interval),
            _number(each.iqm),
            _number(each.median),
            _extent(each),
            "" if each.success_rate is None else f"{100 * each.success_rate:.0f}%",
            failed,
        )
    return made


def _lines(evaluation: Evaluation, short: Mapping[str, str]) -> Iterator[str]:
    yield from _across_lines(evaluation)
    yield from _failure_lines(evaluation)
    yield from _example_lines(evaluation)
    for task, reason in short.items():
        yield f"{task} falls short: {reason}."
    videos, pending = evaluation.videos, evaluation.pending
    if videos:
        yield f"{counted(len(videos), 'video')}:"
        yield from (f"  {path}" for path in videos[:_SHOWN])
        if len(videos) > _SHOWN:
            yield f"  and {len(videos) - _SHOWN} more"
    if pending:
        yield f"{counted(len(pending), 'video')} could not be rendered:"
        reasons = {path.name: reason for path, reason in pending.items()}
        for reason, names in names_by(reasons).items():
            yield f"  {listed(names, 1)}: {printable(reason)}"
    yield f"The results are in {evaluation.directory.absolute()}"


def _across_lines(evaluation: Evaluation) -> Iterator[str]:
    across = evaluation.across
    if across is None or len(across.tasks) < 2:
        return
    figures = [
        ("IQM", across.iqm, across.iqm_interval),
        ("mean", across.mean, None),
        ("median", across.median, None),
        ("optimality gap", across.optimality_gap, across.optimality_gap_interval),
    ]
    said = ", ".join(
        " ".join(filter(None, [name, _number(value), _interval(interval)]))
        for name, value, interval in figures
    )
    yield f"Over {counted(len(across.tasks), 'task')}, as scores from 0 to 1: {said}"
    for task, reason in across.left_out.items():
        yield f"  left out: {task}: {printable(reason)}"


def _failure_lines(evaluation: Evaluation) -> Iterator[str]:
    if failed := evaluation.failed:
        total = counted(len(evaluation.results), "episode")
        yield f"{len(failed)} of {total} failed:"
        reasons = names_by({each.name: str(each.failure) for each in failed})
        for reason, names in [*reasons.items()][:_SHOWN]:
            yield f"  {printable(listed(names, 1))}: {printable(reason)}"
        if len(reasons) > _SHOWN:
            yield f"  and {len(reasons) - _SHOWN} more reasons, in results.csv"
    not_finite = [each.name for each in evaluation.not_finite]
    yield from not_finite_lines(not_finite, ALLOWED)


def _example_lines(evaluation: Evaluation) -> Iterator[str]:
    """Yield a line for the best, median and worst episode of each task."""
    not_finite = {each.name for each in evaluation.not_finite}
    for task in evaluation.plan.tasks[:_SHOWN]:
        known = sorted(evaluation.by_task[task.name], key=lambda each: each.unit)
        known = [each for each in known if each.name not in not_finite]
        for each, role in keep_rule("best,median,worst").choose(known):
            value, file = _number(each.total_reward), evaluation.file_of(each)
            yield f"  {role:6}  {value:>10}  {each.name}  {file}"


def _fields(evaluation: Evaluation, short: Mapping[str, str]) -> dict[str, Any]:
    return {
        "directory": str(evaluation.directory.absolute()),
        "episodes": len(evaluation.results),
        "failed": len(evaluation.failed),
        "not_finite": len(evaluation.not_finite),
        "tasks": [to_json(each) for each in evaluation.summaries],
        "across": evaluation.across and to_json(evaluation.across),
        "videos": [str(path) for path in evaluation.videos],
        "pending": {str(path): why for path, why in evaluation.pending.items()},
        "below": dict(short),
    }


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _interval(interval: Interval | None) -> str:
    if interval is None:
        return ""
    return f"({_number(interval.low)} to {_number(interval.high)})"


def _extent(summary: TaskSummary) -> str:
    if summary.minimum is None:
        return ""
    return f"{_number(summary.minimum)}..{_number(summary.maximum)}"
