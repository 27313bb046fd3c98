# SPDX-License-Identifier: Apache-2.0
"""Actions of Gymnasium environments: drawn, zero, and checked."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from gymnasium import Space, spaces

from ..errors import PolicyError


class GymnasiumActions:
    """The actions of an action space.

    Args:
        space: the environment's; it is copied, so that drawing here and drawing there
            do not disturb each other.
    """

    def __init__(self, space: Space[Any]) -> None:
        self._space = copy.deepcopy(space)

    def __str__(self) -> str:
        return f"an action of {self._space}"

    def seed(self, seed: int) -> None:
        """Begin the sequence of drawn actions that belongs to a seed."""
        self._space.seed(seed)

    def draw(self) -> Any:
        """Return a random action, as the space itself draws: uniform within bounds.

        Where a `Box` has none, Gymnasium draws from a standard normal distribution,
        and from an exponential one where it has one of the two.
        """
        return self._space.sample()

    def zero(self) -> Any:
        """Return the action nearest to zero.

        Raises:
            PolicyError: the space has no such thing.
        """
        return _zero(self._space)

    def checked(self, action: Any) -> Any:
        """Return an action as the environment takes it.

        Numbers of a `Box` may be of any type and out of its bounds, which the
        environments clip themselves, but must be finite and of its shape. The members
        of a `Discrete` space may be NumPy's, of one element, and become `int`.

        Raises:
            PolicyError: it is no action.
        """
        match self._space:
            case spaces.Box() as box:
                sound = _is_numbers(action, box.shape)
            case spaces.Discrete():
                action = _as_int(action)
                sound = self._space.contains(action)
            case _:
                sound = _contains(self._space, action)
        if not sound:
            raise PolicyError(f"The policy must give {self}, got {action!r}.")
        return action


def _zero(space: Space[Any]) -> Any:
    match space:
        case spaces.Box():
            return np.clip(0, space.low, space.high).astype(space.dtype)
        case spaces.Discrete():
            return 0 if space.contains(0) else int(space.start)
        case spaces.MultiDiscrete():
            last = space.start + space.nvec - 1
            return np.clip(0, space.start, last).astype(space.dtype)
        case spaces.MultiBinary():
            return np.zeros(space.shape, space.dtype)
        case spaces.Dict():
            return {name: _zero(part) for name, part in space.spaces.items()}
        case spaces.Tuple():
            return tuple(_zero(part) for part in space.spaces)
    raise PolicyError(f'The policy "zero" knows no zero of the action space {space}.')


def _is_numbers(action: Any, shape: tuple[int, ...]) -> bool:
    try:
        array = np.asarray(action)
    except ValueError:
        # Lists of unequal lengths.
        return False
    return bool(
        array.dtype.kind in "fiub" and array.shape == shape and np.isfinite(array).all()
    )


def _as_int(action: Any) -> Any:
    if isinstance(action, np.ndarray | np.integer) and np.size(action) == 1:
        number = np.asarray(action)
        return int(number.item()) if number.dtype.kind in "iu" else action
    return action


def _contains(space: Space[Any], action: Any) -> bool:
    try:
        return bool(space.contains(action))
    except Exception:
        # Some spaces raise for what is nothing like one of their members.
        return False
