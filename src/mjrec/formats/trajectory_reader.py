# SPDX-License-Identifier: Apache-2.0
"""What can be asked of a trajectory, in flight or finished."""

from __future__ import annotations

import abc
import functools
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InvalidArgument
from .trajectory import ModelChange, TrajectoryContent, TrajectoryHeader


def added_up(rewards: ArrayLike) -> float:
    """Return the sum of rewards, one added after the other, as a monitor does.

    `sum` makes up for roundings from Python 3.12 on, and NumPy's adds in pairs.
    """
    values = np.asarray(rewards, np.float64)
    # Zero comes first: it makes the sum of negative zeros a positive one.
    with np.errstate(all="ignore"):
        return 0.0 + float(np.add.accumulate(values)[-1]) if len(values) else 0.0


class TrajectoryReader(abc.ABC):
    """An open trajectory. T is the number of steps, F of video frames.

    Only what describes the rows is in memory; rows are read when they are asked for,
    in ranges `start, stop` as Python counts them. A reader is used by one thread, and
    in the process that opened it.

    Attributes:
        path: of the file.
        header: what is known of the episode besides its rows.
        row_count: how many states there are: T + 1, the first after the reset; 0 in
            the log of an episode that was killed before that was written.
        rewards: `(T,) float64`.
        terminated: `(T,) bool`.
        truncated: `(T,) bool`.
        frame_steps: `(F,) int64`, the step that each snapshot was taken after.
        change_count: how often the model changed.
        dropped: how many rows and other records at the end of the log were torn or
            damaged, as far as they can be counted, and are not here.
    """

    path: Path
    header: TrajectoryHeader
    row_count: int
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    frame_steps: NDArray[np.int64]
    change_count: int
    dropped: int

    @property
    def step_count(self) -> int:
        """T."""
        return len(self.rewards)

    @property
    def frame_count(self) -> int:
        """F."""
        return len(self.frame_steps)

    def states(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return `(stop - start, state_length) float64`, of `row_count` rows.

        Raises:
            UnreadableFile: the file was damaged since it was opened.
        """
        self._check_range(start, stop, self.row_count, "states")
        return self._states(start, stop)

    def actions(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return `(stop - start, *shape)`, of T; None where they are not recorded."""
        self._check_range(start, stop, self.step_count, "actions")
        return None if self.header.action is None else self._actions(start, stop)

    def observations(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return `(stop - start, *shape)`, of `row_count`; None as of `actions`."""
        self._check_range(start, stop, self.row_count, "observations")
        if self.header.observation is None:
            return None
        return self._observations(start, stop)

    def snapshots(self, start: int, stop: int) -> NDArray[np.uint8]:
        """Return `(stop - start, snapshot.size) uint8` packed rows, of F."""
        self._check_range(start, stop, self.frame_count, "snapshots")
        return self._snapshots(start, stop)

    def iter_model_changes(self) -> Iterator[ModelChange]:
        """Yield the changes of the model in the order of their steps."""
        return (self._model_change(index) for index in range(self.change_count))

    @functools.cached_property
    def model_changes(self) -> tuple[ModelChange, ...]:
        """The changes of the model in the order of their steps; read once."""
        return tuple(self.iter_model_changes())

    def content(self) -> TrajectoryContent:
        """Return everything.

        Raises:
            UnreadableFile: something in the file is damaged.
        """
        return TrajectoryContent(
            header=self.header,
            states=self.states(0, self.row_count),
            actions=self.actions(0, self.step_count),
            rewards=self.rewards,
            terminated=self.terminated,
            truncated=self.truncated,
            observations=self.observations(0, self.row_count),
            frame_steps=self.frame_steps,
            snapshots=self.snapshots(0, self.frame_count),
            model_changes=self.model_changes,
            dropped=self.dropped,
        )

    @abc.abstractmethod
    def close(self) -> None:
        """Close the file; idempotent. What is in memory stays."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return (
            f"<{type(self).__name__} {str(self.path)!r} {self.step_count} steps, "
            f"{self.frame_count} frames>"
        )

    @abc.abstractmethod
    def _states(self, start: int, stop: int) -> NDArray[np.float64]: ...

    @abc.abstractmethod
    def _actions(self, start: int, stop: int) -> NDArray[Any]: ...

    @abc.abstractmethod
    def _observations(self, start: int, stop: int) -> NDArray[Any]: ...

    @abc.abstractmethod
    def _snapshots(self, start: int, stop: int) -> NDArray[np.uint8]: ...

    @abc.abstractmethod
    def _model_change(self, index: int) -> ModelChange: ...

    def _check_range(self, start: int, stop: int, count: int, what: str) -> None:
        if not 0 <= start <= stop <= count:
            raise InvalidArgument(
                f"{self.path.name} has {count} {what}; there are none from {start} to "
                f"{stop}."
            )
