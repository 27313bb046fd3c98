# SPDX-License-Identifier: Apache-2.0
"""Waiting for what other processes and threads do."""

from __future__ import annotations

import time
from collections.abc import Callable

_MOMENT = 0.01


def wait_until(
    holds: Callable[[], object],
    *,
    seconds: float = 30,
    told: Callable[[], object] = lambda: "it has not come to hold",
) -> None:
    """Look again and again, until something holds.

    Args:
        holds: whether it does.
        seconds: far longer than it takes, because the machine may have other work.
        told: what the failure says where it never does.
    """
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, told()
        time.sleep(_MOMENT)
