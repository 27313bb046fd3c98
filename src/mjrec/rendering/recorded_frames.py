# SPDX-License-Identifier: Apache-2.0
"""Which frames a recording has, which of them are wanted, and their captions."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..annotation import Caption
from ..errors import InvalidArgument, NoPictures
from ..formats.trajectory import TrajectoryReader
from ..rates import stride_for, to_rate
from .recorded_facts import video_facts

logger = logging.getLogger(__name__)

_BLOCK_BYTES = 1 << 20

# Of an episode that ended before its second step: any is as good.
_RATE_OF_ONE_FRAME = Fraction(30)


class ChosenFrames(NamedTuple):
    """Some of a recording's frames.

    Attributes:
        indices: their numbers.
        every: the usual number of frames from one to the next.
    """

    indices: list[int]
    every: int


def check_has_frames(reader: TrajectoryReader) -> None:
    """Raise NoPictures, with the reason, if a trajectory has nothing to be drawn."""
    facts = reader.facts
    if facts.get("scene") is not None and reader.frame_count:
        return
    reason = facts.get("refusal") or (
        "it ended before the first" if facts.get("scene") else "none were recorded"
    )
    raise NoPictures(
        f"{reader.path} holds no snapshots to draw pictures from: {reason}. If it has "
        "states, mjrec.render_states can draw those."
    )


def warn_of_other_frames(name: str, facts: Mapping[str, Any]) -> None:
    """Say so where the environment showed more than its scene."""
    reason = video_facts(facts).get("reason")
    if reason:
        logger.warning(
            "%s was recorded live, because %s. What is drawn here is the scene alone.",
            name,
            reason,
        )


def chosen_frames(
    count: int, facts: Mapping[str, Any], max_fps: float | Fraction | None
) -> ChosenFrames:
    """Return which of the recorded frames are no more than `max_fps`.

    0, n, 2n ... with the smallest whole n that fits, and always the last.

    Args:
        count: how many the recording has.
        facts: the recording's, checked.
        max_fps: frames per second of the simulation; None is all there are.

    Raises:
        InvalidArgument: `max_fps` is no rate, or the recording does not know its own.
    """
    every = 1
    if max_fps is not None:
        wanted, recorded = to_rate(max_fps), recorded_rate(facts)
        if recorded is not None:
            every = stride_for(recorded, wanted)
        # An episode that ended before its second step has one frame, at any rate.
        elif count > 1:
            raise InvalidArgument(
                "max_fps needs to know how many control steps a second has, and this "
                "recording ended before that was written. Leave max_fps out."
            )
    last = [count - 1] if count else []
    return ChosenFrames([*range(0, count - 1, every), *last], every)


def recorded_rate(facts: Mapping[str, Any]) -> Fraction | None:
    """Return how many frames a second of the simulation has; None if unknown."""
    if facts.get("rate") is None:
        return None
    return Fraction(facts["rate"]) / int(facts.get("stride", 1))


def usual_fps(facts: Mapping[str, Any], chosen: ChosenFrames) -> Fraction:
    """Return the rate at which a second of the file is as long as when recorded."""
    asked = video_facts(facts).get("fps")
    rate = recorded_rate(facts) if asked is None else Fraction(asked)
    return (_RATE_OF_ONE_FRAME if rate is None else rate) / chosen.every


def captions(reader: TrajectoryReader, indices: Sequence[int]) -> Iterator[Caption]:
    """Return the captions of some frames of a trajectory, in their order.

    The return is the sum of the rewards up to the frame's step. The time is that of
    the simulation since the reset; where no states were recorded, so many steps; where
    it is not known how long these are, there is none. A part of a clip may begin in the
    midst of an episode, and says what was before it.

    Raises:
        UnreadableFile: the file is damaged. All of it is read before this returns.
    """
    facts = reader.facts
    episode_id, before = int(facts.get("episode_id") or 0), facts.get("clip") or {}
    steps = reader.frame_steps[list(indices)]
    # One after the other, as the monitor adds them up.
    first = float(before.get("reward_before", 0.0))
    sums = np.cumsum(np.concatenate([[first], reader.rewards]))
    rewards = sums[np.minimum(steps, len(sums) - 1)]
    times = _times(reader, steps, before.get("reset_time"))
    steps = steps + before.get("steps_before", 0)

    def caption(number: int) -> Caption:
        return Caption(
            episode_id=episode_id,
            step=int(steps[number]),
            time=None if times is None else float(times[number]),
            reward=float(rewards[number]),
        )

    return map(caption, range(len(steps)))


def _times(
    reader: TrajectoryReader, steps: NDArray[np.int64], reset_time: float | None
) -> Sequence[float] | None:
    clock = _clock(reader)
    if clock is not None and len(clock) > max(steps, default=0):
        began = clock[0] if reset_time is None else reset_time
        elapsed: list[float] = (clock[steps] - began).tolist()
        return elapsed
    timestep = reader.facts.get("timestep")
    if timestep is None:
        return None
    return [float(step * Fraction(timestep)) for step in steps.tolist()]


def _clock(reader: TrajectoryReader) -> NDArray[np.float64] | None:
    """Return the simulated time of each state, read in blocks; None without states."""
    clock = reader.columns.get("time")
    if clock is None or not reader.row_count:
        return None
    rows = max(1, _BLOCK_BYTES // reader.dtype["state"].itemsize)
    blocks = [
        # A copy, so that the states themselves need not stay in memory.
        reader.states(start, min(start + rows, reader.row_count))[:, clock.start].copy()
        for start in range(0, reader.row_count, rows)
    ]
    return np.concatenate(blocks)
