# SPDX-License-Identifier: Apache-2.0
"""The simulation of an MJCF file, from a model that is compiled already."""

from __future__ import annotations

import mujoco
import numpy as np

from .mjcf import FRAME_RATE, MjcfSimulation, _meant_timestep


class CompiledSimulation(MjcfSimulation):
    """An `MjcfSimulation` whose file somebody else has compiled, within bounds.

    Args:
        model: the compiled model.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        # Not the base's, which compiles a file in this process.
        self.model = model
        self.data = mujoco.MjData(model)
        self._timestep = _meant_timestep(model)
        self.frame_rate = min(FRAME_RATE, 1 / self._timestep)
        size = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_INTEGRATION))
        self._before = np.empty(size)
        self.reset()
