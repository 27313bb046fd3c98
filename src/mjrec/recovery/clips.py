# SPDX-License-Identifier: Apache-2.0
"""What a dead monitor has left of videos that are counted in steps."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import UnreadableFile
from ..formats.journal import MOST_EPISODES
from ..formats.pending_videos import pending_clip
from ..formats.video_metadata import is_done
from ..rendering.recorded_facts import open_for_rendering, video_path
from ..rendering.recordings import RecordingKey, key_of, parts_of
from .remains import Remains

_END = ".meta.json"
_METADATA = re.compile(r"openaigym\.video\..+\.video[0-9]+\.step[0-9]+\.meta\.json")


def pending_clips(remains: Remains) -> list[dict[str, Any]]:
    """Return how a manifest names those that are still to be rendered.

    One that cannot be read is named by nobody; whoever renders the directory says so.
    """
    keys = {key_of(path.name) for path in remains.clip_parts}
    clips = (_pending(remains.directory, key) for key in keys if key is not None)
    return sorted(
        (clip for clip in clips if clip is not None), key=lambda clip: clip["clip"]
    )


def videos_begun_by_steps(remains: Remains) -> list[Path]:
    """Return the videos of which there is metadata, be they there themselves or not."""
    metadata = (path for path in remains.paths if _METADATA.fullmatch(path.name))
    return [path.with_name(path.name.replace(_END, ".mp4")) for path in metadata]


def last_clip_episode(remains: Remains) -> int:
    """Return the highest number of an episode that a part is of; -1 where none."""
    return max((_episode_of(path) for path in remains.clip_parts), default=-1)


def _pending(directory: Path, key: RecordingKey) -> dict[str, Any] | None:
    parts = parts_of(directory, key)
    if not parts:
        return None
    try:
        facts = _facts(parts[0])
        video = video_path(parts[0], facts)
    except UnreadableFile:
        return None
    if is_done(video):
        return None
    return pending_clip(
        int(facts.get("episode_id") or 0), first_part=parts[0].name, video=video.name
    )


def _episode_of(part: Path) -> int:
    try:
        episode_id = _facts(part).get("episode_id")
    except UnreadableFile:
        return -1
    if type(episode_id) is int and 0 <= episode_id < MOST_EPISODES:
        return episode_id
    return -1


def _facts(part: Path) -> Mapping[str, Any]:
    with open_for_rendering(part) as reader:
        return reader.header.facts
