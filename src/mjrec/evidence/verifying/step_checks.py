# SPDX-License-Identifier: Apache-2.0
"""Whether each recorded state follows from the one before, by MuJoCo alone.

Each state is set, with the inputs that stand in the next, and stepped. So an edited
state is found twice, as what does not follow and as what nothing follows from, and no
error adds up. How many physics steps lie between two states follows from their times,
and must be the same throughout; only the last may be shorter, because a wrapper that
repeats actions stops where the episode ends.

What this cannot tell: whether the first state can be, and whether the inputs are those
that the actions cause. That is for the environment itself (`environment_replay`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ...formats.trajectory import ModelChange, TrajectoryReader
from ...simulation.replay import StateSteps
from .differences import Differences, compared_columns
from .recorded_models import is_of_pictures

# Of a row in a hundred numbers this is a hundred kilobytes.
BLOCK_ROWS: Final = 256

# Far more than there are in any control step.
_MOST_SUBSTEPS = 100_000


@dataclass
class FollowedSteps:
    """What came of making the steps of an episode again.

    Attributes:
        differences: of what was compared.
        unknown: the numbers of states that were not recorded.
        substeps: the physics steps in a control step.
        changed: physical fields of the model that the recording says were changed on
            the way.
        keeps_more_than_state: the model has options with which no step follows from
            states alone.
        trouble: why no step could be made; "" if it could.
    """

    differences: Differences
    unknown: list[int] = field(default_factory=list)
    substeps: int = 0
    changed: set[str] = field(default_factory=set)
    keeps_more_than_state: bool = False
    trouble: str = ""


def substeps_between(
    times: NDArray[np.float64], timestep: float
) -> NDArray[np.float64]:
    """Return how many physics steps lie between states, as whole floats or NaN."""
    with np.errstate(all="ignore"):
        return np.asarray(np.rint(np.diff(times) / timestep))


def follow_steps(
    reader: TrajectoryReader, model: Any, *, is_exact: bool, uneven: bool = False
) -> FollowedSteps:
    """Make the steps of an episode again.

    Args:
        reader: of the episode.
        model: as it was at the episode's beginning; not changed.
        is_exact: whether the solver's warm start is compared too. It is no part of the
            physics, and its error is that of accelerations.
        uneven: whether steps may be one physics step longer or shorter than others,
            as those of an MJCF file's frames are.

    Raises:
        InvalidArgument: the states are not of this model, or the recording changes it
            in a way that cannot be.
        UnreadableFile: the file is damaged.
    """
    steps = StateSteps(model, reader.columns)
    names, compared = compared_columns(reader.columns, with_warm_start=is_exact)
    clock = reader.columns["time"].start
    result = FollowedSteps(
        Differences(names), keeps_more_than_state=steps.keeps_more_than_state
    )
    changing = _Changing(reader, steps, result.changed)
    for start in range(0, reader.row_count - 1, BLOCK_ROWS):
        stop = min(start + BLOCK_ROWS, reader.row_count - 1)
        rows = reader.states(start, stop + 1)
        raw = substeps_between(rows[:, clock], steps.timestep)
        if not result.substeps:
            result.substeps = _usual(raw)
            if not 1 <= result.substeps <= _MOST_SUBSTEPS:
                result.trouble = _strange_time(result.substeps)
                return result
        is_end = stop == reader.row_count - 1
        numbers = allowed_substeps(raw, result.substeps, uneven=uneven, is_end=is_end)
        known: NDArray[np.bool_] = np.asarray(~np.isnan(rows).any(axis=1))
        # MuJoCo would warn of what is no number, and start anew.
        filled = np.where(known[:, np.newaxis], rows, 0.0)
        found = changing.follow(filled, numbers, start)
        result.unknown += (np.flatnonzero(~known[1:]) + start + 1).tolist()
        if start == 0 and not known[0]:
            result.unknown.insert(0, 0)
        both = known[:-1] & known[1:]
        which = np.flatnonzero(both) + start + 1
        recorded, found = rows[1:][both], found[both]
        result.differences.add(which, recorded[:, compared], found[:, compared])
    return result


class _Changing:
    """Makes steps with a model that the recording says was changed on the way.

    A change is noticed after a step, and may have come before it or after.
    """

    def __init__(
        self, reader: TrajectoryReader, steps: StateSteps, changed: set[str]
    ) -> None:
        self._steps = steps
        self._coming: Iterator[ModelChange] = reader.iter_model_changes()
        self._next: deque[tuple[int, Mapping[str, NDArray[Any]]]] = deque()
        self._changed = changed
        # What differs from the stored model at the beginning is in the model already.
        self._advance()
        while self._next and self._next[0][0] <= 0:
            self._next.popleft()
            self._advance()

    def follow(
        self, rows: NDArray[np.float64], substeps: NDArray[np.int64], first: int
    ) -> NDArray[np.float64]:
        """Return what each row becomes; `first` is the number of the first of them."""
        pieces = []
        start, count = 0, len(substeps)
        while self._next and self._next[0][0] <= first + count:
            at = max(start, self._next[0][0] - first)
            pieces.append(self._steps.follow(rows[start : at + 1], substeps[start:at]))
            _, fields = self._next.popleft()
            self._changed.update(fields)
            self._steps.change(fields)
            self._advance()
            if at > start and not _is_same(pieces[-1][-1:], rows[at : at + 1]):
                again = self._steps.follow(rows[at - 1 : at + 1], substeps[at - 1 : at])
                if _is_same(again, rows[at : at + 1]):
                    pieces[-1][-1:] = again
            start = at
        pieces.append(self._steps.follow(rows[start:], substeps[start:]))
        return np.concatenate(pieces)

    def _advance(self) -> None:
        """Find the next change of what steps depend on."""
        if self._next:
            return
        for change in self._coming:
            fields = {n: v for n, v in change.fields.items() if not is_of_pictures(n)}
            if fields:
                self._next.append((change.step, fields))
                return


def _is_same(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return one.tobytes() == np.ascontiguousarray(other).tobytes()


def _usual(raw: NDArray[np.float64]) -> int:
    known = raw[np.isfinite(raw)]
    if not len(known):
        return 0
    values, counts = np.unique(known, return_counts=True)
    return int(np.clip(values[np.argmax(counts)], -1, _MOST_SUBSTEPS + 1))


def allowed_substeps(
    raw: NDArray[np.float64], usual: int, *, uneven: bool, is_end: bool
) -> NDArray[np.int64]:
    """Return with how many physics steps each step is made again.

    Where a step took a time that it cannot have taken the usual number is tried: what
    comes out then differs in the time, at least.
    """
    slack = 1 if uneven else 0
    fine = (np.abs(raw - usual) <= slack) & (raw >= 1)
    if is_end and len(raw):
        fine[-1] |= 1 <= raw[-1] <= usual
    return np.where(fine, raw, usual).astype(np.int64)


def _strange_time(substeps: int) -> str:
    if substeps < 1:
        return "the recorded time does not go on from state to state"
    return f"a step would be more than {_MOST_SUBSTEPS} physics steps"
