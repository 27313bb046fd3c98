# SPDX-License-Identifier: Apache-2.0
"""A recorder for the states of an episode or of part of a clip, one row per step."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileNotWritten, PicturesDiffer
from ..formats.span_writer import SpanWriter
from ..formats.trajectory import ModelChange, row_dtype
from ..rates import rate_from_timestep, stride_for
from .endings import ending
from .fast_path import FastPath, gathering
from .monitored_run import MonitoredRun, What
from .step_arrays import StepArray, action_array, step_array

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart

logger = logging.getLogger(__name__)


class StateRecorder:
    """Records the states of an episode, or of a part of one, one row per step.

    The first row is for the reset. It stays in memory until the first step shows what
    an action looks like and how long a step takes. Frames are taken at steps 0, n, 2n
    ..., where n is the smallest stride that respects `max_fps`, and at the last step.

    Errors are handled here. If no more frames can be taken, only the states are
    recorded from then on. If nothing can be written anymore, the recording ends there,
    and an error is raised unless `on_error` lets the simulation continue.

    Args:
        run: the monitored run.
        name: name of the resulting file, without suffix.
        facts: the facts known at the beginning, in addition to the run's.
        start: the value returned by the capture's `begin_episode`; None if no states
            are accessible.
        observation: the reset's observation; None if observations are not recorded.
        is_clip: whether this is a part of a clip. A clip's frames do not depend on
            actions, so actions are left out. The frames of all parts are counted
            together, so `max_fps` selects them when they are drawn.
        is_alone: whether it gets its own log, so that it can be deleted separately.

    Attributes:
        early_end: the facts about the error that stopped the recording; None while the
            recording continues.
        broken_reason: why no more frames are taken; None while frames are taken.
    """

    def __init__(
        self,
        run: MonitoredRun,
        name: str,
        *,
        facts: Mapping[str, Any],
        start: EpisodeStart | None,
        observation: Any = None,
        is_clip: bool = False,
        is_alone: bool = False,
    ) -> None:
        self.early_end: Mapping[str, Any] | None = None
        self.broken_reason: str | None = None
        self._run = run
        self._name = name
        track = self._track = run.of_clips if is_clip else run.of_episodes
        capture = self._capture = None if start is None else track.capture
        self._what: What = "video" if is_clip else "trajectory"
        self._facts = {**run.recording_facts(start), **facts}
        self._start = start
        self._max_fps = None if is_clip else run.options.max_fps
        self._has_actions = not is_clip
        self._is_alone = is_alone
        self._takes_frames = start is not None and start.snapshot is not None
        self._span: SpanWriter | None = None
        self._fast: FastPath | None = None
        self._irregular: set[str] = set()
        # Pairs of a step and the dtype of the actions from that step on.
        self._action_dtypes: list[list[Any]] = []
        # The parts of the row for the reset.
        self._first: dict[str, Any] = {"action": 0}
        self._first_change: Mapping[str, NDArray[Any]] | None = None
        self._observation = None if observation is None else step_array(observation)
        if self._observation is not None:
            self._observation.set(observation)
            self._first["observation"] = self._observation.values.copy()
        if capture is None or start is None:
            self._first_time = run.env.clock()
        else:
            state = self._first["state"] = np.empty(start.state.itemsize // 8)
            capture.capture_state(state)
            # A state begins with the time.
            self._first_time = float(state[0])
            if start.snapshot is not None:
                snapshot = np.empty(start.snapshot.itemsize // 8, np.uint64)
                self._first_change = capture.capture_snapshot(snapshot)
                self._first["snapshot"] = snapshot
        self._pace = track.pace
        self._use_action(track.action)
        if self._pace is not None and (is_clip or self._action is not None):
            # Most likely nothing has changed since the last recording. If the row
            # cannot be written, the first step reports it.
            with contextlib.suppress(FileNotWritten):
                self._begin(self._pace)

    @property
    def is_there(self) -> bool:
        """Whether the log has any rows of this recording."""
        return self._span is not None

    @property
    def steps(self) -> int:
        """Number of recorded steps."""
        return 0 if self._span is None else self._span.steps

    @property
    def frame_count(self) -> int:
        """Number of snapshots taken."""
        return 0 if self._span is None else self._span.frame_count

    def before_step(self, action: Any) -> None:
        """Copy the next step's action, because the environment may overwrite it."""
        if self.early_end is not None or not self._has_actions:
            return
        if self._action is not None and self._action.set(action):
            return
        if self.steps == 0:
            # The previous episode's actions were different, so the row layout changes.
            self._take_back()
            self._use_action(action_array(action))
            if self._action is not None and self._action.set(action):
                return
        self._note_irregular("actions")
        where = {"episode_id": self._run.episode.episode_id, "step": self.steps}
        given = {"dtype": action.dtype.name} if hasattr(action, "dtype") else {}
        self._run.note("action", {**where, **given, "value": action})

    def step(
        self,
        reward: float,
        *,
        terminated: bool,
        truncated: bool,
        observation: Any = None,
        is_last: bool = False,
        has_frame: bool = True,
    ) -> None:
        """Record the environment after a step.

        If no state is available, the step is logged without one.

        Args:
            reward: the step's reward.
            terminated: whether the task ended the episode.
            truncated: whether a limit outside the task ended it.
            observation: the observation after the step, if observations are recorded.
            is_last: whether this is the last step, which always gets a frame.
            has_frame: False if the environment has already reset itself, so that its
                state belongs to the next episode.

        Raises:
            FileNotWritten: the disk is full, and `on_error` does not tolerate that. The
                step was not recorded, but everything before it is kept.
        """

        def take_row() -> None:
            if self._observation is not None and not self._observation.set(observation):
                self._note_irregular("observations")
            span = self._settled()
            number, slot = span.steps + 1, span.make_room()
            is_frame = False
            try:
                self._write_state(span, slot, has_frame=has_frame)
                if has_frame and (is_last or number % self._stride == 0):
                    is_frame = self._write_snapshot(span, slot, number)
            finally:
                # Do this even after an exception: readers stop at the first gap.
                columns = span.log.columns
                if self._action is not None:
                    columns["action"][slot] = self._action.values
                if self._observation is not None:
                    columns["observation"][slot] = self._observation.values
                span.commit(
                    number,
                    reward,
                    is_frame=is_frame,
                    terminated=terminated,
                    truncated=truncated,
                )

        self._try(take_row)

    def take_frame(self) -> None:
        """Take a snapshot now, unless the current step already has one.

        Raises:
            FileNotWritten: the disk is full, and `on_error` does not tolerate that.
        """

        def take() -> None:
            span = self._span
            if span is not None and span.last_frame != span.steps:
                slot = span.make_room()
                if self._write_snapshot(span, slot, span.steps):
                    span.commit(span.steps, is_step=False, is_frame=True)

        self._try(take)

    def fast_path(self) -> FastPath | None:
        """Return the fast path, or None if it cannot be used."""
        if (
            self.early_end is not None
            or not self._takes_frames
            or self._observation is not None
        ):
            return None
        if self._fast is None and self._span is not None:
            self._fast = self._new_fast_path(self._span)
        return self._fast

    def end_frames(self, reason: str) -> None:
        """Stop taking snapshots and log the reason."""
        self._takes_frames = False
        self._break(reason)
        logger.warning(
            "The frames of %s end early, at step %d: %s", self._name, self.steps, reason
        )

    def note(self, **facts: Any) -> None:
        """Add facts. If the disk is full, they are written along with later facts."""
        self._facts = {**self._facts, **facts}
        with contextlib.suppress(FileNotWritten):
            self.amend(facts)

    def amend(self, facts: Mapping[str, Any]) -> None:
        """Add facts, even after the recording has ended.

        Raises:
            FileNotWritten: the disk is full.
        """
        if self._span is not None:
            self._span.note(facts)

    def end(self, facts: Mapping[str, Any]) -> None:
        """End the recording and write the final facts.

        Raises:
            FileNotWritten: the disk is full, and `on_error` does not tolerate that.
                The facts are written as soon as there is room.
        """
        # The fast path keeps the log's memory alive.
        self._fast = None
        try:
            if self._span is None and self.early_end is None:
                # No step was taken, so only the reset is recorded.
                self._begin(_pace(self._run.env.declared(), None, self._max_fps))
            if self._span is not None:
                self._span.end(facts)
        except FileNotWritten as error:
            # An episode's facts are only late. A clip would go on with a gap.
            if self._span is None or self._what == "video":
                self._break(str(error))
            if not self._run.tolerates(self._what, error):
                raise

    def lose(self, error: Exception, *, all_rows: bool = False) -> None:
        """Record nothing from now on, because of an error.

        Args:
            error: the error.
            all_rows: whether not even the reset's row was written.
        """
        self.early_end = ending(error)
        if all_rows:
            self._take_back()
        # Now, because the process may end before the recording does.
        self._break(str(error), exception=self.early_end["exception"])

    def drop(self) -> None:
        """Discard the rows, even after the recording has ended.

        Raises:
            FileNotWritten: the disk is full.
        """
        # The fast path keeps the log's memory alive.
        self._fast = None
        if self._span is not None:
            self._span.drop()

    def _take_back(self) -> None:
        """Discard the row for the reset. The first step will write it again."""
        self._fast = None
        if self._span is not None:
            # A full disk is reported by a later write.
            with contextlib.suppress(FileNotWritten):
                self._span.drop()
            self._span = None

    def _try(self, take: Callable[[], None]) -> None:
        if self.early_end is not None:
            return
        try:
            take()
        except PicturesDiffer as error:
            self.end_frames(str(error))
        except FileNotWritten as error:
            self.lose(error)
            if not self._run.tolerates(self._what, error):
                raise

    def _break(self, reason: str, **facts: Any) -> None:
        # The first error ended the frames.
        if self.broken_reason is None:
            self.broken_reason = reason
            self.note(broken_reason=reason, **facts)

    def _new_fast_path(self, span: SpanWriter) -> FastPath | None:
        start, action = self._start, self._action
        if start is None or start.words is None or action is None:
            return None
        if action.words is None:
            return None
        return gathering(
            self._run.stats,
            span,
            np.concatenate([start.words, action.words]),
            set_action=action.set,
            is_current=start.is_current,
            is_on_pace=lambda now: self._measured_pace(now) == self._pace,
            stride=self._stride,
        )

    def _settled(self) -> SpanWriter:
        """Return the span for the next row. The first step begins or corrects it."""
        if self._span is not None and self.steps:
            return self._span
        pace = self._measured_pace(self._run.env.clock())
        if self._span is None:
            self._begin(pace)
        elif pace != self._pace:
            self._track.pace = self._pace = pace
            self._fast = None
            self.note(**pace)
        assert self._span is not None
        return self._span

    @property
    def _stride(self) -> int:
        return 1 if self._pace is None else int(self._pace["stride"])

    def _begin(self, pace: Mapping[str, Any]) -> None:
        """Begin the span and write the row for the reset."""
        action, start = self._action, self._start
        self._track.pace, self._track.action = pace, action
        self._pace = pace
        facts = {**self._facts, **self._parts(), **pace}
        if action is not None and action.given is not None:
            self._action_dtypes = [[0, _dtype_name(action.given)]]
            facts["action_dtypes"] = self._action_dtypes
        dtype = _row_dtype(
            state=None if start is None else start.state,
            snapshot=None if start is None else start.snapshot,
            action=None if action is None else action.kind,
            observation=None if self._observation is None else self._observation.kind,
        )
        span = self._track.logs.begin(self._name, facts, dtype, alone=self._is_alone)
        try:
            own = None if start is None else start.model_fields
            for fields in (own, self._first_change):
                if fields:
                    span.log.add_change(ModelChange(step=0, fields=fields))
            slot = span.make_room()
            for part, column in span.log.columns.items():
                if part in self._first:
                    column[slot] = self._first[part]
            span.commit(0, is_frame=self._takes_frames)
            self._span = span
        except BaseException:
            # A video without its first frame would show nothing.
            span.drop()
            raise

    def _write_state(self, span: SpanWriter, slot: int, *, has_frame: bool) -> None:
        if "state" not in span.log.columns:
            return
        state = span.log.columns["state"][slot]
        state[...] = np.nan
        if not has_frame or self._capture is None:
            return
        try:
            self._capture.capture_state(state)
        except PicturesDiffer:
            # The environment has switched to a different simulation.
            self._capture = None
            raise

    def _write_snapshot(self, span: SpanWriter, slot: int, number: int) -> bool:
        """Write the changed fields and a snapshot; return whether one was written."""
        capture = self._capture
        if capture is None:
            return False
        if self._takes_frames:
            snapshot = span.log.columns["snapshot"][slot]
            changed = capture.capture_snapshot(snapshot)
        else:
            changed = capture.changed_fields()
        if changed:
            span.log.add_change(ModelChange(step=number, fields=changed))
        return self._takes_frames

    def _parts(self) -> dict[str, Any]:
        """Return the names and shapes of the arrays that were joined into a vector."""
        arrays = {"action": self._action, "observation": self._observation}
        return {
            f"{name}_parts": [
                [part, list(shape)] for part, shape in array.parts.items()
            ]
            for name, array in arrays.items()
            if array is not None and array.parts is not None
        }

    def _use_action(self, array: StepArray | None) -> None:
        self._action = array
        if array is not None:
            array.on_other_dtype = self._note_action_dtype

    def _note_action_dtype(self) -> None:
        if self._span is not None and self._action is not None:
            given = self._action.given
            assert given is not None
            before = [each for each in self._action_dtypes if each[0] < self.steps]
            self._action_dtypes = [*before, [self.steps, _dtype_name(given)]]
            self.note(action_dtypes=self._action_dtypes)

    def _note_irregular(self, what: str) -> None:
        if what not in self._irregular:
            self._irregular.add(what)
            self.note(**{f"irregular_{what}_from": self.steps})
            logger.warning(
                "%s: from step %d on, the %s have a different type or shape and are "
                "recorded as zeros.",
                self._track.logs.path_of(self._name).name,
                self.steps,
                what,
            )

    def _measured_pace(self, now: float | None) -> Mapping[str, Any]:
        """Return the rate, the first step's measured time, and the frame stride.

        Args:
            now: the simulated time after the first step.
        """
        began = self._first_time
        if began is None or now is None or now <= began:
            return _pace(self._run.env.declared(), None, self._max_fps)
        return _measured(now - began, self._max_fps)


def _pace(
    rate: Fraction, timestep: Fraction | None, max_fps: float | Fraction | None
) -> Mapping[str, Any]:
    return {
        "rate": str(rate),
        "timestep": None if timestep is None else str(timestep),
        "stride": stride_for(rate, max_fps),
    }


# Cached because dtypes are slow to compare unless they are the same object.
_row_dtype = functools.lru_cache(maxsize=16)(row_dtype)

# Cached because NumPy builds the name on each access.
_dtype_name = functools.lru_cache(maxsize=16)(lambda dtype: str(dtype.name))


# Cached because fractions are slow and the same few values recur in each episode.
@functools.lru_cache(maxsize=64)
def _measured(seconds: float, max_fps: float | Fraction | None) -> Mapping[str, Any]:
    rate = rate_from_timestep(seconds)
    return _pace(rate, 1 / rate, max_fps)


class DeferredVideo:
    """A video that is rendered later, in place of a `VideoRecorder`.

    Its frames are recorded snapshots. Its files are written when the video is rendered.
    The monitor's `close` waits for that.

    Args:
        directory: the video's directory.
        name: the video's name, without extension.
        states: the episode's states.

    Attributes:
        path: the video, once rendered.
        metadata_path: the video's metadata file, once rendered.
        enabled: always True.
    """

    enabled = True
    ansi_mode = False

    def __init__(self, directory: Path, name: str, states: StateRecorder) -> None:
        self.path = f"{directory}/{name}.mp4"
        self.metadata_path = f"{directory}/{name}.meta.json"
        self._states = states

    @property
    def broken(self) -> bool:
        """Whether frame recording ended early. Earlier frames are still rendered."""
        return self._states.broken_reason is not None

    @property
    def functional(self) -> bool:
        """Whether frames are (or were) recorded, the opposite of `broken`."""
        return not self.broken

    @property
    def frame_count(self) -> int:
        """The number of frames recorded so far."""
        return self._states.frame_count

    @property
    def empty(self) -> bool:
        """Whether no frame has been recorded."""
        return self.frame_count == 0

    @property
    def finished(self) -> bool:
        """Whether the video has been rendered completely and exists."""
        return Path(self.path).exists() and Path(self.metadata_path).exists()
