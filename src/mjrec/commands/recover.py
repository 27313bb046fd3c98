# SPDX-License-Identifier: Apache-2.0
"""`mjrec recover`: finish what killed processes left in a directory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from ..evaluation.evaluation import is_evaluation
from ..formats.json_fields import to_json
from ..formats.monitor_directory import monitor_directories_in
from ..rendering.recovery import RecoveredFile, Recovery
from ..rendering.recovery import recover as recover_directory
from .options import AsJson
from .terminal import FAILED, print_json, print_lines, result_console


def recover(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    timeout: float = 5.0,
    as_json: AsJson = False,
) -> int:
    """Finish what a killed recording or rendering left in a directory.

    Live videos get their final names, logs become trajectories, and the statistics and
    manifest are rebuilt from the journal. Recordings that were cut off are marked
    incomplete. Files of running processes are not touched. Deferred videos stay
    pending; render them with mjrec render DIR.

    Args:
        directory: a monitor directory or an evaluation.
        timeout: seconds to wait for encoders that are still finishing their files.
        as_json: print one JSON object instead of text.
    """
    recovery = _recover_all(directory, timeout)
    if as_json:
        print_json(to_json(recovery))
    else:
        print_lines(result_console(), [str(recovery)])
    return FAILED if recovery.failures else 0


def _recover_all(directory: Path, timeout: float) -> Recovery:
    """Recover a directory and, for an evaluation, the monitor directories in it."""
    recovery = recover_directory(directory, timeout=timeout)
    for below in monitor_directories_in(directory) if is_evaluation(directory) else ():
        found = recover_directory(below, timeout=timeout, bundle=True)
        folder = below.relative_to(directory)
        files, failures = (
            tuple(RecoveredFile(f"{folder}/{each.name}", each.what) for each in of)
            for of in (found.files, found.failures)
        )
        recovery = Recovery(
            recovery.directory,
            recovery.files + files,
            recovery.failures + failures,
            recovery.open_monitors + found.open_monitors,
        )
    return recovery
