# SPDX-License-Identifier: Apache-2.0
"""`mjrec compare`: how much better the second of two evaluations is."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any

import rich.box
import rich.console
import rich.markup
import rich.table
import tyro

from .. import json_text
from ..evaluation.comparing import Comparison, TaskComparison
from ..evaluation.comparing import compare as compare_evaluations
from ..evaluation.summaries import Bootstrap, Interval
from .help_text import flowing_help
from .terminal import printable, result_console

_USUAL = Bootstrap()


@flowing_help
def compare(
    a: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="A")],
    b: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="B")],
    /,
    *,
    resamples: int = _USUAL.resamples,
    seed: int = _USUAL.seed,
    confidence: float = _USUAL.confidence,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Compare two evaluations: every figure is of B against A.

    For each task that both have: the means, their difference B - A, the probability
    that an episode of B has a higher return than one of A, and the p-value of the
    Mann-Whitney test, adjusted (Holm) for the number of tasks. Over all of them: that
    probability on average, and the difference of the interquartile means of scores.

    Args:
        a: the directory of an evaluation.
        b: the directory of another.
        resamples: of the bootstrap that intervals come from.
        seed: of its generator.
        confidence: the share of intervals that hold the true value.
        as_json: print one JSON object, instead of text.
    """
    how = dataclasses.replace(
        _USUAL, resamples=resamples, seed=seed, confidence=confidence
    )
    comparison = compare_evaluations(a, b, bootstrap=how)
    if as_json:
        sys.stdout.write(json_text.dumps(_fields(comparison)) + "\n")
    else:
        _show(comparison)
    return 0


def _show(comparison: Comparison) -> None:
    console = result_console()
    for line in _lines_before(comparison):
        _print(console, line)
    console.print(_table(comparison))
    for line in _lines_after(comparison):
        _print(console, line)


def _print(console: rich.console.Console, line: str) -> None:
    console.print(printable(line), highlight=False, markup=False, soft_wrap=True)


def _lines_before(comparison: Comparison) -> list[str]:
    return [
        *(f"Caution: {each}." for each in comparison.cautions),
        f"A: {comparison.a} (policy {comparison.policy_a})",
        f"B: {comparison.b} (policy {comparison.policy_b})",
    ]


def _table(comparison: Comparison) -> rich.table.Table:
    has_pairs = any(each.paired for each in comparison.tasks)
    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    table.add_column("task", overflow="fold")
    for name in (
        *("episodes A, B", "mean A", "mean B", "B - A"),
        *(["B - A, paired"] if has_pairs else []),
        *("P(B > A)", "p (Holm)"),
    ):
        table.add_column(name, justify="right")
    for each in comparison.tasks:
        cells = _cells(each, has_pairs=has_pairs)
        table.add_row(*(rich.markup.escape(printable(cell)) for cell in cells))
    return table


def _cells(each: TaskComparison, *, has_pairs: bool) -> list[str]:
    counts = f"{each.episodes_a}, {each.episodes_b}"
    if each.unknown is not None:
        return [f"{each.task}: {each.unknown}", counts]
    paired = each.paired
    shown = _with_interval(paired.difference, paired.interval) if paired else ""
    return [
        each.task,
        counts,
        _number(each.mean_a),
        _number(each.mean_b),
        _with_interval(each.difference, each.difference_interval),
        *([shown] if has_pairs else []),
        _share(each.probability, each.probability_interval),
        _p_value(each.p_value_holm),
    ]


def _lines_after(comparison: Comparison) -> list[str]:
    percent = f"{comparison.bootstrap.confidence * 100:g} %"
    lines = [f"In brackets: {percent} intervals. P(B > A): equal returns count half."]
    for name, tasks in (("A", comparison.only_in_a), ("B", comparison.only_in_b)):
        if tasks:
            lines.append(f"Only in {name}: {', '.join(tasks)}")
    if comparison.remarks:
        lines.append(f"The two also differ in: {'; '.join(comparison.remarks)}.")
    return [*lines, _sentence(comparison)]


def _sentence(comparison: Comparison) -> str:
    """Return what the figures say, in words."""
    compared = comparison.compared
    if not compared:
        return "No task could be compared."
    higher = sum(_is(each, above=True) for each in compared)
    lower = sum(_is(each, above=False) for each in compared)
    tasks = "1 task" if len(compared) == 1 else f"{len(compared)} tasks"
    text = f"B has the higher mean return on {higher} of {tasks}"
    if higher + lower < len(compared):
        text += f", and the same on {len(compared) - higher - lower}"
    chance = _share(comparison.probability, comparison.probability_interval)
    text += f"; probability of improvement of B over A: {chance}"
    scores = comparison.scores
    if scores is not None:
        text += (
            f"; interquartile mean of scores {scores.iqm_a:.3f} in A and "
            f"{scores.iqm_b:.3f} in B, difference "
            f"{_share(scores.difference, scores.interval, digits=3)}"
        )
        count = len(scores.tasks)
        if count < len(compared):
            verb = "has" if count == 1 else "have"
            text += f" ({count} of the tasks {verb} a scale)"
    return f"{text}."


def _is(each: TaskComparison, *, above: bool) -> bool:
    difference = each.difference or 0.0
    return difference > 0 if above else difference < 0


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def _p_value(value: float | None) -> str:
    if value is None:
        return ""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _with_interval(value: float | None, interval: Interval | None) -> str:
    if interval is None:
        return _number(value)
    return f"{_number(value)} ({_number(interval.low)} to {_number(interval.high)})"


def _share(value: float | None, interval: Interval | None, *, digits: int = 2) -> str:
    if value is None:
        return ""
    text = f"{value:.{digits}f}"
    if interval is None:
        return text
    return f"{text} ({interval.low:.{digits}f} to {interval.high:.{digits}f})"


def _fields(comparison: Comparison) -> dict[str, Any]:
    """Return what `--json` prints: the fields of `Comparison`."""
    fields = dataclasses.asdict(comparison)
    return {**fields, "a": str(comparison.a), "b": str(comparison.b)}
