# SPDX-License-Identifier: Apache-2.0
"""`mjrec verify`: make a packed run again, and compare."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Final, Literal

import rich.console
import rich.markup
import rich.table
import tyro

from .. import json_text
from ..evidence import summary
from ..evidence.findings import Outcome, Verdict, Verification
from ..evidence.verify import VerificationProgress
from ..evidence.verify import verify as verify_archive
from ..monitors.progress import progress_bar
from .help_text import flowing_help
from .terminal import printable, result_console

_MOST_FAILURES: Final = 20
_STYLES: Final = {
    str(Verdict.PASS): "bold green",
    str(Verdict.PARTLY): "bold yellow",
    str(Verdict.FAIL): "bold red",
    str(Outcome.MADE_AGAIN): "green",
    str(Outcome.WITHIN_TOLERANCE): "yellow",
    str(Outcome.BELIEVED): "yellow",
    str(Outcome.DIFFERENT): "red",
}


@flowing_help
def verify(
    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE|DIR")],
    /,
    *,
    level: Literal["files", "stats", "physics", "pixels"] = "pixels",
    sample: int | None = None,
    seed: int | None = None,
    trust: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    report: Path | None = None,
    verbose: bool = False,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Make a packed run again from its seeds and actions, and compare.

    What is verified may be anybody's: it is read, made again and compared in processes
    with limits, without network and home, and no code that it names is run. The exit
    status is 0 where everything was made again and is equal (PASS), 3 where nothing
    contradicts it and something is believed (PARTLY), 1 else (FAIL).

    Args:
        path: what mjrec pack has made, that unpacked, or a monitor directory.
        level: where to stop. files is the bag only; stats makes rewards, ends,
            statistics and the selection of episodes again; physics all states too;
            pixels all frames and files too.
        sample: how many frames of each video to draw; all, if left out.
        seed: of the random choice of these frames; one that nobody knows before, if
            left out. It is printed.
        trust: the id of an environment that may be made though it is in no registry of
            Gymnasium's or dm_control's. This runs code that you have installed. May be
            given several times.
        allow: an excuse that is taken, by name and value, "gl=NVIDIA H100" for
            instance. May be given several times.
        report: where to write a page about it (HTML, one file).
        verbose: show every finding.
        as_json: print one JSON object, instead of text.
    """
    with progress_bar(rich.console.Console(stderr=True)) as show:

        def show_progress(now: VerificationProgress) -> None:
            total = max(1, now.total)
            show(now.phase, now.done, total, f"{100 * now.done // total} %")

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
        sys.stdout.write(json_text.dumps(verification.as_json()) + "\n")
    else:
        _show(verification, result_console(), verbose=verbose)
    return verification.verdict.exit_status


def _show(
    verification: Verification, console: rich.console.Console, *, verbose: bool
) -> None:
    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    verdict = str(verification.verdict)
    say(f"[{_STYLES[verdict]}]{verdict}[/] {_plain(summary.headline(verification))}")
    for remark in summary.remarks(verification):
        say(f"  {_plain(remark)}")
    failures = summary.failures(verification)
    for failure in failures[:_MOST_FAILURES]:
        say(f"  [red]different:[/] {_plain(failure)}")
    if len(failures) > _MOST_FAILURES:
        say(f"  ... and {len(failures) - _MOST_FAILURES} more (--json has all)")
    for excuse in summary.excuses(verification):
        say(f"  [yellow]excuse:[/] {_plain(excuse)}")
    for said in summary.inputs(verification):
        say(f"  inputs: {_plain(said)}")
    if (sample := verification.facts.get("sample")) is not None:
        seed = verification.facts.get("seed")
        say(f"  {sample} frames of each video were drawn, chosen with --seed {seed}")
    console.print(_table(verification))
    if verbose:
        for finding in verification.findings:
            item = f"{finding.item}: " if finding.item else ""
            say(
                f"  {finding.topic}: {_plain(item)}{finding.outcome}, "
                f"{summary.counted(finding.count, finding.unit)} "
                f"{_plain(finding.reason)}"
            )


def _table(verification: Verification) -> rich.table.Table:
    table = rich.table.Table(box=None, show_header=False, pad_edge=False)
    for _ in range(3):
        table.add_column(overflow="fold")
    for line in summary.lines(verification):
        style = _STYLES.get(line.outcome, "dim")
        table.add_row(str(line.topic), f"[{style}]{line.outcome}[/]", _plain(line.text))
    return table


def _plain(text: str) -> str:
    return rich.markup.escape(printable(text))
