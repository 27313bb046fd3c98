# SPDX-License-Identifier: Apache-2.0
"""Closing once, whatever happens first: a call, garbage collection, or exit."""

from __future__ import annotations

import atexit
import os
import weakref
from collections.abc import Callable

__all__ = ["ExitGuard"]


class ExitGuard:
    """Calls `close` once: when told to, when `owner` is collected, or at exit.

    In a forked child nothing is called: the files belong to the process that made
    them.

    Args:
        owner: the object whose end means close.
        close: what to call. It must not refer to `owner`, which would then live for
            ever.
    """

    def __init__(self, owner: object, close: Callable[[], None]) -> None:
        self._finalize = weakref.finalize(owner, _in_process(os.getpid(), close))
        # weakref's own exit hook is as old as its first use in the process, and hooks
        # run newest first: simulators would have torn OpenGL down before us.
        self._finalize.atexit = False
        atexit.register(self._finalize)

    def run_first_at_exit(self) -> None:
        """Put this hook before all exit hooks that were registered so far."""
        if self._finalize.alive:
            atexit.unregister(self._finalize)
            atexit.register(self._finalize)

    def close(self) -> None:
        """Call `close`, unless that was done already."""
        atexit.unregister(self._finalize)
        self._finalize()


def _in_process(pid: int, close: Callable[[], None]) -> Callable[[], None]:
    def close_here() -> None:
        if os.getpid() == pid:
            close()

    return close_here
