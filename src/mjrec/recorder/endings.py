# SPDX-License-Identifier: Apache-2.0
"""Reasons why an episode ended early, and a guard that ensures closing at exit."""

from __future__ import annotations

import atexit
import logging
import os
import sys
import threading
import weakref
from collections.abc import Callable
from typing import Any

from ..errors import Error
from ..signals import received

logger = logging.getLogger(__name__)

CLOSE, EXCEPTION, INTERRUPT, RESET = "close", "exception", "interrupt", "reset"

_LONGEST_MESSAGE = 1000


def ending(error: BaseException) -> dict[str, Any]:
    """Return the facts about an early end that an exception caused.

    Returns:
        A dictionary with the key `reason`, which is "close" if the program exited
        normally (`sys.exit()`). If the reason is "exception", the key
        `exception` holds the exception's `type` (its module and name, or only its name
        if it is built in) and its `message`.
    """
    if type(error) is SystemExit:
        return {"reason": CLOSE}
    if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
        return {"reason": INTERRUPT}
    return {
        "reason": EXCEPTION,
        "exception": {"type": _name(type(error)), "message": _message(error)},
    }


def last_error() -> BaseException | None:
    """Return the exception that is ending this process, if it can be found.

    At exit, the interpreter has already printed and stored the exception. In an
    interactive session, the stored exception proves nothing, because exceptions do not
    end such a session.
    """
    if hasattr(sys, "ps1"):
        return None
    # `last_exc` was added in Python 3.12.
    error = getattr(sys, "last_exc", None) or getattr(sys, "last_value", None)
    return error if isinstance(error, BaseException) else received()


def _name(kind: type) -> str:
    if kind.__module__ == "builtins":
        return kind.__qualname__
    return f"{kind.__module__}.{kind.__qualname__}"


def _message(error: BaseException) -> str:
    try:
        return str(error)[:_LONGEST_MESSAGE]
    except Exception:  # a user's __str__ may raise anything
        return ""


# Prefix of the names of the threads that this package creates.
_OWN_THREADS = "mjrec-"


class Failures:
    """Collects errors inside `with` blocks; `raise_first` raises the first one."""

    def __init__(self) -> None:
        self._first: Exception | None = None

    def __enter__(self) -> None: ...

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> bool:
        if isinstance(error, Exception):
            self.note(error)
            return True
        return False

    def note(self, error: Exception) -> None:
        """Collect an error."""
        self._first = self._first or error

    def raise_first(self) -> None:
        """Raise the first error, if there was any."""
        if self._first is not None:
            raise self._first


class ExitGuard:
    """Calls a function once: on request, when `owner` is collected, or at exit.

    In a forked child the function is not called, because the files belong to the
    process that created them.

    Args:
        owner: the object whose garbage collection triggers `close`.
        close: the function to call. It must not refer to `owner`, because `owner` would
            then never be collected.
        at_exit: a function to call before `close` at interpreter exit. It must not
            refer to `owner` either.
    """

    def __init__(
        self,
        owner: object,
        close: Callable[[], None],
        *,
        at_exit: Callable[[], None] = lambda: None,
    ) -> None:
        self._close = close_here = _in_process(os.getpid(), close)
        self._finalize = finalize = weakref.finalize(owner, _aside, close_here)
        # weakref registers its exit hook when it is first used in the process. Newer
        # hooks run first, so a simulator's hook would tear down OpenGL before this one.
        finalize.atexit = False
        self._first = False

        def exit_hook() -> None:
            if finalize.alive:
                at_exit()
                try:
                    finalize()
                except Error as error:
                    # Python would print a traceback of its internal code.
                    logger.error("%s", error)

        self._at_exit = exit_hook
        atexit.register(exit_hook)

    def run_first_at_exit(self) -> None:
        """Move this guard's exit hook ahead of all existing hooks. Works only once."""
        if not self._first and self._finalize.alive:
            self._first = True
            atexit.unregister(self._at_exit)
            atexit.register(self._at_exit)

    def close(self) -> None:
        """Call the function, unless it has already succeeded.

        If the function raises or is interrupted (Ctrl-C), the next call tries again.
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


def _aside(close: Callable[[], None]) -> None:
    """Call `close`, using a new thread if this package created the current one.

    Garbage collection can run on any thread that allocates memory. Closing waits for
    the encoder's thread, so it must not run on that thread.
    """
    if threading.current_thread().name.startswith(_OWN_THREADS):
        threading.Thread(target=close, name="close").start()
    else:
        close()
