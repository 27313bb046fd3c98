# SPDX-License-Identifier: Apache-2.0
"""`mjrec.recover`: finish the files that killed processes left in a directory."""

from __future__ import annotations

import math
import numbers
import os
import time
from dataclasses import dataclass
from pathlib import Path

from ..errors import DirectoryNotWritable, InvalidArgument
from ..formats.locks import is_locked, wait_for_lock
from ..formats.second_names import give_all_second_names
from ..results.monitor_files import monitors_of
from .recovery_needed import is_encoding, needs_recovery, stale_shared_files

# Only one process at a time may recover a directory.
_LOCK = ".openaigym.recover.lock"
_SECONDS = 5.0
_MOMENT = 0.05


@dataclass(frozen=True)
class RecoveredFile:
    """A file, and its state after a recovery.

    Attributes:
        name: the file's final base name.
        what: a description of what was done with the file, or why it failed.
    """

    name: str
    what: str

    def __str__(self) -> str:
        return f"{self.name}: {self.what}"


@dataclass(frozen=True)
class Recovery:
    """The result of `recover`, which is false if there was nothing to do.

    Attributes:
        directory: the directory.
        files: files that were finished.
        failures: files that could not be finished, with the reasons. The files are
            unchanged.
        open_monitors: infixes of monitors that are still recording. Their files were
            left alone.
    """

    directory: Path
    files: tuple[RecoveredFile, ...] = ()
    failures: tuple[RecoveredFile, ...] = ()
    open_monitors: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.files or self.failures)

    def __str__(self) -> str:
        if not self:
            lines = [f"Nothing to recover in {self.directory}."]
        elif not self.files:
            lines = [f"Nothing could be recovered in {self.directory}."]
        else:
            lines = [f"Recovered in {self.directory}:"]
        lines += [f"  {file}" for file in self.files]
        if self.failures:
            lines += ["Not recovered:", *(f"  {file}" for file in self.failures)]
        if self.open_monitors:
            listed = ", ".join(self.open_monitors)
            lines += [f"Still recording, and left alone: {listed}."]
        return "\n".join(lines)


def recover(
    directory: str | os.PathLike[str],
    *,
    timeout: float = _SECONDS,
    bundle: bool = False,
) -> Recovery:
    """Finish the files that killed monitors or renderers left in a directory.

    Live videos get their final names, and metadata with `complete: false` and `reason:
    "killed"`. Logs become trajectories with the same facts. The statistics and manifest
    are written from the journal. Unfinished files from dead processes are removed.
    Deferred videos stay pending: run `mjrec render DIR`. Files of open monitors and
    running renderers are left alone. See `docs/howto/recovery.md` for details.

    This function can be killed at any time and run again. A second run does nothing.

    Args:
        directory: the monitor directory.
        timeout: total number of seconds to wait for encoders that are still finishing
            a dead process's files.
        bundle: whether to put the trajectories from a monitor's logs into one file, as
            an evaluation does.

    Returns:
        The finished files and the failures. A failure does not affect other files.

    Raises:
        InvalidArgument: the directory does not exist, or `timeout` is invalid.
        DirectoryNotWritable: the directory is read-only, and there is something to do.
    """
    path = Path(directory).absolute()
    is_number = isinstance(timeout, numbers.Real) and not isinstance(timeout, bool)
    if not is_number or not 0 <= timeout < math.inf:
        raise InvalidArgument(
            f"timeout must be a number of seconds, 0 or more, got {timeout!r}."
        )
    deadline = time.monotonic() + timeout
    if not path.is_dir():
        raise InvalidArgument(f"Cannot recover {path}: it is not a directory.")
    dead, open_monitors = _dead_and_open(path)
    # While another process recovers the directory, it holds the locks of dead monitors,
    # which then look open.
    if not (dead or stale_shared_files(path) or is_locked(path / _LOCK)):
        return Recovery(path, open_monitors=open_monitors)
    # Imported here because it loads HDF5, which a simulation that resumes after a
    # closed monitor does not need.
    from .recover_monitor import Report, recover_monitor

    report = Report()
    if not os.access(path, os.W_OK | os.X_OK):
        raise DirectoryNotWritable(path, "permission denied")
    # Wait for encoders before taking any lock.
    while time.monotonic() < deadline and any(is_encoding(path, each) for each in dead):
        time.sleep(_MOMENT)
    with wait_for_lock(path / _LOCK):
        # Look again, because another process may have recovered them in the meantime.
        dead, open_monitors = _dead_and_open(path)
        for infix in dead:
            recover_monitor(path, infix, report, bundles=bundle)
        for stale in stale_shared_files(path):
            report.remove(stale)
        give_all_second_names(path)
    files, failures = (
        tuple(RecoveredFile(*each) for each in of)
        for of in (report.files, report.failures)
    )
    return Recovery(path, files, failures, open_monitors)


def _dead_and_open(directory: Path) -> tuple[list[str], tuple[str, ...]]:
    """Return the dead monitors that need work, and the infixes of open monitors."""
    dead: list[str] = []
    still_open: list[str] = []
    for files in monitors_of(directory):
        try:
            if files.is_open:
                still_open.append(files.infix)
            elif needs_recovery(files):
                dead.append(files.infix)
        except OSError as error:
            raise DirectoryNotWritable(directory, error.strerror) from error
    return dead, tuple(still_open)
