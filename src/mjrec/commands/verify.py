# SPDX-License-Identifier: Apache-2.0
"""`mjrec verify`: re-run a packed run and compare the results."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Final, Literal

import rich.box
import rich.console
import rich.markup
import rich.table
import tyro

from ..evidence import summary
from ..evidence.findings import Finding, Verification
from ..evidence.verify import VerificationProgress
from ..evidence.verify import verify as verify_archive
from ..monitors.progress import progress_bar
from ..plain_text import counted
from .options import AsJson
from .terminal import print_json, printable, result_console

_MOST_SHOWN: Final = 8
_COLOURS: Final = {"pass": "green", "open": "yellow", "fail": "bold red"}


def verify(
    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE|DIR")],
    /,
    *,
    level: Literal["files", "stats", "physics", "pixels"] = "pixels",
    report: Path | None = None,
    sample: int | None = None,
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    verbose: bool = False,
    trust: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    seed: int | None = None,
    as_json: AsJson = False,
) -> int:
    """Re-run a packed run from its seeds and actions, and compare the results.

    The archive may come from a stranger: it is read, run and compared in
    resource-limited processes without network or home directory, and no code that it
    names is executed. The exit status is 0 (PASS: all equal), 3 (PARTLY: nothing
    contradicts the archive, but some items had to be trusted) or 1 (FAIL).

    Args:
        path: an archive made by mjrec pack, an unpacked one, a monitor directory, or a
            directory with several, such as an evaluation.
        level: how far to check. files checks the bag; stats also checks rewards,
            episode ends, statistics and the selection of episodes; physics also checks
            all states; pixels also checks all frames and files.
        report: write an HTML page about the result to this file.
        sample: check only this many frames of each video.
        allow: accept an excuse, by name and value, such as "gl=NVIDIA H100". May be
            repeated.
        verbose: show every finding.
        trust: id of an environment that may be created even though it is not in
            Gymnasium's or dm_control's registry. This runs code that you have
            installed. May be repeated.
        seed: seed for --sample. Default: a random one, which is printed.
        as_json: print one JSON object instead of text.
    """
    with progress_bar(rich.console.Console(stderr=True)) as show:

        def show_progress(now: VerificationProgress) -> None:
            total = max(1, now.total)
            show(now.phase, now.done, total, f"{100 * now.done // total}%")

        verification = verify_archive(
            path,
            level=level,
            sample=sample,
            seed=seed,
            trust=trust,
            allow=allow,
            report=report,
            on_progress=show_progress,
        )
    if as_json:
        print_json(verification.as_json())
    else:
        show_verification(verification, result_console(), verbose=verbose)
    return verification.verdict.exit_status


def show_verification(
    verification: Verification, console: rich.console.Console, *, verbose: bool = False
) -> None:
    """Print a verification.

    Args:
        verification: the verification to print.
        console: the console to print to.
        verbose: list all findings, and the software and machine used for verification.
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
