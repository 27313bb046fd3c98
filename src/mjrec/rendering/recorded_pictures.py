# SPDX-License-Identifier: Apache-2.0
"""Which pictures a trajectory has, and which of them are wanted."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from ..errors import InvalidArgument, NoPictures
from ..formats.trajectory_reader import TrajectoryReader
from ..rates import stride_for, to_rate

__all__ = ["check_has_pictures", "chosen_frames"]


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


def chosen_frames(
    count: int, facts: Mapping[str, Any], max_fps: float | Fraction | None
) -> list[int]:
    """Return the numbers of the recorded pictures that are no more than `max_fps`.

    0, n, 2n ... with the smallest whole n that fits, and always the last.

    Args:
        count: how many the recording has.
        facts: the trajectory's.
        max_fps: pictures per second of the simulation; None is all there are.

    Raises:
        InvalidArgument: `max_fps` is no rate, or the recording does not know its own.
    """
    if max_fps is None:
        return list(range(count))
    wanted = to_rate(max_fps)
    if facts.get("rate") is None:
        raise InvalidArgument(
            "max_fps needs to know how many control steps a second has, and this "
            "recording ended before that was written. Leave max_fps out."
        )
    recorded = Fraction(facts["rate"]) / int(facts.get("stride") or 1)
    chosen = list(range(0, count, stride_for(recorded, wanted)))
    if count and chosen[-1] != count - 1:
        chosen.append(count - 1)
    return chosen
