# SPDX-License-Identifier: Apache-2.0
"""`mjrec evaluate`: a policy in many environments, and what came of it."""

from __future__ import annotations

import fnmatch
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import rich.box
import rich.console
import rich.markup
import rich.progress
import rich.table
import tyro

from .. import json_text
from ..errors import InvalidArgument, UnknownName
from ..evaluation.dataclass_json import to_json
from ..evaluation.evaluating import evaluate as evaluate_policy
from ..evaluation.evaluation import Evaluation, EvaluationProgress
from ..evaluation.kept_episodes import keep_rule
from ..evaluation.results_files import PLAN_NAME
from ..evaluation.statistics import Interval
from ..evaluation.summaries import TaskSummary
from ..evaluation.task_sets import tasks_from
from .counted import counted
from .engine_options import NO_ENGINE, EngineOptions
from .environment_options import kwargs_of
from .help_text import flowing_help
from .terminal import printable, result_console
from .view_options import camera_of, size_of

T = TypeVar("T")

_FAILED = 1
_INTERRUPTED = 130
_SHOWN = 10
_MOST_SEEDS = 1_000_000


@dataclass(frozen=True)
class _Shortfall:
    """A task that is not as good as it has to be.

    Attributes:
        task: its name.
        reason: why.
    """

    task: str
    reason: str


@flowing_help
def evaluate(
    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TASK...")
    ] = (),
    /,
    *,
    policy: str | None = None,
    out: Path | None = None,
    episodes: int = 10,
    seeds: str | None = None,
    num_seeds: int | None = None,
    workers: int | None = None,
    keep: str = "best,median,worst",
    protocol: Literal["seeded", "suite"] = "seeded",
    resume: bool = False,
    force: bool = False,
    max_steps: int | None = None,
    episode_timeout: float | None = None,
    camera: str | None = None,
    size: str | None = None,
    max_fps: float = 60,
    quality: Literal["full", "draft"] = "full",
    env_kwargs: str = "{}",
    policy_kwargs: str = "{}",
    score_range: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    fail_under: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    allow_nan: bool = False,
    confidence: float = 0.95,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    engine_options: Annotated[
        tyro.conf.OmitArgPrefixes[EngineOptions], tyro.conf.arg(name="engine")
    ] = NO_ENGINE,
) -> int:
    """Evaluate a policy: so many episodes of each task, and what came of them.

    The exit status is 1 where an episode failed (the policy raised, or gave NaN or the
    wrong shape, or the environment raised), a return is NaN, or a task fell short of
    --fail-under; the results are written all the same. What was interrupted goes on
    with mjrec evaluate --resume DIR.

    Args:
        tasks: environments as in mjrec record, sets (dm_control:benchmarking,
            dm_control:all, dm_control:easy, dm_control:hard, dm_control:extra,
            gymnasium:mujoco), or patterns in quotes ('dm_control/walker-*').
        policy: random, zero, module:name or module:name(), as in mjrec record.
        out: the directory of the evaluation, empty or new.
        episodes: how many of each task and seed.
        seeds: of the runs, such as 0,1,2 or 0-99.
        num_seeds: how many, from 0 on, instead of --seeds; 5, if neither is given.
        workers: how many processes; one for each CPU, if it is not given. The results
            do not depend on it. With --engine, how many workers it has.
        keep: which episodes of each task get a video: best, best:N, median, worst,
            worst:N, failures and failures:N, separated by commas; or cubic, all or
            none.
        protocol: seeded: episode i of seed s starts from NumPy's SeedSequence([s, i]).
            suite: each task and seed has one random stream, seeded with s.
        resume: go on with the evaluation in the directory, and repeat nothing that is
            finished. mjrec evaluate --resume DIR is enough: what is not given is as it
            was. More tasks, seeds or episodes may be asked for.
        force: delete the evaluation that is in the directory.
        max_steps: ends an episode as truncated; 1000 where the environment itself has
            no limit.
        episode_timeout: an episode that takes more seconds has failed.
        camera: name or number; the model's tracking camera, where there is one, if it
            is not given.
        size: of the videos, WIDTHxHEIGHT in pixels.
        max_fps: the most frames for a second of simulated time.
        quality: full, or draft: several times faster, with coarser edges and shadows.
        env_kwargs: more arguments for each environment, as a JSON object.
        policy_kwargs: more arguments for the policy, likewise.
        score_range: TASK=LOW:HIGH, the returns that count as 0 and as 1 in what is said
            over all tasks. Those of dm_control have theirs. May be given several
            times.
        fail_under: TASK=VALUE. The exit status is 1 where the mean return of this task
            is below, or an episode of it failed. TASK may be a pattern. May be given
            several times.
        allow_nan: returns that are NaN or infinite do not make the exit status 1.
        confidence: the share of intervals that hold the true value.
        as_json: print one JSON object at the end, and nothing else.
        engine_options: where episodes are run and videos are drawn, in place of
            processes of this command.
    """
    height, width = size_of(size)
    ranges = _by_task("--score-range", score_range, _range_of, "TASK=LOW:HIGH")
    least = _by_task("--fail-under", fail_under, float, "TASK=VALUE")
    tasks, out = _tasks_and_directory(tasks, out, resume=resume)
    names = tasks_from(tasks) if tasks else ()
    if names:
        _matching(least, names)
    engine = engine_options.chosen(workers)
    console = rich.console.Console(stderr=True, quiet=as_json)
    try:
        with _Progress(console) as progress:
            evaluation = evaluate_policy(
                names,
                policy=policy,
                directory=out,
                episodes=episodes,
                seeds=_seeds_of(seeds),
                num_seeds=num_seeds,
                workers=workers if engine is None else None,
                engine=engine,
                keep=keep,
                protocol=protocol,
                resume=resume,
                force=force,
                episode_timeout=episode_timeout,
                policy_kwargs=kwargs_of(policy_kwargs, "--policy-kwargs"),
                max_steps=max_steps,
                camera=camera_of(camera),
                height=height,
                width=width,
                max_fps=max_fps,
                quality=quality,
                env_kwargs=kwargs_of(env_kwargs),
                score_ranges=ranges,
                confidence=confidence,
                on_progress=progress.show,
            )
    except KeyboardInterrupt:
        console.print(
            f"Interrupted. What was finished is in {out}: mjrec evaluate "
            f"--resume {out} goes on, and repeats none of it.",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
        return _INTERRUPTED
    least = _matching(least, [task.name for task in evaluation.plan.tasks])
    short = _shortfalls(evaluation, least)
    is_nan = bool(evaluation.not_finite) and not allow_nan
    if as_json:
        sys.stdout.write(json_text.dumps(_fields(evaluation, short)) + "\n")
    else:
        _show(evaluation, short)
    return _FAILED if evaluation.failed or short or is_nan else 0


def _tasks_and_directory(
    tasks: tuple[str, ...], out: Path | None, *, resume: bool
) -> tuple[tuple[str, ...], Path]:
    """Return the tasks and the directory; `--resume DIR` names only the latter."""
    if out is None and resume and tasks and (Path(tasks[-1]) / PLAN_NAME).is_file():
        return tasks[:-1], Path(tasks[-1])
    if out is None:
        raise InvalidArgument(
            "Say where the results go, --out DIR, or which evaluation goes on, "
            "--resume DIR."
        )
    return tasks, out


def _matching(least: Mapping[str, float], names: Sequence[str]) -> dict[str, float]:
    """Return what is asked for by task; a pattern is of all tasks that match it.

    Raises:
        UnknownName: no task matches.
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


@dataclass
class _Progress:
    """Shows how far an evaluation is: a bar on a terminal, some lines elsewhere."""

    console: rich.console.Console
    _said: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self._bar = rich.progress.Progress(
            rich.progress.TextColumn("{task.description}"),
            rich.progress.BarColumn(bar_width=30),
            rich.progress.TextColumn("{task.completed}/{task.total} {task.fields[of]}"),
            rich.progress.TimeElapsedColumn(),
            rich.progress.TextColumn("left:"),
            rich.progress.TimeRemainingColumn(),
            console=self.console,
            disable=not self.console.is_terminal,
            transient=True,
        )
        self._run = self._bar.add_task("running", total=None, of="episodes")
        self._draw: rich.progress.TaskID | None = None

    def __enter__(self) -> _Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, progress: EvaluationProgress) -> None:
        """Show how far it is."""
        failed = (
            f"episodes, {progress.failed} failed" if progress.failed else "episodes"
        )
        self._bar.update(
            self._run, completed=progress.done, total=progress.total, of=failed
        )
        if progress.videos:
            if self._draw is None:
                self._draw = self._bar.add_task("drawing", of="videos")
            self._bar.update(
                self._draw, completed=progress.videos_done, total=progress.videos
            )
        if not self.console.is_terminal:
            self._say(progress)

    def _say(self, progress: EvaluationProgress) -> None:
        """Say each tenth once, for the logs of machines."""
        tenth = 10 * progress.done // max(1, progress.total)
        if tenth > self._said:
            self._said = tenth
            self.console.print(
                f"{progress.done}/{progress.total} episodes", highlight=False
            )


def _by_task(
    option: str, given: Sequence[str], read: Callable[[str], T], form: str
) -> dict[str, T]:
    """Return what TASK=... options say, by task."""
    said: dict[str, T] = {}
    for text in given:
        # A path may have one in it.
        task, equals, value = text.rpartition("=")
        try:
            if not (task and equals):
                raise ValueError
            said[task] = _finite(read(value))
        except ValueError:
            raise InvalidArgument(f"{option} is {form}, got {text!r}.") from None
    return said


def _finite(value: T) -> T:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(value)
    return value


def _range_of(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    return float(low), float(high)


def _seeds_of(text: str | None) -> list[int] | None:
    if text is None:
        return None
    seeds: list[int] = []
    for part in text.split(","):
        ends = re.fullmatch(r"([0-9]{1,10})(?:-([0-9]{1,10}))?", part, re.ASCII)
        first = int(ends[1]) if ends else 0
        last = int(ends[2] or first) if ends else -1
        if not first <= last < first + _MOST_SEEDS:
            raise InvalidArgument(
                "--seeds are whole numbers, or ranges of them, with commas between, "
                f"such as 0,1,2 or 0-99, got {text!r}."
            )
        seeds += range(first, last + 1)
    return seeds


def _shortfalls(evaluation: Evaluation, least: Mapping[str, float]) -> list[_Shortfall]:
    found = []
    for task, value in least.items():
        summary = evaluation.summary(task)
        if summary.failed:
            found.append(
                _Shortfall(task, f"{counted(summary.failed, 'episode')} failed")
            )
        elif summary.mean is None:
            found.append(_Shortfall(task, "it has no mean return"))
        elif summary.mean < value:
            found.append(
                _Shortfall(
                    task, f"its mean return {summary.mean:.6g} is below {value:g}"
                )
            )
    return found


def _show(evaluation: Evaluation, short: Sequence[_Shortfall]) -> None:
    console = result_console()
    console.print(_table(evaluation))
    for line in _lines(evaluation, short):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _table(evaluation: Evaluation) -> rich.table.Table:
    table = rich.table.Table(box=rich.box.SIMPLE_HEAD, pad_edge=False)
    percent = f"{100 * evaluation.bootstrap.confidence:g} %"
    table.add_column("task", overflow="fold")
    for name in (
        *("episodes", "mean", percent, "IQM", "median", "min..max", "success"),
        "failed",
    ):
        table.add_column(name, justify="right")
    for summary in evaluation.summaries:
        style = "bold red" if summary.failed else ""
        table.add_row(
            rich.markup.escape(summary.task),
            str(summary.episodes),
            _number(summary.mean),
            _interval(summary.mean_interval),
            _number(summary.iqm),
            _number(summary.median),
            _extent(summary),
            _share(summary.success_rate),
            f"[{style}]{summary.failed}[/]" if style else "0",
        )
    return table


def _lines(evaluation: Evaluation, short: Sequence[_Shortfall]) -> list[str]:
    return [
        *_across_lines(evaluation),
        *_failure_lines(evaluation),
        *_nan_lines(evaluation),
        *_example_lines(evaluation),
        *(f"{each.task} falls short: {each.reason}." for each in short),
        *_video_lines(evaluation),
        f"The results are in {evaluation.directory.absolute()}",
    ]


def _across_lines(evaluation: Evaluation) -> list[str]:
    across = evaluation.across
    if len(across.tasks) < 2:
        return []
    figures = ", ".join(
        [
            _figure("IQM", across.iqm, across.iqm_interval),
            _figure("mean", across.mean, None),
            _figure("median", across.median, None),
            _figure(
                "optimality gap",
                across.optimality_gap,
                across.optimality_gap_interval,
            ),
        ]
    )
    return [
        f"Over {counted(len(across.tasks), 'task')}, as scores from 0 to 1: {figures}",
        *(
            f"  without {task}: {printable(reason)}"
            for task, reason in across.left_out.items()
        ),
    ]


def _failure_lines(evaluation: Evaluation) -> list[str]:
    failed = evaluation.failed
    if not failed:
        return []
    count = f"{len(failed)} of {counted(len(evaluation.results), 'episode')} failed:"
    by_reason: dict[str, list[str]] = {}
    for each in failed:
        name = f"{each.task} seed {each.seed} episode {each.episode}"
        by_reason.setdefault(str(each.failure), []).append(name)
    lines = [
        f"  {printable(names[0])}{_and_more(len(names) - 1)}: {printable(reason)}"
        for reason, names in by_reason.items()
    ]
    rest = len(lines) - _SHOWN
    more = [f"  and {rest} more reasons, in results.csv"] if rest > 0 else []
    return [count, *lines[:_SHOWN], *more]


def _nan_lines(evaluation: Evaluation) -> list[str]:
    found = evaluation.not_finite
    if not found:
        return []
    first = found[0]
    return [
        f"{counted(len(found), 'return')} NaN or infinite, which is no success "
        f"(--allow-nan): {first.task} seed {first.seed} episode {first.episode}"
        f"{_and_more(len(found) - 1)}"
    ]


def _example_lines(evaluation: Evaluation) -> list[str]:
    """Return the best, median and worst episode of each task, each with a file."""
    lines = []
    rule = keep_rule("best,median,worst")
    for task in evaluation.plan.tasks[:_SHOWN]:
        own = [each for each in evaluation.results if each.task == task.name]
        for each, role in rule.choose(own):
            lines.append(
                f"  {role:6}  {_number(each.total_reward):>10}  {task.name} seed "
                f"{each.seed} episode {each.episode}  {evaluation.file_of(each)}"
            )
    return lines


def _video_lines(evaluation: Evaluation) -> list[str]:
    lines = []
    if evaluation.videos:
        lines.append(f"{counted(len(evaluation.videos), 'video')}:")
        lines += [f"  {path}" for path in evaluation.videos[:_SHOWN]]
        rest = len(evaluation.videos) - _SHOWN
        lines += [f"  and {rest} more"] if rest > 0 else []
    if evaluation.pending:
        lines.append(f"{counted(len(evaluation.pending), 'video')} could not be drawn:")
        by_reason: dict[str, list[str]] = {}
        for path, reason in evaluation.pending.items():
            by_reason.setdefault(reason, []).append(path.name)
        lines += [
            f"  {names[0]}{_and_more(len(names) - 1)}: {printable(reason)}"
            for reason, names in by_reason.items()
        ]
    return lines


def _fields(evaluation: Evaluation, short: Sequence[_Shortfall]) -> dict[str, Any]:
    return {
        "directory": str(evaluation.directory.absolute()),
        "episodes": len(evaluation.results),
        "failed": len(evaluation.failed),
        "not_finite": len(evaluation.not_finite),
        "tasks": [to_json(each) for each in evaluation.summaries],
        "across": to_json(evaluation.across),
        "videos": [str(path) for path in evaluation.videos],
        "pending": {str(path): why for path, why in evaluation.pending.items()},
        "below": {each.task: each.reason for each in short},
    }


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _figure(name: str, value: float | None, interval: Interval | None) -> str:
    return " ".join(filter(None, [name, _number(value), _interval(interval)]))


def _interval(interval: Interval | None) -> str:
    if interval is None:
        return ""
    return f"({_number(interval.low)} to {_number(interval.high)})"


def _extent(summary: TaskSummary) -> str:
    if summary.minimum is None:
        return ""
    return f"{_number(summary.minimum)}..{_number(summary.maximum)}"


def _share(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f} %"


def _and_more(number: int) -> str:
    return f" and {number} more" if number else ""
