# SPDX-License-Identifier: Apache-2.0
"""Waiting for other processes and threads."""

import time

_MOMENT = 0.01


def wait_until(holds, *, seconds=30, told=lambda: "it has not come to hold"):
    """Poll until `holds()`; fail with `told()` after far longer than it takes."""
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, told()
        time.sleep(_MOMENT)
