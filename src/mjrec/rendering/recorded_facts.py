# SPDX-License-Identifier: Apache-2.0
"""Trajectories as rendering takes them: with facts that are what they should be.

A trajectory may come from anybody. What is relied on is checked here, once, so that
everything behind it finds a rate where there should be one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..errors import InvalidArgument
from ..formats.json_fields import (
    boolean,
    field,
    integer,
    list_of,
    mapping,
    number,
    optional,
    text,
    unreadable,
)
from ..formats.trajectory import TrajectoryReader
from ..formats.trajectory_file import open_trajectory
from ..formats.video_names import is_second_name
from ..frames import QUALITIES
from ..rates import to_rate
from ..simulation.foreign_trajectories import open_vetted_trajectory
from .views import PlainCamera, plain_camera

# Not all that `Fraction` takes: 1e20000000 keeps it busy for a minute.
_RATE = re.compile(r"\d{1,12}(/\d{1,12})?", re.ASCII)
# What the user has asked for is written as it was given: 29.97, or a fraction that a
# float exactly is.
_ASKED_RATE = re.compile(r"\d{1,40}(\.\d{1,40}|/\d{1,40})?", re.ASCII)
_BASE_NAME = re.compile(r"[\w.-]{1,200}", re.ASCII)
_RECORDINGS = ("deferred", "live")
# Each may have a file of its own.
_MOST_CAMERAS = 100


def open_for_rendering(path: Path, *, is_vetted: bool = False) -> TrajectoryReader:
    """Open a trajectory, whoever made it, and check its facts.

    Afterwards `rate`, `timestep`, `scene`, `model`, `video` and `clip` are there as
    they should be, or None, or missing; `stride`, `kept` and `candidate` as they should
    be, or missing.

    Args:
        path: of the trajectory.
        is_vetted: whether another process of ours has opened it before.

    Raises:
        UnreadableFile: of `open_vetted_trajectory`; or a fact is of a kind that it
            cannot be.
    """
    reader = open_trajectory(path) if is_vetted else open_vetted_trajectory(path)
    try:
        with unreadable(path):
            _check(reader.header.facts)
    except BaseException:
        reader.close()
        raise
    return reader


def model_file(directory: Path, facts: Mapping[str, Any]) -> Path | None:
    """Return what comes first of a model; what it was made from may never come.

    Args:
        directory: of the recording.
        facts: the recording's, checked.
    """
    model = facts.get("model") or {}
    name = model.get("mjb") or model.get("xml")
    return None if name is None else directory / name


def _check(facts: Mapping[str, Any]) -> None:
    for key in ("rate", "timestep"):
        field(facts, key, optional(_rate), default=None)
    field(facts, "stride", _stride, default=1)
    field(facts, "kept", boolean, default=True)
    field(facts, "candidate", boolean, default=False)
    for key in ("refusal", "broken_reason", "reason"):
        field(facts, key, optional(text), default=None)
    for key in ("scene", "exception"):
        field(facts, key, optional(mapping), default=None)
    field(facts, "model", optional(_model), default=None)
    field(facts, "video", optional(_video), default=None)
    field(facts, "clip", optional(_clip), default=None)


def _model(value: Any) -> Mapping[str, Any]:
    model = mapping(value)
    for key in ("mjb", "xml"):
        field(model, key, optional(_base_name), default=None)
    return model


def _video(value: Any) -> Mapping[str, Any]:
    video = mapping(value)
    # Whether it is that of its own episode, `video_path` looks at.
    field(video, "name", text, default="")
    field(video, "quality", _one_of(*QUALITIES), default="full")
    field(video, "recording", _one_of(*_RECORDINGS), default="live")
    field(video, "reason", optional(text), default=None)
    field(video, "selection", optional(mapping), default=None)
    for key in ("fps", "max_fps"):
        field(video, key, optional(_asked_rate), default=None)
    field(video, "cameras", optional(_cameras), default=None)
    for key in ("tiled", "annotate"):
        field(video, key, boolean, default=False)
    field(video, "also_named", optional(_second_name), default=None)
    return video


def _clip(value: Any) -> Mapping[str, Any]:
    clip = mapping(value)
    for key in ("first_step", "part", "steps_before"):
        field(clip, key, _count, default=0)
    field(clip, "reward_before", number, default=0.0)
    field(clip, "reset_time", optional(number), default=None)
    return clip


def _cameras(value: Any) -> tuple[PlainCamera | None, ...]:
    cameras = list_of(optional(plain_camera))(value)
    if not 1 <= len(cameras) <= _MOST_CAMERAS:
        raise ValueError(f"{len(cameras)} is no number of cameras")
    if None in cameras[1:]:
        raise ValueError("only the first can be what the environment itself shows")
    return cameras


def _second_name(value: Any) -> str:
    if not is_second_name(text(value)):
        raise ValueError(f"{value!r:.80} is no second name of a video")
    return str(value)


def _rate(value: Any) -> Fraction:
    if not _RATE.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is no fraction")
    return _positive(value)


def _asked_rate(value: Any) -> Fraction:
    if not _ASKED_RATE.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is no rate")
    try:
        return to_rate(_positive(value))
    except InvalidArgument as error:
        raise ValueError(str(error)) from error


def _positive(value: str) -> Fraction:
    _, _, denominator = value.partition("/")
    if denominator and not int(denominator):
        raise ValueError(f"{value!r} divides by zero")
    if not Fraction(value):
        raise ValueError("it is zero")
    return Fraction(value)


def _base_name(value: Any) -> str:
    if not _BASE_NAME.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is no file's name")
    return str(value)


def _stride(value: Any) -> int:
    return _steps(value, least=1)


def _count(value: Any) -> int:
    return _steps(value, least=0)


def _steps(value: Any, *, least: int) -> int:
    steps = integer(value)
    if isinstance(value, float) or steps < least:
        raise ValueError(f"{steps!r:.80} is no number of steps")
    return steps


def _one_of(*choices: str) -> Any:
    def choice(value: Any) -> str:
        if text(value) not in choices:
            raise ValueError(f"{value!r:.80} is not one of {', '.join(choices)}")
        return str(value)

    return choice
