# SPDX-License-Identifier: Apache-2.0
"""A verification on one screen: the verdict, excuses, and a line for each topic."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import rich.box
import rich.console
import rich.markup
import rich.table

from ..evidence import summary
from ..evidence.findings import Finding, Verification
from ..plain_text import counted
from .terminal import printable

_MOST_SHOWN: Final = 8
_COLOURS: Final = {"pass": "green", "open": "yellow", "fail": "bold red"}


def show_verification(
    verification: Verification, console: rich.console.Console, *, verbose: bool = False
) -> None:
    """Print a verification.

    Args:
        verification: the verification to print.
        console: the console to print to.
        verbose: list all findings, and the software and machine it was verified with.
    """
    most = None if verbose else _MOST_SHOWN
    verdict = f"[bold]{_styled(str(verification.verdict))}[/]"
    console.print(f"{verdict}  {_plain(summary.headline(verification))}")
    _list(console, "", summary.remarks(verification), most)
    _list(console, "Different", summary.failures(verification), most)
    _list(console, "Excuses", summary.excuses(verification), most)
    console.print(_table(verification))
    if drawn := summary.sampled(verification):
        console.print(f"  {drawn}")
    _list(console, "Inputs", summary.inputs(verification), most)
    if verbose:
        rows = [_finding(each) for each in verification.findings]
        _list(console, "Findings", rows, None)
        facts = (f"{key}: {value}" for key, value in verification.facts.items())
        _list(console, "Verified with", facts, None)


def _table(verification: Verification) -> rich.table.Table:
    table = rich.table.Table(
        box=rich.box.SIMPLE, show_header=False, pad_edge=False, padding=(0, 2, 0, 0)
    )
    for ratio in (None, None, 1):
        table.add_column(ratio=ratio, overflow="fold", no_wrap=ratio is None)
    for line in summary.lines(verification):
        table.add_row(str(line.topic), _styled(line.outcome), _plain(line.text))
    return table


def _finding(finding: Finding) -> str:
    many = counted(finding.count, finding.unit)
    excuse = f" (excuse: {finding.excuse})" if finding.excuse else ""
    parts = (finding.topic, finding.outcome, finding.item, many, finding.reason)
    return " | ".join(str(part) for part in parts if part) + excuse


def _list(
    console: rich.console.Console, title: str, rows: Iterable[str], most: int | None
) -> None:
    texts = list(rows)
    if not texts:
        return
    if title:
        console.print(f"[bold]{title}[/]")
    for text in texts[:most]:
        console.print(f"  {_plain(text)}", highlight=False, soft_wrap=True)
    if most is not None and len(texts) > most:
        console.print(f"  ... and {len(texts) - most} more (--verbose lists all)")


def _styled(word: str) -> str:
    style = summary.STYLES.get(word)
    return word if style is None else f"[{_COLOURS[style]}]{word}[/]"


def _plain(text: str) -> str:
    return rich.markup.escape(printable(text))
