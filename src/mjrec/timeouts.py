# SPDX-License-Identifier: Apache-2.0
"""How long something may make no progress before it counts as hanging."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

from .errors import InvalidArgument

_ENVIRONMENT_VARIABLE = "MJREC_TIMEOUT"
_DEFAULT_S = 120.0
_LONGEST_SLICE_S = 1.0


def timeout_s() -> float:
    """Return the seconds without progress, such as a frame, that are waited for.

    120, or what the environment variable `MJREC_TIMEOUT` says.

    Raises:
        InvalidArgument: the variable is no positive number of seconds.
    """
    text = os.environ.get(_ENVIRONMENT_VARIABLE)
    if not text:
        return _DEFAULT_S
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise InvalidArgument(
            f"{_ENVIRONMENT_VARIABLE} is {text!r}. It is the number of seconds after "
            f"which a process that makes no progress is ended, such as {_DEFAULT_S:g}."
        )
    return seconds


class Timeout:
    """Waits for progress in slices, and says when it has been long enough.

    A slice counts for no more than it was to last: where the waiting process itself was
    stopped, suspended or starved, so was most likely what it waits for, and gets its
    time once more.

    ::

        timeout = Timeout()
        while not timeout.is_over:
            if timeout.wait(look_for_news):
                ...

    Args:
        seconds: without progress; `timeout_s()` if None.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = timeout_s() if seconds is None else seconds
        self._waited = 0.0

    @property
    def is_over(self) -> bool:
        """Whether it has been long enough."""
        return self._waited >= self.seconds

    def renew(self) -> None:
        """Begin again: there was progress."""
        self._waited = 0.0

    def wait(self, look: Callable[[float], object]) -> bool:
        """Wait for a slice of the time, and begin again where there was progress.

        Args:
            look: waits at most this many seconds; returns whether there was progress.
        """
        seconds = max(0.0, min(_LONGEST_SLICE_S, self.seconds - self._waited))
        began = time.monotonic()
        if look(seconds):
            self.renew()
            return True
        self._waited += min(time.monotonic() - began, seconds)
        return False
