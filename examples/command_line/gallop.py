"""A policy for `mjrec record`, which finds it as `gallop:Gallop`."""

import numpy as np


class Gallop:
    """Lets a wave run through the joints, whatever it sees.

    Args:
        env: the environment; the command line gives it.
    """

    def __init__(self, env) -> None:
        self._joints = np.arange(env.action_space.shape[0])
        self._step = 0

    def reset(self, seed: int) -> None:
        """Begin the wave anew with each episode."""
        self._step = 0

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return an action."""
        self._step += 1
        return np.sin(0.6 * self._step + self._joints).astype(np.float32)
