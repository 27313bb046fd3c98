# SPDX-License-Identifier: Apache-2.0
"""A video under its temporary name: what it is, and how it gets its final one.

The writer of a video finishes it so; and so does the finder of one that a dead process
left. What the finder needs to know stands in a note beside it, a hidden file
`.<name of the video>.note.part`, which is there before the video is.

The hidden video is locked as long as it is written: by the process that feeds ffmpeg,
and by ffmpeg, which goes on to the end of its file when that process dies.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..atomic_files import file_sha256, write_text
from ..errors import DirectoryNotWritable
from ..json_text import dumps
from .ffmpeg import FfmpegProcess, as_file, every_frame_arguments
from .frame_hashes import cut_frame_hashes, frame_hash_path
from .json_fields import (
    field,
    integer,
    list_of,
    mapping,
    optional,
    rate,
    read_object,
    text,
    unreadable,
)

_READ_SIZE = 1 << 20
_LARGEST_SIDE = 1 << 16
_LONGEST_NOTE = 1 << 24


@dataclass(frozen=True, kw_only=True)
class EncodedVideo:
    """What is known of a video from its first frame on.

    Attributes:
        path: the file, by its final name.
        height: of a frame as it was written, in pixels.
        width: of a frame as it was written, in pixels.
        fps: frames per second.
        codec: ffmpeg's name of the encoder.
        pixel_format: ffmpeg's name of the encoded pixels' format.
        encoder: `ffmpeg` (the binary's base name), `version` (its first line),
            `sha256` (the binary's; None where it is not known yet) and `arguments`
            (all of them; the output file is its base name, so that they stay true when
            the directory moves).
    """

    path: Path
    height: int
    width: int
    fps: Fraction
    codec: str
    pixel_format: str
    encoder: Mapping[str, Any]

    @property
    def padded_height(self) -> int:
        """The file's, even where the codec needs it."""
        return self.height + self.height % 2

    @property
    def padded_width(self) -> int:
        """The file's, even where the codec needs it."""
        return self.width + self.width % 2


@dataclass(frozen=True, kw_only=True)
class VideoFile(EncodedVideo):
    """A finished video.

    Attributes:
        frame_count: how many frames it holds, counted by decoding it.
        file_sha256: of the file's bytes.
        decoded_sha256: of the decoded frames, one after the other: the planes Y, U, V
            for yuv420p, else rgb24.
        frame_hash_path: the `.framehash` file, if one was asked for.
    """

    frame_count: int
    file_sha256: str
    decoded_sha256: str
    frame_hash_path: Path | None


@dataclass(frozen=True, kw_only=True)
class UnfinishedVideo(EncodedVideo):
    """A video that is being encoded, or was.

    Attributes:
        temporary: the file now.
        hashes: its frame hashes now; None where there are to be none.
    """

    temporary: Path
    hashes: Path | None

    def check(self) -> VideoFile:
        """Return what the file holds, as if it had its final name already.

        Raises:
            EncoderError: it cannot be decoded to its end.
        """
        source = self.temporary if self.temporary.exists() else self.path
        frame_count, digest = self._decode(source)
        return VideoFile(
            **{f.name: getattr(self, f.name) for f in dataclasses.fields(EncodedVideo)},
            frame_count=frame_count,
            file_sha256=file_sha256(source),
            decoded_sha256=digest,
            frame_hash_path=None if self.hashes is None else frame_hash_path(self.path),
        )

    def rename(self, file: VideoFile, *, cut: bool = False) -> None:
        """Give the video and its hashes their names. May be called again.

        Args:
            file: what `check` returned.
            cut: leave out the hashes of frames that did not come into the file.

        Raises:
            DirectoryNotWritable: they cannot be renamed.
        """
        # The hashes first: where there is a video, what belongs to it is there too.
        try:
            if self.hashes is None and self.path.exists():
                # Those of the video that is replaced now would be wrong.
                frame_hash_path(self.path).unlink(missing_ok=True)
            elif self.hashes is not None and self.hashes.exists():
                self._rename_hashes(self.hashes, file.frame_count if cut else None)
            try:
                self.temporary.replace(self.path)
            except FileNotFoundError:
                # An earlier call may have been interrupted just after it had done this.
                if file_sha256(self.path) != file.file_sha256:
                    raise
        except OSError as error:
            raise DirectoryNotWritable(self.path.parent, error) from error

    def _rename_hashes(self, hashes: Path, frame_count: int | None) -> None:
        try:
            if frame_count is not None:
                cut_frame_hashes(hashes, frame_count)
        except ValueError:
            # No hashes are better than some.
            hashes.unlink()
        else:
            hashes.replace(frame_hash_path(self.path))

    def _decode(self, source: Path) -> tuple[int, str]:
        """Return how many frames the file holds and the sha256 of all of them."""
        pixel_format = "rgb24"
        frame_bytes = 3 * self.padded_height * self.padded_width
        if self.pixel_format == "yuv420p":
            pixel_format, frame_bytes = "yuv420p", frame_bytes // 2
        arguments = [
            *("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror"),
            # More would take a third more of the CPUs, which others are drawing with.
            *("-threads", "1", "-filter_threads", "1"),
            *("-i", as_file(source), "-map", "0:v:0", *every_frame_arguments()),
            *("-f", "rawvideo", "-pix_fmt", pixel_format, "pipe:1"),
        ]
        what = f"The finished video {source} cannot be decoded."
        digest, total = hashlib.sha256(), 0
        with FfmpegProcess(arguments, what=what, writes=True) as process:
            while block := process.read(_READ_SIZE):
                digest.update(block)
                total += len(block)
            process.wait()
        return -(-total // frame_bytes), digest.hexdigest()


@dataclass(frozen=True)
class VideoNote:
    """What is written down beside an unfinished video.

    Attributes:
        video: what it is.
        metadata: what its metadata file is to say, as far as it is known.
        timing: `timestep` (seconds, a fraction, or None), `stride` and
            `frames_per_step`, as `video_metadata.timing_facts` takes them.
        ffmpeg_size: of the ffmpeg program, in bytes, which tells one from another.
    """

    video: UnfinishedVideo
    metadata: Mapping[str, Any]
    timing: Mapping[str, Any]
    ffmpeg_size: int


def note_path(video: Path) -> Path:
    """Return the name of the note beside an unfinished video."""
    return video.with_name(f".{video.name}.note.part")


def write_note(note: VideoNote) -> None:
    """Write a note, or replace it, whole or not at all.

    Raises:
        FileNotWritten: the disk is full, or the directory is gone.
    """
    video = {
        key: value.name if isinstance(value, Path) else value
        for key, value in vars(note.video).items()
    }
    timestep = note.timing["timestep"]
    content = {
        **vars(note),
        "video": {**video, "fps": str(note.video.fps)},
        "timing": {**note.timing, "timestep": timestep and str(timestep)},
    }
    write_text(note_path(note.video.path), dumps(content))


def read_note(path: Path) -> VideoNote:
    """Return what a note says; all that it names is in its own directory.

    Raises:
        UnreadableFile: it is missing or damaged, or belongs to another video.
    """
    with unreadable(path):
        if path.is_file() and path.stat().st_size > _LONGEST_NOTE:
            raise ValueError("it is too long for a note")
        values = read_object(path)
        timing = field(values, "timing", mapping)
        return VideoNote(
            video=_video(path, field(values, "video", mapping)),
            metadata=field(values, "metadata", mapping),
            timing={
                "timestep": field(timing, "timestep", optional(rate)),
                "stride": field(timing, "stride", _count),
                "frames_per_step": field(timing, "frames_per_step", _count),
            },
            ffmpeg_size=field(values, "ffmpeg_size", integer),
        )


def _video(note: Path, values: Mapping[str, Any]) -> UnfinishedVideo:
    path = note.with_name(field(values, "path", text))
    if note_path(path) != note:
        raise ValueError("it belongs to another video")
    encoder = field(values, "encoder", mapping)
    hashes = field(values, "hashes", optional(text))
    return UnfinishedVideo(
        path=path,
        temporary=_hidden(path, field(values, "temporary", text)),
        hashes=None if hashes is None else _hidden(frame_hash_path(path), hashes),
        height=field(values, "height", _side),
        width=field(values, "width", _side),
        fps=field(values, "fps", rate),
        codec=field(values, "codec", text),
        pixel_format=field(values, "pixel_format", text),
        encoder={
            "ffmpeg": field(encoder, "ffmpeg", text),
            "version": field(encoder, "version", text),
            "sha256": field(encoder, "sha256", optional(text), default=None),
            "arguments": list(field(encoder, "arguments", list_of(text))),
        },
    )


def _hidden(final: Path, name: str) -> Path:
    if not re.fullmatch(rf"\.{re.escape(final.name)}\.[0-9a-f]{{8}}\.part", name):
        raise ValueError(f"{name!r:.200} is no temporary name of {final.name!r:.200}")
    return final.with_name(name)


def _side(value: Any) -> int:
    return _number(value, most=_LARGEST_SIDE)


def _count(value: Any) -> int:
    return _number(value, most=1 << 40)


def _number(value: Any, *, most: int) -> int:
    if not 1 <= integer(value) <= most:
        raise ValueError(f"{value!r:.80} is no number from 1 to {most}")
    return int(value)
