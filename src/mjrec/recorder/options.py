# SPDX-License-Identifier: Apache-2.0
"""A monitor's options."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..annotation import check_annotation
from ..errors import InvalidArgument
from ..formats.row_log import TAIL_BYTES
from ..frames import check_quality
from ..rates import to_rate
from ..schedules import check_takes_one, schedule_name
from .keep_rules import selection_from
from .tracking import FinishedEpisode, Tracker

DEFERRED, LIVE, OFF = "deferred", "live", "off"
RAISE, WARN = "raise", "warn"
# The value of `resume` for recording next to monitors of the same environment without
# reading their files.
JOIN = "join"
# Gym's own prefix is excluded, because such files would look like monitor files.
_NAME_PREFIX = re.compile(r"(?!openaigym)[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}", re.ASCII)
# Switches that affect the content of files.
_SWITCHES = ("observations", "annotate", "tiled")
_MODES = {None: "t", "training": "t", "evaluation": "e"}


@dataclass(frozen=True, kw_only=True)
class Statements:
    """Facts about an original run that a recreation cannot reproduce and must copy.

    Attributes:
        infix: the middle part of the run's file names, which is not claimed yet.
        first_episode_id: the number of the run's first episode.
        provenance: the run's provenance; None if unknown.
        provenance_after: number of journal lines before the provenance, not counting
            the first line.
        clock: a function that returns the time in seconds since the Unix epoch.
        faults: the facts about each fault, paired with the number of journal lines
            before it.
    """

    infix: str
    first_episode_id: int
    provenance: Mapping[str, Any] | None
    provenance_after: int
    clock: Callable[[], float]
    faults: Sequence[tuple[int, Mapping[str, Any]]] = ()


@dataclass(frozen=True, kw_only=True)
class RecorderOptions:
    """A monitor's options, which are described in `mjrec.Monitor`.

    Raises:
        InvalidArgument: a value is invalid.
    """

    video_callable: Callable[[int], Any] | bool | None = None
    force: bool = False
    resume: bool | str = False
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
    keep: str | Callable[[Sequence[FinishedEpisode]], Iterable[int]] | None = None
    step_trigger: Callable[[int], Any] | None = None
    video_length: int | None = None
    name_prefix: str | None = None
    episode_info: bool = False
    annotate: bool = False
    tiled: bool = False
    trackers: Tracker | Sequence[Tracker] = ()
    policy_file: str | os.PathLike[str] | None = None
    # Size of a row log's tail in bytes. Vector environments share one budget.
    tail_bytes: int = TAIL_BYTES
    # The seed from which the episodes' seeds are derived, if any.
    seed: int | None = None
    # The facts of the original run if it is being recreated.
    statements: Statements | None = None

    def __post_init__(self) -> None:
        type_of_mode(self.mode)
        for name in ("fps", "max_fps"):
            if getattr(self, name) is not None:
                to_rate(getattr(self, name), name=name)
        for name in ("observations", "strict", "episode_info", "annotate", "tiled"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidArgument(
                    f"{name} must be True or False, but it is {getattr(self, name)!r}."
                )
        if not (isinstance(self.resume, bool) or self.resume == JOIN):
            raise InvalidArgument(
                'resume must be True, False, or "join" to record next to other '
                f"monitors without reading their files, but it is {self.resume!r}."
            )
        check_quality(self.quality)
        if self.render not in (None, DEFERRED, LIVE, OFF):
            raise InvalidArgument(
                'render must be "deferred", "live", "off", or None for the best that '
                f"the environment allows, but it is {self.render!r}."
            )
        workers = self.workers
        if workers is not None and (not _is_whole(workers) or workers < 0):
            raise InvalidArgument(
                "workers must be a whole number of processes (0 to render nothing now) "
                f"or None for one per usable CPU, but it is {workers!r}."
            )
        if self.on_error not in (RAISE, WARN):
            raise InvalidArgument(
                'on_error must be "raise", or "warn" to continue when something cannot '
                f"be recorded, but it is {self.on_error!r}."
            )
        chosen = self.trajectory_callable
        if not (chosen is None or isinstance(chosen, bool) or callable(chosen)):
            raise InvalidArgument(
                "trajectory_callable must be True, False, None, or a function that "
                "takes an episode number and returns a bool, but it is "
                f"{chosen!r}."
            )
        self._check_clips()
        self._check_keep()
        self._check_trackers()
        self._check_policy_file()
        if self.annotate:
            check_annotation()

    def _check_clips(self) -> None:
        if self.step_trigger is not None:
            if not callable(self.step_trigger):
                raise InvalidArgument(
                    "step_trigger must be a function that takes the number of steps "
                    f"so far and returns a bool, but it is {self.step_trigger!r}."
                )
            check_takes_one(self.step_trigger, "step_trigger", "the number of steps")
            if self.video_callable is not None:
                raise InvalidArgument(
                    "step_trigger chooses videos by step, and video_callable chooses "
                    "them by episode. Pass only one of them."
                )
        length = self.video_length
        if length is not None and (not _is_whole(length) or length < 1):
            raise InvalidArgument(
                "video_length must be a positive whole number, or None for videos "
                f"until the end of the episode, but it is {length!r}."
            )
        if self.has_clips and self.render == OFF:
            raise InvalidArgument(
                "step_trigger and video_length configure videos, but "
                'render="off" disables videos. Leave one of them out.'
            )
        prefix = self.name_prefix
        if prefix is not None and not (
            isinstance(prefix, str) and _NAME_PREFIX.fullmatch(prefix)
        ):
            raise InvalidArgument(
                "name_prefix becomes part of file names. It must consist of 1 to 100 "
                "letters, digits, '_', '-' and '.', begin with a letter, digit or '_', "
                f"and not begin with openaigym, but it is {prefix!r}."
            )

    def _check_keep(self) -> None:
        if self.keep is None:
            return
        selection_from(self.keep)
        if self.video_callable is not None:
            raise InvalidArgument(
                "keep chooses episodes after they have ended, and video_callable "
                "before they begin. Pass only one of them."
            )
        if self.has_clips:
            raise InvalidArgument(
                "keep chooses videos of whole episodes, but step_trigger and "
                "video_length record clips, counted in steps. Pass only one of them."
            )
        if self.render == OFF:
            raise InvalidArgument(
                "keep chooses which episodes get a video, but "
                'render="off" disables videos. Leave one of them out.'
            )

    def _check_trackers(self) -> None:
        given = self.trackers
        several = isinstance(given, Sequence) and not isinstance(given, str)
        for tracker in self.all_trackers if several else (given,):
            if not isinstance(tracker, Tracker):
                raise InvalidArgument(
                    "trackers must be a mjrec.trackers.Tracker or a sequence of "
                    f"trackers, but {tracker!r} is of type {type(tracker).__name__}."
                )
        if len(set(map(id, self.all_trackers))) < len(self.all_trackers):
            raise InvalidArgument(
                f"The same tracker appears twice in {given!r} and would get every call "
                "twice. Pass each tracker only once."
            )

    def _check_policy_file(self) -> None:
        given = self.policy_file
        if given is None:
            return
        if not isinstance(given, str | os.PathLike) or not Path(given).is_file():
            raise InvalidArgument(
                "policy_file must be the path of the policy's file, because the "
                f"manifest contains its SHA-256, but {given!r} is not a file."
            )

    @property
    def clock(self) -> Callable[[], float]:
        """A function that returns the time in seconds since the Unix epoch."""
        return time.time if self.statements is None else self.statements.clock

    def recorded(self) -> dict[str, Any]:
        """Return the options that affect files, for the journal.

        Defaults are left out, and functions are represented by their names. The
        schedule and the `keep` rule are recorded elsewhere.
        """
        kept, trigger = self.trajectory_callable, self.step_trigger
        length = self.video_length
        said: dict[str, Any] = {
            "fps": None if self.fps is None else str(self.fps),
            "max_fps": None if self.max_fps is None else str(self.max_fps),
            "quality": None if self.quality == "full" else self.quality,
            "render": self.render,
            "trajectories": schedule_name(kept) if callable(kept) else kept,
            "step_trigger": None if trigger is None else schedule_name(trigger),
            "video_length": None if length is None else int(length),
            "name_prefix": self.name_prefix,
            "seed": self.seed,
            **{name: getattr(self, name) or None for name in _SWITCHES},
        }
        return {name: value for name, value in said.items() if value is not None}

    @property
    def has_clips(self) -> bool:
        """Whether videos are clips, counted in steps, instead of whole episodes."""
        return self.step_trigger is not None or self.video_length is not None

    @property
    def all_trackers(self) -> tuple[Tracker, ...]:
        """The trackers as a tuple, even if only one was given."""
        if isinstance(self.trackers, Tracker):
            return (self.trackers,)
        return tuple(self.trackers)


@dataclass(frozen=True, kw_only=True)
class RenderingChoice:
    """The choice of when a run's frames are drawn.

    Attributes:
        mode: `DEFERRED`, `LIVE` or `OFF`.
        reason: the reason why frames are drawn live, if users might not expect that.
        is_forced: whether the user requested the mode. If so, using a different mode is
            an error.
    """

    mode: str
    reason: str | None = None
    is_forced: bool = False


def type_of_mode(mode: str | None) -> str:
    """Return the episode type for a monitor mode: "t" or "e".

    Raises:
        InvalidArgument: the mode does not exist.
    """
    if mode not in _MODES:
        raise InvalidArgument(
            f'mode must be "training", "evaluation" or None, but it is {mode!r}.'
        )
    return _MODES[mode]


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
