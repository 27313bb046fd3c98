# SPDX-License-Identifier: Apache-2.0
"""Closing once, whatever happens first: a call, garbage collection, or exit."""

from __future__ import annotations

import atexit
import os
import threading
import weakref
from collections.abc import Callable

# How the names of this package's own threads begin.
_OWN_THREADS = "mjrec-"


class ExitGuard:
    """Calls `close` once: when called, when `owner` is collected, or at exit.

    In a forked child nothing is called: the files belong to the process that made
    them.

    Args:
        owner: the object whose end means close.
        close: what to call. It must not refer to `owner`, which would then live for
            ever.
        at_exit: called before it where the interpreter is ending, likewise.
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
        # weakref's own exit hook is as old as its first use in the process, and hooks
        # run newest first: simulators would have torn OpenGL down before us.
        self._finalize.atexit = False
        self._first = False
        self._at_exit = _one_after_the_other(at_exit, self._finalize)
        atexit.register(self._at_exit)

    def run_first_at_exit(self) -> None:
        """Put this hook before all exit hooks that were registered so far; once."""
        if not self._first and self._finalize.alive:
            self._first = True
            atexit.unregister(self._at_exit)
            atexit.register(self._at_exit)

    def close(self) -> None:
        """Call `close`, unless that was done already.

        Where it raised or was interrupted (Ctrl-C), the next call calls it again.
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
    """Call `close`, on another thread where this one is ours.

    Garbage is collected on whichever thread happens to allocate. Closing waits for the
    encoder's thread, which must not be the one that waits.
    """
    if threading.current_thread().name.startswith(_OWN_THREADS):
        threading.Thread(target=close, name="close").start()
    else:
        close()
