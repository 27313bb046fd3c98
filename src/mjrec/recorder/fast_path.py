# SPDX-License-Identifier: Apache-2.0
"""The fast path for recording ordinary steps.

A step of a fast simulation takes as long as a few hundred lines of Python. Nearly all
steps change only the state: there is no error, the episode does not end, and the model
and the view stay the same. While a recorder has a `FastPath`, the functions in it are
called instead of `Recorder.before_step` and `Recorder.step`. If one returns False, it
has recorded nothing, and the caller must call the recorder's method of the same name.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import FileNotWritten
from ..formats.row_log import TAIL_HEAD, RowLog
from ..formats.span_writer import SpanWriter
from ..formats.trajectory import FRAME, HEAD_WORDS, STEP, TERMINATED, TRUNCATED
from ..simulation.raw_memory import WORDS
from .stats_recorder import StatsRecorder

# Rewards are usually NumPy's float64, and `+` would make the sum a float64 as well.
_sum = float.__add__
# A float can represent every integer up to this one exactly.
_LARGEST = 1 << 53


class FastPath(NamedTuple):
    """The functions that record nearly all steps.

    Attributes:
        before_step: stores the action and returns whether a step may be taken.
        step: counts and records a step, given its reward and the keywords `terminated`
            and `truncated`. It returns False if the step is unusual and was not
            recorded. The recorder itself handles the end of an episode.
    """

    before_step: Callable[[Any], bool]
    step: Callable[..., bool]


def counting(stats: StatsRecorder) -> FastPath:
    """Return a fast path that only counts steps and rewards."""

    def before_step(action: Any) -> bool:
        # Other code may have ended the episode or its recording.
        return stats.done is False and not stats.closed

    def step(reward: Any, *, terminated: bool = False, truncated: bool = False) -> bool:
        if not isinstance(reward, float):
            return False
        total = _sum(reward, stats.rewards)  # type: ignore[arg-type]
        # There are no calls below, because a signal handler could raise after a call.
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
    is_on_pace: Callable[[float], bool],
    stride: int,
) -> FastPath:
    """Return a fast path that records each step with a single memory copy.

    Args:
        stats: the recorder that counts the steps.
        span: the recording, which already has its first row.
        words: indices into `WORDS` for the content of a row after its head.
        set_action: a function that copies the action into the gathered memory. It
            returns False if the type or shape of the action differs from before.
        is_current: a function that returns, after a step, whether only the state has
            changed.
        is_on_pace: a function that returns, given the time after the first step,
            whether the step took the expected simulated time.
        stride: number of steps per frame. The last step always gets a frame.
    """
    log, bodies = span.log, span.log.bodies
    take, both = WORDS.take, STEP | FRAME
    # Between steps, the simulation evicts our code from the CPU's caches. In that case,
    # assigning an item is cheaper than using `struct`.
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
        number, slot = span.steps + 1, row % capacity
        take(words, None, bodies[slot], "clip")
        head = first + slot * width
        # A row's content begins with the state, which begins with the time.
        if number == 1 and not is_on_pace(floats[head + HEAD_WORDS]):
            return False
        is_last = terminated or truncated
        is_frame = is_last or number % stride == 0
        flags = both if is_frame else STEP
        if is_last:
            flags |= TERMINATED * terminated | TRUNCATED * truncated
        whole[head], whole[head + 1], whole[head + 3] = row, number, flags
        floats[head + 2] = reward
        total = _sum(reward, stats.rewards)  # type: ignore[arg-type]
        # There are no calls below, because a signal handler could raise after a call.
        # The counters would then not match the rows.
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
    """Write a full tail to the log, and return whether it has room for the next row."""
    # If the disk is full, the recorder tries again and reports the error.
    with contextlib.suppress(FileNotWritten):
        log.make_room()
    return log.count < log.limit
