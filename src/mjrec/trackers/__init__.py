# SPDX-License-Identifier: Apache-2.0
"""Experiment trackers, which are notified of finished episodes and videos.

`mjrec.Monitor(..., trackers=...)` takes one or more trackers. To support another
service, subclass `Tracker` and override the methods for the events you need. Importing
this package does not import the services' packages.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from ..recorder.tracking import FinishedEpisode, FinishedVideo, Run, Tracker

if TYPE_CHECKING:
    from .monitor_csv import MonitorCsvTracker as MonitorCsvTracker
    from .tensorboard import TensorBoardTracker as TensorBoardTracker
    from .wandb import WandbTracker as WandbTracker

_LAZY = {
    "MonitorCsvTracker": "monitor_csv",
    "TensorBoardTracker": "tensorboard",
    "WandbTracker": "wandb",
}

__all__ = [
    "FinishedEpisode",
    "FinishedVideo",
    "MonitorCsvTracker",
    "Run",
    "TensorBoardTracker",
    "Tracker",
    "WandbTracker",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)
    # Cached, so that later uses cost nothing.
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
