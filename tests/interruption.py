# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C, at a moment that a test chooses."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

from waiting import wait_until


@contextlib.contextmanager
def ctrl_c_soon() -> Iterator[None]:
    """Raise KeyboardInterrupt from a signal's handler, a hundredth of a second on."""
    earlier = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, earlier)


@contextlib.contextmanager
def ctrl_c_once_there_is(path: Path) -> Iterator[None]:
    """Raise KeyboardInterrupt once there is a file, which is then removed."""

    def interrupt() -> None:
        wait_until(path.exists)
        path.unlink()
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        yield
    finally:
        thread.join()
