"""A policy for `mjrec record`, to be used as `--policy gallop:Gallop`."""

import numpy as np


class Gallop:
    """A policy that moves a wave through the joints and ignores the observations.

    Args:
        env: the environment, which `mjrec record` passes.
    """

    def __init__(self, env) -> None:
        self._joints = np.arange(env.action_space.shape[0])
        self._step = 0

    def reset(self, seed: int) -> None:
        """Restart the wave at the beginning of each episode."""
        self._step = 0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the next action."""
        self._step += 1
        return np.sin(0.6 * self._step + self._joints).astype(np.float32)
