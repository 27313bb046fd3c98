# SPDX-License-Identifier: Apache-2.0
"""Recordings as rendering takes them: with facts that are what they should be.

A recording may come from anybody. Facts are checked here, once, so that everything
behind it finds a rate where there should be one, and no path leads elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..errors import InvalidArgument, UnreadableFile
from ..formats.json_fields import (
    base_name,
    boolean,
    field,
    integer,
    list_of,
    mapping,
    number,
    one_of,
    optional,
    rate,
    text,
    unreadable,
)
from ..formats.monitor_directory import (
    ClipPart,
    Infix,
    clip_video_prefix,
    episode_of,
    infix_of,
    video_prefix,
)
from ..formats.trajectory import TrajectoryReader
from ..formats.trajectory_file import open_trajectory
from ..formats.video_names import further_parts, is_second_name, with_part
from ..frames import QUALITIES
from ..rates import to_rate
from ..simulation.foreign_trajectories import open_vetted_trajectory
from .views import PlainCamera, plain_camera

# What the user has asked for is written as it was given: 29.97, or a fraction that a
# float exactly is. Not all that `Fraction` takes: 1e20000000 keeps it busy.
_ASKED_RATE = re.compile(r"\d{1,40}(\.\d{1,40}|/0*[1-9]\d{0,39})?", re.ASCII)


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
            _check_all(reader.facts, _FACTS)
    except BaseException:
        reader.close()
        raise
    return reader


def model_file(directory: Path, facts: Mapping[str, Any]) -> Path | None:
    """Return the file of a recording's model that has to be there for rendering."""
    model = facts.get("model") or {}
    # The compiled one comes first; what it was made from may never come.
    name = model.get("mjb") or model.get("xml")
    return None if name is None else directory / name


def video_facts(facts: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a recording says of its video; nothing where it has none."""
    return facts.get("video") or {}


def video_path(recording: Path, facts: Mapping[str, Any]) -> Path:
    """Return where the video of a trajectory, or of a part of a clip, belongs.

    Raises:
        UnreadableFile: the recording names none, or one that is not its own.
    """
    name = str(video_facts(facts).get("name"))
    clip = ClipPart.parse(recording.name)
    infix = clip.infix if clip else Infix.parse(infix_of(recording.name) or "")
    # The name of a clip's video tells in which episode it began; no other file does.
    episode = episode_of(name if clip else recording.name)
    own: set[str] = set()
    if infix is not None and episode is not None:
        own.add(f"{video_prefix(infix, episode)}.mp4")
        if clip is not None:
            own.add(f"{clip_video_prefix(infix, episode, clip.first_step)}.mp4")
    if name not in own:
        raise UnreadableFile(
            recording,
            f"the video that it names, {name!r:.200}, is not that of its own episode",
        )
    return recording.with_name(name)


def further_video_paths(recording: Path, facts: Mapping[str, Any]) -> list[Path]:
    """Return where the videos of a recording's further cameras belong.

    Raises:
        UnreadableFile: as `video_path`.
    """
    video = video_facts(facts)
    cameras = video.get("cameras") or ()
    if video.get("tiled") or len(cameras) < 2:
        return []
    first = video_path(recording, facts)
    return [
        first.with_name(with_part(first.name, part)) for part in further_parts(cameras)
    ]


def _asked_rate(value: Any) -> Fraction:
    if not _ASKED_RATE.fullmatch(text(value)):
        raise ValueError(f"{value!r:.80} is no rate")
    try:
        return to_rate(Fraction(value))
    except InvalidArgument as error:
        raise ValueError(str(error)) from error


def _count(value: Any) -> int:
    if isinstance(value, float) or integer(value) < 0:
        raise ValueError(f"{value!r:.80} is no number of steps")
    return int(value)


def _stride(value: Any) -> int:
    if _count(value) < 1:
        raise ValueError("it is zero")
    return int(value)


def _cameras(value: Any) -> tuple[PlainCamera | None, ...]:
    cameras = list_of(optional(plain_camera))(value)
    if not cameras or None in cameras[1:]:
        raise ValueError("only the first can be what the environment itself shows")
    return cameras


def _second_name(value: Any) -> str:
    if not is_second_name(text(value)):
        raise ValueError(f"{value!r:.80} is no second name of a video")
    return str(value)


def _object_of(**checks: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def check(value: Any) -> Mapping[str, Any]:
        _check_all(mapping(value), checks)
        return mapping(value)

    return optional(check)


def _check_all(
    facts: Mapping[str, Any], checks: Mapping[str, Callable[[Any], Any]]
) -> None:
    for key, check in checks.items():
        field(facts, key, check, default=None)


_FACTS: Mapping[str, Callable[[Any], Any]] = {
    "rate": optional(rate),
    "timestep": optional(rate),
    "stride": _stride,
    "kept": boolean,
    "candidate": boolean,
    "refusal": optional(text),
    "broken_reason": optional(text),
    "reason": optional(text),
    "scene": optional(mapping),
    "exception": optional(mapping),
    "model": _object_of(mjb=optional(base_name), xml=optional(base_name)),
    "video": _object_of(
        # Whether it is that of its own episode, `video_path` looks at.
        name=text,
        quality=one_of(*QUALITIES),
        recording=one_of("deferred", "live"),
        reason=optional(text),
        selection=optional(mapping),
        fps=optional(_asked_rate),
        max_fps=optional(_asked_rate),
        cameras=optional(_cameras),
        tiled=boolean,
        annotate=boolean,
        also_named=optional(_second_name),
    ),
    "clip": _object_of(
        first_step=_count,
        part=_count,
        steps_before=_count,
        reward_before=number,
        reset_time=optional(number),
    ),
}
