# SPDX-License-Identifier: Apache-2.0
"""Writing videos: every frame, once, in order, in a file that anybody can play.

Frames go through a bounded queue to a thread that feeds ffmpeg; the caller waits when
the encoder is slower and never loses a frame. The file has a temporary name until it
is complete and its frames have been counted again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import itertools
import numbers
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

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
from .ffmpeg import (
    FfmpegProcess,
    ffmpeg_executable,
    ffmpeg_sha256,
    ffmpeg_version,
    run_ffmpeg,
    video_encoders,
)
from .frame_hashes import frame_hash_header, frame_hash_line

__all__ = ["VideoFile", "VideoWriter", "save_video"]

_DEFAULT_CODEC = "libx264"
_DEFAULT_CRF = 18.0
_WORST_CRF = 51.0
# x264's output depends on the number of its threads, so that the number is a constant
# and not the machine's.
_ENCODER_THREADS = 4
_QUEUED_BYTES = 32 << 20
_MAX_QUEUED_FRAMES = 64
_READ_SIZE = 1 << 20

_MUXERS = {
    ".mp4": "mp4",
    ".mov": "mov",
    ".mkv": "matroska",
    ".webm": "webm",
    ".avi": "avi",
}
_WITH_MOOV = ("mp4", "mov")

# Pixel formats that hold rgb24 without loss.
_RGB_FORMATS = ("rgb24", "bgr24", "gbrp", "bgr0", "rgb0")
_LOSSLESS_CODECS = frozenset(
    {"ffv1", "libx264rgb", "utvideo", "png", "apng", "qtrle", "ffvhuff", "huffyuv"}
)
# Where ffmpeg's own default is poor, or not what the codec is taken for.
_QUALITY = {
    _DEFAULT_CODEC: ("-crf", f"{_DEFAULT_CRF:g}"),
    "libx264rgb": ("-crf", "0"),
    "mpeg4": ("-q:v", "2"),
}

# Rounding and chroma averaging as the definition says rather than as the CPU likes
# best: without `bitexact` and `accurate_rnd`, swscale's result depends on the CPU.
_SCALE_FLAGS = "area+accurate_rnd+full_chroma_int+full_chroma_inp+bitexact"
_TO_BT709 = (
    f"scale=out_color_matrix=bt709:out_range=limited:flags={_SCALE_FLAGS},"
    "format=yuv420p"
)
_BT709_TAGS = (
    *("-color_primaries", "bt709"),
    *("-color_trc", "bt709"),
    *("-colorspace", "bt709"),
    *("-color_range", "tv"),
)


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
        fps: frames per second, exact as a fraction.
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
        self.fps = to_rate(fps)
        self._settings = _settings(
            codec=_check_codec(codec),
            crf=_check_crf(crf),
            muxer=_MUXERS[self.path.suffix.lower()],
            encoder_arguments=tuple(encoder_arguments),
        )
        self._wants_frame_hashes = bool(frame_hashes)
        _try_encoding(ffmpeg_executable(), self._settings, self.fps)
        self._frame_count = 0
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
        started = self._encoding
        checked = check_frame(frame, size=started.size if started else None)
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
        if self._encoding is not None:
            try:
                self.result = self._encoding.finish()
            except Exception:
                self.abort()
                raise
        self._closed = True

    def abort(self) -> None:
        """Stop at once and leave nothing; an older file of that name stays."""
        self._closed = True
        if self._encoding is not None and self.result is None:
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
        if self._closed:
            return
        if self._encoding is None:
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

    def _start(self, first: Frame) -> _Encoding:
        check_size(*first.shape[:2])
        self._encoding = _Encoding(
            self.path,
            fps=self.fps,
            size=(first.shape[0], first.shape[1]),
            settings=self._settings,
            frame_hashes=self._wants_frame_hashes,
        )
        return self._encoding


@dataclass(frozen=True)
class _Settings:
    """How to encode, whatever the size and the rate.

    Attributes:
        codec: ffmpeg's name of the encoder.
        pixel_format: of the encoded pixels.
        muxer: ffmpeg's name of the kind of file.
        arguments: the output arguments but for the kind of file and its name.
    """

    codec: str
    pixel_format: str
    muxer: str
    arguments: tuple[str, ...]

    @property
    def decoded_format(self) -> str:
        """The pixel format in which the finished file's frames are hashed."""
        return "yuv420p" if self.pixel_format == "yuv420p" else "rgb24"

    def input_arguments(self, *, height: int, width: int, fps: Fraction) -> list[str]:
        """Return the arguments for raw frames on standard input."""
        return [
            *("-hide_banner", "-loglevel", "error", "-nostdin", "-y"),
            *("-f", "rawvideo", "-pixel_format", "rgb24"),
            *("-video_size", f"{width}x{height}"),
            *("-framerate", f"{fps.numerator}/{fps.denominator}"),
            *("-i", "pipe:0"),
        ]


class _Encoding:
    """A video in the making: ffmpeg, the thread that feeds it, temporary files."""

    def __init__(
        self,
        path: Path,
        *,
        fps: Fraction,
        size: tuple[int, int],
        settings: _Settings,
        frame_hashes: bool,
    ) -> None:
        self.size = size
        self.temporary = temporary_path(path)
        self._path = path
        self._fps = fps
        self._settings = settings
        self._padded = (size[0] + size[0] % 2, size[1] + size[1] % 2)
        self._hashes = _FrameHashFile(path, size, fps) if frame_hashes else None
        self._encoded = 0
        height, width = self._padded
        self._process = FfmpegProcess(
            [
                *settings.input_arguments(height=height, width=width, fps=fps),
                *settings.arguments,
                *(("-movflags", "+faststart") if settings.muxer in _WITH_MOOV else ()),
                *("-f", settings.muxer),
                _as_file(self.temporary),
            ],
            what=f"The video {path} could not be encoded.",
            reads=True,
        )
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
            frame_hash_path=_frame_hash_path(self._path) if self._hashes else None,
            encoder=self._describe_encoder(),
        )
        self._rename()
        return result

    def abort(self) -> None:
        """End everything and remove the temporary files."""
        # First the process: the thread may be waiting for it to read.
        self._process.kill()
        self.worker.abort()
        self.temporary.unlink(missing_ok=True)
        if self._hashes is not None:
            self._hashes.abort()

    def _encode(self, frame: Frame) -> None:
        if self._hashes is not None:
            self._hashes.add(self._encoded, frame)
        self._process.write(pad_to_even(frame))
        self._encoded += 1

    def _count_and_hash(self) -> str:
        frame_count, digest = _decode(
            self.temporary,
            pixel_format=self._settings.decoded_format,
            size=self._padded,
            fps=self._fps,
        )
        if frame_count != self._encoded:
            error = self._process.error("")
            raise FrameCountError(
                f"{self._path} was to hold {self._encoded} frames, and decoding gives "
                f"{frame_count}. It was not kept.",
                command=error.command,
                returncode=error.returncode,
                stderr=error.stderr,
            )
        return digest

    def _rename(self) -> None:
        # The hashes first: where there is a video, what belongs to it is there too.
        if self._hashes is not None:
            self._hashes.finish()
        else:
            # Those of the video that is replaced now would be wrong.
            _frame_hash_path(self._path).unlink(missing_ok=True)
        self.temporary.replace(self._path)

    def _describe_encoder(self) -> dict[str, Any]:
        executable, *arguments = self._process.command
        return {
            "ffmpeg": Path(executable).name,
            "version": ffmpeg_version(),
            "sha256": ffmpeg_sha256(),
            "arguments": [*arguments[:-1], self._path.name],
        }


class _FrameHashFile:
    """A `.framehash` file in the making."""

    def __init__(self, video: Path, size: tuple[int, int], fps: Fraction) -> None:
        self._path = _frame_hash_path(video)
        self._temporary = temporary_path(self._path)
        with self._naming_the_directory():
            self._file: TextIO = self._temporary.open("w", encoding="ascii")
            self._file.write(frame_hash_header(height=size[0], width=size[1], fps=fps))

    def add(self, number: int, frame: Frame) -> None:
        with self._naming_the_directory():
            self._file.write(frame_hash_line(number, frame))

    def finish(self) -> None:
        with self._naming_the_directory():
            self._file.close()
            # Missing when an interrupted close is repeated.
            with contextlib.suppress(FileNotFoundError):
                self._temporary.replace(self._path)

    def abort(self) -> None:
        # What cannot be written any more need not be.
        with contextlib.suppress(OSError):
            self._file.close()
        self._temporary.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _naming_the_directory(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DirectoryNotWritable(self._path.parent, error) from error


def _frame_hash_path(video: Path) -> Path:
    return video.with_suffix(".framehash")


def _check_path(path: str | os.PathLike[str]) -> Path:
    try:
        checked = Path(os.fspath(path))
    except TypeError as error:
        raise InvalidArgument(
            f"path must be the name of a file, got {path!r}."
        ) from error
    if checked.suffix.lower() not in _MUXERS:
        raise InvalidArgument(
            f"The name of a video ends in {', '.join(_MUXERS)}, got {str(path)!r}."
        )
    if checked.is_dir():
        raise InvalidArgument(f"{checked} is a directory; path must be a file's name.")
    parent = checked.absolute().parent
    if not parent.is_dir():
        raise DirectoryNotWritable(parent, "it does not exist")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise DirectoryNotWritable(parent, "permission denied")
    # Absolute, so that a change of the working directory moves nothing.
    return checked.absolute()


def _check_crf(crf: object) -> float | None:
    if crf is None:
        return None
    number = isinstance(crf, numbers.Real) and not isinstance(crf, bool)
    if not number or not 0 <= float(crf) <= _WORST_CRF:  # type: ignore[arg-type]  # number says so
        raise InvalidArgument(
            f"crf must be a number from 0 (largest) to {_WORST_CRF:g} (worst), got "
            f"{crf!r}."
        )
    return float(crf)  # type: ignore[arg-type]  # as above


def _check_codec(codec: object) -> str:
    if codec is None:
        return _DEFAULT_CODEC
    if not isinstance(codec, str):
        raise InvalidArgument(
            f"codec must be ffmpeg's name of an encoder, got {codec!r}."
        )
    return codec


def _settings(
    *, codec: str, crf: float | None, muxer: str, encoder_arguments: tuple[str, ...]
) -> _Settings:
    help_text = _encoder_help(ffmpeg_executable(), codec)
    pixel_format = _pixel_format(codec, help_text)
    yuv = pixel_format == "yuv420p"
    arguments = (
        *("-an", "-map_metadata", "-1"),
        *(("-vf", _TO_BT709) if yuv else ("-pix_fmt", pixel_format)),
        *("-c:v", codec),
        *_codec_arguments(codec, crf),
        *_quality_arguments(codec, crf, help_text),
        *("-threads", str(_ENCODER_THREADS)),
        *("-fflags", "+bitexact", "-flags:v", "+bitexact"),
        *(_BT709_TAGS if yuv else ()),
        *encoder_arguments,
    )
    return _Settings(codec, pixel_format, muxer, arguments)


def _codec_arguments(codec: str, crf: float | None) -> tuple[str, ...]:
    if codec not in ("libx264", "libx264rgb"):
        return ()
    # x264 calls lossless what truncates to 0, and no profile High has it.
    lossless = crf is not None and int(crf) == 0
    high = codec == "libx264" and not lossless
    return (
        *("-preset", "veryfast"),
        *(("-profile:v", "high") if high else ()),
        *("-x264-params", "cpu-independent=1"),
    )


def _quality_arguments(
    codec: str, crf: float | None, help_text: str
) -> tuple[str, ...]:
    if crf is None:
        return _QUALITY.get(codec, ())
    if " -crf " not in help_text:
        raise InvalidArgument(
            f"The encoder {codec} knows no crf, got crf={crf:g}: leave it out, or use "
            "codec='libx264'."
        )
    return ("-crf", f"{crf:g}")


def _pixel_format(codec: str, help_text: str) -> str:
    _, _, rest = help_text.partition("Supported pixel formats:")
    supported = rest.partition("\n")[0].split()
    wanted = _RGB_FORMATS if codec in _LOSSLESS_CODECS else ("yuv420p",)
    for pixel_format in wanted:
        if pixel_format in supported:
            return pixel_format
    raise InvalidArgument(
        f"The encoder {codec} takes none of {', '.join(wanted)}, only "
        f"{', '.join(supported) or 'unknown formats'}: use codec='libx264', or "
        "codec='ffv1' for a lossless video."
    )


@functools.lru_cache
def _encoder_help(executable: str, codec: str) -> str:
    """Return what ffmpeg says about an encoder; `executable` is a key of the cache."""
    available = video_encoders()
    if codec not in available:
        raise UnknownName(
            "video encoder",
            codec,
            available,
            hint=f"They are those of {executable}, {ffmpeg_version()}.",
        )
    shown = run_ffmpeg(["-hide_banner", "-h", f"encoder={codec}"]).stdout
    return shown.decode("utf-8", errors="replace")


@functools.lru_cache
def _try_encoding(executable: str, settings: _Settings, fps: Fraction) -> None:
    """Encode one small grey frame, so that what cannot work fails before any work.

    Once for each combination; `executable` is a key of the cache.
    """
    side = 64
    fragmented = ("-movflags", "+frag_keyframe+empty_moov")
    run_ffmpeg(
        [
            *settings.input_arguments(height=side, width=side, fps=fps),
            *settings.arguments,
            # A pipe cannot be rewritten from its start.
            *(fragmented if settings.muxer in _WITH_MOOV else ()),
            *("-f", settings.muxer, "pipe:1"),
        ],
        standard_input=bytes([128]) * (side * side * 3),
    )


def _decode(
    video: Path, *, pixel_format: str, size: tuple[int, int], fps: Fraction
) -> tuple[int, str]:
    """Return how many frames a file holds and the sha256 of all of them."""
    # New timestamps, one tick after the other: with those of the file, ffmpeg would
    # drop or repeat frames to make the rate even, and hide what is to be found.
    tick = f"settb={fps.denominator}/{fps.numerator},setpts=N"
    process = FfmpegProcess(
        [
            *("-hide_banner", "-loglevel", "error", "-nostdin", "-xerror"),
            *("-i", _as_file(video), "-map", "0:v:0", "-vf", tick),
            *("-r", f"{fps.numerator}/{fps.denominator}"),
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
        frames = list(frames)
    if episode_trigger is not None and episode_trigger(episode_index):
        path = folder / f"{name_prefix}-episode-{episode_index}.mp4"
        _write_video(itertools.islice(frames, video_length), path, kwargs)
    if step_trigger is not None:
        held = list(frames)
        # The first frame is the reset's.
        for step, first in enumerate(range(1, len(held)), start=step_starting_index):
            if step_trigger(step):
                last = None if video_length is None else first + video_length
                path = folder / f"{name_prefix}-step-{step}.mp4"
                _write_video(held[first:last], path, kwargs)


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
