# SPDX-License-Identifier: Apache-2.0
"""Writing videos: every frame, once, in order, in a file that anybody can play.

Frames go through a bounded queue to a thread that feeds ffmpeg; the caller waits when
the encoder is slower and never loses a frame. The file has a temporary name until it
is complete and its frames have been counted again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import numbers
import os
import tempfile
import warnings
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from ..atomic_files import temporary_path
from ..errors import (
    ClosedError,
    DirectoryNotWritable,
    FrameCountError,
    InvalidArgument,
)
from ..frames import Frame, check_frame, check_size, pad_to_even
from ..rates import to_rate
from ..worker_thread import WorkerThread
from .encoder_settings import MUXERS, encoder_settings, try_encoding
from .ffmpeg import (
    FfmpegProcess,
    as_file,
    ffmpeg_executable,
    ffmpeg_sha256,
    ffmpeg_version,
)
from .frame_hashes import FrameHashFile, frame_hash_path
from .locks import Lock
from .unfinished_video import UnfinishedVideo, VideoFile

# ffmpeg takes no larger number, above or below, for a rate as a fraction: given one, it
# silently takes the nearest fraction that fits.
_MAX_RATE_TERM = 10**6
_QUEUED_BYTES = 32 << 20
_MAX_QUEUED_FRAMES = 64


class VideoWriter:
    """Writes one video.

    ::

        with mjrec.VideoWriter("run.mp4", fps=40) as video:
            for frame in frames:
                video.write(frame)

    The default is H.264 High in yuv420p with bt709 colours, which every browser plays.
    The same frames give the same file, byte for byte, on any CPU, with the same
    ffmpeg.

    An existing file is replaced when the new one is complete. Without a frame there is
    no file and no error. Leaving `with` through an exception finishes the file with
    the frames written so far; only where the encoder itself failed is there none. One
    thread at a time may use a writer.

    Args:
        path: the file; `.mp4`, `.mov`, `.mkv`, `.webm` or `.avi`.
        fps: frames per second. A fraction is exact in the file; a float is the
            simplest fraction that is equal to within a millionth.
        crf: from 0 (largest) to 51 (worst); 18 if None, which few can tell from the
            original. Below 1, x264 is lossless but for the conversion of colours, and
            the profile is one that browsers do not play.
        codec: ffmpeg's name of an encoder; libx264 if None. The lossless ones of RGB
            (`ffv1` and `libx264rgb` in `.mkv`, for example) keep every pixel.
        frame_hashes: whether to write, beside the video and under its name with
            `.framehash` for extension, the sha256 of each frame as it was given.
        encoder_arguments: further output arguments for ffmpeg, placed behind ours.

    Attributes:
        path: the file.
        fps: as a `Fraction`.
        frame_count: how many frames were written so far.
        closed: whether the file is finished or given up.
        result: what was written, once closed; None without frames.

    Raises:
        InvalidArgument: an argument cannot be.
        UnknownName: ffmpeg has no such encoder.
        DirectoryNotWritable: the file's directory is missing or cannot be written to.
        EncoderError: ffmpeg cannot encode with this codec, crf, rate and kind of file.
        MissingDependency: there is no ffmpeg.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        fps: float | Fraction,
        crf: float | None = None,
        codec: str | None = None,
        frame_hashes: bool = False,
        encoder_arguments: Sequence[str] = (),
    ) -> None:
        self.closed = True
        self.result: VideoFile | None = None
        self.frame_count = 0
        # From the first frame on.
        self._encoding: _Encoding | None = None
        self.path = _check_path(path)
        self.fps = _check_fps(fps)
        self._settings = encoder_settings(
            codec=codec,
            crf=crf,
            muxer=MUXERS[self.path.suffix.lower()],
            encoder_arguments=encoder_arguments,
        )
        self._temporary = temporary_path(self.path)
        hashes = temporary_path(frame_hash_path(self.path))
        self._temporary_hashes = hashes if frame_hashes else None
        try_encoding(ffmpeg_executable(), self._settings, self.fps)
        self._process_id = os.getpid()
        self.closed = False

    def write(self, frame: Frame) -> None:
        """Add a frame, a `(height, width, 3) uint8` array; the first fixes the size.

        The frame is copied: the caller may reuse its memory at once. Waits while the
        encoder is behind.

        Raises:
            InvalidFrame: it is no such array; the writer stays usable.
            ClosedError: after `close` or `abort`, or in a forked process.
            EncoderError: ffmpeg failed or died. Nothing is left of the video.
        """
        encoding = self._encoding
        if self.closed or (encoding is not None and encoding.is_ending):
            raise ClosedError(
                f"The video {self.path} is closed after {self.frame_count} frames; a "
                "file cannot be reopened: write another one."
            )
        if self._was_forked():
            raise ClosedError(
                f"The video {self.path} belongs to process {self._process_id}, from "
                "which this one was forked: write it there, or another one here."
            )
        checked = check_frame(frame, size=None if encoding is None else encoding.size)
        check_size(*checked.shape[:2])
        try:
            if encoding is None:
                encoding = _Encoding(self.unfinished(*checked.shape[:2]))
                self._encoding = encoding
            # A plain copy in rows from top to bottom, whatever the view was.
            encoding.thread.put(np.array(checked, order="C", copy=True, subok=False))
        except Exception:
            self.abort()
            raise
        self.frame_count += 1

    def unfinished(self, height: int, width: int) -> UnfinishedVideo:
        """Return what the file is until it is finished.

        Args:
            height: of a frame, in pixels.
            width: of a frame, in pixels.
        """
        return UnfinishedVideo(
            path=self.path,
            temporary=self._temporary,
            hashes=self._temporary_hashes,
            height=height,
            width=width,
            fps=self.fps,
            codec=self._settings.codec,
            pixel_format=self._settings.pixel_format,
            encoder={
                "ffmpeg": Path(ffmpeg_executable()).name,
                "version": ffmpeg_version(),
                # Reading the whole program takes a while, and is not for the beginning.
                "sha256": None,
                "arguments": self._settings.arguments(
                    height=height + height % 2,
                    width=width + width % 2,
                    fps=self.fps,
                    output=self.path.name,
                ),
            },
        )

    def close(self) -> None:
        """Finish the file: encode what waits, count the frames again, give the name.

        Idempotent. After Ctrl-C has interrupted it no more frames are taken, and
        another call goes on. On the thread that encodes, where a garbage collection may
        call it, it leaves the rest to another call.

        Raises:
            EncoderError: ffmpeg failed or died. Nothing is left of the video.
            FrameCountError: the file does not hold the frames that were written.
        """
        if self.closed:
            return
        if self._encoding is not None and not self._was_forked():
            try:
                self.result = self._encoding.finish()
            except Exception:
                self.abort()
                raise
            if self.result is None:
                return
        self.closed = True

    def abort(self) -> None:
        """Stop at once and leave nothing; an older file of that name stays.

        Idempotent.
        """
        if not self.closed and self._encoding is not None and not self._was_forked():
            self._encoding.abort()
        self.closed = True

    def leave(self) -> None:
        """Take no more frames; the encoder finishes the unfinished file by itself.

        Never waits. Idempotent.
        """
        if not self.closed and self._encoding is not None and not self._was_forked():
            self._encoding.leave()
        self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
            return
        # The reason for leaving matters more than what happens to the video.
        try:
            self.close()
        except Exception as failure:
            error.add_note(f"The video {self.path} could not be finished: {failure}")

    def __del__(self) -> None:
        if self.closed or self._encoding is None or self._was_forked():
            return
        # Waiting is not for a finaliser. The thread encodes what waits and ffmpeg
        # finishes its file, under the temporary name.
        self.leave()
        warnings.warn(
            f"The VideoWriter of {self.path} was never closed; its frames are in "
            f"{self._temporary}. Use it in a with statement.",
            ResourceWarning,
            source=self,
            stacklevel=2,
        )

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__} {str(self.path)!r} fps={self.fps} "
            f"codec={self._settings.codec} {'closed' if self.closed else 'open'}, "
            f"{self.frame_count} frames>"
        )

    def _was_forked(self) -> bool:
        """Tell whether this is a forked child's copy: the video is the parent's."""
        return os.getpid() != self._process_id


class _Encoding:
    """A video in the making: ffmpeg, the thread that feeds it, temporary files."""

    def __init__(self, video: UnfinishedVideo) -> None:
        self.size = (video.height, video.width)
        self.temporary = video.temporary
        self.is_ending = False
        self._video = video
        self._encoded = 0
        self._input_ended = False
        self._hashes: FrameHashFile | None = None
        with contextlib.ExitStack() as on_failure:
            try:
                # First of all: what is not locked may be swept up. With the mode that a
                # new file gets from every program.
                self._lock = Lock(video.temporary, "", mode=0o666)
            except OSError as error:
                raise DirectoryNotWritable(video.path.parent, error) from error
            on_failure.callback(self._lock.release)
            if video.hashes is not None:
                self._hashes = FrameHashFile(
                    video.hashes,
                    final=frame_hash_path(video.path),
                    size=self.size,
                    fps=video.fps,
                )
                on_failure.callback(self._hashes.abort)
            self._process = FfmpegProcess(
                [*video.encoder["arguments"][:-1], as_file(video.temporary)],
                what=f"The video {video.path} could not be encoded.",
                reads=True,
                # It shares the lock, which it holds to its own end when we die.
                keeps=self._lock.fileno(),
            )
            on_failure.callback(self._end_process)
            frame_bytes = 3 * video.height * video.width
            self.thread = WorkerThread[Frame](
                self._encode,
                capacity=min(_MAX_QUEUED_FRAMES, max(2, _QUEUED_BYTES // frame_bytes)),
                name=f"encoder of {video.path.name}",
                finish=self._end_input,
            )
            on_failure.pop_all()

    def finish(self) -> VideoFile | None:
        """Complete the file, check it and give it its name.

        Each part can be done again, where Ctrl-C came in between. None on the encoder's
        own thread, which cannot wait for itself.
        """
        self.is_ending = True
        self.thread.close()
        if not self._input_ended:
            return None
        self._process.wait()
        file = self._video.check()
        if file.frame_count != self._encoded:
            raise FrameCountError(
                f"{file.path} was to hold {self._encoded} frames, and decoding gives "
                f"{file.frame_count}. It was not kept.",
                command=self._process.command,
                returncode=0,
                stderr="",
            )
        encoder = {**file.encoder, "sha256": ffmpeg_sha256()}
        file = dataclasses.replace(file, encoder=encoder)
        if self._hashes is not None:
            self._hashes.close()
        self._video.rename(file)
        self._process.release()
        self._lock.release()
        return file

    def abort(self) -> None:
        """End everything and remove the temporary files."""
        # First the process: the thread may be waiting for it to read.
        self._process.kill()
        self.thread.abort()
        self._end_process()
        if self._hashes is not None:
            self._hashes.abort()

    def leave(self) -> None:
        """Let the encoder go on to the end of what it was given, by itself."""
        self.thread.leave()
        self._lock.let_go()

    def _encode(self, frame: Frame) -> None:
        if not self._encoded:
            # It is remembered, and the next frames are still being drawn.
            ffmpeg_sha256()
        if self._hashes is not None:
            self._hashes.add(frame)
        self._process.write(pad_to_even(frame))
        self._encoded += 1

    def _end_input(self) -> None:
        self._process.end_input()
        self._input_ended = True

    def _end_process(self) -> None:
        self._process.kill()
        self._process.release()
        # ffmpeg may have put another file in the place of the one that is locked.
        self.temporary.unlink(missing_ok=True)
        self._lock.release()


def _check_path(path: str | os.PathLike[str]) -> Path:
    try:
        checked = Path(os.fspath(path))
    except TypeError as error:
        raise InvalidArgument(
            f"path must be the name of a file, got {path!r}."
        ) from error
    if checked.suffix.lower() not in MUXERS:
        raise InvalidArgument(
            f"The name of a video ends in {', '.join(MUXERS)}, got {str(path)!r}."
        )
    if checked.is_dir():
        raise InvalidArgument(f"{checked} is a directory; path must be a file's name.")
    parent = checked.absolute().parent
    if not parent.is_dir():
        raise DirectoryNotWritable(parent, "it does not exist")
    try:
        # The permissions alone do not tell: root may all, and a disk may be read-only.
        tempfile.TemporaryFile(dir=parent).close()
    except OSError as error:
        raise DirectoryNotWritable(parent, error) from error
    # Absolute, so that a change of the working directory moves nothing.
    return checked.absolute()


def _check_fps(fps: float | Fraction) -> Fraction:
    """Return the rate, if the file can say it; the nearest that it can, for a float."""
    rate = to_rate(fps)
    nearest = (
        rate.limit_denominator(_MAX_RATE_TERM)
        if rate < 1
        else 1 / (1 / rate).limit_denominator(_MAX_RATE_TERM)
    )
    if nearest != rate and isinstance(fps, numbers.Rational):
        raise InvalidArgument(
            f"fps={rate} cannot be written exactly: above and below may be at most "
            f"{_MAX_RATE_TERM}. The nearest that can is {nearest}."
        )
    return nearest
