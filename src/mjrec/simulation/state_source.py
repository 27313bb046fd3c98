# SPDX-License-Identifier: Apache-2.0
"""What a recorder asks of a simulation, step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..formats.trajectory import RowLayout, StateComponent


@dataclass(frozen=True, kw_only=True)
class MomentMemory:
    """The memory of a simulation itself, for a recorder that gathers rows from it.

    Attributes:
        words: what state and snapshot consist of, in `gathering.WORDS`; this object
            keeps them alive.
        owners: of the words.
        is_current: tells that nothing but the state is other than at the capture
            before, which is usual: the memory then holds this moment, until the
            environment is called again. Where it does not, `capture_state` and
            `capture_snapshot` are to be asked.
    """

    words: NDArray[np.intp]
    owners: Any
    is_current: Callable[[], bool]


@dataclass(frozen=True, kw_only=True)
class EpisodeStart:
    """What is known of a simulation when an episode begins.

    Attributes:
        state: the components of a state.
        snapshot: of what pictures are made from; without fields where `refusal` says
            why there are none.
        model: where the model is stored, for the facts of a trajectory.
        scene: how it is shown, likewise; None where there are no snapshots.
        model_fields: what is other than in the stored model.
        refusal: why no picture can be made from snapshots of this model; None where
            it can, which was checked.
        memory: for this episode; None where each moment needs a closer look.
    """

    state: tuple[StateComponent, ...]
    snapshot: RowLayout
    model: Mapping[str, Any]
    scene: Mapping[str, Any] | None
    model_fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    refusal: str | None = None
    memory: MomentMemory | None = None


class StateSource(Protocol):
    """The states of a simulation, episode by episode, as bytes."""

    def open(self, directory: Path) -> None:
        """Store models in `directory` from here on."""

    def resetting(self) -> AbstractContextManager[None]:
        """Return what to put around the reset of the environment."""

    def begin_episode(self) -> EpisodeStart:
        """Return what is there now, just after a reset."""

    def capture_state(self, out: NDArray[np.float64]) -> None:
        """Write the state of this moment into `out`, `(state_length,)`."""

    def capture_snapshot(
        self, out: NDArray[np.uint8]
    ) -> Mapping[str, NDArray[Any]] | None:
        """Write what a picture of this moment is made from into `out`.

        Args:
            out: `(snapshot.size,)`, contiguous, at a multiple of 8 bytes.

        Returns:
            Model and view fields that are other than at the capture before (or at the
            beginning of the episode); None, which is usual, where all are the same.
        """

    def changed_fields(self) -> Mapping[str, NDArray[Any]] | None:
        """Return what `capture_snapshot` returns, without a snapshot."""

    def model_changed(self) -> None:
        """Note that anything in the model may be another; the next capture looks."""

    def forget_pictures(self) -> None:
        """Let the next episode's pictures depend on none that was made before.

        To be called between episodes. Cameras that are placed at the first picture, or
        that each picture moves, are as in a simulation that has just been made.
        """

    def finish(self) -> None:
        """Wait until every model is stored.

        Raises:
            FileNotWritten: one could not be.
        """

    def close(self) -> None:
        """Let go of what was acquired; idempotent."""
