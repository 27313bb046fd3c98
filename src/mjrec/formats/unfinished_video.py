# SPDX-License-Identifier: Apache-2.0
"""Unfinished live videos, with notes that let any process finish them.

The note, `.<name of the video>.note.part`, is written before the video. The video has a
hidden name. While it is being written, it is locked both by the process that feeds
ffmpeg and by ffmpeg itself, which completes its file if that process dies.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..atomic_files import write_text
from ..errors import DirectoryNotWritable
from ..json_text import dumps
from .ffmpeg import ffmpeg_sha256, ffmpeg_version
from .frame_hashes import cut_frame_hashes, frame_hash_path
from .json_fields import (
    field,
    mapping,
    optional,
    positive,
    rate,
    read_object,
    text,
    unreadable,
)
from .monitor_directory import unfinished_files
from .video_file import content_facts


@dataclass(frozen=True, kw_only=True)
class UnfinishedVideo:
    """A video that is or was being encoded.

    Attributes:
        path: the final path of the video.
        metadata: the metadata about the recording that is known so far.
        facts: the metadata about the file and its timing, and `frames_per_step`.
    """

    path: Path
    metadata: Mapping[str, Any]
    facts: Mapping[str, Any]

    @property
    def temporary(self) -> Path:
        """The video's current path."""
        return next(iter(unfinished_files(self.path)), self.path)

    @property
    def hashes(self) -> list[Path]:
        """The current paths of the video's frame hashes, if there are any."""
        return unfinished_files(frame_hash_path(self.path))

    @property
    def hashed_frames(self) -> int:
        """Number of frames that were, or were about to be, passed to the encoder."""
        texts = [path.read_text("ascii", "replace") for path in self.hashes]
        return sum(not line.startswith("#") for t in texts for line in t.splitlines())

    def finish(self) -> dict[str, Any]:
        """Rename the video and its frame hashes to their final names.

        Returns:
            `facts`, completed with facts about the file's content.

        Raises:
            EncoderError: the video cannot be decoded to its end.
            DirectoryNotWritable: the files cannot be renamed.
        """
        part = self.temporary
        found = content_facts(
            part,
            height=self.facts["padded_height"],
            width=self.facts["padded_width"],
            pixel_format=self.facts["pixel_format"],
        )
        encoder = field(self.facts, "encoder_version", mapping)
        is_same_ffmpeg = encoder.get("version") == ffmpeg_version()
        try:
            for hashes in self.hashes:
                _finish_hashes(hashes, frame_hash_path(self.path), found["frame_count"])
            part.replace(self.path)
        except OSError as error:
            raise DirectoryNotWritable(self.path.parent, error) from error
        sha256 = ffmpeg_sha256() if is_same_ffmpeg else None
        return {**self.facts, **found, "ffmpeg_sha256": sha256}

    def forget(self) -> None:
        """Remove the unfinished video and its frame hashes, then the note."""
        parts = [*unfinished_files(self.path), *self.hashes]
        for path in (*parts, note_path(self.path)):
            path.unlink(missing_ok=True)


def note_path(video: Path) -> Path:
    """Return the path of the note about an unfinished video."""
    return video.with_name(f".{video.name}.note.part")


def write_note(video: UnfinishedVideo) -> None:
    """Atomically write or replace a note.

    Raises:
        FileNotWritten: the disk is full, or the directory was removed.
    """
    content = {"metadata": video.metadata, "facts": video.facts}
    write_text(note_path(video.path), dumps(content))


def read_note(video: Path) -> UnfinishedVideo:
    """Read the note about a video.

    Raises:
        UnreadableFile: the note is missing or damaged.
    """
    path = note_path(video)
    with unreadable(path):
        values = read_object(path)
        facts = field(values, "facts", mapping)
        for key in ("padded_height", "padded_width", "stride", "frames_per_step"):
            field(facts, key, positive)
        field(facts, "fps", rate)
        field(facts, "timestep", optional(rate))
        field(facts, "pixel_format", text)
        field(facts, "encoder_version", mapping)
        metadata = field(values, "metadata", mapping)
        return UnfinishedVideo(path=video, metadata=metadata, facts=facts)


def _finish_hashes(part: Path, final: Path, frame_count: int) -> None:
    try:
        # Some frames that have hashes may not have reached the file.
        cut_frame_hashes(part, frame_count)
    except ValueError:
        # Incomplete hashes are worse than none.
        part.unlink()
    else:
        part.replace(final)
