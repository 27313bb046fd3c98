# SPDX-License-Identifier: Apache-2.0
"""`mjrec compare`: how much better the second of two evaluations is, or of two sets."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import rich.box
import rich.markup
import rich.table
import tyro

from .. import json_text
from ..errors import InvalidArgument
from ..evaluation.comparing import Comparison, TaskComparison
from ..evaluation.comparing import compare as compare_evaluations
from ..evaluation.requirements import parse_requirement
from ..evaluation.statistics import Interval
from .counted import counted
from .help_text import flowing_help
from .terminal import printable, result_console

_UNMET = 1


@flowing_help
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
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Compare evaluations: every figure is of B against A.

    A and B are two directories: mjrec compare A B. Or they are several each, one for
    each training: mjrec compare A... --against B... Then the figures are of the
    evaluations' mean returns, and say how much better the method of B is.

    For each task that all have: the means, their difference B - A, the probability of
    improvement (that B has a higher return than A), and the p-value of the Mann-Whitney
    test, adjusted (Holm) for the number of tasks. Over all of them: that probability on
    average, and the difference of the interquartile means of scores.

    The exit status is 1 where a task cannot be compared (no episode was completed, or
    returns are NaN). With --require or --no-worse-than also where that does not hold,
    and where an episode of B (with --no-worse-than B: of A) failed.

    Args:
        a: A and B; with --against, the directories of A.
        against: the directories of B.
        require: [TASK: ]FIGURE > NUMBER, also >=, < and <=, such as 'probability of
            improvement > 0.75'. Figures of all tasks: probability of improvement, IQM
            A, IQM B, IQM difference. Of the task named or, without one, of each: mean
            A, mean B, difference, paired difference, p-value. Behind a figure, low or
            high is that end of its interval. May be given several times.
        no_worse_than: A requires of B that the interquartile mean of its scores is not
            lower by --margin or more, as the interval has it; B the same of A.
        margin: of scores, such as 0.05.
        confidence: the share of intervals that hold the true value.
        resamples: of the bootstrap that intervals come from.
        seed: of its generator.
        as_json: print one JSON object, instead of text.
    """
    if not against:
        if len(a) != 2:
            raise InvalidArgument(
                "Two evaluations are compared (mjrec compare A B), or two sets (mjrec "
                f"compare A... --against B...), got {len(a)} without --against."
            )
        a, against = a[:1], a[1:]
    if (no_worse_than is None) != (margin is None):
        raise InvalidArgument("--no-worse-than and --margin belong together.")
    texts = list(require)
    if margin is not None:
        if margin < 0:
            raise InvalidArgument(f"--margin is 0 or more, got {margin:g}.")
        bound = f"low > -{margin}" if no_worse_than == "A" else f"high < {margin}"
        texts.append(f"IQM difference {bound}")
    required = [parse_requirement(text) for text in texts]
    comparison = compare_evaluations(
        a, against, confidence=confidence, resamples=resamples, seed=seed
    )
    unmet = [why for each in required for why in each.shortfalls(comparison)]
    if required:
        unmet += _failures(comparison, "A" if no_worse_than == "B" else "B")
    if as_json:
        sys.stdout.write(json_text.dumps(_fields(comparison, unmet)) + "\n")
    else:
        _show(comparison, unmet)
    cannot = len(comparison.compared) < len(comparison.tasks)
    return _UNMET if unmet or cannot else 0


def _failures(comparison: Comparison, side: str) -> Iterator[str]:
    for task in comparison.tasks:
        failed = task.failed_a if side == "A" else task.failed_b
        if failed:
            yield f"{task.task}: {counted(failed, 'episode')} of {side} failed"


def _show(comparison: Comparison, unmet: Sequence[str]) -> None:
    console = result_console()
    table = _table(comparison)
    for shown in (*_lines_before(comparison), table, *_lines_after(comparison, unmet)):
        if isinstance(shown, str):
            shown = rich.markup.escape(printable(shown))
        console.print(shown, highlight=False, soft_wrap=shown is not table)


def _lines_before(comparison: Comparison) -> Iterator[str]:
    for caution in comparison.cautions:
        yield f"Caution: {caution}."
    for name, directories, policy in (
        ("A", comparison.a, comparison.policy_a),
        ("B", comparison.b, comparison.policy_b),
    ):
        listed = ", ".join(map(str, directories))
        count = f"{len(directories)} evaluations: " if len(directories) > 1 else ""
        yield f"{name}: {count}{listed} (policy {policy})"


def _table(comparison: Comparison) -> rich.table.Table:
    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    rows = [_cells(each) for each in comparison.tasks]
    shown = [
        name
        for name in rows[0]
        if name != "B - A, paired" or any(row[name] for row in rows)
    ]
    for name in shown:
        table.add_column(
            name, justify="left" if name == "task" else "right", overflow="fold"
        )
    for row in rows:
        table.add_row(*(rich.markup.escape(printable(row[name])) for name in shown))
    return table


def _cells(each: TaskComparison) -> dict[str, str]:
    paired = each.paired
    return {
        "task": f"{each.task}: {each.unknown}" if each.unknown else each.task,
        "episodes A, B": f"{each.episodes_a}, {each.episodes_b}",
        "mean A": _number(each.mean_a),
        "mean B": _number(each.mean_b),
        "B - A": _number(each.difference, each.difference_interval),
        "B - A, paired": _number(paired.difference, paired.interval) if paired else "",
        "P(B > A)": _share(each.probability, each.probability_interval),
        "p (Holm)": _p_value(each.p_value_holm),
    }


def _lines_after(comparison: Comparison, unmet: Sequence[str]) -> Iterator[str]:
    percent = f"{comparison.bootstrap.confidence * 100:g} %"
    yield (
        f"In brackets: {percent} intervals, over {comparison.unit}. P(B > A): equal "
        "returns count half."
    )
    for name, tasks in (("A", comparison.only_in_a), ("B", comparison.only_in_b)):
        if tasks:
            yield f"Only in {name}: {', '.join(tasks)}"
    if comparison.remarks:
        yield f"The two also differ in: {'; '.join(comparison.remarks)}."
    yield _sentence(comparison)
    for why in unmet:
        yield f"Not met: {why}."


def _sentence(comparison: Comparison) -> str:
    """Return what the figures say, in words."""
    differences = [task.difference or 0.0 for task in comparison.compared]
    if not differences:
        return "No task could be compared."
    higher = sum(difference > 0 for difference in differences)
    same = sum(difference == 0 for difference in differences)
    text = (
        f"B has the higher mean return on {higher} of "
        f"{counted(len(differences), 'task')}{f', and the same on {same}' * bool(same)}"
        "; probability of improvement of B over A: "
        f"{_share(comparison.probability, comparison.probability_interval)}"
    )
    scores = comparison.scores
    if scores is not None:
        text += (
            f"; interquartile mean of scores {scores.iqm_a:.3f} in A and "
            f"{scores.iqm_b:.3f} in B, difference "
            f"{_share(scores.difference, scores.interval, digits=3)}"
        )
        count = len(scores.tasks)
        if count < len(differences):
            verb = "has" if count == 1 else "have"
            text += f" ({count} of the tasks {verb} a scale)"
    return f"{text}."


def _number(value: float | None, interval: Interval | None = None) -> str:
    return _shown(value, interval, ".6g")


def _share(value: float | None, interval: Interval | None, *, digits: int = 2) -> str:
    return _shown(value, interval, f".{digits}f")


def _shown(value: float | None, interval: Interval | None, form: str) -> str:
    if value is None:
        return ""
    if interval is None:
        return f"{value:{form}}"
    return f"{value:{form}} ({interval.low:{form}} to {interval.high:{form}})"


def _p_value(value: float | None) -> str:
    if value is None:
        return ""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _fields(comparison: Comparison, unmet: Sequence[str]) -> dict[str, Any]:
    """Return what `--json` prints: the fields of `Comparison`, and what is not met."""
    fields = dataclasses.asdict(comparison)
    a, b = (list(map(str, paths)) for paths in (comparison.a, comparison.b))
    return {**fields, "a": a, "b": b, "unmet": list(unmet)}
