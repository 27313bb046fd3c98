# SPDX-License-Identifier: Apache-2.0
"""One video of one environment, picture by picture, with its metadata."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from .. import json_text
from ..annotation import Caption, annotated, check_annotation, pillow_version
from ..atomic_files import write_text
from ..blank_frames import BlankFrames
from ..errors import InvalidArgument, InvalidFrame
from ..formats.asciicast import AsciicastWriter, text_of_frame
from ..formats.ffmpeg import ffmpeg_executable
from ..formats.unfinished_video import VideoNote, note_path, write_note
from ..formats.video_metadata import StepRuns, file_facts, timing_facts
from ..formats.video_writer import VideoWriter
from ..frames import Frame, check_frame
from ..rates import rate_from_timestep, stride_for, to_rate
from ..simulation.inside import simulation_time
from .declared_rate import declared_rate

logger = logging.getLogger(__name__)

_IMAGE_MODES = ("rgb_array", "rgb_array_list")
_TEXT_MODES = ("ansi", "ansi_list")


class PictureSource(Protocol):
    """What a video is taken from: an environment, or what stands for one."""

    @property
    def render_mode(self) -> str | None:
        """What `render` gives: `rgb_array`, `rgb_array_list`, `ansi` or `ansi_list`.

        With any other there are no pictures.
        """

    def render(self) -> Any:
        """Return the picture of this moment, or the list of those since the last."""


def can_give_pictures(source: object) -> bool:
    """Tell whether `source` has a render mode that a video can be made of."""
    return getattr(source, "render_mode", None) in (*_IMAGE_MODES, *_TEXT_MODES)


class VideoRecorder:
    """Records what `env.render()` gives, one frame for each `capture_frame`.

    Images become an mp4 (`VideoWriter` says which), text becomes an asciicast of
    version 1 (`.json`). The rate is real time: the simulated time between the first
    two captures where `env` is a MuJoCo environment, else what `env` declares. `close`
    finishes the file and writes `<path without extension>.meta.json`. Until then a
    hidden note beside the unfinished mp4 says what it is, for `mjrec.recover`.

    A frame that is none (None, or another size or type than the first) stops the
    video: what came before it stays as a playable file, `broken` is set, and one
    warning and the metadata say so.

    Args:
        env: has `render_mode` and `render()`. With a render mode that gives no
            pictures the recorder is not enabled and does nothing.
        path: the video, ending in `.mp4`, or `.json` for text. A file in a new
            temporary directory without `path` and `base_path`.
        metadata: goes first into the metadata file. It is copied.
        enabled: False makes a recorder that does nothing.
        base_path: the path without extension, instead of `path`.
        fps: frames per second of the file, instead of real time.
        max_fps: the most frames per second that are wanted: of the pictures of
            `rgb_array` every n-th is taken, with the smallest n that fits, and the
            last, see `capture_last`. Of the other render modes every one is.
        frame_hashes: also write the `.framehash` of an image video.
        clock: returns the simulated time in seconds, or None where there is none.
        declared: returns the rate to take where there is no simulated time.
        facts: returns more for the metadata, asked for once, after the last frame.
        strict: whether images that show nothing (all black, of one colour each, or all
            the same) are an error of `close`; else they are a warning.
        caption: returns what is written on the images of this moment; None where
            nothing is.

    Raises:
        MissingDependency: there is no Pillow to write captions with.
        InvalidArgument: both `path` and `base_path` are given, or the extension is
            another.

    Attributes:
        path: the video; None when not enabled.
        metadata_path: the metadata file; None when not enabled.
        metadata: what the metadata file will hold, as far as it is known.
        enabled: whether it records.
        broken: a bad frame, or an encoder that failed, ended the video early.
        finished: the video is there, under its name and whole; known after `close`.
    """

    def __init__(
        self,
        env: PictureSource,
        path: str | os.PathLike[str] | None = None,
        metadata: Mapping[str, Any] | None = None,
        enabled: bool = True,
        base_path: str | os.PathLike[str] | None = None,
        *,
        fps: float | Fraction | None = None,
        max_fps: float | Fraction | None = None,
        frame_hashes: bool = False,
        clock: Callable[[], float | None] | None = None,
        declared: Callable[[], Fraction] | None = None,
        facts: Callable[[], Mapping[str, Any]] | None = None,
        strict: bool = False,
        caption: Callable[[], Caption] | None = None,
    ) -> None:
        if caption is not None:
            check_annotation()
        self._caption = caption
        self.env = env
        self.enabled = bool(enabled) and can_give_pictures(env)
        self.broken = False
        self.finished = False
        self.path: str | None = None
        self.metadata_path: str | None = None
        self.metadata = dict(metadata or {})
        self.ansi_mode = getattr(env, "render_mode", None) in _TEXT_MODES
        self._clock = clock or (lambda: simulation_time(env))
        self._declared = declared or (lambda: declared_rate(env))
        self._facts = facts
        self._strict = strict
        self._blank_frames = BlankFrames()
        self._fps = None if fps is None else to_rate(fps)
        self._max_fps = None if max_fps is None else to_rate(max_fps, name="max_fps")
        self._stride = 1
        self._last_taken = -1
        self._frame_hashes = frame_hashes
        self._take = text_of_frame if self.ansi_mode else self._checked_frame
        self._size: tuple[int, int] | None = None
        self._writer: VideoWriter | AsciicastWriter | None = None
        self._is_noted = False
        # Frames wait here until the second capture tells the rate.
        self._waiting: list[Any] = []
        self._captures = 0
        self._first: tuple[int, float | None] | None = None
        self._measured = False
        self._frames_per_capture = 1
        self._timestep: Fraction | None = None
        self._rate: Fraction | None = None
        self._steps = StepRuns()
        self._closed = False
        if not self.enabled:
            if enabled:
                logger.info(
                    "No video of %s: its render mode is %r.",
                    type(env).__name__,
                    getattr(env, "render_mode", None),
                )
            return
        # Absolute, so that a later chdir does not part the video from its metadata.
        self.path = str(Path(self._path_of(path, base_path)).absolute())
        self.metadata_path = str(Path(self.path).with_suffix(".meta.json"))
        self.metadata["content_type"] = (
            "video/vnd.openai.ansivid" if self.ansi_mode else "video/mp4"
        )

    @property
    def functional(self) -> bool:
        """Whether frames are (or were) recorded: enabled and not broken."""
        return self.enabled and not self.broken

    @property
    def empty(self) -> bool:
        """Whether there is no frame: none came, or the encoder lost them."""
        return self._steps.total == 0

    @property
    def frame_count(self) -> int:
        """The number of frames recorded so far."""
        return self._steps.total

    @property
    def closed(self) -> bool:
        """Whether `close` or `discard` was called."""
        return self._closed

    def capture_frame(self) -> None:
        """Record what `env.render()` gives now.

        Nothing happens when the recorder is not functional or is closed. What
        `env.render()` raises is raised.

        Raises:
            EncoderError: ffmpeg failed; the recorder is broken from then on.
        """
        if not self.functional or self._closed:
            return
        # Counted also where `render` raises: frames belong to steps.
        step, self._captures = self._captures, self._captures + 1
        self._settle_stride(step)
        if step % self._stride == 0:
            self._capture(step)

    def capture_last(self) -> None:
        """Record the picture of the last step, if `max_fps` has left it out.

        To be called at the end of an episode, before the environment goes on. Raises
        what `capture_frame` raises.
        """
        step = self._captures - 1
        if self.functional and not self._closed and step > self._last_taken >= 0:
            self._capture(step)

    def give_up(self, reason: str) -> None:
        """Take no more frames, and say why; those that were taken stay."""
        if self.functional:
            self._break(reason)

    def _capture(self, step: int) -> None:
        rendered = self.env.render()
        self._last_taken = step
        frames = rendered if isinstance(rendered, list) else [rendered]
        try:
            for frame in frames:
                self._add(self._take(frame))
                self._steps.add(step)
            self._settle_rate(step, len(frames))
        except InvalidFrame as error:
            self._break(str(error))
        except Exception as error:
            self._abandon(error)
            raise

    def close(self) -> None:
        """Finish the video and write its metadata. A second call does nothing.

        Without a frame there is no video, and the metadata says `empty`. Where it is
        interrupted (Ctrl-C), the next call finishes what is left.

        Raises:
            EncoderError: ffmpeg failed; the metadata is written all the same.
            BlankVideo: with `strict`; the video and its metadata are there.
        """
        if self._closed:
            return
        if self.enabled:
            try:
                self._finish_writer()
            except Exception as error:
                self._abandon(error)
                self._write_metadata()
                self._closed = True
                raise
            self._write_metadata()
        self._closed = True
        if self.finished and self.path is not None:
            self._blank_frames.judge(Path(self.path), strict=self._strict)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def discard(self) -> None:
        """End without a video and without metadata."""
        self._closed = True
        self._waiting.clear()
        if self._writer is not None:
            self._writer.abort()
        self._forget_note()

    def _path_of(
        self,
        path: str | os.PathLike[str] | None,
        base_path: str | os.PathLike[str] | None,
    ) -> str:
        extension = ".json" if self.ansi_mode else ".mp4"
        if path is not None and base_path is not None:
            raise InvalidArgument(
                f"Give either path ({path}) or base_path ({base_path}), not both."
            )
        if base_path is not None:
            return os.fspath(base_path) + extension
        if path is None:
            return str(Path(tempfile.mkdtemp(prefix="mjrec-")) / f"video{extension}")
        if Path(path).suffix != extension:
            kind = "text, an asciicast" if self.ansi_mode else "images, an mp4"
            raise InvalidArgument(
                f"With render_mode={self.env.render_mode!r} the recording is {kind}: "
                f"its path must end in {extension}, got {os.fspath(path)!r}."
            )
        return os.fspath(path)

    def _checked_frame(self, frame: object) -> Frame:
        checked = check_frame(frame, size=self._size)
        self._size = (checked.shape[0], checked.shape[1])
        self._blank_frames.add(checked)
        return checked if self._caption is None else annotated(checked, self._caption())

    def _add(self, frame: Any) -> None:
        if self._writer is not None:
            self._write(self._writer, frame)
        elif self.ansi_mode:
            self._waiting.append(frame)
        else:
            # The environment may draw the next picture into the same array.
            self._waiting.append(frame.copy())

    def _settle_stride(self, step: int) -> None:
        """Choose every how many-th picture is taken, once a step has been timed."""
        if self._max_fps is None or self._measured or self._first is None:
            return
        if getattr(self.env, "render_mode", None) != "rgb_array":
            return
        timestep = _time_of_a_step(self._first, (step, self._clock()))
        rate = 1 / timestep if timestep is not None else self._declared()
        self._stride = stride_for(rate, self._max_fps)
        if self._stride > 1:
            self._measured = True
            self._timestep = timestep
            self._steps = StepRuns([self._first[0]], stride=self._stride)
            if self._writer is None:
                self._open_writer(rate / self._stride)
            self._note_rest()

    def _settle_rate(self, step: int, frames: int) -> None:
        """Measure the time of a step, from the first two pictures that there are."""
        if self._writer is None and self._fps is not None:
            self._open_writer(self._fps)
        if self._first is None:
            self._first = (step, self._clock())
        elif not self._measured:
            self._measured = True
            # That of the reset may be another one.
            self._frames_per_capture = max(frames, 1)
            self._timestep = _time_of_a_step(self._first, (step, self._clock()))
            if self._writer is None:
                self._open_writer(self._real_time(frames))
            self._note_rest()

    def _real_time(self, frames: int) -> Fraction:
        if self._timestep is not None and frames:
            return rate_from_timestep(float(self._timestep / frames))
        return self._declared()

    def _thinned(self, rate: Fraction) -> Fraction:
        return rate / stride_for(rate, self._max_fps)

    def _open_writer(self, rate: Fraction) -> None:
        assert self.path is not None
        self._rate = rate
        if self.ansi_mode:
            self._writer = AsciicastWriter(Path(self.path), rate=rate)
        else:
            self._writer = VideoWriter(
                self.path, fps=rate, frame_hashes=self._frame_hashes
            )
        for frame in self._waiting:
            self._write(self._writer, frame)
        self._waiting.clear()

    def _write(self, writer: VideoWriter | AsciicastWriter, frame: Any) -> None:
        # The note is there before the file that it is about.
        if not self._is_noted and isinstance(writer, VideoWriter):
            self._note(writer, {})
        writer.write(frame)

    def _note(self, writer: VideoWriter, facts: Mapping[str, Any]) -> None:
        """Write down what the unfinished file is, for whoever finds it."""
        assert self._size is not None
        self._is_noted = True
        timestep = self._timestep
        write_note(
            VideoNote(
                video=writer.unfinished(*self._size),
                metadata={**self.metadata, **facts},
                timing={
                    "timestep": None if timestep is None else str(timestep),
                    "stride": self._stride,
                    "frames_per_step": self._frames_per_capture,
                },
                ffmpeg_size=Path(ffmpeg_executable()).stat().st_size,
            )
        )

    def _note_rest(self) -> None:
        """Complete the note by what the second picture has told."""
        if not isinstance(self._writer, VideoWriter) or self._writer.frame_count == 0:
            return
        # What they raise is raised: caught here, the exception of a signal's handler
        # would be lost, and the metadata needs them in the end.
        self._note(self._writer, self._facts() if self._facts else {})

    def _forget_note(self) -> None:
        if self._is_noted and self.path is not None:
            note_path(Path(self.path)).unlink(missing_ok=True)

    def _break(self, reason: str) -> None:
        self.broken = True
        self.metadata["broken_reason"] = reason
        logger.warning(
            "The video %s ends after %d frames, because the next one was bad: %s",
            self.path,
            self.frame_count,
            reason,
        )

    def _abandon(self, error: Exception) -> None:
        """Give the video up: its encoder failed, and no part of it is to be trusted."""
        self.broken = True
        self.finished = False
        self.metadata["broken_reason"] = str(error)
        self._waiting.clear()
        self._steps = StepRuns()
        if self._writer is not None:
            self._writer.abort()

    def _finish_writer(self) -> None:
        if self._waiting:
            self._open_writer(self._fps or self._thinned(self._declared()))
        if self._writer is not None:
            self._writer.close()
            self.finished = True

    def _write_metadata(self) -> None:
        if self.finished:
            self.metadata.update(self._description())
            self.metadata.update(self._facts() if self._facts else {})
        else:
            self.metadata["empty"] = True
        if self.broken:
            self.metadata["broken"] = True
        assert self.metadata_path is not None
        write_text(Path(self.metadata_path), json_text.dumps(self.metadata))
        self._forget_note()

    def _description(self) -> dict[str, Any]:
        description = timing_facts(
            self._steps,
            fps=self._rate,
            timestep=self._timestep,
            stride=self._stride,
            frames_per_step=self._frames_per_capture,
        )
        if isinstance(self._writer, AsciicastWriter):
            encoder = {"backend": "TextEncoder", "version": 1}
            return {"encoder_version": encoder, **description}
        if isinstance(self._writer, VideoWriter) and self._writer.result is not None:
            facts = {**file_facts(self._writer.result), **self._blank_frames.facts()}
            if self._caption is not None:
                facts["annotated"] = {"pillow": pillow_version()}
            return {**description, **facts}
        return description


def _time_of_a_step(
    earlier: tuple[int, float | None], later: tuple[int, float | None]
) -> Fraction | None:
    """Return the seconds between two steps, by what the clock showed at two others."""
    (first, start), (last, end) = earlier, later
    if start is None or end is None or end <= start:
        return None
    return 1 / rate_from_timestep((end - start) / (last - first))
