# SPDX-License-Identifier: Apache-2.0
"""A recording: it begins at a state, takes rows, and ends with facts.

An episode is one; a clip is one for each episode that it is of.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileNotWritten, PicturesDiffer
from ..formats.span_writer import SpanLogs, SpanWriter
from ..formats.trajectory import ModelChange, row_dtype
from ..rates import rate_from_timestep, stride_for
from ..simulation.raw_memory import words_of
from .fast_path import FastPath, gathering
from .monitored_run import MonitoredRun
from .run_journal import What
from .step_arrays import StepArray, action_array, step_array

if TYPE_CHECKING:
    from ..simulation.capture import Capture, EpisodeStart

logger = logging.getLogger(__name__)


class Recording:
    """Records the states of an episode, or of a part of one: a row a step.

    It begins in the log with the first `step`, because only then it is known what an
    action is and how long a step takes, or with `end`: a reset that another reset
    replaces leaves nothing. Frames are steps 0, n, 2n ... where n is the smallest
    stride that keeps `max_fps`, and always the last one.

    What goes wrong ends here. Where no picture can be made any more, the frames end
    and the states go on. Where nothing can be written any more, the recording ends
    there: an error, unless `on_error` has it that the simulation goes on.

    Args:
        run: of which it is.
        name: of the file that it becomes, without suffix.
        logs: where its rows go.
        what: is lost where they cannot be written.
        facts: what is known at its beginning.
        states: of the simulation; None where there is none that can be seen.
        start: what `states.begin_episode` returned.
        max_fps: the most frames per second that are wanted; None for every step.
        observation: of the reset; None where observations are not recorded.
        is_alone: it may be deleted alone: it gets a log of its own.

    Attributes:
        path: of the file that it becomes.
        is_stopped: nothing more is recorded, after an error.
        broken_reason: why there are no frames any more; None while there are.
    """

    def __init__(
        self,
        run: MonitoredRun,
        name: str,
        *,
        logs: SpanLogs,
        what: What,
        facts: Mapping[str, Any],
        states: Capture | None,
        start: EpisodeStart | None,
        max_fps: float | Fraction | None = None,
        observation: Any = None,
        is_alone: bool = False,
    ) -> None:
        self.path = logs.path_of(name)
        self.is_stopped = False
        self.broken_reason: str | None = None
        self._run = run
        self._name = name
        self._logs = logs
        self._what = what
        self._facts = facts
        self._states = states
        self._start = start
        self._max_fps = max_fps
        self._is_alone = is_alone
        self._state = None if start is None else start.state
        self._snapshot = None if start is None else start.snapshot
        self._takes_frames = self._snapshot is not None
        self._stride = 1
        self._span: SpanWriter | None = None
        self._fast: FastPath | None = None
        self._irregular: set[str] = set()
        self._action: StepArray | None = None
        # From which step on they were given as what.
        self._action_dtypes: list[list[Any]] = []
        self._observation = None if observation is None else step_array(observation)
        # What belongs to step 0 waits here until there is a span.
        self._first_state = np.full(_words(self._state), np.nan)
        self._first_snapshot = np.empty(_words(self._snapshot), np.uint64)
        self._first_observation = None
        if self._observation is not None:
            self._observation.set(observation)
            self._first_observation = self._observation.values.copy()
        self._first_change: Mapping[str, NDArray[Any]] | None = None
        self._first_time = run.subject.clock()
        if states is not None:
            states.capture_state(self._first_state)
            if self._takes_frames:
                self._first_change = states.capture_snapshot(self._first_snapshot)

    @property
    def is_there(self) -> bool:
        """Whether the log has something of it."""
        return self._span is not None

    @property
    def steps(self) -> int:
        """How many steps were recorded."""
        return 0 if self._span is None else self._span.steps

    @property
    def frame_count(self) -> int:
        """How many snapshots were taken."""
        return 0 if self._span is None else self._span.frame_count

    @property
    def size(self) -> int:
        """The bytes of its rows."""
        return 0 if self._span is None else self._span.size

    def before_step(self, action: Any) -> None:
        """Note the action of the coming step, which the environment may overwrite."""
        if self.is_stopped:
            return
        if self._span is None and action is not None:
            self._action = self._array_for(action)
        if self._action is None and action is None:
            # A clip's: what was done is in the episode's.
            return
        if self._action is None or not self._action.set(action):
            self._note_irregular("actions")
            where = {"episode_id": self._run.episode.episode_id, "step": self.steps}
            given = {"dtype": action.dtype.name} if hasattr(action, "dtype") else {}
            self._run.journal.note("action", {**where, **given, "value": action})

    def step(
        self,
        reward: float,
        *,
        terminated: bool,
        truncated: bool,
        observation: Any = None,
        is_last: bool = False,
        has_picture: bool = True,
    ) -> None:
        """Record what the environment is like after a step.

        Where there is no state to be had, the step is in the log without one.

        Args:
            reward: of the step.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            observation: after the step; only where observations are recorded.
            is_last: it is the last one, and gets a frame.
            has_picture: False where the environment has reset itself already: its
                state is the next episode's.

        Raises:
            FileNotWritten: the disk is full, and that is not tolerated. The step was
                not recorded, and all before it is kept.
        """

        def take_row() -> None:
            if self._observation is not None and not self._observation.set(observation):
                self._note_irregular("observations")
            span = self._span or self._begin()
            number, slot = span.steps + 1, span.make_room()
            is_frame = False
            try:
                self._write_state(span, slot, has_picture=has_picture)
                if has_picture and (is_last or number % self._stride == 0):
                    is_frame = self._write_snapshot(span, slot, number)
            finally:
                # Whatever was raised: a missing step would be the end of the log.
                self._write_arrays(span, slot)
                span.commit(
                    number,
                    reward,
                    is_frame=is_frame,
                    terminated=terminated,
                    truncated=truncated,
                )

        self._try(take_row)

    def take_frame(self) -> None:
        """Take the snapshot of this moment, unless there is one of it already.

        Raises:
            FileNotWritten: the disk is full, and that is not tolerated.
        """

        def take() -> None:
            span = self._span
            if span is not None and span.last_frame != span.steps:
                slot = span.make_room()
                if self._write_snapshot(span, slot, span.steps):
                    span.commit(span.steps, is_step=False, is_frame=True)

        self._try(take)

    def fast_path(self) -> FastPath | None:
        """Return what usual steps can be recorded with; None where there are none."""
        if self.is_stopped or not self._takes_frames or self._observation is not None:
            return None
        if self._fast is None and self._span is not None:
            self._fast = self._new_fast_path(self._span)
        return self._fast

    def end_frames(self, reason: str) -> None:
        """Take no more snapshots, and say why."""
        self._takes_frames = False
        self._break(reason)
        logger.warning(
            "The frames of %s end early, at step %d: %s", self._name, self.steps, reason
        )

    def note(self, **facts: Any) -> None:
        """Add to its facts."""
        if self._span is None:
            self._facts = {**self._facts, **facts}
        else:
            self._span.note(facts)

    def end(self, facts: Mapping[str, Any]) -> None:
        """Write what is known of its end; what the first call says counts.

        Raises:
            FileNotWritten: the disk is full, and that is not tolerated; the next call
                tries again.
        """
        # It holds the log's memory.
        self._fast = None
        try:
            (self._span or self._begin()).end(facts)
            if self._is_alone:
                self._logs.close()
        except FileNotWritten as error:
            self._break(str(error))
            if not self._run.tolerates(self._what, error):
                raise

    def discard(self) -> None:
        """Leave nothing."""
        if self._span is not None:
            self._span.drop()
            if self._is_alone:
                self._logs.close()

    def add(self, facts: Mapping[str, Any]) -> None:
        """Add to its facts, also after its end.

        Raises:
            FileNotWritten: the disk is full.
        """
        if self._span is not None:
            self._span.add(facts)

    def remove(self) -> None:
        """Give up its rows, after its end.

        Raises:
            FileNotWritten: the disk is full.
            DirectoryNotWritable: files cannot be removed.
        """
        if self._span is not None:
            self._span.remove()

    def _try(self, take: Callable[[], None]) -> None:
        if self.is_stopped:
            return
        try:
            take()
        except PicturesDiffer as error:
            self.end_frames(str(error))
        except FileNotWritten as error:
            self.is_stopped = True
            self._break(str(error))
            if not self._run.tolerates(self._what, error):
                raise

    def _break(self, reason: str) -> None:
        self.broken_reason = reason
        self.note(broken_reason=reason)

    def _new_fast_path(self, span: SpanWriter) -> FastPath | None:
        start, action = self._start, self._action
        # Of another size the last word would have what stands behind it in memory.
        if start is None or start.words is None or action is None or action.size % 8:
            return None
        known = self._run.row_words
        if known is None or known[0] is not start.words or known[1] is not action:
            words = np.concatenate([start.words, words_of([action.values])])
            self._run.row_words = known = start.words, action, words
        return gathering(
            self._run.stats,
            span,
            known[2],
            set_action=action.set,
            is_current=start.is_current,
            stride=self._stride,
        )

    def _begin(self) -> SpanWriter:
        action, observation = self._action, self._observation
        dtype = _row_dtype(
            state=self._state,
            snapshot=self._snapshot,
            action=None if action is None else action.kind,
            observation=None if observation is None else observation.kind,
        )
        facts = {**self._facts, **self._parts(), **self._measured_pace()}
        if action is not None and action.given is not None:
            facts["action_dtypes"] = self._action_dtypes = [[0, action.given.name]]
        span = self._logs.begin(self._name, facts, dtype, alone=self._is_alone)
        try:
            own = None if self._start is None else self._start.model_fields
            for fields in (own, self._first_change):
                if fields:
                    span.log.add_change(ModelChange(step=0, fields=fields))
            columns, slot = span.log.columns, span.make_room()
            for part, first in (
                ("state", self._first_state),
                ("snapshot", self._first_snapshot),
            ):
                if part in columns:
                    columns[part][slot] = first
            if self._action is not None:
                columns["action"][slot] = 0
            if self._first_observation is not None:
                columns["observation"][slot] = self._first_observation
            span.commit(0, is_frame=self._takes_frames)
            self._span = span
        except BaseException:
            # Without its first frame it would promise a video of nothing.
            span.drop()
            raise
        return span

    def _write_state(self, span: SpanWriter, slot: int, *, has_picture: bool) -> None:
        if "state" not in span.log.columns:
            return
        state = span.log.columns["state"][slot]
        state[...] = np.nan
        if not has_picture or self._states is None:
            return
        try:
            self._states.capture_state(state)
        except PicturesDiffer:
            # It is another simulation from here on.
            self._states = None
            raise

    def _write_snapshot(self, span: SpanWriter, slot: int, number: int) -> bool:
        """Write the snapshot of this moment, and what has changed; tell whether so."""
        states = self._states
        if states is None:
            return False
        if self._takes_frames:
            snapshot = span.log.columns["snapshot"][slot]
            changed = states.capture_snapshot(snapshot)
        else:
            changed = states.changed_fields()
        if changed:
            span.log.add_change(ModelChange(step=number, fields=changed))
        return self._takes_frames

    def _write_arrays(self, span: SpanWriter, slot: int) -> None:
        columns = span.log.columns
        if self._action is not None:
            columns["action"][slot] = self._action.values
        if self._observation is not None:
            columns["observation"][slot] = self._observation.values

    def _parts(self) -> dict[str, Any]:
        """Return what dictionaries were made into one vector from."""
        arrays = {"action": self._action, "observation": self._observation}
        return {
            f"{name}_parts": [
                [part, list(shape)] for part, shape in array.parts.items()
            ]
            for name, array in arrays.items()
            if array is not None and array.parts is not None
        }

    def _array_for(self, action: Any) -> StepArray | None:
        """Return memory for actions like the first: that of before, where it fits."""
        array = self._run.action
        if array is not None:
            array.on_other_dtype = self._note_action_dtype
        if array is None or not array.set(action):
            array = action_array(action)
            self._run.action = array or self._run.action
            if array is not None:
                array.on_other_dtype = self._note_action_dtype
        return array

    def _note_action_dtype(self) -> None:
        if self._span is not None and self._action is not None:
            given = self._action.given
            assert given is not None
            self._action_dtypes = [*self._action_dtypes, [self.steps, given.name]]
            self.note(action_dtypes=self._action_dtypes)

    def _note_irregular(self, what: str) -> None:
        if what not in self._irregular:
            self._irregular.add(what)
            self.note(**{f"irregular_{what}_from": self.steps})
            logger.warning(
                "%s: from step %d on the %s are not like those before and are recorded "
                "as zeros.",
                self.path.name,
                self.steps,
                what,
            )

    def _measured_pace(self) -> Mapping[str, Any]:
        """Measure the time of a step over the first one, and choose the stride."""
        began, now = self._first_time, self._run.subject.clock()
        if began is None or now is None or now <= began:
            facts = _pace(self._run.subject.declared(), None, self._max_fps)
        else:
            facts = _measured(now - began, self._max_fps)
        self._stride = facts["stride"]
        return facts


def _pace(
    rate: Fraction, timestep: Fraction | None, max_fps: float | Fraction | None
) -> Mapping[str, Any]:
    return {
        "rate": str(rate),
        "timestep": None if timestep is None else str(timestep),
        "stride": stride_for(rate, max_fps),
    }


# Mostly of one kind in all episodes; that two dtypes are one is told at once then.
_row_dtype = functools.lru_cache(maxsize=8)(row_dtype)


# Of the same few steps in each episode; fractions take Python long.
@functools.lru_cache(maxsize=64)
def _measured(seconds: float, max_fps: float | Fraction | None) -> Mapping[str, Any]:
    rate = rate_from_timestep(seconds)
    return _pace(rate, 1 / rate, max_fps)


def _words(kind: np.dtype[Any] | None) -> int:
    return 0 if kind is None else kind.itemsize // 8


class DeferredVideo:
    """Stands where a `VideoRecorder` stands when pictures are drawn live.

    Its frames are the snapshots of a recording. The files come when somebody has
    rendered them, which the monitor's `close` waits for.

    Args:
        base_path: the video's path without extension.
        recording: of the episode.

    Attributes:
        path: the video, once it is rendered.
        metadata_path: its metadata, likewise.
        enabled: True.
    """

    enabled = True
    ansi_mode = False

    def __init__(self, base_path: Path, recording: Recording) -> None:
        self.path = f"{base_path}.mp4"
        self.metadata_path = f"{base_path}.meta.json"
        self._recording = recording

    @property
    def broken(self) -> bool:
        """Whether no more frames could be taken; those before are rendered."""
        return self._recording.broken_reason is not None

    @property
    def functional(self) -> bool:
        """Whether frames are (or were) recorded: not broken."""
        return not self.broken

    @property
    def frame_count(self) -> int:
        """The number of frames recorded so far."""
        return self._recording.frame_count

    @property
    def empty(self) -> bool:
        """Whether there is no frame."""
        return self.frame_count == 0

    @property
    def finished(self) -> bool:
        """Whether the video has been rendered and is there, whole."""
        return Path(self.path).exists() and Path(self.metadata_path).exists()
