# SPDX-License-Identifier: Apache-2.0
"""Handlers that turn termination signals into exceptions, so that files are closed."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from .errors import Error

# Schedulers and CI systems send these signals at a time limit, and terminals send them
# when they are closed.
_SIGNALS = (signal.SIGTERM, signal.SIGHUP)


class Terminated(SystemExit):
    """The exception for a signal that asks the process to end.

    Like KeyboardInterrupt, it unwinds `with` blocks and `finally` clauses, and is not
    caught by `except Exception`. If it is not caught, the exit status is 128 plus the
    signal's number.

    Attributes:
        signal: the signal.
    """

    def __init__(self, signum: int) -> None:
        self.signal = signal.Signals(signum)
        super().__init__(128 + signum)

    def __str__(self) -> str:
        return self.signal.name


def exit_on_signals() -> None:
    """Make SIGTERM and SIGHUP end this process like Ctrl-C.

    By default, these signals kill the process, and `mjrec recover` has to finish its
    files. After this call, they raise `Terminated` in the main thread, so monitors
    close their files. Pending videos are not rendered, but their number is logged. The
    `mjrec` command calls this function.

    Signals that are ignored (`nohup`) or that have a handler are left alone.

    Raises:
        Error: the function is called outside the main thread, where Python handles
            signals.
    """
    if threading.current_thread() is not threading.main_thread():
        raise Error(
            "exit_on_signals() was called in the thread "
            f"{threading.current_thread().name!r}, but Python sets signal handlers "
            "only in the main thread: call it there, before the recording starts."
        )
    for signum in _deadly():
        signal.signal(signum, _raise)
    if sys.unraisablehook is not _send_again:
        _hooks[:] = [sys.unraisablehook]
        sys.unraisablehook = _send_again


@contextlib.contextmanager
def exiting_on_signals() -> Iterator[None]:
    """Apply `exit_on_signals` inside a `with` block only.

    Outside the main thread, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handled = _deadly()
    exit_on_signals()
    try:
        yield
    finally:
        for signum in handled:
            signal.signal(signum, signal.SIG_DFL)
        if sys.unraisablehook is _send_again:
            sys.unraisablehook = _hooks.pop()


def _deadly() -> list[signal.Signals]:
    """Return the signals that would kill the process."""
    return [s for s in _SIGNALS if signal.getsignal(s) is signal.SIG_DFL]


def received() -> Terminated | None:
    """Return the exception that the first signal raised, or None if there was none.

    An exit handler needs this, because it cannot see an uncaught `SystemExit`.
    """
    return _received[0] if _received else None


_received: list[Terminated] = []
_hooks: list[Callable[[sys.UnraisableHookArgs], object]] = []
_MOMENT = 0.05


def _raise(signum: int, frame: FrameType | None) -> None:
    error = Terminated(signum)
    _received.append(error)
    raise error


def _send_again(unraisable: sys.UnraisableHookArgs) -> None:
    """Resend a signal whose exception was lost.

    The exception was raised inside a finalizer or a callback, where Python only reports
    exceptions and continues. Schedulers do not send a second SIGTERM; they send
    SIGKILL.
    """
    error = unraisable.exc_value
    if not isinstance(error, Terminated):
        _hooks[0](unraisable)
        return
    # Send the signal a little later, because here the exception would be lost again.
    signum = error.signal
    threading.Timer(_MOMENT, lambda: os.kill(os.getpid(), signum)).start()
