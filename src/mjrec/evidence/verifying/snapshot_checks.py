# SPDX-License-Identifier: Apache-2.0
"""Whether what pictures are drawn from follows from the recorded states.

Pictures are drawn from snapshots: where bodies, cameras, lights and tendons are. They
are taken again from the recorded states on each side of the step, in the two ways in
which simulations leave them (`snapshot_steps`). Where the camera stands, and how the
scene is shown, is the author's choice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ...formats.trajectory import TrajectoryReader
from ...simulation.replay import (
    SnapshotSteps,
    column_names,
    live_snapshot,
    numbers_of,
)
from .differences import Differences, compared_columns
from .step_checks import BLOCK_ROWS, allowed_substeps, substeps_between

# Most of the price is reading them: half a millisecond each.
_FEW: Final = 3


@dataclass
class FollowedSnapshots:
    """What came of taking the snapshots of an episode again.

    Attributes:
        differences: of what was compared, by the steps that frames were drawn after.
        unknown: the steps whose states were not recorded, each once.
    """

    differences: Differences
    unknown: list[int] = field(default_factory=list)


def begun_snapshot(
    reader: TrajectoryReader, model: Any, data: Any, *, tolerance: float
) -> NDArray[np.float64] | None:
    """Return the first snapshot that an environment gives itself.

    Environments may move a thing after all has been computed in their reset.

    Args:
        reader: of the episode.
        model: of the environment that has just begun.
        data: likewise.
        tolerance: how far from the recorded state it may be.

    Returns:
        Its numbers; None where the environment is not in the recorded state.

    Raises:
        InvalidArgument: what is recorded is not of this model.
    """
    state, numbers = live_snapshot(model, data, reader.columns, _kind(reader))
    _, compared = compared_columns(reader.columns, with_warm_start=False)
    recorded = reader.states(0, 1)[0]
    is_near = np.allclose(
        state[compared], recorded[compared], rtol=tolerance, atol=tolerance
    )
    return numbers if is_near else None


def follow_snapshots(
    reader: TrajectoryReader,
    model: Any,
    *,
    substeps: int,
    uneven: bool = False,
    few: bool = False,
    begun: NDArray[np.float64] | None = None,
) -> FollowedSnapshots:
    """Take the snapshots of an episode again.

    Args:
        reader: of the episode.
        model: as it was at the episode's beginning; not changed.
        substeps: the physics steps in a control step; 0 where there are no steps.
        uneven: as of `follow_steps`.
        few: whether a few of them do, the first and the last included.
        begun: what `begun_snapshot` gave.

    Raises:
        InvalidArgument: states or snapshots are not of this model, or the recording
            changes it in a way that cannot be.
        UnreadableFile: the file is damaged.
    """
    taking = _Taking(reader, model, begun)
    result = FollowedSnapshots(Differences(column_names(_kind(reader))))
    unknown: set[int] = set()
    chosen = np.arange(reader.frame_count)
    if few and len(chosen) > _FEW:
        chosen = np.linspace(0, len(chosen) - 1, _FEW).astype(int)
    for first, rows, frames in _blocks(reader, chosen):
        times = rows[:, taking.clock]
        numbers = allowed_substeps(
            substeps_between(times, taking.steps.timestep),
            max(substeps, 1),
            uneven=uneven,
            is_end=first + len(rows) == reader.row_count,
        )
        wanted = numbers_of(_snapshots(reader, frames))
        compared: list[int] = []
        ours, theirs = np.empty_like(wanted), np.empty_like(wanted)
        for step, recorded in zip(
            reader.frame_steps[frames].tolist(), wanted, strict=True
        ):
            row = step - first
            before = rows[row - 1] if row and substeps else None
            number = int(numbers[row - 1]) if before is not None else 0
            found = taking.nearest(step, rows[row], before, number, recorded)
            if found is None:
                unknown.add(step)
                continue
            theirs[len(compared)], ours[len(compared)] = found
            compared.append(step)
        count = len(compared)
        result.differences.add(np.array(compared, int), theirs[:count], ours[:count])
    result.unknown = sorted(unknown)
    return result


def _kind(reader: TrajectoryReader) -> np.dtype[Any]:
    return reader.snapshots(0, 0).dtype


def _snapshots(reader: TrajectoryReader, frames: NDArray[np.int64]) -> NDArray[Any]:
    first, last = int(frames[0]), int(frames[-1])
    if last - first + 1 == len(frames):
        return reader.snapshots(first, last + 1)
    return np.concatenate([reader.snapshots(f, f + 1) for f in frames.tolist()])


def _blocks(
    reader: TrajectoryReader, chosen: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.int64]]]:
    """Yield states, the number of the first, and the chosen frames of all but it.

    A state stands before the first that has a frame, but for the very first.
    """
    for start in range(0, reader.row_count, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, reader.row_count)
        steps = reader.frame_steps[chosen]
        begin, end = np.searchsorted(steps, [start, stop]).tolist()
        if begin == end:
            continue
        first = max(start - 1, 0)
        rows = reader.states(first, stop)
        # There may be many frames of one state.
        for at in range(begin, end, BLOCK_ROWS):
            yield first, rows, chosen[at : min(at + BLOCK_ROWS, end)]


class _Taking:
    """Takes snapshots with a model that the recording says was changed on the way.

    A change is noticed after a step, and may have come before what is drawn was
    computed or after.
    """

    def __init__(
        self,
        reader: TrajectoryReader,
        model: Any,
        begun: NDArray[np.float64] | None,
    ) -> None:
        self.steps = SnapshotSteps(model, reader.columns, _kind(reader))
        self.clock = reader.columns["time"].start
        self._begun = begun
        self._coming = reader.iter_model_changes()
        self._next = next(self._coming, None)

    def nearest(
        self,
        step: int,
        state: NDArray[np.float64],
        before: NDArray[np.float64] | None,
        substeps: int,
        recorded: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Return a snapshot as it is recorded and as it is, in the way that fits best.

        Args:
            step: that it was taken after.
            state: after that step.
            before: the state before; None without one.
            substeps: the physics steps between them.
            recorded: its numbers.

        Returns:
            Both, alike where no picture depends on them; None where the states are not
            known.
        """
        if np.isnan(state).any():
            return None
        has_both = before is None or not np.isnan(before).any()
        best, smallest = None, np.inf
        for found in self._ways(step, state, before if has_both else None, substeps):
            alike = self.steps.alike(recorded, found)
            if alike.tobytes() == found.tobytes():
                return alike, found
            with np.errstate(all="ignore"):
                error = float(np.max(np.abs(alike - found) / (1 + np.abs(alike))))
            if best is None or error < smallest:
                best, smallest = (alike, found), error
        return best if has_both else None

    def _ways(
        self,
        step: int,
        state: NDArray[np.float64],
        before: NDArray[np.float64] | None,
        substeps: int,
    ) -> Iterator[NDArray[np.float64]]:
        self._change_until(step - 1)
        yield from self._both_ways(state, before, substeps)
        if self._change_until(step):
            yield from self._both_ways(state, before, substeps)
        if step == 0 and self._begun is not None:
            yield self._begun

    def _both_ways(
        self,
        state: NDArray[np.float64],
        before: NDArray[np.float64] | None,
        substeps: int,
    ) -> Iterator[NDArray[np.float64]]:
        if before is not None:
            yield self.steps.stepped(before, state, substeps)
        yield self.steps.settled(state)

    def _change_until(self, step: int) -> bool:
        """Change the model as it had changed after a step; tell whether it did."""
        fields: dict[str, NDArray[Any]] = {}
        while self._next is not None and self._next.step <= step:
            fields.update(self._own(self._next.fields))
            self._next = next(self._coming, None)
        self.steps.change(fields)
        return bool(fields)

    def _own(self, fields: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        return {
            name: value
            for name, value in fields.items()
            if not name.startswith(("camera.", "option."))
        }
