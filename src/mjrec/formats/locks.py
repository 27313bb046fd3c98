# SPDX-License-Identifier: Apache-2.0
"""Lock files. The kernel, not a process id, shows whether the holder is alive.

An open monitor keeps `.openaigym.<infix>.lock` locked (with `flock`). The kernel
releases the lock no matter how the process ends, so a lock file that no process holds
was left by a dead monitor. A process id would not show this, because process ids are
reused, especially in containers.

A monitor's lock is never reused, because its name belongs to that monitor alone. The
other locks (for rendering a video, using a CPU or rewriting a manifest) are reused, and
a lock file left by a dead process is taken over.

A directory may be untrusted. A link, a pipe or a file with a second hard link in place
of a lock file is never followed, written to or waited for. Acquiring such a lock raises
an error.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import time
import weakref
from pathlib import Path
from typing import Self

from ..errors import DirectoryNotWritable

# `is_locked` briefly holds the lock, which is not a reason to give up.
_MOMENTS = 5
_MOMENT = 0.002

# Do not follow a link, and do not block if the file is a pipe.
_CAREFULLY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
# The errors for a link, a directory, and a socket or a device without a driver.
_OF_OTHER_THINGS = (errno.ELOOP, errno.EISDIR, errno.ENXIO)

# A forked child shares the lock and could keep it held after its parent is killed.
_held: weakref.WeakSet[Lock] = weakref.WeakSet()


class Lock:
    """A new file at `path`, locked until `release` or the end of the process.

    Args:
        path: the file to create; it must not exist.
        content: information about the lock's holder for other processes. It remains
            when the holder dies.
        mode: the file's permission bits.

    Raises:
        FileExistsError: the file exists, whether or not a process holds it.
        OSError: the file cannot be created.
    """

    def __init__(self, path: Path, content: str, *, mode: int = 0o644) -> None:
        # Python opens every descriptor with close-on-exec, so an encoder that outlives
        # this process does not keep the lock.
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
        descriptor = os.open(path, flags, mode)
        self._take(path, descriptor)
        try:
            if not self._lock(fcntl.LOCK_EX):
                # Until it was locked, the file looked like a dead monitor's lock.
                raise FileExistsError(f"{path} was removed while it was being locked")
            os.write(descriptor, content.encode())
        except BaseException:
            self.release()
            raise

    def _take(self, path: Path, descriptor: int) -> None:
        self._path = path
        self._descriptor: int | None = descriptor
        _held.add(self)

    def _lock(self, operation: int) -> bool:
        """Lock the file, and return whether it is still the file at the path."""
        fcntl.flock(self.fileno(), operation)
        return _is_at(self.fileno(), self._path)

    def fileno(self) -> int:
        """Return the file descriptor. A process that inherits it holds the lock too."""
        if self._descriptor is None:
            raise ValueError(f"{self._path.name} is no longer locked")
        return self._descriptor

    def let_go(self) -> None:
        """Release the lock but leave the file. Idempotent."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def release(self) -> None:
        """Remove the file and release the lock. Idempotent.

        If another program has replaced the file, the new file is kept.
        """
        try:
            # Remove the file before unlocking it, so that it is never seen unlocked.
            if self._descriptor is not None and _is_at(self._descriptor, self._path):
                self._path.unlink(missing_ok=True)
        finally:
            self.let_go()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def try_lock(path: Path) -> Lock | None:
    """Return a lock at `path`, or None if another process holds it.

    A file that no process holds is taken over, and its content is kept. A missing file
    is created.

    Raises:
        DirectoryNotWritable: the file cannot be created or opened, or is a link or not
            a regular file.
    """
    for _ in range(_MOMENTS):
        with contextlib.suppress(BlockingIOError):
            return _taken(path, fcntl.LOCK_EX | fcntl.LOCK_NB)
        time.sleep(_MOMENT)
    return None


def wait_for_lock(path: Path) -> Lock:
    """Acquire the lock at `path`, waiting until no other process holds it.

    Raises:
        DirectoryNotWritable: see `try_lock`.
    """
    return _taken(path, fcntl.LOCK_EX)


def _taken(path: Path, operation: int) -> Lock:
    try:
        while True:
            lock = Lock.__new__(Lock)
            lock._take(path, _opened(path))
            try:
                # Its holder may have removed the file after we opened it, and another
                # process may have created a new one. Then our lock guards nothing.
                if lock._lock(operation):
                    return lock
            except BaseException:
                lock.let_go()
                raise
            lock.let_go()
    except BlockingIOError:
        raise
    except OSError as error:
        raise DirectoryNotWritable(path.parent, error.strerror) from error


def _opened(path: Path) -> int:
    """Return a descriptor for the lock file at `path`, creating it if missing."""
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR | _CAREFULLY, 0o644)
    except OSError as error:
        if error.errno not in _OF_OTHER_THINGS:
            raise
    else:
        facts = os.fstat(descriptor)
        # A file that has just been removed has no links at all.
        if stat.S_ISREG(facts.st_mode) and facts.st_nlink <= 1:
            return descriptor
        os.close(descriptor)
    what = (
        f"{path.name} is a link or not a regular file, so it is not a lock. Remove it"
    )
    raise OSError(errno.EINVAL, what)


def is_locked(path: Path) -> bool:
    """Return whether a running process holds the lock file at `path`.

    A link, or anything else that is not a regular file, counts as not held.

    Raises:
        OSError: the file exists but cannot be opened.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | _CAREFULLY)
    except FileNotFoundError:
        return False
    except OSError as error:
        if error.errno in _OF_OTHER_THINGS:
            return False
        raise
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            return False
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _forget_locks_of_the_parent() -> None:
    for lock in list(_held):
        lock.let_go()


os.register_at_fork(after_in_child=_forget_locks_of_the_parent)
