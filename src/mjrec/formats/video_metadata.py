# SPDX-License-Identifier: Apache-2.0
"""The metadata file of a video.

Live and deferred videos have the same keys, because both take them from this module.
The caller adds facts about the episode, the frames and any failures.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from .. import json_text
from ..atomic_files import write_text
from ..errors import Error
from .json_fields import read_object, unreadable
from .video_file import VideoFile

_FAILED = ".failed.json"
# The output of ffmpeg or a driver can be long. Its beginning and end matter most.
_LONGEST_REASON = 1000
_CUT = " [...] "

# A part of a file's name, in the form that `camera_part` returns.
_PART = re.compile(r"[A-Za-z0-9_%-]{1,200}", re.ASCII)


# Metadata keys about a finished file, taken from a `VideoFile`.
_OF_FILE = (
    *("height", "width", "padded_height", "padded_width", "codec", "pixel_format"),
    *("file_sha256", "decoded_sha256"),
)
# Metadata keys about the episode, taken from a recording's facts.
_OF_EPISODE = ("episode_id", "type", "env_id", "seed", "options", "versions")


def recording_facts(facts: Mapping[str, Any], *, recording: str) -> dict[str, Any]:
    """Return the metadata about the recording that a video shows.

    Args:
        facts: the known facts about the recording; for a clip, about its first part.
        recording: when the frames are rendered, "live" or "deferred".
    """
    video = facts.get("video") or {}
    further = {"recording_reason": video.get("reason")} if recording == "live" else {}
    further["selection"] = video.get("selection")
    return {
        **{key: facts[key] for key in _OF_EPISODE if key in facts},
        "recording": recording,
        **{key: value for key, value in further.items() if value is not None},
    }


class StepRuns:
    """The step of every frame, stored as runs of frames to save memory.

    Args:
        steps: the steps of the frames so far, in order.
        stride: the usual number of steps from one frame to the next.

    Attributes:
        ranges: the first and the last step of each run; consecutive frames in a run are
            one stride apart.
        total: number of frames.
    """

    def __init__(self, steps: Iterable[int] = (), *, stride: int = 1) -> None:
        self.ranges: list[list[int]] = []
        self.total = 0
        self._stride = stride
        for step in steps:
            self.add(step)

    def add(self, step: int) -> None:
        """Add a frame at `step`."""
        self.total += 1
        if self.ranges and self.ranges[-1][1] == step - self._stride:
            self.ranges[-1][1] = step
        else:
            self.ranges.append([step, step])


def timing_facts(
    steps: StepRuns,
    *,
    fps: Fraction | None,
    timestep: Fraction | None,
    stride: int = 1,
    frames_per_step: int = 1,
) -> dict[str, Any]:
    """Return the metadata about timing.

    Args:
        steps: the step of every frame.
        fps: the frame rate of the file.
        timestep: simulated seconds per step, if known.
        stride: the usual number of steps from one frame to the next.
        frames_per_step: number of frames per step; must be 1 unless the stride is 1.
    """
    speed = None
    if fps is not None and timestep is not None:
        speed = float(fps * timestep * Fraction(stride, frames_per_step))
    return {
        "fps": str(fps),
        "timestep": None if timestep is None else str(timestep),
        "playback_speed": speed,
        "stride": stride,
        "frame_count": steps.total,
        "frame_steps": steps.ranges,
    }


def file_facts(file: VideoFile) -> dict[str, Any]:
    """Return the metadata about a finished file and its encoding."""
    return {
        # gym's three keys. The command line contains no directory, so it stays valid
        # when the recordings are moved.
        "encoder_version": {
            "backend": "ffmpeg",
            "version": file.encoder["version"],
            "cmdline": [file.encoder["ffmpeg"], *file.encoder["arguments"]],
        },
        "ffmpeg_sha256": file.encoder["sha256"],
        **{name: getattr(file, name) for name in _OF_FILE},
    }


def metadata_path(video: Path) -> Path:
    """Return the path of a video's metadata file."""
    return video.with_suffix(".meta.json")


def write_metadata(video: Path, metadata: Mapping[str, Any]) -> None:
    """Write the metadata file of a video.

    Raises:
        FileNotWritten: the disk is full, or the directory was removed.
    """
    write_text(metadata_path(video), json_text.dumps(metadata))


def amend_metadata(video: Path, facts: Mapping[str, Any]) -> None:
    """Add facts to the metadata file of a finished video.

    Raises:
        UnreadableFile: the metadata file is missing or damaged.
        FileNotWritten: the disk is full.
    """
    path = metadata_path(video)
    with unreadable(path):
        known = read_object(path)
    if any(known.get(name) != value for name, value in facts.items()):
        write_metadata(video, {**known, **facts})


def finished_videos(video: Path) -> list[tuple[str, str]]:
    """Return the names of an episode's finished videos and of their metadata files.

    The first video, which must exist, comes first. Its metadata, which is written last,
    lists the videos from additional cameras (`further_videos`). The list is untrusted,
    so only names that belong to this episode are accepted.

    Args:
        video: the first video.
    """
    names = [(video.name, metadata_path(video).name)]
    known = metadata_of(video).get("further_videos")
    for name in known if isinstance(known, list) else ():
        if isinstance(name, str) and _is_further(name, video):
            further = video.with_name(name)
            if further.is_file() and metadata_path(further).is_file():
                names.append((name, metadata_path(further).name))
    return list(dict.fromkeys(names))


def further_live_videos(video: Path) -> list[str]:
    """Return the names of an episode's live videos from additional cameras.

    This is for readers that have only these files. Videos that were rendered from a
    trajectory are excluded, because their metadata does not say "live".

    Args:
        video: the first video of the episode, which need not exist.
    """
    return [
        path.name
        for path in sorted(video.parent.iterdir())
        if _is_further(path.name, video)
        and metadata_of(path).get("recording") == "live"
    ]


def is_done(video: Path) -> bool:
    """Return whether a video needs no more work because it is finished or given up."""
    metadata = metadata_path(video)
    return metadata.exists() and (video.exists() or is_broken(metadata))


def is_broken(metadata: Path) -> bool:
    """Return whether a video's metadata marks it as broken."""
    return bool(_read_or_nothing(metadata).get("broken"))


def metadata_of(video: Path) -> Mapping[str, Any]:
    """Return the content of a video's metadata, or {} if it cannot be read."""
    return _read_or_nothing(metadata_path(video))


def _read_or_nothing(path: Path) -> Mapping[str, Any]:
    with contextlib.suppress(OSError, ValueError):
        return read_object(path)
    return {}


def _is_further(name: str, video: Path) -> bool:
    begin, end = f"{video.stem}.", ".mp4"
    part = name.removeprefix(begin).removesuffix(end)
    return name == f"{begin}{part}{end}" and _PART.fullmatch(part) is not None


def failure_path(video: Path) -> Path:
    """Return the path of the file that states why a video could not be rendered.

    The file contains `{"reason": "no OpenGL backend works here: ..."}`. It is written
    when rendering fails, and removed once the video exists.

    Args:
        video: the video, or a part of a clip if the clip's video may be unknown.
    """
    return video.with_suffix(_FAILED)


def note_failure(video: Path, reason: str) -> None:
    """Record why a video could not be rendered. Errors while doing so are ignored."""
    with contextlib.suppress(Error, OSError):
        text = json_text.dumps({"reason": _shortened(reason)})
        write_text(failure_path(video), text)


def forget_failure(video: Path) -> None:
    """Remove the record of a failure, because the video now exists."""
    with contextlib.suppress(OSError):
        failure_path(video).unlink(missing_ok=True)


def reason_of(video: Path) -> str | None:
    """Return the reason why a video could not be rendered, or None if unknown."""
    reason = _read_or_nothing(failure_path(video)).get("reason")
    return reason if isinstance(reason, str) else None


def _shortened(reason: str) -> str:
    if len(reason) <= _LONGEST_REASON:
        return reason
    half = (_LONGEST_REASON - len(_CUT)) // 2
    return f"{reason[:half]}{_CUT}{reason[-half:]}"
