# SPDX-License-Identifier: Apache-2.0
"""`mjrec.recover`: all that killed processes have left in a directory, in order."""

from __future__ import annotations

import math
import numbers
import os
from pathlib import Path

from ..errors import DirectoryNotWritable, InvalidArgument
from ..formats.locks import is_locked, wait_for_lock
from ..formats.second_names import give_all_second_names
from .killed_leftovers import Remains, has_work, is_open, model_leftovers, remains_of
from .recovery_report import Recovery

# One recovery of a directory at a time.
_LOCK = ".openaigym.recover.lock"
_SECONDS = 5.0


def recover(
    directory: str | os.PathLike[str], *, timeout: float = _SECONDS
) -> Recovery:
    """Put a directory in order whose monitors, or renderers, were killed.

    Videos that were recorded live get their names, and metadata that says
    `complete: false` and `reason: "killed"`; logs become trajectories that say the
    same; statistics and manifest are made of the journal; unfinished files that
    nobody will finish are removed. What was to be rendered stays pending: `mjrec
    render DIR`. Files of monitors that are open, and of renderers at work, are left
    alone. `docs/reliability.md` has the details.

    It may be killed at any moment and run again; run once more, it does nothing.

    Args:
        directory: the monitor directory.
        timeout: how many seconds to wait, in all, for encoders that have outlived the
            process that recorded, and are finishing their files.

    Returns:
        What was done. Where something could not be done, that is told there, and all
        else was done.

    Raises:
        InvalidArgument: there is no such directory.
        DirectoryNotWritable: it is read-only, and something is to be done.
    """
    path = Path(directory).absolute()
    seconds = _check_timeout(timeout)
    if not path.is_dir():
        raise InvalidArgument(f"There is no directory {path} to recover.")
    dead, open_monitors = _sorted_out(path)
    # Whoever is recovering holds the locks of the dead, who look alive meanwhile.
    if not (dead or model_leftovers(path) or is_locked(path / _LOCK)):
        return Recovery(path, open_monitors=open_monitors)
    # Not at the top: it loads HDF5, which a simulation that goes on where a closed
    # monitor left off has no use for.
    from .killed_monitors import KilledMonitors

    if not os.access(path, os.W_OK | os.X_OK):
        raise DirectoryNotWritable(path, "permission denied")
    try:
        lock = wait_for_lock(path / _LOCK, f"{os.getpid()}\n")
    except OSError as error:
        raise DirectoryNotWritable(path, error.strerror) from error
    try:
        # Once more, because another process may have done it meanwhile.
        dead, open_monitors = _sorted_out(path)
        killed_monitors = KilledMonitors(path, seconds=seconds)
        for remains in dead:
            killed_monitors.put_in_order(remains.infix)
        killed_monitors.sweep_models()
        give_all_second_names(path)
    finally:
        lock.release()
    files, failures = tuple(killed_monitors.files), tuple(killed_monitors.failures)
    return Recovery(path, files, failures, open_monitors)


def _check_timeout(timeout: object) -> float:
    is_number = isinstance(timeout, numbers.Real) and not isinstance(timeout, bool)
    if not is_number or not 0 <= timeout < math.inf:  # type: ignore[operator]  # is_number
        raise InvalidArgument(
            f"timeout must be a number of seconds, 0 or more, got {timeout!r}."
        )
    return float(timeout)  # type: ignore[arg-type]  # is_number


def _sorted_out(directory: Path) -> tuple[list[Remains], tuple[str, ...]]:
    """Return the monitors to be put in order, and the infixes of those open."""
    dead: list[Remains] = []
    still_open: list[str] = []
    for remains in remains_of(directory):
        try:
            if is_open(remains):
                still_open.append(str(remains.infix))
            elif has_work(remains):
                dead.append(remains)
        except OSError as error:
            raise DirectoryNotWritable(directory, error.strerror) from error
    return dead, tuple(still_open)
