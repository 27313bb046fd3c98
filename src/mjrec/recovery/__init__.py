# SPDX-License-Identifier: Apache-2.0
"""Putting a directory in order whose monitors, or renderers, were killed.

What a living process writes is left alone: it holds a lock, which the kernel drops
when it ends, however it ends.
"""

from __future__ import annotations

from .recovering import recover
from .report import RecoveredFile, Recovery

__all__ = ["RecoveredFile", "Recovery", "recover"]
