# SPDX-License-Identifier: Apache-2.0
"""What is written on the frames of a recorded episode."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ..annotation import Caption
from ..formats.trajectory import TrajectoryReader

_BLOCK_BYTES = 1 << 20


class Captions:
    """The captions of some frames of a trajectory, in their order.

    The return is the sum of the rewards up to the frame's step. The time is that of
    the simulation since the reset; where no states were recorded, so many steps; where
    it is not known how long these are, there is none. A part of a clip may begin in the
    midst of an episode, and says what was before it.

    Args:
        reader: of the trajectory; not used any more afterwards.
        indices: the numbers of the frames.

    Raises:
        UnreadableFile: the file is damaged.
    """

    def __init__(self, reader: TrajectoryReader, indices: Sequence[int]) -> None:
        facts = reader.header.facts
        self._episode_id = int(facts.get("episode_id") or 0)
        before = facts.get("clip") or {}
        steps = reader.frame_steps[list(indices)]
        self._steps: list[int] = (steps + before.get("steps_before", 0)).tolist()
        # One after the other, as the monitor adds them up.
        first = float(before.get("reward_before", 0.0))
        sums = np.cumsum(np.concatenate([[first], reader.rewards]))
        self._rewards: list[float] = sums[np.minimum(steps, len(sums) - 1)].tolist()
        self._times = _times(reader, steps.tolist(), before.get("reset_time"))

    def __iter__(self) -> Iterator[Caption]:
        times: Iterable[float | None]
        times = itertools.repeat(None) if self._times is None else self._times
        for step, reward, time in zip(self._steps, self._rewards, times, strict=False):
            yield Caption(
                episode_id=self._episode_id, step=step, time=time, reward=reward
            )


def _times(
    reader: TrajectoryReader, steps: Sequence[int], reset_time: float | None
) -> list[float] | None:
    clock = _clock(reader)
    if clock is not None and len(clock) > max(steps, default=0):
        began = clock[0] if reset_time is None else reset_time
        elapsed = clock[list(steps)] - began
        return [float(seconds) for seconds in elapsed]
    timestep = reader.header.facts.get("timestep")
    if timestep is None:
        return None
    return [float(step * Fraction(timestep)) for step in steps]


def _clock(reader: TrajectoryReader) -> NDArray[np.float64] | None:
    """Return the simulated time of each state, read in blocks; None without states."""
    offsets = [part.offset for part in reader.header.state if part.name == "time"]
    if not offsets or not reader.row_count:
        return None
    rows = max(1, _BLOCK_BYTES // (8 * max(1, reader.header.state_length)))
    blocks = []
    for start in range(0, reader.row_count, rows):
        states = reader.states(start, min(start + rows, reader.row_count))
        # A copy, so that the states themselves need not stay in memory.
        blocks.append(states[:, offsets[0]].copy())
    return np.concatenate(blocks)
