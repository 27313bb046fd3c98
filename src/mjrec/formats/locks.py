# SPDX-License-Identifier: Apache-2.0
"""Lock files: who is alive is asked of the kernel, never of a process number.

An open monitor holds `.openaigym.<infix>.lock` locked (`flock`). The kernel drops
that when the process ends, however it ends, so a lock file that no process holds is
what a dead monitor left. Process numbers come round again, in containers all the time.

A monitor's lock is a name that is given once. The others (who renders a video, who
uses a CPU, who rewrites a manifest) go from hand to hand, and what a dead process left
is taken over.

A directory may come from anybody. A link, a pipe or a file with a second name that
stands where a lock belongs is no lock: it is never followed, written or waited
for. Asking for that lock raises an error that says so.
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

# `is_locked` holds a lock for a moment, which is no reason to give up.
_MOMENTS = 5
_MOMENT = 0.002

# Not blocking, should a pipe lie there.
_CAREFULLY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
# Of a link, a directory, and a socket or a device without a driver.
_OF_OTHER_THINGS = (errno.ELOOP, errno.EISDIR, errno.ENXIO)

# A forked child shares the lock, which would outlive a killed parent in it.
_held: weakref.WeakSet[Lock] = weakref.WeakSet()


class Lock:
    """A new file at `path`, locked until `release` or the end of the process.

    Args:
        path: the file to make; it must not exist.
        content: what others may read about its holder; it stays when the holder dies.
        mode: of the file.

    Raises:
        FileExistsError: the file is there, held or left behind.
        OSError: it cannot be made there.
    """

    def __init__(self, path: Path, content: str, *, mode: int = 0o644) -> None:
        # Python opens every descriptor close-on-exec: an encoder that outlives this
        # process does not keep the lock.
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
        descriptor = os.open(path, flags, mode)
        self._take(path, descriptor)
        try:
            if not self._lock(fcntl.LOCK_EX):
                # Before it was locked it looked like a dead monitor's.
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
        """Lock the file; False where another one is in its place by now."""
        fcntl.flock(self.fileno(), operation)
        return _is_at(self.fileno(), self._path)

    def fileno(self) -> int:
        """Return the descriptor. A process that inherits it holds the lock too."""
        if self._descriptor is None:
            raise ValueError(f"{self._path.name} is not locked any more")
        return self._descriptor

    def let_go(self) -> None:
        """Hold it no longer, and leave the file; further calls do nothing."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def release(self) -> None:
        """Remove the file and let it go; further calls do nothing.

        A file that another program has put in its place stays.
        """
        try:
            # Removed while it is still held: it is never seen unlocked.
            if self._descriptor is not None and _is_at(self._descriptor, self._path):
                self._path.unlink(missing_ok=True)
        finally:
            self.let_go()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def try_lock(path: Path) -> Lock | None:
    """Return a lock at `path`, or None where another process holds it.

    A file that no process holds is taken over with its content, and made where it is
    missing.

    Raises:
        DirectoryNotWritable: it cannot be made or opened, or something else stands
            there.
    """
    for _ in range(_MOMENTS):
        with contextlib.suppress(BlockingIOError):
            return _taken(path, fcntl.LOCK_EX | fcntl.LOCK_NB)
        time.sleep(_MOMENT)
    return None


def wait_for_lock(path: Path) -> Lock:
    """Return a lock at `path`, as soon as no other process holds it.

    Raises:
        DirectoryNotWritable: as `try_lock`.
    """
    return _taken(path, fcntl.LOCK_EX)


def _taken(path: Path, operation: int) -> Lock:
    try:
        while True:
            lock = Lock.__new__(Lock)
            lock._take(path, _opened(path))
            try:
                # Its holder may have removed it after it was opened, and another
                # process have made a new one: then this one guards nothing.
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
    """Return a descriptor of the lock file at `path`, made where it is missing."""
    try:
        descriptor = os.open(path, os.O_CREAT | os.O_RDWR | _CAREFULLY, 0o644)
    except OSError as error:
        if error.errno not in _OF_OTHER_THINGS:
            raise
    else:
        facts = os.fstat(descriptor)
        # One that has just been removed has no name at all.
        if stat.S_ISREG(facts.st_mode) and facts.st_nlink <= 1:
            return descriptor
        os.close(descriptor)
    what = f"{path.name} is a link or no regular file, which no lock is. Remove it"
    raise OSError(errno.EINVAL, what)


def is_locked(path: Path) -> bool:
    """Return whether a living process holds the lock file at `path`.

    A link or no regular file counts as not held.

    Raises:
        OSError: the file is there and cannot be opened.
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
