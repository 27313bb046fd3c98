# SPDX-License-Identifier: Apache-2.0
"""How much memory this process has had."""

from __future__ import annotations

import re
from pathlib import Path

_PEAK = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)


def peak_memory() -> float:
    """Return the peak of this process's memory, in MB."""
    # Not `ru_maxrss`: that of a new process begins with its parent's.
    match = _PEAK.search(Path("/proc/self/status").read_text())
    assert match is not None
    return int(match[1]) * 1024 / 1e6
