# SPDX-License-Identifier: Apache-2.0
"""Timeouts for work that is considered hung when it makes no progress."""

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
    """Return the maximum time without progress (such as a new frame), in seconds.

    It is 120 unless the environment variable `MJREC_TIMEOUT` is set.

    Raises:
        InvalidArgument: the variable is not a positive, finite number.
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
            f"{_ENVIRONMENT_VARIABLE} is {text!r}. It must be the number of seconds "
            "after which a process without progress is killed, such as "
            f"{_DEFAULT_S:g}."
        )
    return seconds


class Timeout:
    """A timeout that waits for progress in short slices.

    A slice never counts for more than its planned duration. If this process was
    stopped, suspended or starved, the process that it waits for probably was too, so
    the lost time does not count.

    ::

        timeout = Timeout()
        while not timeout.is_over:
            if timeout.wait(look_for_news):
                ...

    Args:
        seconds: maximum time without progress; `timeout_s()` if None.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = timeout_s() if seconds is None else seconds
        self._waited = 0.0

    @property
    def is_over(self) -> bool:
        """Whether the timeout has passed without progress."""
        return self._waited >= self.seconds

    def renew(self) -> None:
        """Restart the timeout because there was progress."""
        self._waited = 0.0

    def wait(self, look: Callable[[float], object]) -> bool:
        """Wait for one slice, and restart the timeout if there was progress.

        Args:
            look: a function that waits for at most the given number of seconds, and
                returns whether there was progress.

        Returns:
            Whether there was progress.
        """
        seconds = max(0.0, min(_LONGEST_SLICE_S, self.seconds - self._waited))
        began = time.monotonic()
        if look(seconds):
            self.renew()
            return True
        self._waited += min(time.monotonic() - began, seconds)
        return False
