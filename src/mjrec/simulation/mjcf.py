# SPDX-License-Identifier: Apache-2.0
"""A model from an MJCF file, simulated frame by frame."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..rates import MAX_DENOMINATOR

FRAME_RATE = Fraction(60)

# Authors write a timestep of 1/n seconds with about five digits.
_ROUNDING = Fraction(1, 10**5)

_INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_BAD_STATES = {
    int(mujoco.mjtWarning.mjWARN_BADQPOS): "position",
    int(mujoco.mjtWarning.mjWARN_BADQVEL): "velocity",
    int(mujoco.mjtWarning.mjWARN_BADQACC): "acceleration",
}


def load_mjcf(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file, and return the model.

    Raises:
        UnreadableFile: the file is missing, or MuJoCo rejects it for the stated reason.
    """
    if path.exists() and not path.is_file():
        # Opening a pipe would block forever.
        raise UnreadableFile(path, "it is not a regular file")
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    # If memory runs out, MuJoCo raises RuntimeError.
    except (RuntimeError, ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise UnreadableFile(path, reason.rstrip(".")) from error


class MjcfSimulation:
    """A simulation in whole physics steps, at 60 frames per simulated second.

    Frame k is taken after the whole number of steps that is closest to k/60 seconds.
    With a timestep of 0.01, frames are 2, 1, 2, 2, 1, 2 ... steps apart. A frame is
    never more than half a step off, and errors do not accumulate. If the timestep is
    longer than 1/60 second, each frame is one step, and the frame rate is one over the
    timestep.

    Args:
        model: the compiled model; see `load_mjcf`.

    Attributes:
        model: the `mujoco.MjModel`.
        data: the model's `mujoco.MjData`.
        frame_rate: frames per simulated second.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.data = mujoco.MjData(self.model)
        self._timestep = _meant_timestep(self.model)
        self.frame_rate = min(FRAME_RATE, 1 / self._timestep)
        self._before = np.empty(mujoco.mj_stateSize(self.model, _INTEGRATION))
        self.reset()

    def reset(self) -> None:
        """Reset to the model's initial state with `mj_resetData`, not to a keyframe."""
        self._frames = 0
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)

    def advance(self, ctrl: NDArray[np.float64]) -> str | None:
        """Simulate until the next frame.

        If the simulation becomes unstable, MuJoCo resets it in the middle of a step.
        This is undone: the simulation stays at the last good frame.

        Args:
            ctrl: the actuators' controls, `(nu,) float64`; MuJoCo clamps them to the
                actuators' ranges.

        Returns:
            A description of the problem, or None if there was none.
        """
        mujoco.mj_getState(self.model, self.data, self._before, _INTEGRATION)
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, nstep=self._steps_to_next_frame())
        self._frames += 1
        trouble = self._trouble()
        if trouble is not None:
            mujoco.mj_setState(self.model, self.data, self._before, _INTEGRATION)
            mujoco.mj_forward(self.model, self.data)
        return trouble

    def state(self) -> NDArray[np.float64]:
        """Return positions, velocities and activations, `(nq + nv + na,) float64`."""
        return np.concatenate([self.data.qpos, self.data.qvel, self.data.act])

    def control_ranges(self) -> NDArray[np.float64]:
        """Return the lowest and highest control of each actuator, `(nu, 2) float64`.

        The range of an actuator without limits is infinite.
        """
        limited = self.model.actuator_ctrllimited.astype(bool)[:, np.newaxis]
        endless = np.array([-np.inf, np.inf])
        return np.where(limited, self.model.actuator_ctrlrange, endless)

    def _steps_to_next_frame(self) -> int:
        return self._steps_until(self._frames + 1) - self._steps_until(self._frames)

    def _steps_until(self, frame: int) -> int:
        return math.floor(frame / (self.frame_rate * self._timestep) + Fraction(1, 2))

    def _trouble(self) -> str | None:
        # MuJoCo's reset clears older counts, so any bad step leaves one of these set.
        for warning, quantity in _BAD_STATES.items():
            if self.data.warning[warning].number:
                index = self.data.warning[warning].lastinfo
                return (
                    "the simulation became unstable: found a NaN, infinite or huge "
                    f"{quantity} at index {index}"
                )
        return None


def _meant_timestep(model: mujoco.MjModel) -> Fraction:
    """Return the timestep that the author intended: 1/60 for 0.0166667, for example."""
    exact = Fraction(model.opt.timestep)
    steps_a_second = round(1 / exact)
    if abs(exact * steps_a_second - 1) < _ROUNDING:
        return Fraction(1, steps_a_second)
    return exact.limit_denominator(MAX_DENOMINATOR) or exact
