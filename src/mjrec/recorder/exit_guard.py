# SPDX-License-Identifier: Apache-2.0
"""Closing exactly once: on a call, at garbage collection, or at exit."""

from __future__ import annotations

import atexit
import os
import threading
import weakref
from collections.abc import Callable

# Prefix of the names of this package's threads.
_OWN_THREADS = "mjrec-"


class ExitGuard:
    """Calls `close` once: when called, when `owner` is collected, or at exit.

    In a forked child nothing is called, because the files belong to the process that
    created them.

    Args:
        owner: the object to close for when it is collected.
        close: the function to call. It must not refer to `owner`, which would then
            never be collected.
        at_exit: called before `close` at interpreter exit. It must not refer to
            `owner` either.
    """

    def __init__(
        self,
        owner: object,
        close: Callable[[], None],
        *,
        at_exit: Callable[[], None] = lambda: None,
    ) -> None:
        self._close = _in_process(os.getpid(), close)
        self._finalize = weakref.finalize(owner, _aside, self._close)
        # weakref registers its exit hook at its first use in the process, and hooks run
        # newest first: simulators would tear OpenGL down before this one.
        self._finalize.atexit = False
        self._first = False
        self._at_exit = _one_after_the_other(at_exit, self._finalize)
        atexit.register(self._at_exit)

    def run_first_at_exit(self) -> None:
        """Run this hook before all exit hooks registered so far. Works once."""
        if not self._first and self._finalize.alive:
            self._first = True
            atexit.unregister(self._at_exit)
            atexit.register(self._at_exit)

    def close(self) -> None:
        """Call `close`, unless it has already succeeded.

        If `close` raises or is interrupted (Ctrl-C), the next call tries again.
        """
        if self._finalize.alive:
            self._close()
            self._finalize.detach()
            atexit.unregister(self._at_exit)


def _in_process(pid: int, close: Callable[[], None]) -> Callable[[], None]:
    def close_here() -> None:
        if os.getpid() == pid:
            close()

    return close_here


def _one_after_the_other(
    first: Callable[[], None], finalize: weakref.finalize[..., object]
) -> Callable[[], None]:
    def both() -> None:
        if finalize.alive:
            first()
            finalize()

    return both


def _aside(close: Callable[[], None]) -> None:
    """Call `close`, on a new thread if the current one belongs to this package.

    Garbage collection runs on any thread that allocates. Closing waits for the
    encoder's thread, so it must not run on that thread.
    """
    if threading.current_thread().name.startswith(_OWN_THREADS):
        threading.Thread(target=close, name="close").start()
    else:
        close()
