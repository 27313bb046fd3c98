# SPDX-License-Identifier: Apache-2.0
"""Text recordings that were being written when their process was killed.

What they hold is on the disk frame by frame; the rest of the file, and its metadata,
are made here. They have no note: their frames tell the rate, and the trajectory, where
there is one, the episode.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..formats.asciicast import AsciicastWriter, unfinished_recording
from ..formats.monitor_directory import episode_of, video_prefix
from ..formats.video_metadata import (
    StepRuns,
    metadata_path,
    timing_facts,
    write_metadata,
)
from .known_episodes import KnownEpisodes
from .recovery_report import RecoveredFile

_TOLD_BY_TRAJECTORY = ("type", "env_id", "seed", "options", "versions")


def finish_text(part: Path, known: KnownEpisodes) -> RecoveredFile | None:
    """Make a text recording, and its metadata, of the frames that are there.

    Args:
        part: the hidden file that the frames were written into.
        known: what is known of the monitor's episodes.

    Returns:
        What was made; None where it was there already.

    Raises:
        UnreadableFile: there is no whole frame in it.
        Error: the files cannot be written.
    """
    number = episode_of(part.name)
    assert number is not None
    path = part.with_name(f"{video_prefix(known.infix, number)}.json")
    if metadata_path(path).exists():
        part.unlink(missing_ok=True)
        return None
    rate, frames = unfinished_recording(part)
    ending = known.ending(number)
    sums = known.sums(number)
    if ending is None or sums.get("length") != len(frames) - 1:
        ending = {"complete": False, "reason": "killed"}
    writer = AsciicastWriter(path, rate=rate)
    for frame in frames:
        writer.write(frame)
    writer.close()
    facts: dict[str, Any] = dict(known.facts(number))
    write_metadata(
        path,
        {
            "episode_id": number,
            "content_type": "video/vnd.openai.ansivid",
            "encoder_version": {"backend": "TextEncoder", "version": 1},
            "recording": "live",
            **{key: facts[key] for key in _TOLD_BY_TRAJECTORY if key in facts},
            **ending,
            **sums,
            **timing_facts(StepRuns(range(len(frames))), fps=rate, timestep=None),
            "recovered": True,
        },
    )
    part.unlink(missing_ok=True)
    cut = "" if ending["complete"] else f", incomplete: {ending['reason']}"
    count = f"{len(frames)} {'frame' if len(frames) == 1 else 'frames'}"
    return RecoveredFile(path.name, count + cut)
