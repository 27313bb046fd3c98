# SPDX-License-Identifier: Apache-2.0
"""`mjrec compare`: compare two evaluations, or two sets of them."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import rich.markup
import rich.table
import tyro

from ..errors import InvalidArgument
from ..evaluation.comparing import TASK_FIGURES, Comparison
from ..evaluation.comparing import compare as compare_evaluations
from ..evaluation.requirements import parse_requirement
from ..evaluation.statistics import Estimate
from ..plain_text import counted
from .options import AsJson
from .terminal import print_json, print_lines, printable, result_console, table

_UNMET = 1


def compare(
    a: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="DIRECTORY...")
    ],
    /,
    *,
    against: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DIRECTORY...")] = (),
    require: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    no_worse_than: Literal["A", "B"] | None = None,
    margin: float | None = None,
    confidence: float = 0.95,
    resamples: int = 10_000,
    seed: int = 0,
    allow_nan: bool = False,
    as_json: AsJson = False,
) -> int:
    """Compare evaluations: how much better is B than A?

    Compare two directories (mjrec compare A B), or several training runs on each side
    (mjrec compare A... --against B...). With several, each evaluation counts as one
    training run, represented by its mean return.

    For each common task, the output shows both means, their difference B - A, the
    probability of improvement (B's return is higher than A's), and the p-value of the
    Mann-Whitney test, adjusted for the number of tasks (Holm). Across tasks, it
    shows the mean probability of improvement and the difference between the IQMs.

    The exit status is 1 if a task cannot be compared (no completed episode, or NaN), or
    if a requirement of --require or --no-worse-than is not met. With either option, it
    is also 1 if an episode of B failed (or of A, for --no-worse-than B).

    Args:
        a: A and B; with --against, the directories of A.
        against: the directories of B.
        require: [TASK: ]FIGURE > NUMBER, or with >=, < or <=, such as 'probability of
            improvement > 0.75'. Figures across tasks: probability of improvement, IQM
            A, IQM B, IQM difference. Figures of TASK, or of each task: mean A, mean B,
            difference, paired difference, p-value. Append low or high to a figure for
            that end of its interval. May be repeated.
        no_worse_than: A requires that, according to the interval, B's interquartile
            mean score is less than --margin below A's; B requires the reverse.
        margin: a score difference, such as 0.05.
        confidence: confidence level of the intervals.
        resamples: bootstrap resamples.
        seed: seed of the bootstrap.
        allow_nan: do not exit with status 1 because of NaN or infinite returns.
        as_json: print one JSON object instead of text.
    """
    if not against:
        if len(a) != 2:
            raise InvalidArgument(
                "Give two evaluations (mjrec compare A B), or two sets of evaluations "
                f"(mjrec compare A... --against B...), not {len(a)} without --against."
            )
        a, against = a[:1], a[1:]
    if (no_worse_than is None) != (margin is None):
        raise InvalidArgument("--no-worse-than and --margin must be given together.")
    texts = list(require)
    if margin is not None:
        if margin < 0:
            raise InvalidArgument(f"--margin must be 0 or more, got {margin:g}.")
        bound = f"low > -{margin}" if no_worse_than == "A" else f"high < {margin}"
        texts.append(f"IQM difference {bound}")
    required = [parse_requirement(text) for text in texts]
    comparison = compare_evaluations(
        a, against, confidence=confidence, resamples=resamples, seed=seed
    )
    unmet = [why for each in required for why in each.shortfalls(comparison)]
    if required:
        side, name = (0, "A") if no_worse_than == "B" else (1, "B")
        failed = {task.task: task.failed[side] for task in comparison.tasks}
        unmet += [
            f"{task}: {counted(count, 'episode')} of {name} failed"
            for task, count in failed.items()
            if count
        ]
    if as_json:
        sides = {side: list(map(str, getattr(comparison, side))) for side in "ab"}
        print_json({**dataclasses.asdict(comparison), **sides, "unmet": unmet})
    else:
        console = result_console()
        print_lines(console, map(printable, _lines_before(comparison)))
        console.print(_table(comparison))
        after = (f"Not met: {why}." for why in unmet)
        lines = itertools.chain(_lines_after(comparison), after)
        print_lines(console, map(printable, lines))
    unknown = any(
        task.unknown and not (allow_nan and any(task.not_finite))
        for task in comparison.tasks
    )
    return _UNMET if unmet or unknown else 0


def _lines_before(comparison: Comparison) -> Iterator[str]:
    for caution in comparison.cautions:
        yield f"Caution: {caution}."
    for name, directories, policy in zip(
        "AB", (comparison.a, comparison.b), comparison.policies, strict=True
    ):
        count = f"{len(directories)} evaluations: " if len(directories) > 1 else ""
        yield f"{name}: {count}{', '.join(map(str, directories))} (policy {policy})"


def _table(comparison: Comparison) -> rich.table.Table:
    # Not all comparisons have a column of paired differences.
    names = [n for n in TASK_FIGURES if any(n in t.figures for t in comparison.tasks)]
    made = table(["task", "episodes", *names])
    for task in comparison.tasks:
        label = f"{task.task}: {task.unknown}" if task.unknown else task.task
        made.add_row(
            rich.markup.escape(printable(label)),
            ", ".join(map(str, task.episodes)),
            *(_cell(name, task.figures.get(name)) for name in names),
        )
    return made


def _cell(name: str, estimate: Estimate | None) -> str:
    if estimate is None:
        return ""
    # The table has no room for the means' intervals.
    if name.startswith("mean"):
        return _number(estimate.value)
    return _estimate(estimate).replace(" (", "\n(")


def _lines_after(comparison: Comparison) -> Iterator[str]:
    percent = f"{comparison.bootstrap.confidence * 100:g}%"
    yield (
        f"In brackets: {percent} intervals over {comparison.unit}. Ties count as half "
        "in the probability of improvement; p-values are Holm-adjusted."
    )
    for name, tasks in zip("AB", comparison.left_out, strict=True):
        if tasks:
            yield f"Only in {name}: {', '.join(tasks)}"
    if comparison.remarks:
        yield f"The two also differ in: {'; '.join(comparison.remarks)}."
    yield _sentence(comparison)


def _sentence(comparison: Comparison) -> str:
    """Return a summary of the figures in one sentence."""
    differences = [
        each.figures["difference"].value for each in comparison.tasks if each.figures
    ]
    if not differences:
        return "No task could be compared."
    higher = sum(difference > 0 for difference in differences)
    same = differences.count(0)
    tasks = counted(len(differences), "task")
    text = f"B has the higher mean return on {higher} of {tasks}"
    if same:
        text += f", and the same on {same}"
    for name, estimate in comparison.figures.items():
        text += f"; {name} {_estimate(estimate)}"
    if 0 < len(comparison.scored) < len(differences):
        text += f" (scores of {counted(len(comparison.scored), 'task')})"
    return f"{text}."


def _estimate(estimate: Estimate) -> str:
    interval = estimate.interval
    if interval is None:
        return _number(estimate.value)
    ends = f"{_number(interval.low)} to {_number(interval.high)}"
    return f"{_number(estimate.value)} ({ends})"


def _number(value: float) -> str:
    return f"{value:.4g}" if abs(value) < 1000 else f"{value:.1f}"
