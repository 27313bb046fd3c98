# SPDX-License-Identifier: Apache-2.0
"""A recorder for one video of an environment, with its metadata."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

from ..annotation import Caption, check_annotation
from ..errors import InvalidArgument, InvalidFrame
from ..formats.asciicast import text_of_frame
from ..formats.video_metadata import StepRuns, timing_facts, write_metadata
from ..formats.video_sink import VideoSink
from ..frames import Frame, check_frame
from ..rates import rate_from_timestep, stride_for, to_rate
from ..simulation.find_simulation import simulation_in, simulation_time

logger = logging.getLogger(__name__)

_IMAGE_MODES = ("rgb_array", "rgb_array_list")
_TEXT_MODES = ("ansi", "ansi_list")


class FrameSource(Protocol):
    """A source of frames, such as an environment or a stand-in for one."""

    @property
    def render_mode(self) -> str | None:
        """The render mode: `rgb_array`, `rgb_array_list`, `ansi` or `ansi_list`.

        Other modes do not provide frames.
        """

    def render(self) -> Any:
        """Return the current frame, or a list of all frames since the last call."""


def can_give_frames(source: object) -> bool:
    """Return whether the render mode of `source` provides frames for a video."""
    return getattr(source, "render_mode", None) in (*_IMAGE_MODES, *_TEXT_MODES)


class VideoRecorder:
    """Records `env.render()`, one frame per `capture_frame`, with gym's interface.

    Images become an mp4 file (see `VideoWriter`). Text becomes an asciicast version 1
    (`.json`). The video plays in real time. For a MuJoCo environment, the frame rate
    follows from the simulated time between the first two captures. For other
    environments, it is the rate that `env` declares. `close` finishes the file and
    writes `<path without extension>.meta.json`. Until then, a hidden file describes the
    unfinished mp4 for `mjrec.recover`.

    A bad frame (None, or a different size or type from the first frame) ends the video.
    The earlier frames remain as a playable file, and `broken` is set. A warning and the
    metadata report the bad frame.

    Args:
        env: an object with `render_mode` and `render()`. If the render mode does not
            provide frames, the recorder is disabled and does nothing.
        path: path of the video, ending in `.mp4`, or in `.json` for text. Without
            `path` and `base_path`, a file in a new temporary directory is used.
        metadata: initial entries for the metadata file. The mapping is copied.
        enabled: whether to record. If false, the recorder does nothing.
        base_path: path without the extension, as an alternative to `path`.
        fps: frame rate of the file, if the video should not play in real time.
        max_fps: maximum frame rate. In the `rgb_array` mode, every n-th frame and the
            last frame are taken (see `capture_last`). Other render modes keep all
            frames.
        frame_hashes: whether to write a `.framehash` file next to a video of images.
        clock: a function that returns the simulated time in seconds, or None if there
            is no simulated time.
        declared: a function that returns the rate to use if no time is simulated.
        facts: a function that returns additional metadata. It is called once there is a
            frame.
        strict: whether `close` raises an error if the images show nothing (all black, a
            single color or no movement). Otherwise, it logs a warning.
        caption: a function that returns the text for the current frame, or None.

    Raises:
        MissingDependency: captions were requested, but Pillow is not installed.
        InvalidArgument: both `path` and `base_path` are given, or the extension is
            wrong.

    Attributes:
        path: path of the video; None if the recorder is disabled.
        metadata_path: path of the metadata file; None if the recorder is disabled.
        metadata: the content of the metadata file so far.
        enabled: whether the recorder records frames.
        broken: whether a bad frame or a failed encoder ended the video early.
        finished: whether the video exists and is complete. Known only after `close`.
        closed: whether `close`, `leave` or `discard` was called.
    """

    def __init__(
        self,
        env: FrameSource,
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
        self.env = env
        self.enabled = bool(enabled) and can_give_frames(env)
        self.broken = self.finished = self.closed = False
        self.path: str | None = None
        self.metadata_path: str | None = None
        self.metadata = dict(metadata or {})
        mode = getattr(env, "render_mode", None)
        self.ansi_mode = mode in _TEXT_MODES
        # If there is one image per step, some images do not have to be drawn.
        self._may_leave_out = mode == "rgb_array"
        self._caption = caption
        self._clock = clock or (lambda: simulation_time(env))
        self._declared = declared or (lambda: declared_rate(env))
        self._facts = facts or dict
        self._strict = strict
        self._fps = None if fps is None else to_rate(fps)
        self._max_fps = None if max_fps is None else to_rate(max_fps, name="max_fps")
        self._frame_hashes = frame_hashes
        self._sink: VideoSink | None = None
        self._size: tuple[int, int] | None = None
        # Frames are kept here until the second capture, when the rate is known.
        self._waiting: list[tuple[Frame | str, Caption | None]] = []
        self._captures = 0
        self._first: tuple[int, float | None] | None = None
        self._last_taken = -1
        self._breaks_off: tuple[int, str] | None = None
        self._steps = StepRuns()
        self._stride = self._frames_per_step = 1
        self._timestep: Fraction | None = None
        self._rate: Fraction | None = None
        if not self.enabled:
            if enabled:
                logger.info(
                    "%s gets no video because its render mode is %r.",
                    type(env).__name__,
                    mode,
                )
            return
        # Absolute, so that a later chdir does not separate the video and its metadata.
        self.path = str(Path(self._path_of(path, base_path)).absolute())
        self.metadata_path = str(Path(self.path).with_suffix(".meta.json"))
        self.metadata["content_type"] = (
            "video/vnd.openai.ansivid" if self.ansi_mode else "video/mp4"
        )

    @property
    def functional(self) -> bool:
        """Whether the recorder is enabled and not broken."""
        return self.enabled and not self.broken

    @property
    def empty(self) -> bool:
        """Whether there are no frames, or the encoder has lost all captured frames."""
        return self._steps.total == 0

    @property
    def frame_count(self) -> int:
        """The number of frames recorded so far."""
        return self._steps.total

    def capture_frame(self) -> None:
        """Record the current result of `env.render()`.

        If the recorder is closed or not functional, nothing happens. Exceptions from
        `env.render()` are passed on.

        Raises:
            EncoderError: ffmpeg failed. After that, the recorder is broken.
        """
        if not self.functional or self.closed:
            return
        # The capture counts even if `render` raises, because frames belong to steps.
        step, self._captures = self._captures, self._captures + 1
        if self._may_leave_out:
            with self._abandoning():
                self._settle_rate(step, frames=1)
        if step % self._stride == 0:
            self._capture(step)

    def capture_last(self) -> None:
        """Record the frame of the last step if `max_fps` left it out.

        Call this method at the end of an episode, before the next reset or step. It
        raises the same errors as `capture_frame`.
        """
        step = self._captures - 1
        if self.functional and not self.closed and step > self._last_taken >= 0:
            self._capture(step)

    def give_up(self, reason: str) -> None:
        """Stop taking frames and log the reason. Earlier frames are kept."""
        if not self.functional:
            return
        self.broken = True
        self.metadata["broken_reason"] = reason
        logger.warning(
            "The video %s ends after %d frames because the next frame was bad: %s",
            self.path,
            self.frame_count,
            reason,
        )

    def break_off(self, reason: str, *, frames: int) -> None:
        """Stop after the given number of frames. With 0, delete all frames."""
        if frames:
            self._breaks_off = frames, reason
        else:
            self._fail(reason)

    def close(self) -> None:
        """Finish the video and write its metadata. A second call does nothing.

        If there are no frames, no video is written, and the metadata contains `empty`.
        If Ctrl-C interrupts the call, the next call continues.

        Raises:
            EncoderError: ffmpeg failed. The metadata is written anyway.
            BlankVideo: `strict` is set, and the video shows nothing. The video and its
                metadata are kept.
        """
        if self.closed:
            return
        if self.enabled:
            try:
                with self._abandoning():
                    self._finish()
            except Exception:
                self._describe()
                self.closed = True
                raise
            self._describe()
        self.closed = True
        if self.finished and self._sink is not None:
            self._sink.blank.judge(self._sink.path, strict=self._strict)

    def leave(self) -> None:
        """Release the files as SIGKILL would, so that recovery finishes the video."""
        if not self.closed and self._sink is not None:
            self._sink.leave()
        self.closed = True

    def discard(self) -> None:
        """Discard the video and write no metadata."""
        if not self.closed:
            self.closed = True
            self._drop_frames()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _path_of(
        self,
        path: str | os.PathLike[str] | None,
        base_path: str | os.PathLike[str] | None,
    ) -> str:
        extension = ".json" if self.ansi_mode else ".mp4"
        if path is not None and base_path is not None:
            raise InvalidArgument(
                f"Pass either path ({path}) or base_path ({base_path}), not both."
            )
        if base_path is not None:
            return os.fspath(base_path) + extension
        if path is None:
            return str(Path(tempfile.mkdtemp(prefix="mjrec-")) / f"video{extension}")
        if Path(path).suffix != extension:
            kind = "text (an asciicast)" if self.ansi_mode else "images (an mp4 file)"
            raise InvalidArgument(
                f"With render_mode={self.env.render_mode!r} the recording is {kind}, "
                f"so its path must end in {extension}, but it is {os.fspath(path)!r}."
            )
        return os.fspath(path)

    def _capture(self, step: int) -> None:
        if self._breaks_off is not None and self.frame_count >= self._breaks_off[0]:
            self.give_up(self._breaks_off[1])
            return
        rendered = self.env.render()
        self._last_taken = step
        frames = rendered if isinstance(rendered, list) else [rendered]
        with self._abandoning():
            for frame in frames:
                self._add(frame)
                self._steps.add(step)
            self._settle_rate(step, len(frames))
            if self._first is None:
                self._first = (step, self._clock())

    def _add(self, frame: object) -> None:
        taken: Frame | str
        caption = None
        if self.ansi_mode:
            taken = text_of_frame(frame)
        else:
            taken = check_frame(frame, size=self._size)
            self._size = (taken.shape[0], taken.shape[1])
            caption = None if self._caption is None else self._caption()
        if self._sink is not None:
            self._sink.write(taken, caption)
        else:
            # The environment may draw the next frame in the same array.
            taken = taken if isinstance(taken, str) else taken.copy()
            self._waiting.append((taken, caption))

    def _settle_rate(self, step: int, frames: int) -> None:
        """Open the video once the frames of two steps show how long a step takes."""
        if self._sink is not None or self._first is None:
            return
        (first, start), now = self._first, self._clock()
        if start is not None and now is not None and now > start:
            self._timestep = 1 / rate_from_timestep((now - start) / (step - first))
        self._frames_per_step = max(frames, 1)
        real_time: Callable[[], Fraction] = self._declared
        if self._timestep is not None and frames:
            timestep = float(self._timestep / frames)
            real_time = functools.partial(rate_from_timestep, timestep)
        if self._may_leave_out and self._max_fps is not None:
            self._stride = stride_for(real_time(), self._max_fps)
            if self._stride > 1:
                self._steps = StepRuns([self._first[0]], stride=self._stride)
        self._open(self._fps or real_time() / self._stride)

    def _open(self, fps: Fraction) -> None:
        assert self.path is not None
        self._rate = fps
        self._sink = VideoSink(
            Path(self.path), fps=fps, frame_hashes=self._frame_hashes, note=self._note
        )
        for frame, caption in self._waiting:
            self._sink.write(frame, caption)
        self._waiting.clear()

    def _note(self) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """Return the metadata and the timing that describe the unfinished video."""
        timing = {**self._timing(), "frames_per_step": self._frames_per_step}
        return {**self.metadata, **self._facts()}, timing

    def _timing(self) -> Mapping[str, Any]:
        return timing_facts(
            self._steps,
            fps=self._rate,
            timestep=self._timestep,
            stride=self._stride,
            frames_per_step=self._frames_per_step,
        )

    @contextlib.contextmanager
    def _abandoning(self) -> Iterator[None]:
        """End the video at a bad frame. If any other error occurs, delete it."""
        try:
            yield
        except InvalidFrame as error:
            self.give_up(str(error))
        except Exception as error:
            self._fail(str(error))
            raise

    def _fail(self, reason: str) -> None:
        self.broken = True
        self.metadata["broken_reason"] = reason
        self._steps = StepRuns()
        self._drop_frames()

    def _drop_frames(self) -> None:
        self._waiting.clear()
        if self._sink is not None:
            self._sink.discard()
            self._sink = None

    def _finish(self) -> None:
        if self._waiting:
            rate = self._fps
            if rate is None:
                declared = self._declared()
                rate = declared / stride_for(declared, self._max_fps)
            self._open(rate)
        if self._sink is not None:
            self._sink.finish()
            self.finished = True

    def _describe(self) -> None:
        """Write the metadata."""
        assert self.path is not None
        if self.broken:
            self.metadata["broken"] = True
        if self._sink is None:
            self.metadata["empty"] = True
            write_metadata(Path(self.path), self.metadata)
            return
        self.metadata = self._sink.describe(
            {**self.metadata, **self._timing(), **self._facts()}
        )


_DEFAULT_RATE = Fraction(30)


def declared_rate(env: object) -> Fraction:
    """Return the frame rate that an environment declares.

    The rate follows from the control timestep of a dm_control environment or from `dt`
    of a Gymnasium MuJoCo environment. For other environments, it is `render_fps` in the
    metadata. The default is 30, with a warning if the environment can be drawn.

    Raises:
        InvalidArgument: `render_fps` is not a valid rate.
    """
    base = getattr(env, "unwrapped", env)
    simulation = simulation_in(env)
    if callable(timestep := getattr(base, "control_timestep", None)):
        return rate_from_timestep(float(timestep()))
    if simulation is not None and (dt := getattr(base, "dt", None)):
        return rate_from_timestep(float(dt))
    fps = (getattr(env, "metadata", None) or {}).get("render_fps")
    if fps is not None:
        return to_rate(fps, name=f'metadata["render_fps"] of {type(env).__name__}')
    can_be_drawn = getattr(env, "render_mode", None) is not None
    if can_be_drawn or simulation is not None:
        logger.warning(
            "%s does not declare a frame rate (no control timestep, no render_fps). "
            "Its videos use %d frames per second; set fps= to choose another rate.",
            type(env).__name__,
            _DEFAULT_RATE,
        )
    return _DEFAULT_RATE
