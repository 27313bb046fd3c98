# SPDX-License-Identifier: Apache-2.0
"""The fast path: recording steps that change nothing but the state.

A step of a fast simulation takes as long as a few hundred lines of Python. Nearly all
steps are alike: no error, no end, the same model, the same view. While a recorder has a
`FastPath`, its functions are called instead of `Recorder.before_step` and
`Recorder.step`. If one of them returns False, nothing was recorded, and the caller must
call the recorder's method of that name.
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

# Rewards are usually NumPy's float64, and `+` would turn the sum into one, too.
_sum = float.__add__
# Floats represent every integer exactly up to here.
_LARGEST = 1 << 53


class Step(Protocol):
    """A function that records and counts a step, given its reward."""

    def __call__(
        self, reward: Any, *, terminated: bool = ..., truncated: bool = ...
    ) -> bool:
        """Return False if the step is unusual and was not recorded."""


class FastPath(NamedTuple):
    """The functions that record nearly all steps.

    Attributes:
        before_step: notes the action and returns whether a step may be taken.
        step: records a step. The recorder itself handles the end of the episode.
    """

    before_step: Callable[[Any], bool]
    step: Step


def counting(stats: StatsRecorder) -> FastPath:
    """Return a fast path that only counts steps and rewards."""

    def before_step(action: Any) -> bool:
        # The episode, or its recording, may have been ended elsewhere.
        return stats.done is False and not stats.closed

    def step(reward: Any, *, terminated: bool = False, truncated: bool = False) -> bool:
        if not isinstance(reward, float):
            return False
        total = _sum(reward, stats.rewards)  # type: ignore[arg-type]
        # No calls from here on, because a signal handler could raise after a call.
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
    """Return a fast path that records each step with one copy of memory.

    Args:
        stats: counts the steps.
        span: the recording, which already has its first row.
        words: indices into `WORDS` of a row's content after its head.
        set_action: copies the action into the gathered memory; returns False if the
            action has a different type or shape than before.
        is_current: returns, after a step, whether nothing but the state has changed.
        is_on_pace: returns, after the first step, whether it took the expected
            simulated time.
        stride: steps that are multiples of it get a frame, and so does the last step.
    """
    log, bodies = span.log.rows, span.log.bodies
    take, both = WORDS.take, STEP | FRAME
    # The simulation evicts our code from the CPU's caches; then assigning an item is
    # cheaper than `struct`.
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
        # No calls from here on, because a signal handler could raise after a call, and
        # the counters would not match the rows.
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
    """Write a full tail to the log; return whether the next row may stay in it."""
    # On a full disk the recorder tries again and reports it.
    with contextlib.suppress(FileNotWritten):
        log.make_room()
    return log.count < log.limit
