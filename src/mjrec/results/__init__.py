# SPDX-License-Identifier: Apache-2.0
"""Reading results: finding, merging and listing the files of monitors.

This needs no simulator, OpenGL or ffmpeg, and reads files of this package and of gym
0.7.4 to 0.22.
"""

from __future__ import annotations

from .episodes import Episode as Episode
from .episodes import iter_episodes as iter_episodes
from .merging import load_results as load_results
from .merging import merge_stats_files as merge_stats_files
from .monitor_files import clear_monitor_files as clear_monitor_files
from .monitor_files import detect_monitor_files as detect_monitor_files
from .monitor_files import detect_training_manifests as detect_training_manifests
