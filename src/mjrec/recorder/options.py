# SPDX-License-Identifier: Apache-2.0
"""What a monitor was asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from ..errors import InvalidArgument
from ..frames import check_quality
from ..rates import to_rate

__all__ = [
    "DEFERRED",
    "LIVE",
    "OFF",
    "RAISE",
    "WARN",
    "RecorderOptions",
    "RenderingChoice",
    "type_of_mode",
]

DEFERRED, LIVE, OFF = "deferred", "live", "off"
RAISE, WARN = "raise", "warn"
_MODES = {None: "t", "training": "t", "evaluation": "e"}


@dataclass(frozen=True, kw_only=True)
class RecorderOptions:
    """What a monitor was asked for; `mjrec.Monitor` says what each means.

    Raises:
        InvalidArgument: a value cannot be.
    """

    video_callable: Callable[[int], Any] | bool | None = None
    force: bool = False
    resume: bool = False
    write_upon_reset: bool = False
    uid: str | None = None
    mode: str | None = None
    fps: float | Fraction | None = None
    max_fps: float | Fraction | None = None
    quality: str = "full"
    render: str | None = None
    workers: int | None = None
    trajectory_callable: Callable[[int], Any] | bool | None = None
    observations: bool = False
    allow_early_reset: bool = False
    on_error: str = RAISE
    strict: bool = False

    def __post_init__(self) -> None:
        type_of_mode(self.mode)
        for name in ("fps", "max_fps"):
            if getattr(self, name) is not None:
                to_rate(getattr(self, name), name=name)
        for name in ("observations", "strict"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidArgument(
                    f"{name} must be True or False, got {getattr(self, name)!r}."
                )
        check_quality(self.quality)
        if self.render not in (None, DEFERRED, LIVE, OFF):
            raise InvalidArgument(
                'render must be "deferred", "live", "off", or None for the best that '
                f"the environment allows, got {self.render!r}."
            )
        workers = self.workers
        if workers is not None and (not _is_whole(workers) or workers < 0):
            raise InvalidArgument(
                "workers must be a whole number of processes, 0 to render nothing now, "
                f"or None for one for each usable CPU, got {workers!r}."
            )
        if self.on_error not in (RAISE, WARN):
            raise InvalidArgument(
                'on_error must be "raise", or "warn" to go on without what cannot be '
                f"recorded, got {self.on_error!r}."
            )
        chosen = self.trajectory_callable
        if not (chosen is None or isinstance(chosen, bool) or callable(chosen)):
            raise InvalidArgument(
                "trajectory_callable must be a function from an episode's number to a "
                f"bool, True, False or None, got {chosen!r}."
            )


@dataclass(frozen=True, kw_only=True)
class RenderingChoice:
    """When the pictures of a run are drawn.

    Attributes:
        mode: `DEFERRED`, `LIVE` or `OFF`.
        reason: why they are drawn live, where it could be thought otherwise.
        is_forced: the user asked for it, and anything else is an error.
    """

    mode: str
    reason: str | None = None
    is_forced: bool = False


def type_of_mode(mode: str | None) -> str:
    """Return the type of the episodes of a monitor mode: "t" or "e".

    Raises:
        InvalidArgument: there is no such mode.
    """
    if mode not in _MODES:
        raise InvalidArgument(
            f'mode must be "training", "evaluation" or None, got {mode!r}.'
        )
    return _MODES[mode]


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
