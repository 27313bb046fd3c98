# SPDX-License-Identifier: Apache-2.0
"""Waiting for what other processes and threads do."""

import time

_MOMENT = 0.01


def wait_until(holds, *, seconds=30, told=lambda: "it has not come to hold"):
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
