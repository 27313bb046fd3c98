# SPDX-License-Identifier: Apache-2.0
"""A live video under its temporary name: what a finder needs to finish it.

That stands in a note beside it, a hidden file `.<name of the video>.note.part`, which
is there before the video is. The hidden video is locked as long as it is written: by
the process that feeds ffmpeg, and by ffmpeg, which goes on to the end of its file when
that process dies.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..atomic_files import file_sha256, write_text
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
from .video_file import count_frames


@dataclass(frozen=True, kw_only=True)
class UnfinishedVideo:
    """A video that is being encoded, or was.

    Attributes:
        path: the file, by its final name.
        temporary: the file now.
        hashes: its frame hashes now; None where there are to be none.
        metadata: what its metadata file is to say of what was recorded, as far as it
            is known.
        facts: what it is to say of the file and its timing; and `frames_per_step`.
    """

    path: Path
    temporary: Path
    hashes: Path | None
    metadata: Mapping[str, Any]
    facts: Mapping[str, Any]

    def finish(self) -> dict[str, Any]:
        """Give the video and the hashes of its frames their names.

        Returns:
            `facts` with what the file holds: `frame_count`, and its hashes.

        Raises:
            EncoderError: it cannot be decoded to its end.
            DirectoryNotWritable: the files cannot be renamed.
        """
        source = self.temporary if self.temporary.exists() else self.path
        frame_count, digest = count_frames(
            source,
            height=self.facts["padded_height"],
            width=self.facts["padded_width"],
            pixel_format=self.facts["pixel_format"],
        )
        encoder = field(self.facts, "encoder_version", mapping)
        is_same_ffmpeg = encoder.get("version") == ffmpeg_version()
        found = {
            "frame_count": frame_count,
            "file_sha256": file_sha256(source),
            "decoded_sha256": digest,
            "ffmpeg_sha256": ffmpeg_sha256() if is_same_ffmpeg else None,
        }
        try:
            if self.hashes is not None and self.hashes.exists():
                _finish_hashes(self.hashes, frame_hash_path(self.path), frame_count)
            source.replace(self.path)
        except OSError as error:
            raise DirectoryNotWritable(self.path.parent, error) from error
        return {**self.facts, **found}


def note_path(video: Path) -> Path:
    """Return the name of the note beside an unfinished video."""
    return video.with_name(f".{video.name}.note.part")


def write_note(video: UnfinishedVideo) -> None:
    """Write a note, or replace it, whole or not at all.

    Raises:
        FileNotWritten: the disk is full, or the directory is gone.
    """
    content = {
        "temporary": video.temporary.name,
        "hashes": video.hashes and video.hashes.name,
        "metadata": video.metadata,
        "facts": video.facts,
    }
    write_text(note_path(video.path), dumps(content))


def read_note(path: Path) -> UnfinishedVideo:
    """Return what a note says; all that it names is in its own directory.

    Raises:
        UnreadableFile: it is missing or damaged, or belongs to another video.
    """
    with unreadable(path):
        values = read_object(path)
        metadata = field(values, "metadata", mapping)
        facts = field(values, "facts", mapping)
        for key in ("padded_height", "padded_width", "stride", "frames_per_step"):
            field(facts, key, positive)
        field(facts, "fps", rate)
        field(facts, "timestep", optional(rate))
        field(facts, "pixel_format", text)
        field(facts, "encoder_version", mapping)
        video = path.with_name(path.name[1:].removesuffix(".note.part"))
        temporary = _hidden(video, field(values, "temporary", text))
        hashes = field(values, "hashes", optional(text))
        return UnfinishedVideo(
            path=video,
            temporary=temporary,
            hashes=None if hashes is None else _hidden(frame_hash_path(video), hashes),
            metadata=metadata,
            facts=facts,
        )


def _finish_hashes(part: Path, final: Path, frame_count: int) -> None:
    try:
        # Frames whose hashes are there need not have come into the file.
        cut_frame_hashes(part, frame_count)
    except ValueError:
        # No hashes are better than some.
        part.unlink()
    else:
        part.replace(final)


def _hidden(final: Path, name: str) -> Path:
    if not re.fullmatch(rf"\.{re.escape(final.name)}\.[0-9a-f]{{8}}\.part", name):
        raise ValueError(f"{name!r:.200} is no temporary name of {final.name!r:.200}")
    return final.with_name(name)
