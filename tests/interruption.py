# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C at a chosen moment."""

import contextlib
import signal


@contextlib.contextmanager
def ctrl_c_soon():
    """Raise KeyboardInterrupt from a signal's handler after 0.01 seconds."""
    earlier = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, earlier)
