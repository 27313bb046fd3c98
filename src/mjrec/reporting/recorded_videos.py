# SPDX-License-Identifier: Apache-2.0
"""The finished videos of monitors, and what their metadata says of them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

from ..errors import UnreadableFile
from ..formats.json_fields import field, integer, number, rate, read_object
from ..formats.monitor_directory import episode_of
from ..formats.regular_files import regular_path
from ..formats.video_metadata import finished_videos, is_broken, metadata_path
from ..formats.video_names import view_of
from ..results.journal_or_stats import MonitorResults
from .contents import ReportVideo

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
    for name in sorted({*_listed(results), *_finished(results)}, key=_order):
        path = directory / name
        try:
            regular_path(path)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            problems.append(f"The video {path} is left out: {reason}.")
            continue
        said: Mapping[str, Any] = {}
        try:
            said = read_object(metadata_path(path))
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            problems.append(
                f"The metadata of {path} cannot be read: {reason}. The video is shown "
                "without them."
            )
        found.append(_video(path, said, results))
    return found


def _listed(results: MonitorResults) -> list[str]:
    try:
        manifest = results.manifest
    except UnreadableFile:
        # Its episodes cannot be read either; that is said there.
        return []
    return [] if manifest is None else [video for video, _ in manifest.videos]


def _finished(results: MonitorResults) -> list[str]:
    files = results.files
    return [
        name
        for number in sorted(files.videos.keys() & files.metadata.keys())
        if not is_broken(files.metadata[number])
        for name, _ in finished_videos(files.videos[number])
    ]


def _order(name: str) -> tuple[int, str, str]:
    # A further camera's follows the first one's.
    return episode_of(name) or 0, view_of(name), name


def _video(path: Path, said: Mapping[str, Any], results: MonitorResults) -> ReportVideo:
    episode_id = episode_of(path.name)
    if said.get("first_step") is not None or "sub_environments" in said:
        episode_id = None
    drawn_with = (said.get("gl_renderer"), said.get("gl_version"))
    texts = [text[:_LONGEST_TEXT] for text in drawn_with if isinstance(text, str)]
    sha256 = said.get("file_sha256")
    is_hash = isinstance(sha256, str) and _SHA256.fullmatch(sha256)
    command = None
    if episode_id is not None and said.get("recording") == "deferred":
        trajectory = results.files.trajectories.get(episode_id)
        command = None if trajectory is None else _command(path, said, trajectory)
    return ReportVideo(
        path=path,
        infix=results.files.infix,
        episode_id=episode_id,
        height=_pixels(said, "height"),
        width=_pixels(said, "width"),
        seconds=_seconds(said),
        camera=_camera(said.get("camera")),
        renderer=", ".join(texts) or None,
        sha256=sha256 if is_hash else None,
        command=command,
        notes=_notes(said),
    )


def _command(path: Path, said: Mapping[str, Any], trajectory: Path) -> str | None:
    """Return what a shell takes to render a video again, beside the recorded ones."""
    camera = said.get("camera")
    options = []
    if view_of(path.name) and "tiled" not in said:
        # A further camera's; without its name the first one is rendered.
        is_name = isinstance(camera, str) and not _NUMBER.fullmatch(camera)
        if not is_name and (isinstance(camera, bool) or not isinstance(camera, int)):
            return None
        options = [f"--camera={camera}"]
    target = str(trajectory)
    if target.startswith("-"):
        target = f"./{target}"
    return shlex.join(["mjrec", "render", target, *options, "--out", "again.mp4"])


def _notes(said: Mapping[str, Any]) -> list[str]:
    notes = []
    if said.get("complete") is False:
        reason = said.get("reason")
        why = reason if isinstance(reason, str) else "it is not known why"
        notes.append(f"Incomplete: the episode was not over ({why[:_LONGEST_TEXT]}).")
    if said.get("first_step") is not None:
        notes.append("Counted in steps: it may go on across episodes.")
    if "sub_environments" in said:
        notes.append("Shows several sub-environments side by side.")
    if said.get("recording") == "live":
        notes.append("Recorded live: it cannot be rendered again from recorded states.")
    if said.get("quality") == "draft":
        notes.append("Drawn in draft quality.")
    if "annotated" in said:
        notes.append("Has captions on its frames.")
    speed = said.get("playback_speed")
    if isinstance(speed, float) and abs(speed - 1) > 1e-3:
        notes.append(f"Plays at {speed:.3g} times the speed of the simulation.")
    selection = said.get("selection")
    if isinstance(selection, Mapping) and isinstance(selection.get("rule"), str):
        notes.append(_of_selection(selection))
    return notes


def _of_selection(selection: Mapping[str, Any]) -> str:
    rule = selection["rule"][:_LONGEST_TEXT]
    if selection.get("decided") is not True:
        return f"Kept by a run that ended before it could choose by {rule}."
    among = selection.get("finished")
    of = f" among {among} episodes" if type(among) is int else ""
    return f"Chosen by {rule}{of} after they had ended."


def _pixels(said: Mapping[str, Any], key: str) -> int | None:
    try:
        count = field(said, key, integer)
    except ValueError:
        return None
    return count if 0 < count <= _MOST_PIXELS else None


def _seconds(said: Mapping[str, Any]) -> float | None:
    try:
        frames = field(said, "frame_count", integer)
        fps: Fraction = field(said, "fps", rate)
        seconds = float(frames / fps)
    except (ValueError, OverflowError):
        return None
    return seconds if seconds > 0 else None


def _camera(camera: Any) -> str | None:
    if isinstance(camera, str):
        return camera[:_LONGEST_TEXT]
    if type(camera) is int:
        return "free camera" if camera == -1 else f"camera {camera}"
    if isinstance(camera, list) and camera:
        each = [_camera(one) for one in camera[:100]]
        return ", ".join(one or "?" for one in each)
    return _posed(camera) if isinstance(camera, Mapping) else None


def _posed(camera: Mapping[str, Any]) -> str | None:
    if camera.get("type") == "mjCAMERA_FIXED":
        fixed = camera.get("fixedcamid")
        return f"camera {fixed}" if type(fixed) is int else None
    kind = "tracking" if camera.get("type") == "mjCAMERA_TRACKING" else "free"
    pose = []
    for key in ("azimuth", "elevation", "distance"):
        try:
            pose.append(f"{key} {field(camera, key, number):.4g}")
        except ValueError:
            continue
    return f"{kind} camera" + (f" ({', '.join(pose)})" if pose else "")
