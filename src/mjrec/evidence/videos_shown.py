# SPDX-License-Identifier: Apache-2.0
"""What a video shows, said plainly: not all of an episode, not in real time, unlike.

It may all be made again as it was asked for; a reader should know what was asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..formats.json_fields import read_object
from ..formats.video_metadata import metadata_path
from .findings import Finding, Outcome, Topic


def read_metadata(video: Path) -> Mapping[str, Any]:
    """Return what the metadata file of a video says; nothing where it is damaged."""
    return _read(metadata_path(video))


def remarks_on_video(metadata: Path, file: str) -> Iterator[Finding]:
    """Yield what a reader would not expect of a video.

    Args:
        metadata: its metadata file.
        file: the name of that, below `data/`.
    """
    for reason in _remarks(_read(metadata)):
        yield Finding(
            topic=Topic.VIDEOS,
            item=file,
            outcome=Outcome.NOTED,
            reason=reason,
            unit="video",
        )


def _remarks(said: Mapping[str, Any]) -> Iterator[str]:
    if said.get("empty"):
        yield "has no frames"
        return
    speed = said.get("playback_speed")
    if isinstance(speed, int | float) and abs(speed - 1) > 1e-9:
        yield f"plays at {speed:g} times real time"
    elif speed is None and said.get("content_type") == "video/mp4":
        yield "does not say how fast it plays: how long a step lasts is not known"
    if said.get("broken"):
        yield f"broke off: {said.get('broken_reason')}"
    elif said.get("complete") is False:
        yield f"shows an episode that did not end: {said.get('reason')}"
    if "first_step" in said:
        yield "is a clip, not a whole episode"
    elif (runs := said.get("frame_steps")) and not _is_whole(runs, said.get("length")):
        yield "does not show its episode from the reset to the last step"
    if said.get("first_video"):
        yield "shows a further camera"
    if said.get("recording") == "live":
        yield f"was drawn while its episode ran: {said.get('recording_reason')}"
    for key, meaning in (
        ("annotated", "has captions drawn into its frames"),
        ("packed_smaller", "was drawn again in a smaller size to be packed"),
    ):
        if said.get(key):
            yield meaning
    if said.get("quality") == "draft":
        yield "is drawn in draft quality"


def _is_whole(runs: Any, length: Any) -> bool:
    try:
        return bool(runs[0][0] == 0 and runs[-1][1] == length)
    except (TypeError, LookupError):
        return False


def _read(path: Path) -> Mapping[str, Any]:
    try:
        return read_object(path)
    except (OSError, ValueError):
        return {}
