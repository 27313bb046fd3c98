# SPDX-License-Identifier: Apache-2.0
"""The temporary folder of a verification, and those that killed ones left behind."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from ..formats.locks import Lock, is_locked

_PREFIX = "mjrec-verify-"
# Held by the process whose folder it is in.
_LOCK = "lock"
# A lock is a file for a moment before it is held.
_A_MOMENT_S = 60.0


@contextlib.contextmanager
def working_folder() -> Iterator[Path]:
    """Yield a new folder, and remove it at the end.

    What verifications of the same user have left that were killed is removed first.
    """
    parent = Path(tempfile.gettempdir())
    for folder in parent.glob(f"{_PREFIX}*"):
        # One that goes away meanwhile, or that cannot be looked at, is no reason to
        # stop.
        with contextlib.suppress(OSError):
            if _is_abandoned(folder):
                shutil.rmtree(folder, ignore_errors=True)
    with tempfile.TemporaryDirectory(
        prefix=_PREFIX, ignore_cleanup_errors=True
    ) as name:
        folder = Path(name)
        lock = None
        # There are file systems without locks.
        with contextlib.suppress(OSError):
            lock = Lock(folder / _LOCK, "", mode=0o600)
        try:
            yield folder
        finally:
            if lock is not None:
                lock.release()


def _is_abandoned(folder: Path) -> bool:
    facts = folder.lstat()
    if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != os.getuid():
        return False
    # Where there is none, nothing says that its process has ended.
    age = time.time() - (folder / _LOCK).lstat().st_mtime
    return age > _A_MOMENT_S and not is_locked(folder / _LOCK)
