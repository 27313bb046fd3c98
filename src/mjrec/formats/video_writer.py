# SPDX-License-Identifier: Apache-2.0
"""Writers for videos that contain every frame once, in order, and play everywhere.

Frames go through a bounded queue to a thread that feeds ffmpeg. The caller waits if the
encoder is slower, so no frame is lost. The file has a temporary name until it is
complete and its frames have been recounted.
"""

from __future__ import annotations

import inspect
import itertools
import numbers
import os
import tempfile
import warnings
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import numpy as np

from ..atomic_files import temporary_path
from ..errors import (
    ClosedError,
    DirectoryNotWritable,
    InvalidArgument,
    UnknownName,
)
from ..frames import Frame, check_frame, check_size
from ..rates import to_rate
from ..schedules import capped_cubic_video_schedule
from .encoder_settings import MUXERS, check_encoding, encoder_settings
from .ffmpeg import ffmpeg_executable, ffmpeg_version
from .frame_hashes import frame_hash_path
from .video_file import Encoding, VideoFile

# The largest numerator and denominator of a rate in ffmpeg, which silently replaces
# other rates with the nearest fraction that fits.
_MAX_RATE_TERM = 10**6


class VideoWriter:
    """A writer for one video file.

    ::

        with mjrec.VideoWriter("run.mp4", fps=40) as video:
            for frame in frames:
                video.write(frame)

    By default, the video is H.264 (High profile, yuv420p, bt709), which every browser
    plays. With the same ffmpeg, the same frames produce the same file, byte for byte,
    on any CPU.

    An existing file is replaced when the new one is complete. If no frame is written,
    there is no file and no error. If an exception escapes the `with` block, the file is
    finished with the frames so far, unless the encoder failed. Use a writer from one
    thread at a time.

    Args:
        path: the file: `.mp4`, `.mov`, `.mkv`, `.webm` or `.avi`.
        fps: frames per second. A fraction is stored exactly; a float becomes the
            nearest fraction with a numerator and denominator of at most a million.
        crf: quality, from 0 (largest file) to 51 (worst). None means 18, which looks
            like the original. Below 1, x264 is lossless except for color conversion,
            but browsers cannot play the file.
        codec: ffmpeg's name for an encoder. None means libx264. Lossless RGB encoders
            (`ffv1` and `libx264rgb` in `.mkv`) keep every pixel.
        frame_hashes: whether to write the SHA-256 of each frame to a `.framehash` file
            with the video's name.
        encoder_arguments: additional output arguments for ffmpeg.

    Attributes:
        path: the file.
        fps: the rate as a `Fraction`.
        frame_count: number of frames written so far.
        closed: whether the file is finished or abandoned.
        result: the finished file; None before `close`, or if there were no frames.
        temporary: path of the file until it is complete.
        temporary_hashes: path of the `.framehash` file until it is complete, if
            requested.

    Raises:
        InvalidArgument: an argument is invalid.
        UnknownName: ffmpeg has no such encoder.
        DirectoryNotWritable: the directory is missing or not writable.
        EncoderError: ffmpeg cannot encode with this combination of options.
        MissingDependency: ffmpeg is not installed.
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
        # Set when the first frame is written.
        self._encoding: Encoding | None = None
        self.path = _check_path(path)
        self.fps = _check_fps(fps)
        self._settings = encoder_settings(
            codec=codec,
            crf=crf,
            muxer=MUXERS[self.path.suffix.lower()],
            encoder_arguments=encoder_arguments,
        )
        self.temporary = temporary_path(self.path)
        hashes = temporary_path(frame_hash_path(self.path))
        self.temporary_hashes = hashes if frame_hashes else None
        check_encoding(self._settings, self.fps)
        self._process_id = os.getpid()
        self.closed = False

    def write(self, frame: Frame) -> None:
        """Add a `(height, width, 3) uint8` frame of the same size as the first one.

        The frame is copied. The call waits while the encoder is behind.

        Raises:
            InvalidFrame: the frame is not such an array, or has a different size. The
                writer stays usable.
            ClosedError: the writer was closed or aborted, or belongs to a process that
                this one was forked from.
            EncoderError: ffmpeg failed or died. No file is left.
        """
        encoding = self._encoding
        if self.closed or (encoding is not None and encoding.is_ending):
            raise ClosedError(
                f"The video {self.path} was closed after {self.frame_count} frames, "
                "and a video cannot be reopened: create a new VideoWriter."
            )
        if self._was_forked():
            raise ClosedError(
                f"The video {self.path} belongs to process {self._process_id}, from "
                "which this one was forked: write to it there, or create a new "
                "VideoWriter here."
            )
        checked = check_frame(frame, size=None if encoding is None else encoding.size)
        height, width = check_size(*checked.shape[:2])
        try:
            if encoding is None:
                encoding = self._encoding = Encoding(
                    self.file_of(height, width), self.temporary, self.temporary_hashes
                )
            # A plain copy with rows from top to bottom, even if the frame is a strided
            # view.
            encoding.thread.put(np.array(checked, order="C", copy=True, subok=False))
        except Exception:
            self.abort()
            raise
        self.frame_count += 1

    def file_of(self, height: int, width: int) -> VideoFile:
        """Return the facts known about the file before it is finished.

        Args:
            height: height of a frame in pixels.
            width: width of a frame in pixels.
        """
        has_hashes = self.temporary_hashes is not None
        return VideoFile(
            path=self.path,
            height=height,
            width=width,
            fps=self.fps,
            codec=self._settings.codec,
            pixel_format=self._settings.pixel_format,
            encoder={
                "ffmpeg": Path(ffmpeg_executable()).name,
                "version": ffmpeg_version(),
                # Hashing the whole binary takes a while, so it is not done at the
                # start.
                "sha256": None,
                "arguments": self._settings.arguments(
                    height=height + height % 2,
                    width=width + width % 2,
                    fps=self.fps,
                    output=self.path.name,
                ),
            },
            frame_hash_path=frame_hash_path(self.path) if has_hashes else None,
        )

    def close(self) -> None:
        """Finish the file: encode the rest, count the frames, and rename the file.

        Idempotent. If Ctrl-C interrupts this method, no more frames are accepted, and
        another call continues.

        Raises:
            EncoderError: ffmpeg failed or died. No file is left.
            FrameCountError: the file does not contain exactly the frames that were
                written.
        """
        if self.closed:
            return
        if self._encoding is not None and not self._was_forked():
            try:
                self.result = self._encoding.finish()
            except Exception:
                self.abort()
                raise
        self.closed = True

    def abort(self) -> None:
        """Stop immediately, leaving no new file. An older file is kept. Idempotent."""
        if not self.closed and self._encoding is not None and not self._was_forked():
            self._encoding.abort()
        self.closed = True

    def leave(self) -> None:
        """Accept no more frames and let the encoder finish on its own. Idempotent."""
        if not self.closed and self._encoding is not None and not self._was_forked():
            self._encoding.leave()
        self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, *__: object) -> None:
        try:
            self.close()
        except Exception as failure:
            if error is None:
                raise
            # The original error matters more than what happens to the video.
            error.add_note(f"The video {self.path} could not be finished: {failure}")

    def __del__(self) -> None:
        if self.closed or self._encoding is None or self._was_forked():
            return
        # A finalizer must not wait. The thread encodes the queued frames, and ffmpeg
        # finishes its file under the temporary name.
        self.leave()
        warnings.warn(
            f"The VideoWriter for {self.path} was never closed; its frames are in "
            f"{self.temporary}. Use it in a with statement.",
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
        """Return whether this is a forked child, whose parent owns the video."""
        return os.getpid() != self._process_id


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
    """Write videos of one episode's frames, like Gymnasium's `save_video`.

    `<prefix>-episode-<episode_index>.mp4` contains the episode if `episode_trigger`
    selects it. `<prefix>-step-<n>.mp4` starts with the frame of step n if
    `step_trigger` selects that step. The first frame belongs to the reset, and the
    second to step `step_starting_index`. No frames are left out.

    `frames` can be any iterable. With only an episode trigger, it is streamed up to
    `video_length`, and it is not read at all if no video is due. With a step trigger,
    videos can overlap, so all frames are held in memory. An existing video is replaced
    when the new one is complete. If there are no frames, no file is written. If
    `frames` raises an error, the frames so far are kept.

    Args:
        frames: `(height, width, 3) uint8` arrays.
        video_folder: the directory, which is created if necessary.
        episode_trigger: a function that takes an episode's number and returns whether
            the episode gets a video. If both triggers are None, episodes 0, 1, 8, 27
            ... 729 and every 1000th episode get one.
        step_trigger: a function that takes a step's number and returns whether a video
            starts at that step.
        video_length: maximum number of frames in a video; None for no limit.
        name_prefix: the prefix of the file names.
        episode_index: the episode's number.
        step_starting_index: the number of the episode's first step.
        **kwargs: `fps`, which is required, and other options of `VideoWriter`.

    Raises:
        InvalidArgument: `fps` is missing, an option is unknown, or a value is invalid.
        DirectoryNotWritable: `video_folder` cannot be created or written to.
        InvalidFrame: a frame has the wrong shape or dtype.
        EncoderError: ffmpeg failed or died; see `VideoWriter`.
    """
    _check_options(kwargs, video_length)
    if episode_trigger is None and step_trigger is None:
        episode_trigger = capped_cubic_video_schedule
    folder = Path(video_folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DirectoryNotWritable(folder, error) from error
    if step_trigger is not None:
        # Copy them: a generator may reuse the same array.
        is_held = isinstance(frames, Sequence | np.ndarray)
        frames = held = list(frames if is_held else map(np.array, frames))
    if episode_trigger is not None and episode_trigger(episode_index):
        path = folder / f"{name_prefix}-episode-{episode_index}.mp4"
        _write_video(itertools.islice(frames, video_length), path, kwargs)
    if step_trigger is not None:
        # The first frame belongs to the reset.
        for step, first in enumerate(range(1, len(held)), start=step_starting_index):
            if step_trigger(step):
                last = None if video_length is None else first + video_length
                path = folder / f"{name_prefix}-step-{step}.mp4"
                _write_video(held[first:last], path, kwargs)


def _write_video(frames: Iterable[Frame], path: Path, options: dict[str, Any]) -> None:
    with VideoWriter(path, **options) as video:
        for frame in frames:
            video.write(frame)


def _check_options(options: dict[str, Any], video_length: object) -> None:
    parameters = inspect.signature(VideoWriter).parameters.values()
    known = [one.name for one in parameters if one.kind is one.KEYWORD_ONLY]
    for name in options:
        if name not in known:
            raise UnknownName("option of save_video", name, known)
    if "fps" not in options:
        raise InvalidArgument(
            "save_video needs fps, the video's frames per second, for example "
            "fps=env.metadata['render_fps']."
        )
    to_rate(options["fps"])
    is_number = isinstance(video_length, int) and not isinstance(video_length, bool)
    if video_length is not None and (not is_number or video_length <= 0):  # type: ignore[operator]  # is_number
        raise InvalidArgument(
            "video_length must be a positive number of frames, or None for all, not "
            f"{video_length!r}."
        )


def _check_path(path: str | os.PathLike[str]) -> Path:
    try:
        checked = Path(os.fspath(path))
    except TypeError as error:
        raise InvalidArgument(
            f"path must be the name of a file, not {path!r}."
        ) from error
    if checked.suffix.lower() not in MUXERS:
        raise InvalidArgument(
            f"A video's name must end in {' or '.join(MUXERS)}, but this name is "
            f"{str(path)!r}."
        )
    if checked.is_dir():
        raise InvalidArgument(f"{checked} is a directory; path must be a file's name.")
    # Absolute, so that changing the working directory does not move the file.
    checked = checked.absolute()
    try:
        # Checking permissions is not enough: root may do anything, and a disk may be
        # read-only.
        tempfile.TemporaryFile(dir=checked.parent).close()
    except OSError as error:
        raise DirectoryNotWritable(checked.parent, error.strerror) from error
    return checked


def _check_fps(fps: float | Fraction) -> Fraction:
    """Return the rate. A float is rounded to the nearest rate that a file can store."""
    rate = to_rate(fps)
    nearest = (
        rate.limit_denominator(_MAX_RATE_TERM)
        if rate < 1
        else 1 / (1 / rate).limit_denominator(_MAX_RATE_TERM)
    )
    if nearest != rate and isinstance(fps, numbers.Rational):
        raise InvalidArgument(
            f"fps={rate} cannot be stored exactly: its numerator and denominator may "
            f"be at most {_MAX_RATE_TERM}. The nearest valid rate is {nearest}."
        )
    return nearest
