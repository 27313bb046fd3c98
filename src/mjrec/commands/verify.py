# SPDX-License-Identifier: Apache-2.0
"""`mjrec verify`: make a packed run again, and compare."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import rich.console
import tyro

from .. import json_text
from ..evidence.verify import VerificationProgress
from ..evidence.verify import verify as verify_archive
from ..monitors.progress import progress_bar
from .help_text import flowing_help
from .terminal import result_console
from .verification_screen import show_verification


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
        path: what mjrec pack has made, that unpacked, a monitor directory, or one that
            holds some, such as an evaluation's.
        level: where to stop. files is the bag only; stats makes rewards, ends,
            statistics and the selection of episodes again; physics all states too;
            pixels all frames and files too.
        sample: how many frames of each video to draw; all, if left out.
        seed: of the random choice of these frames; one that cannot be foreseen, if
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
        show_verification(verification, result_console(), verbose=verbose)
    return verification.verdict.exit_status
