# SPDX-License-Identifier: Apache-2.0
"""Writing down the states of one episode while it runs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PicturesDiffer
from ..formats.trajectory import Array, ModelChange, RowLayout, TrajectoryHeader
from ..formats.trajectory_log import RowFormat, TrajectoryLogWriter
from ..rates import rate_from_timestep, stride_for
from ..simulation.state_source import EpisodeStart, StateSource
from .step_arrays import StepArray, action_array, step_array

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How simulated time becomes frames.

    Attributes:
        clock: returns the simulated time in seconds, or None where there is none.
        declared: returns the steps per second to take where it cannot be measured.
        max_fps: the most frames per second that are wanted; None for every step.
    """

    clock: Callable[[], float | None]
    declared: Callable[[], Fraction]
    max_fps: float | Fraction | None = None


@dataclass(frozen=True, kw_only=True)
class MomentCopier:
    """Copies steps and their frames from the simulation's own memory.

    For a step that did not end its episode and left a picture.
    `TrajectoryRecorder.step` does the same, and more that is rarely needed.

    Attributes:
        set_action: notes the action before the step; False where it is not like those
            before.
        can_copy: tells, after the step, whether nothing but the state is new.
        copy_step: copies a step; called with its number and its reward.
        copy_moment: copies a step and its frame; likewise.
        stride: only steps of which this is a factor have a frame.
        log: has them then, and counts them.
    """

    set_action: Callable[[Any], bool]
    can_copy: Callable[[], bool]
    copy_step: Callable[[int, float], None]
    copy_moment: Callable[[int, float], None]
    stride: int
    log: TrajectoryLogWriter


class TrajectoryRecorder:
    """Writes the trajectory of one episode: a state a step, a snapshot a frame.

    The log is made by the first `step`, because only then it is known what an action
    is, or by `end`: a reset that another reset replaces leaves nothing.

    Frames are steps 0, n, 2n ... where n is the smallest stride that keeps `max_fps`,
    and always the last one.

    Args:
        path: of the log.
        facts: what is known of the episode, for the header.
        states: of the simulation; None where there is none that can be seen.
        start: what `states.begin_episode` returned.
        pace: how simulated time becomes frames.
        observation: of the reset; None where observations are not recorded.
        rows: what those of the trajectory before are like, if there was one.

    Attributes:
        path: of the log, which is there after the first step.
        copier: for the usual steps; None where each needs a closer look.
        is_stopped: nothing more of the episode is recorded, after an error.
        rows: what they are like, once there is a log.
    """

    def __init__(
        self,
        path: Path,
        *,
        facts: Mapping[str, Any],
        states: StateSource | None,
        start: EpisodeStart | None,
        pace: Pace,
        observation: Any = None,
        rows: RowFormat | None = None,
    ) -> None:
        self.path = path
        self.rows = rows
        self.copier: MomentCopier | None = None
        self._facts = facts
        self._states = states
        self._start = start or _NOTHING
        self._pace = pace
        self._state_bytes = 8 * sum(c.length for c in self._start.state)
        self._takes_frames = bool(self._start.snapshot.fields)
        self._stride = 1
        self._log: TrajectoryLogWriter | None = None
        self._ended = False
        self._is_told = False
        self.is_stopped = False
        # What a row holds behind its state; and a state where there is none.
        self._behind_state: tuple[memoryview, ...] = ()
        self._no_state = np.full(self._state_bytes // 8, np.nan).tobytes()
        self._irregular: set[str] = set()
        self._action: StepArray | None = None
        self._observation = None if observation is None else step_array(observation)
        # What belongs to step 0 waits here until there is a log.
        self._first_state = self._no_state
        self._snapshot = np.empty(self._start.snapshot.size, np.uint8)
        self._first_observation = _bytes_of(self._observation, observation)
        self._first_change: Mapping[str, NDArray[Any]] | None = None
        self._first_time = pace.clock()
        self._take_first()

    @property
    def is_there(self) -> bool:
        """Whether there is a file, with as much as could be written."""
        return self._log is not None and self._log.is_there

    @property
    def steps(self) -> int:
        """How many steps were recorded."""
        return 0 if self._log is None else self._log.steps

    @property
    def frame_count(self) -> int:
        """How many snapshots were taken."""
        return 0 if self._log is None else self._log.frame_count

    @property
    def last_frame(self) -> int:
        """The step of the last one; -1 before."""
        return -1 if self._log is None else self._log.last_frame

    def before_step(self, action: Any) -> None:
        """Note the action of the coming step, which the environment may overwrite."""
        if self.is_stopped:
            return
        if self._log is None:
            self._action = action_array(action)
            self._begin_log()
        if self._action is not None and not self._action.set(action):
            self._note_irregular("actions")

    def note(self, **facts: Any) -> None:
        """Add to the facts of the episode."""
        if self._log is None:
            self._facts = {**self._facts, **facts}
        else:
            self._log.add_facts(facts)

    def stop_frames(self, reason: str) -> None:
        """Take no more snapshots, and say why."""
        self._takes_frames = False
        self.copier = None
        self.note(broken_reason=reason)

    def stop(self, reason: str) -> None:
        """Record nothing more of the episode, and say why; what was recorded stays."""
        self.is_stopped = True
        self.copier = None
        self.note(broken_reason=reason)

    def step(
        self,
        reward: float,
        terminated: bool,
        truncated: bool,
        observation: Any,
        is_last: bool,
        has_picture: bool,
    ) -> None:
        """Record what the environment is like after a step.

        Where there is no state to be had, the step is in the log without one.

        Args:
            reward: of the step.
            terminated: the task ended the episode.
            truncated: a limit from outside the task ended it.
            observation: after the step; only where observations are recorded.
            is_last: the episode is over.
            has_picture: False where the environment has reset itself already: its
                state is the next episode's.

        Raises:
            FileNotWritten: the disk is full; the step was not recorded, and all before
                it is kept.
            PicturesDiffer: no picture of this moment can be made from its state.
        """
        if self.is_stopped:
            return
        log = self._log
        assert log is not None, "before_step was not called"
        if self._observation is not None and not self._observation.set(observation):
            self._note_irregular("observations")
        number = self.steps + 1
        state: bytes | memoryview = self._no_state
        try:
            if has_picture and self._states is not None:
                state = self._states.capture_state()
        except PicturesDiffer:
            # It is another simulation from here on.
            self._states = None
            raise
        finally:
            # Whatever was raised: a step that is missing would be the end of the log.
            row = (state, *self._behind_state)
            log.add_step(number, reward, terminated, truncated, row)
        if number == 1:
            self._settle_pace(log)
        if has_picture and (is_last or number % self._stride == 0):
            self.take_frame()

    def take_frame(self) -> None:
        """Take the snapshot of this moment, unless there is one of it already.

        Raises:
            PicturesDiffer: no picture of this moment can be made from its state.
        """
        log, states, number = self._log, self._states, self.steps
        if log is None or states is None or self.last_frame == number:
            return
        if self.is_stopped:
            return
        if not self._takes_frames:
            changed = states.changed_fields()
        else:
            changed = states.capture_snapshot(self._snapshot)
        if changed:
            # Before the frame that shows it.
            log.add_model_change(ModelChange(step=number, fields=changed))
        if self._takes_frames:
            log.add_frame(number, (self._snapshot.data,))

    def end(self, facts: Mapping[str, Any]) -> None:
        """Write what is known of the episode's end, and close the log. Idempotent.

        What the first call says counts, also where it could not be written.

        Raises:
            FileNotWritten: the disk is full; the next call tries again.
        """
        if self._ended:
            return
        if self._log is None:
            self._begin_log()
        assert self._log is not None
        if self.steps == 0:
            self._settle_pace(self._log)
        if not self._is_told:
            self._log.add_facts(facts)
            self._is_told = True
        self._log.close()
        self._ended = True

    def abandon(self) -> None:
        """Let go without writing what could not be written; what is there stays."""
        self._ended = True
        if self._log is not None:
            self._log.abandon()

    def discard(self) -> None:
        """Leave nothing."""
        self._ended = True
        if self._log is not None:
            self._log.discard()

    def _take_first(self) -> None:
        if self._states is None:
            return
        self._first_state = bytes(self._states.capture_state())
        if self._takes_frames:
            self._first_change = self._states.capture_snapshot(self._snapshot)

    def _begin_log(self) -> None:
        start = self._start
        log = TrajectoryLogWriter(
            self.path,
            TrajectoryHeader(
                facts={**self._facts, **self._parts()},
                state=start.state,
                snapshot=start.snapshot,
                action=_array_of(self._action),
                observation=_array_of(self._observation),
            ),
            rows=self.rows,
        )
        try:
            self._add_first(log)
            self._log = log
        except BaseException:
            # A signal's handler may have raised: without its first row and frame it
            # would promise a video of nothing. The end begins it anew.
            log.discard()
            raise

    def _add_first(self, log: TrajectoryLogWriter) -> None:
        self.rows = log.rows
        for fields in (self._start.model_fields, self._first_change):
            if fields:
                log.add_model_change(ModelChange(step=0, fields=fields))
        arrays = [array for array in (self._action, self._observation) if array]
        self._behind_state = tuple(array.bytes.data for array in arrays)
        no_action = bytes(0 if self._action is None else self._action.size)
        first = (self._first_state, no_action, self._first_observation)
        log.add_step(0, 0.0, False, False, first)
        if self._takes_frames:
            log.add_frame(0, (self._snapshot.data,))

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

    def _new_copier(self, log: TrajectoryLogWriter) -> MomentCopier | None:
        memory, action = self._start.memory, self._action
        if memory is None or action is None:
            return None
        if self._observation is not None or not self._takes_frames:
            return None
        row = (*memory.state, *self._behind_state)
        return MomentCopier(
            set_action=action.set,
            can_copy=memory.is_current,
            copy_step=log.steps_of(row),
            copy_moment=log.moments_of(row, memory.snapshot),
            stride=self._stride,
            log=log,
        )

    def _settle_pace(self, log: TrajectoryLogWriter) -> None:
        """Measure the time of a step over the first one, and choose the stride."""
        elapsed = _difference(self._first_time, self._pace.clock())
        rate = rate_from_timestep(elapsed) if elapsed else self._pace.declared()
        self._stride = stride_for(rate, self._pace.max_fps)
        self.copier = self._new_copier(log)
        log.add_facts(
            {
                "rate": str(rate),
                "timestep": str(1 / rate) if elapsed else None,
                "stride": self._stride,
            }
        )


_NOTHING = EpisodeStart(state=(), snapshot=RowLayout(), model={}, scene=None)


def _array_of(array: StepArray | None) -> Array | None:
    return None if array is None else array.kind


def _bytes_of(array: StepArray | None, value: Any) -> bytes:
    if array is None:
        return b""
    array.set(value)
    return array.bytes.tobytes()


def _difference(start: float | None, end: float | None) -> float | None:
    if start is None or end is None or end <= start:
        return None
    return end - start
