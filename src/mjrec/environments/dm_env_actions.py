# SPDX-License-Identifier: Apache-2.0
"""Actions of dm_env environments: drawn, zero, and checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
from dm_env import specs
from numpy.typing import NDArray

from ..errors import PolicyError

# A spec, or a dictionary, list or tuple of such, however deep.
Spec: TypeAlias = Any

# dm_control says 1e10 (mjMAXVAL) for actuators without limits.
_ENDLESS = 1e10


class DmEnvActions:
    """The actions of an action spec.

    Args:
        spec: the environment's `action_spec()`, which may be nested.
    """

    def __init__(self, spec: Spec) -> None:
        self._spec = spec
        self._generator = np.random.default_rng()

    def __str__(self) -> str:
        return f"an action of {self._spec}"

    def seed(self, seed: int) -> None:
        """Begin the sequence of drawn actions that belongs to a seed."""
        self._generator = np.random.default_rng(seed)

    def draw(self) -> Any:
        """Return a random action, uniform within its bounds.

        Where a number has no bounds it is drawn from a standard normal distribution,
        and its distance from the only bound from an exponential one.
        """
        return _map_leaves(self._draw_leaf, self._spec)

    def zero(self) -> Any:
        """Return the action nearest to zero.

        Raises:
            PolicyError: the spec has no such thing.
        """
        return _map_leaves(_zero_leaf, self._spec)

    def checked(self, action: Any) -> Any:
        """Return an action as the environment takes it.

        Numbers may be of any type and out of bounds, which MuJoCo clips, but must be
        finite and of the shape of the spec; discrete ones must be whole and in range.

        Raises:
            PolicyError: it is no action.
        """
        if not _fits(self._spec, action):
            raise PolicyError(f"The policy must give {self}, got {action!r}.")
        return action

    def _draw_leaf(self, spec: specs.Array) -> Any:
        if isinstance(spec, specs.DiscreteArray):
            return spec.dtype.type(self._generator.integers(spec.num_values))
        low, high = _bounds(spec)
        drawn = _draw(self._generator, low, high)
        return drawn.astype(spec.dtype)


def _map_leaves(function: Callable[[specs.Array], Any], spec: Spec) -> Any:
    if isinstance(spec, Mapping):
        return {name: _map_leaves(function, part) for name, part in spec.items()}
    if isinstance(spec, list | tuple):
        parts = [_map_leaves(function, part) for part in spec]
        return tuple(parts) if isinstance(spec, tuple) else parts
    if isinstance(spec, specs.Array) and spec.dtype.kind in "fiub":
        return function(spec)
    raise PolicyError(
        'The policies "random" and "zero" know no actions of the kind of '
        f"{spec!r}. Give a policy of your own as module:name."
    )


def _bounds(spec: specs.Array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and highest values, `spec.shape`; infinite for none."""
    low: NDArray[np.float64] = np.array(-np.inf)
    high: NDArray[np.float64] = np.array(np.inf)
    if isinstance(spec, specs.BoundedArray):
        low = np.where(spec.minimum <= -_ENDLESS, -np.inf, spec.minimum)
        high = np.where(spec.maximum >= _ENDLESS, np.inf, spec.maximum)
    return np.broadcast_to(low, spec.shape), np.broadcast_to(high, spec.shape)


def _draw(
    generator: np.random.Generator, low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    # All three are drawn every time: one number's bounds leave the others alone.
    uniform = generator.uniform(size=low.shape)
    normal = generator.standard_normal(low.shape)
    exponential = generator.standard_exponential(low.shape)
    has_low, has_high = np.isfinite(low), np.isfinite(high)
    bottom, top = np.where(has_low, low, 0.0), np.where(has_high, high, 0.0)
    return np.select(
        [has_low & has_high, has_low, has_high],
        [bottom + uniform * (top - bottom), bottom + exponential, top - exponential],
        normal,
    )


def _zero_leaf(spec: specs.Array) -> Any:
    if isinstance(spec, specs.DiscreteArray):
        return spec.dtype.type(0)
    return np.clip(0.0, *_bounds(spec)).astype(spec.dtype)


def _fits(spec: Spec, action: Any) -> bool:
    if isinstance(spec, Mapping):
        return (
            isinstance(action, Mapping)
            and action.keys() == spec.keys()
            and all(_fits(part, action[name]) for name, part in spec.items())
        )
    if isinstance(spec, list | tuple):
        return (
            isinstance(action, list | tuple)
            and len(action) == len(spec)
            and all(map(_fits, spec, action))
        )
    return _fits_leaf(spec, action)


def _fits_leaf(spec: specs.Array, action: Any) -> bool:
    try:
        array = np.asarray(action)
    except ValueError:
        # Lists of unequal lengths.
        return False
    if array.shape != spec.shape:
        return False
    if isinstance(spec, specs.DiscreteArray):
        return array.dtype.kind in "iu" and 0 <= int(array) < int(spec.num_values)
    return bool(array.dtype.kind in "fiub" and np.isfinite(array).all())
