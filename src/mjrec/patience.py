# SPDX-License-Identifier: Apache-2.0
"""How long something may make no progress before it counts as hanging."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

from .errors import InvalidArgument

_ENVIRONMENT_VARIABLE = "MJREC_PATIENCE"
_DEFAULT_S = 120.0
_LONGEST_SLICE_S = 1.0


def patience_s() -> float:
    """Return the seconds without progress, such as a frame, that are waited for.

    120, or what the environment variable `MJREC_PATIENCE` says.

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


class Patience:
    """Waits for progress in slices, and says when it has been long enough.

    A slice counts for no more than it was to last: where the waiting process itself was
    stopped, suspended or starved, so was most likely what it waits for, and gets its
    time once more.

    ::

        patience = Patience()
        while not patience.is_over:
            if patience.wait(look_for_news):
                ...

    Args:
        seconds: without progress; `patience_s()` if None.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = patience_s() if seconds is None else seconds
        self._waited = 0.0

    @property
    def is_over(self) -> bool:
        """Whether it has been long enough."""
        return self._waited >= self.seconds

    def renew(self) -> None:
        """Begin anew: there was progress."""
        self._waited = 0.0

    def wait(self, look: Callable[[float], object]) -> bool:
        """Wait for a slice of the time, and begin anew where there was progress.

        Args:
            look: waits at most so many seconds, and tells whether there was progress.
        """
        seconds = max(0.0, min(_LONGEST_SLICE_S, self.seconds - self._waited))
        began = time.monotonic()
        if look(seconds):
            self.renew()
            return True
        self._waited += min(time.monotonic() - began, seconds)
        return False
