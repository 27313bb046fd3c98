# SPDX-License-Identifier: Apache-2.0
"""A sink that turns frames, whether live or deferred, into one finished video.

Images become an mp4 file with frame hashes, and text becomes an asciicast. The metadata
file is written last: if it exists, the video is complete.

A live video has a note, `.<name of the video>.note.part`, that lets any process finish
it. The note is written before the video. While an mp4 file is being written, under a
hidden name, it is locked both by the process that feeds ffmpeg and by ffmpeg itself,
which completes its file if that process dies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..annotation import Caption, annotated, check_annotation
from ..atomic_files import write_text
from ..blank_frames import BlankFrames
from ..frames import Frame
from ..json_text import dumps
from .asciicast import AsciicastWriter
from .frame_hashes import frame_hash_path
from .video_file import VideoFile
from .video_metadata import file_facts, metadata_path, write_metadata
from .video_writer import VideoWriter

_TEXT_FACTS = {"encoder_version": {"backend": "TextEncoder", "version": 1}}

_Note = Callable[[], tuple[Mapping[str, Any], Mapping[str, Any]]]


class VideoSink:
    """A writer that turns a stream of frames into a video and its companion files.

    Args:
        path: the video: `.mp4` for images, `.json` for text.
        fps: frames per second.
        frame_hashes: whether to write the `.framehash` file of images.
        note: a function that returns the metadata and the timing known so far, for the
            note about the unfinished file. Another process needs the note to finish
            the file if this process is killed. If None, no note is written; use this if
            the video can be rendered again.

    Raises:
        Error: see `VideoWriter`.

    Attributes:
        path: the video.
        blank: checks whether the frames show anything.
    """

    def __init__(
        self,
        path: Path,
        *,
        fps: Fraction,
        frame_hashes: bool = True,
        note: _Note | None = None,
    ) -> None:
        self.path = path
        self.blank = BlankFrames()
        self._note = note
        self._is_annotated = self._is_finished = False
        self._writer: VideoWriter | AsciicastWriter
        if path.suffix == ".json":
            self._writer = AsciicastWriter(path, rate=fps)
        else:
            self._writer = VideoWriter(path, fps=fps, frame_hashes=frame_hashes)

    @property
    def file(self) -> VideoFile | None:
        """The finished mp4 file; None before it is finished, and for text."""
        return getattr(self._writer, "result", None)

    def write(self, frame: Frame | str, caption: Caption | None = None) -> None:
        """Add a frame, waiting while the encoder is behind.

        Args:
            frame: an image or a string.
            caption: the caption to draw on the image.

        Raises:
            Error: see `VideoWriter.write`.
        """
        if self._note is not None and not self._writer.frame_count:
            # Write the note before the file that it describes.
            metadata, timing = self._note()
            facts: Mapping[str, Any] = _TEXT_FACTS
            if isinstance(self._writer, VideoWriter) and not isinstance(frame, str):
                facts = file_facts(self._writer.file_of(*frame.shape[:2]))
            note = {"metadata": metadata, "facts": {**timing, **facts}}
            write_text(note_path(self.path), dumps(note))
        if isinstance(self._writer, AsciicastWriter):
            assert isinstance(frame, str)
            self._writer.write(frame)
            return
        assert not isinstance(frame, str)
        self._writer.write(frame if caption is None else annotated(frame, caption))
        self._is_annotated |= caption is not None
        # Check the frame without the caption, which would hide that it is blank.
        self.blank.add(frame)

    def finish(self) -> None:
        """Complete the video. After an interrupt, call this method again to continue.

        Raises:
            Error: see `VideoWriter.close`.
        """
        # The metadata of an older video would be wrong for this one.
        metadata_path(self.path).unlink(missing_ok=True)
        self._writer.close()
        self._is_finished = True

    def describe(self, metadata: Mapping[str, Any]) -> dict[str, Any]:
        """Write the metadata of the finished video. Can be called more than once.

        Args:
            metadata: the facts that the sink does not know.

        Returns:
            The metadata as written.

        Raises:
            FileNotWritten: the disk is full.
        """
        described = {**metadata, **self._facts()}
        write_metadata(self.path, described)
        self._forget_note()
        return described

    def discard(self) -> None:
        """Remove this video's files. An older video stays unless it was replaced.

        Idempotent.
        """
        self._writer.abort()
        if self._is_finished:
            # Remove the metadata first: if it exists, the video must exist.
            for path in (
                metadata_path(self.path),
                self.path,
                frame_hash_path(self.path),
            ):
                path.unlink(missing_ok=True)
        self._forget_note()

    def leave(self) -> None:
        """Close the unfinished file, leaving it and its note for another process."""
        self._writer.leave()

    def _facts(self) -> dict[str, Any]:
        if self.file is None:
            return dict(_TEXT_FACTS)
        facts = {**file_facts(self.file), **self.blank.facts()}
        if self._is_annotated:
            facts["annotated"] = {"pillow": check_annotation()}
        return facts

    def _forget_note(self) -> None:
        if self._note is not None:
            note_path(self.path).unlink(missing_ok=True)


def note_path(video: Path) -> Path:
    """Return the path of the note about an unfinished video."""
    return video.with_name(f".{video.name}.note.part")
