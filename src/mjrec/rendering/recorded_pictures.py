# SPDX-License-Identifier: Apache-2.0
"""Which pictures a trajectory has, and which of them are wanted."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from fractions import Fraction
from typing import Any, NamedTuple

from ..errors import InvalidArgument, NoPictures
from ..formats.trajectory import TrajectoryReader
from ..rates import stride_for, to_rate

logger = logging.getLogger(__name__)


class ChosenFrames(NamedTuple):
    """Some of a trajectory's pictures.

    Attributes:
        indices: their numbers.
        every: the usual number of pictures from one to the next.
    """

    indices: list[int]
    every: int


def check_has_pictures(reader: TrajectoryReader) -> None:
    """Raise NoPictures, with the reason, if a trajectory has nothing to be drawn."""
    facts = reader.header.facts
    if facts.get("scene") is not None and reader.frame_count:
        return
    reason = facts.get("refusal") or (
        "it ended before the first" if facts.get("scene") else "none were recorded"
    )
    raise NoPictures(
        f"{reader.path} holds no snapshots to draw pictures from: {reason}. If it has "
        "states, mjrec.render_states can draw those."
    )


def warn_of_other_pictures(reader: TrajectoryReader) -> None:
    """Say so where the environment showed more than its scene."""
    reason = (reader.header.facts.get("video") or {}).get("reason")
    if reason:
        logger.warning(
            "%s was recorded live, because %s. What is drawn here is the scene alone.",
            reader.path.name,
            reason,
        )


def chosen_frames(
    count: int, facts: Mapping[str, Any], max_fps: float | Fraction | None
) -> ChosenFrames:
    """Return which of the recorded pictures are no more than `max_fps`.

    0, n, 2n ... with the smallest whole n that fits, and always the last.

    Args:
        count: how many the recording has.
        facts: the trajectory's, checked.
        max_fps: pictures per second of the simulation; None is all there are.

    Raises:
        InvalidArgument: `max_fps` is no rate, or the recording does not know its own.
    """
    every = _every(count, facts, max_fps)
    last = [count - 1] if count else []
    return ChosenFrames([*range(0, count - 1, every), *last], every)


def _every(
    count: int, facts: Mapping[str, Any], max_fps: float | Fraction | None
) -> int:
    if max_fps is None:
        return 1
    wanted, recorded = to_rate(max_fps), recorded_rate(facts)
    if recorded is not None:
        return stride_for(recorded, wanted)
    # An episode that ended before its second step has one picture, at any rate.
    if count > 1:
        raise InvalidArgument(
            "max_fps needs to know how many control steps a second has, and this "
            "recording ended before that was written. Leave max_fps out."
        )
    return 1


def recorded_rate(facts: Mapping[str, Any]) -> Fraction | None:
    """Return how many pictures a second of the simulation has; None if unknown.

    Args:
        facts: the trajectory's, checked.
    """
    if facts.get("rate") is None:
        return None
    return Fraction(facts["rate"]) / int(facts.get("stride", 1))
