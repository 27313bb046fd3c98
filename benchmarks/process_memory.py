# SPDX-License-Identifier: Apache-2.0
"""The peak memory of this process."""

from __future__ import annotations

import re
from pathlib import Path

_PEAK = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)


def peak_memory() -> float:
    """Return the peak of this process's memory, in MB."""
    # `ru_maxrss` is not used, because a new process inherits its parent's value.
    match = _PEAK.search(Path("/proc/self/status").read_text())
    assert match is not None
    return int(match[1]) * 1024 / 1e6
