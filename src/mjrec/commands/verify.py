# SPDX-License-Identifier: Apache-2.0
"""`mjrec verify`: re-run a packed run and compare the results."""

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
    report: Path | None = None,
    sample: int | None = None,
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    verbose: bool = False,
    trust: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    seed: int | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Re-run a packed run from its seeds and actions, and compare the results.

    The archive may come from a stranger: it is read, run and compared in processes with
    limits, without network or home directory, and no code that it names is executed.
    The exit status is 0 (PASS: all equal), 3 (PARTLY: nothing contradicts the archive,
    but something had to be taken on trust) or 1 (FAIL).

    Args:
        path: an archive made by mjrec pack, an unpacked one, a monitor directory, or a
            directory with several, such as an evaluation.
        level: where to stop. files checks the bag; stats also rewards, ends, statistics
            and the selection of episodes; physics also all states; pixels also all
            frames and files.
        report: write an HTML page about the result to this file.
        sample: check only this many frames of each video.
        allow: accept an excuse, by name and value, such as "gl=NVIDIA H100". May be
            repeated.
        verbose: show every finding.
        trust: id of an environment that may be created even though it is not in
            Gymnasium's or dm_control's registry. This runs code that you have
            installed. May be repeated.
        seed: seed for --sample. By default a random one, which is printed.
        as_json: print one JSON object instead of text.
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
