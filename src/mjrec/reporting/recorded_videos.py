# SPDX-License-Identifier: Apache-2.0
"""The finished videos of monitors, and what their metadata says of them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from ..errors import UnreadableFile
from ..formats.json_fields import field, integer, rate, read_object
from ..formats.monitor_directory import episode_of, view_of
from ..formats.regular_files import regular_path
from ..formats.video_metadata import finished_videos, is_broken, metadata_path
from ..results.journal_or_stats import MonitorResults
from .contents import ReportVideo
from .provenance import spaced

T = TypeVar("T")

_SHA256: Final = re.compile(r"[0-9a-f]{64}", re.ASCII)
_NUMBER: Final = re.compile(r"-?\d+", re.ASCII)
_LONGEST_TEXT: Final = 1000
_MOST_PIXELS: Final = 1 << 15


def recorded_videos(
    results: MonitorResults, directory: Path, problems: list[str]
) -> list[ReportVideo]:
    """Return the videos of a monitor that are finished and there, each once.

    They are those that its manifest lists, and those that were finished after it was
    written, with those of further cameras. Text recordings are among them.

    Args:
        results: of the monitor.
        directory: of its files.
        problems: is added to where one is listed and gone, or cannot be read.
    """
    found: list[ReportVideo] = []
    for name in sorted(set(_names(results)), key=_order):
        path = directory / name
        facts: Mapping[str, Any] = {}
        try:
            regular_path(path)
        except (OSError, ValueError) as error:
            problems.append(f"The video {path} is left out: {_reason(error)}.")
            continue
        try:
            facts = read_object(metadata_path(path))
        except (OSError, ValueError) as error:
            problems.append(
                f"The metadata of {path} cannot be read: {_reason(error)}. The video "
                "is shown without them."
            )
        found.append(_video(path, facts, results))
    return found


def _names(results: MonitorResults) -> Iterator[str]:
    try:
        manifest = results.manifest
    except UnreadableFile:
        # Its episodes cannot be read either; that is said there.
        manifest = None
    if manifest is not None:
        yield from (video for video, _ in manifest.videos)
    files = results.files
    for number in files.videos.keys() & files.metadata.keys():
        if not is_broken(files.metadata[number]):
            yield from (name for name, _ in finished_videos(files.videos[number]))


def _order(name: str) -> tuple[int, str, str]:
    # A further camera's follows the first one's.
    return episode_of(name) or 0, view_of(name), name


def _reason(error: Exception) -> object:
    return error.strerror if isinstance(error, OSError) else error


def _video(
    path: Path, facts: Mapping[str, Any], results: MonitorResults
) -> ReportVideo:
    episode_id = episode_of(path.name)
    if facts.get("first_step") is not None or "sub_environments" in facts:
        episode_id = None
    drawn_with = (facts.get("gl_renderer"), facts.get("gl_version"))
    texts = [text[:_LONGEST_TEXT] for text in drawn_with if isinstance(text, str)]
    sha256 = facts.get("file_sha256")
    is_hash = isinstance(sha256, str) and _SHA256.fullmatch(sha256)
    command = trajectory = None
    if episode_id is not None and facts.get("recording") == "deferred":
        trajectory = results.files.trajectories.get(episode_id)
        command = None if trajectory is None else _command(path, facts, trajectory)
    frames, fps = _known(facts, "frame_count", integer), _known(facts, "fps", rate)
    return ReportVideo(
        path=path,
        infix=results.files.infix,
        episode_id=episode_id,
        height=_known(facts, "height", _pixels),
        width=_known(facts, "width", _pixels),
        seconds=float(frames / fps) if frames and frames > 0 and fps else None,
        camera=_camera(facts.get("camera")),
        renderer=", ".join(texts) or None,
        sha256=sha256 if is_hash else None,
        command=command,
        notes=list(_notes(facts)),
        trajectory=trajectory,
    )


def _command(path: Path, facts: Mapping[str, Any], trajectory: Path) -> str | None:
    """Return what a shell takes to render a video again, beside the recorded ones."""
    camera = facts.get("camera")
    options = []
    if view_of(path.name) and "tiled" not in facts:
        # A further camera's; without its name the first one is rendered.
        is_name = isinstance(camera, str) and not _NUMBER.fullmatch(camera)
        if not is_name and type(camera) is not int:
            return None
        options = [f"--camera={camera}"]
    # A name may look like an option.
    target = f"./{trajectory}" if str(trajectory).startswith("-") else str(trajectory)
    return shlex.join(["mjrec", "render", target, *options, "--out", "again.mp4"])


def _notes(facts: Mapping[str, Any]) -> Iterator[str]:
    if facts.get("complete") is False:
        reason = facts.get("reason")
        why = reason if isinstance(reason, str) else "it is not known why"
        yield f"Incomplete: the episode was not over ({why[:_LONGEST_TEXT]})."
    if facts.get("first_step") is not None:
        yield "Counted in steps: it may go on across episodes."
    if "sub_environments" in facts:
        yield "Shows several sub-environments side by side."
    if facts.get("recording") == "live":
        yield "Recorded live: it cannot be rendered again from recorded states."
    if facts.get("quality") == "draft":
        yield "Drawn in draft quality."
    if "annotated" in facts:
        yield "Has captions on its frames."
    speed = facts.get("playback_speed")
    if isinstance(speed, float) and abs(speed - 1) > 1e-3:
        yield f"Plays at {speed:.3g} times the speed of the simulation."
    selection = facts.get("selection")
    if isinstance(selection, Mapping) and isinstance(selection.get("rule"), str):
        rule, among = (
            spaced(selection["rule"][:_LONGEST_TEXT]),
            selection.get("finished"),
        )
        of = f" among {among} episodes" if type(among) is int else ""
        if selection.get("decided") is True:
            yield f"Chosen by {rule}{of} after they had ended."
        else:
            yield f"Kept by a run that ended before it could choose by {rule}."


def _known(facts: Mapping[str, Any], key: str, read: Callable[[Any], T]) -> T | None:
    """Return what metadata says; None where that is nothing, or nonsense."""
    try:
        return field(facts, key, read)
    except ValueError:
        return None


def _pixels(value: Any) -> int:
    if not 0 < (count := integer(value)) <= _MOST_PIXELS:
        raise ValueError(value)
    return count


def _camera(camera: Any) -> str | None:
    match camera:
        case str():
            return camera[:_LONGEST_TEXT]
        case bool():
            return None
        case int():
            return "free camera" if camera == -1 else f"camera {camera}"
        case [_, *_]:
            return ", ".join(_camera(one) or "?" for one in camera[:100])
        case {"type": 1}:
            return "tracking camera"
        case {}:
            return "free camera"
    return None
