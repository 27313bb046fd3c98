# SPDX-License-Identifier: Apache-2.0
"""Waiting for other processes and threads."""

import time

_MOMENT = 0.01


def wait_until(holds, *, seconds=30, told=lambda: "the condition never held"):
    """Poll until `holds()`; after `seconds`, fail with the message `told()`."""
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, told()
        time.sleep(_MOMENT)
