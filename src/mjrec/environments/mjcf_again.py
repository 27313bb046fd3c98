# SPDX-License-Identifier: Apache-2.0
"""The environment of an MJCF file, from a model that is compiled already."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..simulation.mjcf import MjcfSimulation
from .made_again import (
    EpisodeStart,
    RecordedEnvironment,
    StepAgain,
    wrappers_refused,
)


class MjcfAgain:
    """Does what `MjcfEnvironment` does, and its `TimeLimit`.

    Args:
        recorded: what the recording says of it.
        model: compiled from the sources in the archive.

    Raises:
        NotMadeAgain: wrappers stood around it.
    """

    is_settled = False
    is_all_in_state = True
    made_with = "made from the sources in the archive"

    def __init__(self, recorded: RecordedEnvironment, model: Any) -> None:
        if recorded.wrappers:
            raise wrappers_refused(recorded.wrappers)
        limit = recorded.max_episode_steps
        self._limit = limit if isinstance(limit, int) else None
        self._simulation = MjcfSimulation(model)
        self._steps = 0

    def simulation(self) -> tuple[Any, Any]:
        """Return MuJoCo's model and data."""
        return self._simulation.model, self._simulation.data

    def begin(self, start: EpisodeStart) -> Any:
        """Go to the model's initial state; nothing in it is random."""
        return self.begin_anyhow()

    def begin_anyhow(self) -> Any:
        """Do the same: there is no other beginning."""
        self._steps = 0
        self._simulation.reset()
        return self._simulation.state()

    def step(self, action: Any) -> StepAgain:
        """Simulate one frame."""
        ctrl = np.asarray(action, np.float64)
        if ctrl.shape != (self._simulation.model.nu,):
            raise ValueError(f"an action of the shape {ctrl.shape}")
        trouble = self._simulation.advance(ctrl)
        self._steps += 1
        return StepAgain(
            observation=self._simulation.state(),
            reward=0.0,
            terminated=trouble is not None,
            truncated=self._limit is not None and self._steps >= self._limit,
        )

    def close(self) -> None:
        """Do nothing: nothing is open."""
