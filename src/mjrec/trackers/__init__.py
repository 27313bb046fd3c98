# SPDX-License-Identifier: Apache-2.0
"""Experiment trackers, which are notified of finished episodes and videos.

`mjrec.Monitor(..., trackers=...)` takes one or more trackers. To support another
service, subclass `Tracker` and override the methods for the events you need. Importing
this package does not import the services' packages.
"""

from __future__ import annotations

from ..recorder.tracking import FinishedEpisode, FinishedVideo, Run, Tracker
from .monitor_csv import MonitorCsvTracker
from .tensorboard import TensorBoardTracker
from .wandb import WandbTracker

__all__ = [
    "FinishedEpisode",
    "FinishedVideo",
    "MonitorCsvTracker",
    "Run",
    "TensorBoardTracker",
    "Tracker",
    "WandbTracker",
]
