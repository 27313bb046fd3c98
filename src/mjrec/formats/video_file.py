# SPDX-License-Identifier: Apache-2.0
"""The encoding of one video from its first frame to its last, with a final check."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, TextIO

from ..atomic_files import file_sha256, writing
from ..errors import (
    DirectoryNotWritable,
    EncoderError,
    FrameCountError,
)
from ..frames import Frame, pad_to_even
from ..worker_thread import WorkerThread
from .ffmpeg import FfmpegProcess, as_file, every_frame_arguments, ffmpeg_sha256
from .frame_hashes import frame_hash_header, frame_hash_line, frame_hash_path
from .locks import Lock

_QUEUED_BYTES = 32 << 20
_MAX_QUEUED_FRAMES = 64
_READ_SIZE = 1 << 20


@dataclass(frozen=True, kw_only=True)
class VideoFile:
    """A finished video.

    Attributes:
        path: the file.
        height: height of a written frame in pixels; see `padded_height`.
        width: width of a written frame in pixels; see `padded_width`.
        fps: frames per second.
        codec: ffmpeg's name for the encoder.
        pixel_format: ffmpeg's name for the format of the encoded pixels.
        encoder: facts about ffmpeg: `ffmpeg` (the binary's base name), `version` (the
            first line of its version output), `sha256` (of the binary) and `arguments`
            (all arguments, with only the base name of the output file, so that they
            stay valid if the directory is moved).
        frame_hash_path: the `.framehash` file, if requested.
        frame_count: number of frames in the file, counted by decoding it.
        file_sha256: SHA-256 of the file's bytes.
        decoded_sha256: SHA-256 of the decoded frames in order: the planes Y, U, V for
            yuv420p, otherwise rgb24.
    """

    path: Path
    height: int
    width: int
    fps: Fraction
    codec: str
    pixel_format: str
    encoder: Mapping[str, Any]
    frame_hash_path: Path | None
    frame_count: int = 0
    file_sha256: str = ""
    decoded_sha256: str = ""

    @property
    def padded_height(self) -> int:
        """Height of the file's frames, which is always even."""
        return self.height + self.height % 2

    @property
    def padded_width(self) -> int:
        """Width of the file's frames, which is always even."""
        return self.width + self.width % 2


def content_facts(
    path: Path, *, height: int, width: int, pixel_format: str
) -> dict[str, Any]:
    """Decode a video, and return the metadata about its content.

    The keys are `frame_count`, `file_sha256` and `decoded_sha256`.

    Args:
        path: the file.
        height: height of a frame in the file, in pixels.
        width: width of a frame in the file, in pixels.
        pixel_format: pixel format of the file. A yuv420p file is decoded to yuv420p,
            and any other file to rgb24.

    Raises:
        EncoderError: the video cannot be decoded to its end.
    """
    decoded = "yuv420p" if pixel_format == "yuv420p" else "rgb24"
    frame_bytes = 3 * height * width // (2 if decoded == "yuv420p" else 1)
    arguments = [
        *("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror"),
        # More threads would take a third more CPU time, which the render workers need.
        *("-threads", "1", "-filter_threads", "1"),
        *("-i", as_file(path), "-map", "0:v:0", *every_frame_arguments()),
        *("-f", "rawvideo", "-pix_fmt", decoded, "pipe:1"),
    ]
    what = f"The finished video {path} cannot be decoded."
    digest, total = hashlib.sha256(), 0
    with FfmpegProcess(arguments, what=what, writes=True) as process:
        while block := process.read(_READ_SIZE):
            digest.update(block)
            total += len(block)
        process.wait()
    return {
        "frame_count": -(-total // frame_bytes),
        "file_sha256": file_sha256(path),
        "decoded_sha256": digest.hexdigest(),
    }


class Encoding:
    """A video being encoded: ffmpeg, the thread that feeds it, and temporary files."""

    def __init__(self, file: VideoFile, temporary: Path, hashes: Path | None) -> None:
        self.size = (file.height, file.width)
        self.is_ending = self._is_left = False
        self._file = file
        self.temporary = temporary
        self._parts = {temporary: file.path}
        self._encoded = 0
        self._input_ended = False
        self._hashes: TextIO | None = None
        with contextlib.ExitStack() as on_failure:
            try:
                # Lock the file first, because an unlocked file may be cleaned up. The
                # mode is the usual default for new files.
                self._lock = Lock(temporary, "", mode=0o666)
            except OSError as error:
                raise DirectoryNotWritable(file.path.parent, error) from error
            on_failure.callback(self._remove_files)
            if hashes is not None and file.frame_hash_path is not None:
                self._parts[hashes] = file.frame_hash_path
                header = frame_hash_header(
                    height=file.height, width=file.width, fps=file.fps
                )
                with writing(file.frame_hash_path):
                    # Use line buffering, so that each line reaches the operating system
                    # before the next one is written.
                    self._hashes = hashes.open("w", encoding="ascii", buffering=1)
                    self._hashes.write(header)
            self._process = FfmpegProcess(
                [*file.encoder["arguments"][:-1], as_file(temporary)],
                what=f"The video {file.path} could not be encoded.",
                reads=True,
                # ffmpeg shares the lock. If this process dies, ffmpeg holds the lock
                # until ffmpeg ends.
                keeps=self._lock.fileno(),
            )
            on_failure.callback(self._process.release)
            on_failure.callback(self._process.kill)
            frame_bytes = 3 * file.height * file.width
            self.thread = WorkerThread[Frame](
                self._encode,
                capacity=min(_MAX_QUEUED_FRAMES, max(2, _QUEUED_BYTES // frame_bytes)),
                name=f"encoder of {file.path.name}",
                finish=self._end_input,
            )
            on_failure.pop_all()

    def finish(self) -> VideoFile:
        """Complete the file, check it and rename it to its final name.

        After Ctrl-C, call this method again to continue.
        """
        self.is_ending = True
        self.thread.close()
        self._process.wait()
        if not self._file.file_sha256:
            self._file = self._checked()
        if self._hashes is None:
            # Hashes of the video that is being replaced would be wrong for this one.
            frame_hash_path(self._file.path).unlink(missing_ok=True)
        else:
            self._hashes.close()
        try:
            # Rename the hashes first, so that a finished video always has its hashes.
            for part, final in reversed(self._parts.items()):
                if part.exists():
                    part.replace(final)
        except OSError as error:
            raise DirectoryNotWritable(self._file.path.parent, error) from error
        self._process.release()
        self._lock.release()
        return self._file

    def abort(self) -> None:
        """Stop everything and remove the temporary files."""
        # Kill the process first: the thread may be waiting for it to read.
        self._process.kill()
        self.thread.abort()
        self._process.release()
        self._remove_files()

    def leave(self) -> None:
        """Leave the encoder to finish on its own with the frames that it was given."""
        self._is_left = True
        self.thread.leave()
        if self._input_ended:
            self._wait_and_close()
        self._lock.let_go()

    def _encode(self, frame: Frame) -> None:
        if not self._encoded:
            # Hash ffmpeg now, while the next frames are still being rendered; the
            # result is cached.
            ffmpeg_sha256()
        if self._hashes is not None:
            with writing(frame_hash_path(self._file.path)):
                self._hashes.write(frame_hash_line(self._encoded, frame))
        self._process.write(pad_to_even(frame))
        self._encoded += 1

    def _end_input(self) -> None:
        self._process.end_input()
        self._input_ended = True
        if self._is_left:
            self._wait_and_close()

    def _wait_and_close(self) -> None:
        """Wait for ffmpeg to end. Its file is left for another process to finish."""
        if self._hashes is not None:
            self._hashes.close()
        with contextlib.suppress(EncoderError):
            self._process.wait()
        self._process.release()

    def _checked(self) -> VideoFile:
        """Decode the temporary file, and return the video with facts about its content.

        Raises:
            FrameCountError: the file does not contain exactly the encoded frames.
        """
        file = self._file
        found = content_facts(
            self.temporary,
            height=file.padded_height,
            width=file.padded_width,
            pixel_format=file.pixel_format,
        )
        if found["frame_count"] != self._encoded:
            raise FrameCountError(
                f"{file.path} should contain {self._encoded} frames, but decoding "
                f"it gives {found['frame_count']}. The file was not kept.",
                command=self._process.command,
                returncode=0,
                stderr="",
            )
        encoder = {**file.encoder, "sha256": ffmpeg_sha256()}
        return replace(file, encoder=encoder, **found)

    def _remove_files(self) -> None:
        with contextlib.suppress(OSError):
            # The files are removed anyway, so a failed write does not matter.
            if self._hashes is not None:
                self._hashes.close()
        # ffmpeg may have replaced the locked file with a different one.
        for part in self._parts:
            part.unlink(missing_ok=True)
        self._lock.release()
