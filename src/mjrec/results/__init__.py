# SPDX-License-Identifier: Apache-2.0
"""Functions that find, list and merge the results of monitors.

They need no simulator, OpenGL or ffmpeg, and read files from this package and from gym
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
