# SPDX-License-Identifier: Apache-2.0
"""The read half: what monitors wrote, found, merged and listed.

It needs no simulator, no OpenGL and no ffmpeg, and reads what this package and every
gym from 0.7.4 to 0.22 wrote.
"""

from __future__ import annotations

from .episodes import Episode, iter_episodes
from .merging import load_results, merge_stats_files
from .monitor_files import (
    clear_monitor_files,
    detect_monitor_files,
    detect_training_manifests,
)

__all__ = [
    "Episode",
    "clear_monitor_files",
    "detect_monitor_files",
    "detect_training_manifests",
    "iter_episodes",
    "load_results",
    "merge_stats_files",
]
