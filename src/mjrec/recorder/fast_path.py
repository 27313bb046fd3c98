# SPDX-License-Identifier: Apache-2.0
"""Recording steps after which nothing but the state is new.

A fast simulation's step takes as long as some hundred lines of Python. Nearly all steps
are alike: no error, no end, the same model, the same view. A `FastPath` stands in place
of `Recorder.before_step` and `Recorder.step` for as long as the recorder has one. Where
one of its functions returns False nothing was recorded, and the recorder's method of
that name is to be called.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import FileNotWritten
from ..formats.row_log import TAIL_HEAD, RowLog
from ..formats.span_writer import SpanWriter
from ..formats.trajectory import FRAME, STEP, TERMINATED, TRUNCATED
from ..simulation.raw_memory import WORDS
from .stats_recorder import StatsRecorder

# Rewards are NumPy's float64 as a rule: `+` would make one of the sum, too.
_sum = float.__add__
# A float has each integer up to here, and one far beyond it is no float.
_LARGEST = 1 << 53


class Step(Protocol):
    """Records a step by its reward, and counts it."""

    def __call__(
        self, reward: Any, *, terminated: bool = ..., truncated: bool = ...
    ) -> bool:
        """Return False where it is not usual, and nothing was recorded."""


class FastPath(NamedTuple):
    """What nearly all steps are recorded with.

    Attributes:
        before_step: notes the action, and tells whether a step may be taken.
        step: records a step. That the episode is over by it is the recorder's to say.
    """

    before_step: Callable[[Any], bool]
    step: Step


def counting(stats: StatsRecorder) -> FastPath:
    """Return what counts steps and records nothing else."""

    def before_step(action: Any) -> bool:
        # Others may have ended the episode, or its recording.
        return stats.done is False and not stats.closed

    def step(reward: Any, *, terminated: bool = False, truncated: bool = False) -> bool:
        if not isinstance(reward, float):
            return False
        total = _sum(reward, stats.rewards)  # type: ignore[arg-type]
        # No call from here on, behind which a signal's handler could raise.
        stats.rewards = total
        stats.steps += 1  # type: ignore[operator]
        stats.total_steps += 1
        return True

    return FastPath(before_step, step)


def gathering(
    stats: StatsRecorder,
    span: SpanWriter,
    words: NDArray[np.intp],
    *,
    set_action: Callable[[Any], bool],
    is_current: Callable[[], bool],
    is_on_pace: Callable[[], bool],
    stride: int,
) -> FastPath:
    """Return what records steps with one copy of memory each.

    Args:
        stats: counts the steps.
        span: the recording, which has its first row.
        words: those of a row but its head, in `WORDS`.
        set_action: puts the action into the memory that is gathered; False where it is
            not like those before.
        is_current: tells, after the step, whether nothing but the state is new.
        is_on_pace: tells, after the first step, whether it lasted as long as supposed.
        stride: only its multiples have a frame.
    """
    log, bodies = span.log.rows, span.log.bodies
    take, both = WORDS.take, STEP | FRAME
    # Code that simulates leaves little of ours in a CPU's caches: an item costs less
    # there than `struct` does.
    whole, floats = memoryview(log.memory).cast("q"), memoryview(log.memory).cast("d")
    capacity, width, first = log.capacity, log.row_size // 8, TAIL_HEAD // 8

    def before_step(action: Any) -> bool:
        return stats.done is False and not stats.closed and set_action(action)

    def step(reward: Any, *, terminated: bool = False, truncated: bool = False) -> bool:
        row = log.count
        if (row >= log.limit and not _makes_room(log)) or not is_current():
            return False
        if not isinstance(reward, float):
            if type(reward) is not int or abs(reward) > _LARGEST:
                return False
            reward = float(reward)
        number = span.steps + 1
        if number == 1 and not is_on_pace():
            return False
        slot = row % capacity
        take(words, None, bodies[slot], "clip")
        is_last = terminated or truncated
        is_frame = is_last or number % stride == 0
        flags = both if is_frame else STEP
        if is_last:
            flags |= TERMINATED * terminated | TRUNCATED * truncated
        head = first + slot * width
        whole[head], whole[head + 1], whole[head + 3] = row, number, flags
        floats[head + 2] = reward
        total = _sum(reward, stats.rewards)  # type: ignore[arg-type]
        # No call from here on, behind which a signal's handler could raise: what is
        # counted is what is there.
        whole[0] = log.count = row + 1
        span.steps = number
        if is_frame:
            span.last_frame = number
            span.frame_count += 1
        stats.rewards = total
        stats.steps += 1  # type: ignore[operator]
        stats.total_steps += 1
        return True

    return FastPath(before_step, step)


def _makes_room(log: RowLog) -> bool:
    """Write a full tail away; return False where rows do not stay in it, or cannot."""
    # On a full disk the recorder tries again, and says so.
    with contextlib.suppress(FileNotWritten):
        log.make_room()
    return log.count < log.limit
