# SPDX-License-Identifier: Apache-2.0
"""A video under its temporary name: what it is, and how it gets its final one.

Whoever encodes a video finishes it so; and whoever finds one that a dead process left
does the same. What the finder needs to know stands in a note beside it, a hidden file
`.<name of the video>.note.part`, which is there before the video is.

The hidden file is locked as long as somebody writes it: the process that feeds ffmpeg,
or ffmpeg, which goes on to the end of its file when that process dies.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..atomic_files import write_text
from ..errors import DirectoryNotWritable
from ..file_digests import file_sha256
from ..json_text import dumps
from .ffmpeg import FfmpegProcess, every_frame_arguments
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


@dataclass(frozen=True)
class VideoFile:
    """A finished video.

    Attributes:
        path: the file.
        frame_count: how many frames it holds, counted by decoding it.
        height: of a frame as it was written, in pixels.
        width: of a frame as it was written, in pixels.
        padded_height: the file's, even where the codec needs it.
        padded_width: the file's, even where the codec needs it.
        fps: frames per second.
        codec: ffmpeg's name of the encoder.
        pixel_format: ffmpeg's name of the encoded pixels' format.
        file_sha256: of the file's bytes.
        decoded_sha256: of the decoded frames, one after the other: the planes Y, U, V
            for yuv420p, else rgb24.
        frame_hash_path: the `.framehash` file, if one was asked for.
        encoder: `ffmpeg` (the binary's base name), `version` (its first line),
            `sha256` (the binary's) and `arguments` (all of them; the output file is
            its base name, so that they stay true when the directory moves).
    """

    path: Path
    frame_count: int
    height: int
    width: int
    padded_height: int
    padded_width: int
    fps: Fraction
    codec: str
    pixel_format: str
    file_sha256: str
    decoded_sha256: str
    frame_hash_path: Path | None
    encoder: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class UnfinishedVideo:
    """A video that is being encoded, or was.

    Attributes:
        path: its final name.
        temporary: the file now.
        hashes: its frame hashes now; None where there are to be none.
        height: of a frame, in pixels.
        width: of a frame, in pixels.
        fps: frames per second.
        codec: ffmpeg's name of the encoder.
        pixel_format: ffmpeg's name of the encoded pixels' format.
        encoder: as `VideoFile` has it; `sha256` is None where nobody knows it yet.
    """

    path: Path
    temporary: Path
    hashes: Path | None
    height: int
    width: int
    fps: Fraction
    codec: str
    pixel_format: str
    encoder: Mapping[str, Any]

    @property
    def padded(self) -> tuple[int, int]:
        """Height and width in the file."""
        return self.height + self.height % 2, self.width + self.width % 2

    @property
    def decoded_format(self) -> str:
        """The pixel format in which the finished file's frames are hashed."""
        return "yuv420p" if self.pixel_format == "yuv420p" else "rgb24"

    def check(self) -> VideoFile:
        """Return what the file holds, as if it had its final name already.

        Raises:
            EncoderError: it cannot be decoded to its end.
        """
        source = self.temporary if self.temporary.exists() else self.path
        height, width = self.padded
        frame_count, digest = _decode(
            source, pixel_format=self.decoded_format, size=self.padded
        )
        return VideoFile(
            path=self.path,
            frame_count=frame_count,
            height=self.height,
            width=self.width,
            padded_height=height,
            padded_width=width,
            fps=self.fps,
            codec=self.codec,
            pixel_format=self.pixel_format,
            file_sha256=file_sha256(source),
            decoded_sha256=digest,
            frame_hash_path=None if self.hashes is None else frame_hash_path(self.path),
            encoder=dict(self.encoder),
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
            self._replace(file)
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

    def _replace(self, file: VideoFile) -> None:
        try:
            self.temporary.replace(self.path)
        except FileNotFoundError:
            # An earlier call may have been interrupted just after it had done this.
            if file_sha256(self.path) != file.file_sha256:
                raise


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
        f.name: getattr(note.video, f.name) for f in dataclasses.fields(note.video)
    }
    for name in ("path", "temporary", "hashes"):
        video[name] = None if video[name] is None else video[name].name
    video["fps"] = str(note.video.fps)
    video["encoder"] = dict(note.video.encoder)
    content = {
        "video": video,
        "metadata": dict(note.metadata),
        "timing": dict(note.timing),
        "ffmpeg_size": note.ffmpeg_size,
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
        note = VideoNote(
            video=_video(path, field(values, "video", mapping)),
            metadata=field(values, "metadata", mapping),
            timing=field(values, "timing", _timing),
            ffmpeg_size=field(values, "ffmpeg_size", integer),
        )
        if note_path(note.video.path) != path:
            raise ValueError("it belongs to another video")
        return note


def _video(note: Path, values: Mapping[str, Any]) -> UnfinishedVideo:
    name = field(values, "path", text)
    hidden = _hidden_of(name)
    hashes = field(values, "hashes", optional(_hidden_of(_hashes_of(name))))
    return UnfinishedVideo(
        path=note.with_name(name),
        temporary=note.with_name(field(values, "temporary", hidden)),
        hashes=None if hashes is None else note.with_name(hashes),
        height=field(values, "height", _side),
        width=field(values, "width", _side),
        fps=field(values, "fps", rate),
        codec=field(values, "codec", text),
        pixel_format=field(values, "pixel_format", text),
        encoder=field(values, "encoder", _encoder),
    )


def _hashes_of(video: str) -> str:
    return frame_hash_path(Path(video)).name


def _hidden_of(final: str) -> Callable[[Any], str]:
    pattern = re.compile(rf"\.{re.escape(final)}\.[0-9a-f]{{8}}\.part")

    def hidden(value: Any) -> str:
        if not pattern.fullmatch(text(value)):
            raise ValueError(f"{value!r:.200} is no temporary name of {final!r:.200}")
        return str(value)

    return hidden


def _side(value: Any) -> int:
    side = integer(value)
    if not 1 <= side <= _LARGEST_SIDE:
        raise ValueError(f"{side!r:.80} is no number of pixels")
    return side


def _encoder(value: Any) -> Mapping[str, Any]:
    values = mapping(value)
    return {
        "ffmpeg": field(values, "ffmpeg", text),
        "version": field(values, "version", text),
        "sha256": field(values, "sha256", optional(text), default=None),
        "arguments": list(field(values, "arguments", list_of(text))),
    }


def _timing(value: Any) -> Mapping[str, Any]:
    values = mapping(value)
    return {
        "timestep": field(values, "timestep", optional(rate)),
        "stride": field(values, "stride", _count),
        "frames_per_step": field(values, "frames_per_step", _count),
    }


def _count(value: Any) -> int:
    count = integer(value)
    if not 1 <= count <= 1 << 40:
        raise ValueError(f"{count!r:.80} is no count")
    return count


def _decode(
    video: Path, *, pixel_format: str, size: tuple[int, int]
) -> tuple[int, str]:
    """Return how many frames a file holds and the sha256 of all of them."""
    process = FfmpegProcess(
        [
            *("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror"),
            *("-i", as_file(video), "-map", "0:v:0", *every_frame_arguments()),
            *("-f", "rawvideo", "-pix_fmt", pixel_format, "pipe:1"),
        ],
        what=f"The finished video {video} cannot be decoded.",
        writes=True,
    )
    try:
        digest = hashlib.sha256()
        total = 0
        while block := process.read(_READ_SIZE):
            digest.update(block)
            total += len(block)
        process.wait()
    finally:
        process.kill()
        process.release()
    height, width = size
    frame_bytes = height * width * 3
    if pixel_format == "yuv420p":
        frame_bytes //= 2
    frame_count, rest = divmod(total, frame_bytes)
    return frame_count + bool(rest), digest.hexdigest()


def as_file(path: Path) -> str:
    """Return a path as ffmpeg takes it for one, whatever is in it."""
    # Without the prefix a colon in the name would make ffmpeg look for a protocol.
    return f"file:{path}"
