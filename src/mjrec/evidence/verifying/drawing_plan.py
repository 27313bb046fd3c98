# SPDX-License-Identifier: Apache-2.0
"""Which recorded pictures a video is to show, and how they are to be drawn.

It is the trajectory that says so, which the other levels check, and not the video's
metadata: that has to fit. Which trajectory it is follows from the video's name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from ...annotation import Caption, check_annotation
from ...errors import Error, MissingDependency, NoPictures
from ...formats.monitor_directory import (
    Infix,
    episode_of,
    infix_of,
    trajectory_prefix,
    view_of,
)
from ...formats.spans import FINISHED, is_in_flight
from ...formats.trajectory import TrajectoryReader
from ...formats.video_metadata import StepRuns
from ...frames import grid_shape
from ...rendering.recorded_facts import (
    ChosenFrames,
    captions,
    check_has_frames,
    further_video_paths,
    open_for_rendering,
    usual_fps,
    video_path,
)
from ...rendering.views import PlainCamera, View, plain_camera
from .live_pictures import told_live, why_others_are_shown
from .shipped_video import ShippedVideo


class NotDrawable(Exception):
    """There is nothing that pictures of a video could be drawn from."""


class DoesNotFit(Exception):
    """A video's metadata says something else than its trajectory."""


@dataclass(frozen=True, kw_only=True)
class DrawingPlan:
    """How the pictures of a video are drawn.

    Attributes:
        trajectory: what they are drawn from.
        indices: the numbers of its pictures, in the order of the video's frames.
        view: how they are drawn.
        cameras: all of them, where they are in one picture.
        captions: what is written on them, by frame; None where nothing is.
        excuse: why the video may show something else than what is drawn, as it was
            drawn live; None where it must show that.
        mujoco: the version that recorded it, or None.
        machine: the fingerprint of the machine that recorded it; None where nobody
            says.
    """

    trajectory: Path
    indices: Sequence[int]
    view: View
    cameras: Sequence[PlainCamera | None] | None
    captions: Sequence[Caption] | None
    excuse: str | None
    mujoco: str | None
    machine: Mapping[str, Any] | None


@dataclass(frozen=True, kw_only=True)
class _Seen:
    """What is seen in a video, and of which pictures."""

    view: View
    chosen: ChosenFrames
    is_annotated: bool
    fps: Fraction | None
    cameras: Sequence[PlainCamera | None] | None = None


def plan_drawing(video: ShippedVideo) -> DrawingPlan:
    """Return how the pictures of a video are drawn again.

    Raises:
        NotDrawable: they cannot be, for a reason that proves nothing.
        DoesNotFit: the metadata contradicts the trajectory.
    """
    path = _trajectory_of(video)
    try:
        reader = open_for_rendering(path)
    except Error as error:
        raise DoesNotFit(f"its trajectory cannot be read: {error}") from error
    with reader:
        try:
            excuse = _excuse(video, path, reader)
        except Error as error:
            raise DoesNotFit(str(error)) from error
        try:
            return _plan(video, path, reader, excuse)
        except (DoesNotFit, Error) as error:
            told = str(error)
            if excuse is None:
                raise DoesNotFit(told) from error
            reason = f"{told}; it was drawn live, and {excuse}"
            raise NotDrawable(reason) from error


def _plan(
    video: ShippedVideo, path: Path, reader: TrajectoryReader, excuse: str | None
) -> DrawingPlan:
    seen = _seen(video, path, reader)
    _check_fits(video, reader, seen)
    facts = reader.facts
    return DrawingPlan(
        trajectory=path,
        indices=seen.chosen.indices,
        view=seen.view,
        cameras=seen.cameras,
        captions=_captions(reader, seen),
        excuse=excuse,
        mujoco=_mujoco(facts),
        machine=_machine(facts),
    )


def _excuse(video: ShippedVideo, path: Path, reader: TrajectoryReader) -> str | None:
    """Return why a video may show something else than what was recorded."""
    facts = reader.facts
    if not _is_live(facts) or video.name not in _original_views(path, facts):
        return None
    return why_others_are_shown(video, facts)


def _is_live(facts: Mapping[str, Any]) -> bool:
    recorded = facts.get("video")
    return recorded is not None and recorded.get("recording") == "live"


def _trajectory_of(video: ShippedVideo) -> Path:
    number, infix = episode_of(video.name), Infix.parse(infix_of(video.name) or "")
    if number is None or infix is None:
        raise NotDrawable("its name is not that of an episode's video")
    stem = trajectory_prefix(infix, number)
    path = video.path.with_name(f"{stem}{FINISHED}")
    if path.exists() or is_in_flight(path):
        return path
    if video.is_live:
        raise NotDrawable(told_live(video.live_reason))
    raise NotDrawable(
        f"there is no trajectory {stem}.h5 to draw from: the states of its episode "
        "were not recorded (mode='evaluation' or trajectory_callable records them), or "
        "it is a video that is counted in steps"
    )


def _seen(video: ShippedVideo, path: Path, reader: TrajectoryReader) -> _Seen:
    """Return what a video is to show, after its own trajectory."""
    facts = reader.facts
    recorded = facts.get("video")
    if recorded is None and video.is_clip:
        raise NotDrawable("it is a video that is counted in steps")
    if recorded is None:
        raise DoesNotFit(
            f"{path.name} says that no video of its episode was to be recorded"
        )
    views = _original_views(path, facts)
    try:
        check_has_frames(reader)
    except NoPictures as error:
        if video.name in views and _is_live(facts):
            reason = recorded.get("reason") or facts.get("refusal")
            raise NotDrawable(told_live(reason or video.live_reason)) from error
        raise NotDrawable(str(error).removesuffix(".")) from error
    if video.name not in views:
        return _seen_again(video, reader)
    camera, tiles = views[video.name]
    if _is_live(facts):
        # Drawn with a size of its own it may show what the environment does not.
        first = _variant_camera(video.first_camera, facts)
        camera = first if camera is None and tiles is None else camera
        tiles = None if tiles is None else (first, *tiles[1:])
    chosen = ChosenFrames(list(range(reader.frame_count)), 1)
    return _Seen(
        view=_sized(video, reader, camera, tiles),
        cameras=tiles,
        chosen=chosen,
        is_annotated=bool(recorded.get("annotate", False)),
        fps=usual_fps(facts, chosen),
    )


def _original_views(
    path: Path, facts: Mapping[str, Any]
) -> dict[str, tuple[PlainCamera | None, Sequence[PlainCamera | None] | None]]:
    """Return the camera, or the cameras in one picture, of each recorded video."""
    recorded = facts["video"]
    first = video_path(path, facts).name
    cameras = list(recorded.get("cameras") or ())
    if recorded.get("tiled") and len(cameras) > 1:
        return {first: (None, (None, *map(plain_camera, cameras[1:])))}
    further = [other.name for other in further_video_paths(path, facts)]
    views = dict(zip(further, map(plain_camera, cameras[1:]), strict=False))
    return {first: (None, None), **{name: (c, None) for name, c in views.items()}}


def _sized(
    video: ShippedVideo,
    reader: TrajectoryReader,
    camera: PlainCamera | None,
    tiles: Sequence[Any] | None,
) -> View:
    """Return the view of a recorded video: as recorded, or smaller."""
    facts = reader.facts
    quality = facts["video"].get("quality", "full")
    if _is_live(facts):
        # Whoever draws live draws as the environment does.
        quality = video.quality
    if video.quality != quality:
        raise DoesNotFit(
            f"its metadata says quality {video.quality}, and its trajectory {quality}"
        )
    rows, columns = grid_shape(len(tiles or (None,)))
    height, width = video.height // rows, video.width // columns
    scene = facts["scene"]
    recorded = scene.get("height"), scene.get("width")
    if (height, width) != recorded and not video.is_smaller:
        raise DoesNotFit(
            f"its metadata says {width}x{height} pixels, and its trajectory "
            f"{recorded[1]}x{recorded[0]}"
        )
    view = View(camera=camera, height=height, width=width)
    return dataclasses.replace(view, quality=quality) if _is_live(facts) else view


def _seen_again(video: ShippedVideo, reader: TrajectoryReader) -> _Seen:
    """Return what a video shows that was rendered again, beside the recorded ones."""
    if video.camera is None:
        raise NotDrawable(
            f"it is none of the videos that its trajectory names ({view_of(video.name)}"
            "), and its metadata names no camera"
        )
    every, rest = divmod(video.stride, reader.facts.get("stride", 1))
    if rest or not every:
        raise DoesNotFit(f"no recorded pictures are {video.stride} steps apart")
    last = reader.frame_count - 1
    return _Seen(
        view=View(
            camera=_variant_camera(video.camera, reader.facts),
            height=video.height,
            width=video.width,
            quality=video.quality,
        ),
        chosen=ChosenFrames([*range(0, last, every), last], every),
        is_annotated=video.pillow is not None,
        fps=None,
    )


def _variant_camera(
    camera: PlainCamera | None, facts: Mapping[str, Any]
) -> PlainCamera | None:
    """Return the camera that metadata names, as a view has it: None is as recorded."""
    return None if camera == facts["scene"].get("label") else camera


def _check_fits(video: ShippedVideo, reader: TrajectoryReader, seen: _Seen) -> None:
    count = len(seen.chosen.indices)
    if video.frame_count != count:
        raise DoesNotFit(
            f"its metadata says {video.frame_count} frames, and its trajectory has "
            f"{count} pictures"
        )
    stride = reader.facts.get("stride", 1) * seen.chosen.every
    steps = reader.frame_steps[list(seen.chosen.indices)].tolist()
    runs = StepRuns(steps, stride=stride).ranges
    if [list(run) for run in video.frame_steps] != runs:
        raise DoesNotFit(
            "its metadata says other steps of its frames than its trajectory: "
            f"{_brief(video.frame_steps)}, not {_brief(runs)}"
        )
    if seen.fps is not None and video.fps != seen.fps:
        raise DoesNotFit(
            f"its metadata says {video.fps} frames a second, and its trajectory "
            f"{seen.fps}"
        )


def _captions(reader: TrajectoryReader, seen: _Seen) -> Sequence[Caption] | None:
    if not seen.is_annotated:
        return None
    try:
        check_annotation()
    except MissingDependency as error:
        raise NotDrawable(str(error).removesuffix(".")) from error
    return list(captions(reader, seen.chosen.indices))


def _mujoco(facts: Mapping[str, Any]) -> str | None:
    versions = facts.get("versions")
    version = versions.get("mujoco") if isinstance(versions, Mapping) else None
    return version if isinstance(version, str) else None


def _machine(facts: Mapping[str, Any]) -> Mapping[str, Any] | None:
    machine = facts.get("machine")
    return machine if isinstance(machine, Mapping) else None


def _brief(runs: Sequence[Sequence[int]]) -> str:
    shown = ", ".join("-".join(map(str, run)) for run in runs[:3])
    return f"{shown} ..." if len(runs) > 3 else shown
