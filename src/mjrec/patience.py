# SPDX-License-Identifier: Apache-2.0
"""How long something may make no progress before it counts as hanging."""

from __future__ import annotations

import math
import os
import time

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
            has_news = wait(patience.begin_slice())
            patience.end_slice()
            if has_news:
                patience.renew()

    Args:
        seconds: without progress; `patience_s()` if None.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = patience_s() if seconds is None else seconds
        self._waited = 0.0
        self._began = 0.0
        self._slice = 0.0

    @property
    def is_over(self) -> bool:
        """Whether it has been long enough."""
        return self._waited >= self.seconds

    def renew(self) -> None:
        """Begin anew: there was progress."""
        self._waited = 0.0

    def begin_slice(self) -> float:
        """Return how many seconds to wait now."""
        rest = max(0.0, self.seconds - self._waited)
        self._slice = min(_LONGEST_SLICE_S, rest)
        self._began = time.monotonic()
        return self._slice

    def end_slice(self) -> None:
        """Count the time since `begin_slice`, up to what it had said."""
        self._waited += min(time.monotonic() - self._began, self._slice)
