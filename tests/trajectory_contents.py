# SPDX-License-Identifier: Apache-2.0
"""Read a whole trajectory as arrays that can be compared."""

from dataclasses import dataclass
from typing import Any

from mjrec.formats.trajectory import ModelChange


@dataclass(frozen=True, kw_only=True)
class TrajectoryContent:
    facts: dict[str, Any]
    dtype: Any
    states: Any
    actions: Any
    rewards: Any
    terminated: Any
    truncated: Any
    observations: Any
    frame_steps: Any
    snapshots: Any
    model_changes: tuple[ModelChange, ...] = ()
    dropped: int = 0


def content_of(reader):
    return TrajectoryContent(
        facts=dict(reader.facts),
        dtype=reader.dtype,
        states=reader.states(0, reader.row_count),
        actions=reader.actions(0, reader.step_count),
        rewards=reader.rewards,
        terminated=reader.terminated,
        truncated=reader.truncated,
        observations=reader.observations(0, reader.row_count),
        frame_steps=reader.frame_steps,
        snapshots=reader.snapshots(0, reader.frame_count),
        model_changes=tuple(reader.iter_model_changes()),
        dropped=reader.dropped,
    )
