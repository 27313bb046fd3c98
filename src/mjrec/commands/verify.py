# SPDX-License-Identifier: Apache-2.0
"""`mjrec verify`: what a packed run proves, item by item."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import rich.box
import rich.console
import rich.markup
import rich.table
import tyro

from .. import json_text
from ..evidence.verification import Check, Level, Verdict, Verification
from ..evidence.verifying import verify as verify_archive
from ..monitors.progress import progress_bar
from .help_text import flowing_help
from .terminal import printable, result_console

_FAILED = 1
_MOST_SHOWN = 50

_QUESTIONS: Final[Mapping[Level, str]] = {
    Level.FILES: "are all files there, unchanged?",
    Level.STATS: "do statistics follow from rewards, and videos from the schedule?",
    Level.PHYSICS: "do states follow from actions?",
    Level.PIXELS: "do pictures follow from states?",
}
_STYLES: Final[Mapping[Verdict, str]] = {
    Verdict.PASS: "green",
    Verdict.FAIL: "bold red",
    Verdict.NOT_CHECKABLE: "yellow",
}


@flowing_help
def verify(
    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE|DIR")],
    /,
    *,
    level: Literal["files", "stats", "physics", "pixels"] = "pixels",
    sample: int | None = None,
    seed: int = 0,
    trust: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    report: Path | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Check a packed run, and say item by item what it proves.

    What is checked may be anybody's: it is unpacked into a temporary folder, read in a
    process of its own with limits, and no code that it names is run. The exit status
    is 0 where nothing failed; what is not checkable is no failure, and no proof.

    Args:
        path: what mjrec pack has made, be it unpacked, or a monitor directory.
        level: how deep to go; each level includes those before it.
        sample: how many frames of each video to draw again; all, if left out.
        seed: of the random choice of these frames.
        trust: the id of an environment that may be made though it is in no registry of
            Gymnasium's or dm_control's. This runs code that you have installed. May be
            given several times.
        report: where to write a page about it (HTML, one file).
        as_json: print one JSON object, instead of text.
    """
    console = rich.console.Console(stderr=True)
    with progress_bar(console) as show:
        verification = verify_archive(
            path,
            level=level,
            sample=sample,
            seed=seed,
            trust=trust,
            report=report,
            on_progress=lambda progress: show(
                progress.level.value,
                progress.done,
                max(1, progress.total),
                f"{100 * progress.done // max(1, progress.total)} %",
            ),
        )
    if as_json:
        sys.stdout.write(json_text.dumps(_fields(verification)) + "\n")
    else:
        _show(verification)
    return 0 if verification.passed else _FAILED


def _show(verification: Verification) -> None:
    console = result_console()
    for level in verification.level.included:
        checks = [check for check in verification.checks if check.level is level]
        console.print(_table(level, checks))
    console.print(_verdict(verification), highlight=False, markup=False, soft_wrap=True)


def _table(level: Level, checks: list[Check]) -> rich.table.Table:
    table = rich.table.Table(
        title=f"{level.value}: {_QUESTIONS[level]}",
        title_justify="left",
        title_style="bold",
        box=rich.box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        pad_edge=False,
        show_header=False,
        expand=False,
    )
    for ratio in (None, 2, 3):
        table.add_column(ratio=ratio, overflow="fold")
    # What failed comes first, and is never left out.
    order = [Verdict.FAIL, Verdict.NOT_CHECKABLE, Verdict.PASS]
    groups = sorted(_alike(checks), key=lambda group: order.index(group[0].verdict))
    failed = sum(group[0].verdict is Verdict.FAIL for group in groups)
    most = max(_MOST_SHOWN, failed)
    for group in groups[:most]:
        table.add_row(*map(_cell, _texts(group)), style=None)
    if len(groups) > most:
        table.add_row("", f"... and {len(groups) - most} more (--json has all)", "")
    return table


def _alike(checks: list[Check]) -> Iterable[list[Check]]:
    """Return the checks in groups of those that say the same of several subjects."""
    groups: dict[Any, list[Check]] = {}
    for number, check in enumerate(checks):
        key: Any = (check.verdict, check.claim)
        if check.verdict is Verdict.FAIL:
            key = number
        elif check.verdict is Verdict.NOT_CHECKABLE:
            key = (*key, check.reason)
        groups.setdefault(key, []).append(check)
    return groups.values()


def _texts(group: list[Check]) -> tuple[tuple[str, str], ...]:
    first, last = group[0], group[-1]
    what = f"{first.subject}: {first.claim}" if first.subject else first.claim
    reason = first.reason
    if len(group) > 1:
        what = f"{len(group)} times, {first.subject} to {last.subject}: {first.claim}"
        is_same = all(check.reason == reason for check in group)
        reason = reason if is_same else f"{reason}; others likewise (--json has all)"
    return (first.verdict.value, _STYLES[first.verdict]), (what, ""), (reason, "")


def _cell(text: tuple[str, str]) -> str:
    words = rich.markup.escape(printable(text[0]))
    return f"[{text[1]}]{words}[/]" if text[1] else words


def _verdict(verification: Verification) -> str:
    counts = {verdict: verification.count(verdict) for verdict in Verdict}
    numbers = (
        f"{counts[Verdict.PASS]} passed, {counts[Verdict.FAIL]} failed, "
        f"{counts[Verdict.NOT_CHECKABLE]} not checkable"
    )
    if not verification.passed:
        return f"FAILED: {numbers}."
    if counts[Verdict.NOT_CHECKABLE]:
        return f"Nothing failed: {numbers}. What is not checkable is not proved."
    return f"Verified: {numbers}."


def _fields(verification: Verification) -> dict[str, Any]:
    """Return what `--json` prints; `docs/verifying.md` says what each field is."""
    return {
        "path": str(verification.path),
        "level": verification.level.value,
        "passed": verification.passed,
        "counts": {verdict.value: verification.count(verdict) for verdict in Verdict},
        "checks": [
            {
                "level": check.level.value,
                "verdict": check.verdict.value,
                "claim": check.claim,
                "subject": check.subject,
                "reason": check.reason,
                "figures": dict(check.figures),
            }
            for check in verification.checks
        ],
        "facts": dict(verification.facts),
    }
