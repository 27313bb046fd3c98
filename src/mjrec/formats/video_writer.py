# SPDX-License-Identifier: Apache-2.0
"""Writing videos: every frame, once, in order, in a file that anybody can play.

Frames go through a bounded queue to a thread that feeds ffmpeg; the caller waits when
the encoder is slower and never loses a frame. The file has a temporary name until it
is complete and its frames have been counted again.
"""

from __future__ import annotations

import hashlib
import inspect
import itertools
import numbers
import os
import tempfile
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from ..atomic_files import temporary_path
from ..errors import (
    ClosedError,
    DirectoryNotWritable,
    FrameCountError,
    InvalidArgument,
    UnknownName,
)
from ..frames import Frame, check_frame, check_size, pad_to_even
from ..rates import to_rate
from ..schedules import capped_cubic_video_schedule
from ..worker_thread import WorkerThread
from .encoder_settings import (
    MUXERS,
    EncoderSettings,
    encoder_settings,
    try_encoding,
)
from .ffmpeg import (
    FfmpegProcess,
    every_frame_arguments,
    ffmpeg_executable,
    ffmpeg_sha256,
    ffmpeg_version,
)
from .frame_hashes import FrameHashFile, frame_hash_path

__all__ = ["VideoFile", "VideoWriter", "save_video"]

# ffmpeg takes no larger number, above or below, for a rate as a fraction: given one, it
# silently takes the nearest fraction that fits.
_MAX_RATE_TERM = 10**6
_QUEUED_BYTES = 32 << 20
_MAX_QUEUED_FRAMES = 64
_READ_SIZE = 1 << 20


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
        self._closed = True
        self._encoding: _Encoding | None = None
        self.result: VideoFile | None = None
        self.path = _check_path(path)
        self.fps = _check_fps(fps)
        self._settings = encoder_settings(
            codec=codec,
            crf=crf,
            muxer=MUXERS[self.path.suffix.lower()],
            encoder_arguments=encoder_arguments,
        )
        self._wants_frame_hashes = bool(frame_hashes)
        try_encoding(ffmpeg_executable(), self._settings, self.fps)
        self._frame_count = 0
        self._process_id = os.getpid()
        self._closed = False

    @property
    def frame_count(self) -> int:
        """How many frames were written so far."""
        return self._frame_count

    @property
    def closed(self) -> bool:
        """Whether the writer takes no more frames."""
        return self._closed

    def write(self, frame: Frame) -> None:
        """Add a frame, a `(height, width, 3) uint8` array; the first fixes the size.

        The frame is copied: the caller may reuse its memory at once. Waits while the
        encoder is behind.

        Raises:
            InvalidFrame: it is no such array; the writer stays usable.
            ClosedError: after `close` or `abort`.
            EncoderError: ffmpeg failed or died. Nothing is left of the video.
        """
        if self._closed:
            raise ClosedError(
                f"The video {self.path} is closed after {self._frame_count} frames; "
                "a file cannot be reopened: write another one."
            )
        self._check_process()
        started = self._encoding
        checked = check_frame(frame, size=started.size if started else None)
        check_size(*checked.shape[:2])
        try:
            encoding = started or self._start(checked)
            # A plain copy in rows from top to bottom, whatever the view was.
            encoding.worker.put(np.array(checked, order="C", copy=True, subok=False))
        except Exception:
            self.abort()
            raise
        self._frame_count += 1

    def close(self) -> None:
        """Finish the file: encode what waits, count the frames again, give the name.

        Idempotent; may be called again after Ctrl-C interrupted it.

        Raises:
            EncoderError: ffmpeg failed or died. Nothing is left of the video.
            FrameCountError: the file does not hold the frames that were written.
        """
        if self._closed:
            return
        if self._encoding is not None and not self._was_forked():
            try:
                self.result = self._encoding.finish()
            except Exception:
                self.abort()
                raise
        self._closed = True

    def abort(self) -> None:
        """Stop at once and leave nothing; an older file of that name stays."""
        if self._closed:
            return
        self._closed = True
        if self._encoding is not None and not self._was_forked():
            self._encoding.abort()

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
        if self._closed or self._encoding is None or self._was_forked():
            return
        # Waiting is not for a finaliser. The thread encodes what waits and ffmpeg
        # finishes its file, under the temporary name.
        self._encoding.worker.leave()
        warnings.warn(
            f"The VideoWriter of {self.path} was never closed; its frames are in "
            f"{self._encoding.temporary}. Use it in a with statement.",
            ResourceWarning,
            source=self,
            stacklevel=2,
        )

    def __repr__(self) -> str:
        state = "closed" if self._closed else "open"
        return (
            f"<{type(self).__name__} {str(self.path)!r} fps={self.fps} "
            f"codec={self._settings.codec} {state}, {self._frame_count} frames>"
        )

    def _was_forked(self) -> bool:
        """Tell whether this is a forked child's copy: the video is the parent's."""
        return os.getpid() != self._process_id

    def _check_process(self) -> None:
        if self._was_forked():
            raise ClosedError(
                f"The video {self.path} belongs to process {self._process_id}, from "
                "which this one was forked: write it there, or another one here."
            )

    def _start(self, first: Frame) -> _Encoding:
        self._encoding = _Encoding(
            self.path,
            fps=self.fps,
            size=(first.shape[0], first.shape[1]),
            settings=self._settings,
            frame_hashes=self._wants_frame_hashes,
        )
        return self._encoding


class _Encoding:
    """A video in the making: ffmpeg, the thread that feeds it, temporary files."""

    def __init__(
        self,
        path: Path,
        *,
        fps: Fraction,
        size: tuple[int, int],
        settings: EncoderSettings,
        frame_hashes: bool,
    ) -> None:
        self.size = size
        self.temporary = temporary_path(path)
        self._path = path
        self._fps = fps
        self._settings = settings
        self._padded = (size[0] + size[0] % 2, size[1] + size[1] % 2)
        self._encoded = 0
        self._hashes = (
            FrameHashFile(frame_hash_path(path), size=size, fps=fps)
            if frame_hashes
            else None
        )
        try:
            self._process = self._start_ffmpeg()
        except BaseException:
            self._abort_hashes()
            raise
        height, width = self._padded
        frame_bytes = height * width * 3
        self.worker = WorkerThread[Frame](
            self._encode,
            capacity=min(_MAX_QUEUED_FRAMES, max(2, _QUEUED_BYTES // frame_bytes)),
            name=f"encoder of {path.name}",
            finish=self._process.end_input,
        )

    def finish(self) -> VideoFile:
        """Complete the file, check it and give it its name."""
        self.worker.close()
        self._process.wait()
        decoded_sha256 = self._count_and_hash()
        file_sha256 = _sha256_of_file(self.temporary)
        result = VideoFile(
            path=self._path,
            frame_count=self._encoded,
            height=self.size[0],
            width=self.size[1],
            padded_height=self._padded[0],
            padded_width=self._padded[1],
            fps=self._fps,
            codec=self._settings.codec,
            pixel_format=self._settings.pixel_format,
            file_sha256=file_sha256,
            decoded_sha256=decoded_sha256,
            frame_hash_path=frame_hash_path(self._path) if self._hashes else None,
            encoder=self._describe_encoder(),
        )
        self._rename()
        self._process.release()
        return result

    def abort(self) -> None:
        """End everything and remove the temporary files."""
        # First the process: the thread may be waiting for it to read.
        self._process.kill()
        self.worker.abort()
        self._process.release()
        self.temporary.unlink(missing_ok=True)
        self._abort_hashes()

    def _start_ffmpeg(self) -> FfmpegProcess:
        height, width = self._padded
        arguments = self._settings.arguments(
            height=height, width=width, fps=self._fps, output=_as_file(self.temporary)
        )
        what = f"The video {self._path} could not be encoded."
        return FfmpegProcess(arguments, what=what, reads=True)

    def _abort_hashes(self) -> None:
        if self._hashes is not None:
            self._hashes.abort()

    def _encode(self, frame: Frame) -> None:
        if self._hashes is not None:
            self._hashes.add(frame)
        self._process.write(pad_to_even(frame))
        self._encoded += 1

    def _count_and_hash(self) -> str:
        frame_count, digest = _decode(
            self.temporary,
            pixel_format=self._settings.decoded_format,
            size=self._padded,
        )
        if frame_count != self._encoded:
            raise FrameCountError(
                f"{self._path} was to hold {self._encoded} frames, and decoding gives "
                f"{frame_count}. It was not kept.",
                command=self._process.command,
                returncode=0,
                stderr="",
            )
        return digest

    def _rename(self) -> None:
        # The hashes first: where there is a video, what belongs to it is there too.
        try:
            if self._hashes is not None:
                self._hashes.finish()
            elif self._path.exists():
                # Those of the video that is replaced now would be wrong.
                frame_hash_path(self._path).unlink(missing_ok=True)
            self.temporary.replace(self._path)
        except OSError as error:
            raise DirectoryNotWritable(self._path.parent, error) from error

    def _describe_encoder(self) -> dict[str, Any]:
        executable, *arguments = self._process.command
        return {
            "ffmpeg": Path(executable).name,
            "version": ffmpeg_version(),
            "sha256": ffmpeg_sha256(),
            "arguments": [*arguments[:-1], self._path.name],
        }


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


def _decode(
    video: Path, *, pixel_format: str, size: tuple[int, int]
) -> tuple[int, str]:
    """Return how many frames a file holds and the sha256 of all of them."""
    process = FfmpegProcess(
        [
            *("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror"),
            *("-i", _as_file(video), "-map", "0:v:0", *every_frame_arguments()),
            *("-f", "rawvideo", "-pix_fmt", pixel_format, "pipe:1"),
        ],
        what=f"The finished video {video} cannot be decoded.",
        writes=True,
    )
    digest = hashlib.sha256()
    total = 0
    try:
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


def _sha256_of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _as_file(path: Path) -> str:
    # Without the prefix a colon in the name would make ffmpeg look for a protocol.
    return f"file:{path}"


def save_video(
    frames: Iterable[Frame],
    video_folder: str | os.PathLike[str],
    episode_trigger: Callable[[int], Any] | None = None,
    step_trigger: Callable[[int], Any] | None = None,
    video_length: int | None = None,
    name_prefix: str = "rl-video",
    episode_index: int = 0,
    step_starting_index: int = 0,
    **kwargs: Any,
) -> None:
    """Write videos of one episode's frames, as Gymnasium's function of that name does.

    `<prefix>-episode-<episode_index>.mp4` holds the episode, if `episode_trigger` says
    yes; `<prefix>-step-<n>.mp4` begins with the frame of step n, for each n for which
    `step_trigger` says yes. The first frame is the reset's and belongs to no step; the
    second is that of step `step_starting_index`. Every frame is in the file.

    `frames` may be any iterable. Where only the episode trigger is used it is streamed,
    read no further than `video_length`, and not at all when no video is due; with a
    step trigger, whose videos may overlap, all frames are held in memory. An existing
    video is replaced when the new one is complete. No frames, no file. If `frames`
    raises, the frames before that are kept.

    Args:
        frames: `(height, width, 3) uint8` arrays.
        video_folder: the directory; made if need be.
        episode_trigger: from an episode's number to whether it gets a video. If both
            triggers are None: the cubes 0, 1, 8, 27 ... 729 and every 1000th.
        step_trigger: from a step's number to whether a video begins there.
        video_length: the most frames of a video; all that follow if None.
        name_prefix: begins the files' names.
        episode_index: the episode's number.
        step_starting_index: the number of the episode's first step.
        **kwargs: `fps`, which is required, and the other options of `VideoWriter`.

    Raises:
        InvalidArgument: `fps` is missing, an option is unknown, or a value cannot be.
        DirectoryNotWritable: `video_folder` cannot be made or written to.
        InvalidFrame: what is no picture.
        EncoderError: as `VideoWriter.write` and `close`.
    """
    _check_options(kwargs)
    _check_video_length(video_length)
    if episode_trigger is None and step_trigger is None:
        episode_trigger = capped_cubic_video_schedule
    folder = _make_directory(Path(video_folder))
    if step_trigger is not None:
        frames = held = _hold(frames)
    if episode_trigger is not None and episode_trigger(episode_index):
        path = folder / f"{name_prefix}-episode-{episode_index}.mp4"
        _write_video(itertools.islice(frames, video_length), path, kwargs)
    if step_trigger is not None:
        # The first frame is the reset's.
        for step, first in enumerate(range(1, len(held)), start=step_starting_index):
            if step_trigger(step):
                last = None if video_length is None else first + video_length
                path = folder / f"{name_prefix}-step-{step}.mp4"
                _write_video(held[first:last], path, kwargs)


def _hold(frames: Iterable[Frame]) -> Sequence[Frame]:
    if isinstance(frames, Sequence | np.ndarray):
        return list(frames)
    # Copies: a generator may fill the same array again and again.
    return [np.array(frame) for frame in frames]


def _write_video(frames: Iterable[Frame], path: Path, options: dict[str, Any]) -> None:
    with VideoWriter(path, **options) as video:
        for frame in frames:
            video.write(frame)


def _check_options(options: dict[str, Any]) -> None:
    parameters = inspect.signature(VideoWriter).parameters.values()
    known = [one.name for one in parameters if one.kind is one.KEYWORD_ONLY]
    for name in options:
        if name not in known:
            raise UnknownName("option of save_video", name, known)
    if "fps" not in options:
        raise InvalidArgument(
            "save_video needs fps, the frames per second of the video: "
            "fps=env.metadata['render_fps'], for example."
        )
    to_rate(options["fps"])


def _check_video_length(video_length: object) -> None:
    if video_length is None:
        return
    is_number = isinstance(video_length, int) and not isinstance(video_length, bool)
    if not is_number or not video_length > 0:  # type: ignore[operator]  # is_number
        raise InvalidArgument(
            "video_length must be a positive number of frames, or None for all, got "
            f"{video_length!r}."
        )


def _make_directory(directory: Path) -> Path:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(directory, error) from error
    return directory
