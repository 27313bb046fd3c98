# SPDX-License-Identifier: Apache-2.0
"""Flushing in time, also where nobody writes any more.

A writer that flushes when something is added keeps what was added last to itself for
as long as the next step takes: a simulation that hangs would lose it. One thread of
this process looks after all writers that are open, and ends with the last of them.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import weakref
from typing import Protocol

logger = logging.getLogger(__name__)

_SECONDS = 0.2


class Flushed(Protocol):
    """What is looked after."""

    @property
    def is_due(self) -> bool:
        """Whether to flush. Asked on another thread."""

    def flush_beside(self) -> None:
        """Flush. Called on another thread."""

    def renew_locks(self) -> None:
        """Make new locks, in a forked child: another thread may have held the old."""


class _Watch:
    """The writers that are open, and the thread that looks after them."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.writers: weakref.WeakSet[Flushed] = weakref.WeakSet()
        # Of the writers those of which it was said, and has not changed since.
        self.failing: weakref.WeakSet[Flushed] = weakref.WeakSet()
        self.is_kept = False

    def add(self, writer: Flushed) -> None:
        with self.lock:
            self.writers.add(writer)
            if not self.is_kept:
                self.is_kept = True
                name = "mjrec-flushing"
                threading.Thread(target=self._keep, name=name, daemon=True).start()

    def discard(self, writer: Flushed) -> None:
        with self.lock:
            self.writers.discard(writer)

    def _keep(self) -> None:
        time.sleep(_SECONDS)
        while self._look_at_all():
            time.sleep(_SECONDS)

    def _look_at_all(self) -> bool:
        """Flush what is due; return whether there is anything to look after."""
        # Not in `_keep`, which would keep the last writer alive until the next round.
        with self.lock:
            writers = list(self.writers)
            self.is_kept = bool(writers)
        for writer in writers:
            if writer.is_due:
                self._flush(writer)
        return bool(writers)

    def _flush(self, writer: Flushed) -> None:
        try:
            writer.flush_beside()
        except Exception:
            # Whoever writes will meet it too, and the others are to be looked after.
            if writer not in self.failing:
                self.failing.add(writer)
                logger.warning("%r could not be flushed.", writer, exc_info=True)
        else:
            self.failing.discard(writer)


_watch = _Watch()


def flush_in_time(writer: Flushed, *, is_open: bool = True) -> None:
    """Look after `writer`, which is not kept alive by it; or no longer."""
    if is_open:
        _watch.add(writer)
    else:
        _watch.discard(writer)


def _start_anew() -> None:
    # The thread is the parent's, and so may be the locks.
    global _watch
    writers = list(_watch.writers)
    _watch = _Watch()
    for writer in writers:
        writer.renew_locks()


os.register_at_fork(after_in_child=_start_anew)
