# SPDX-License-Identifier: Apache-2.0
"""When the sub-environments of a vector environment are reset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from ..errors import InvalidArgument

# The names of the members of Gymnasium's AutoresetMode.
DISABLED, NEXT_STEP, SAME_STEP = "DISABLED", "NEXT_STEP", "SAME_STEP"


def autoreset_mode(env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> str:
    """Return `DISABLED`, `NEXT_STEP` or `SAME_STEP`.

    Raises:
        InvalidArgument: the vector environment does not say.
    """
    mode = (env.metadata or {}).get("autoreset_mode")
    # Gymnasium 1.0 has no such thing: its own reset in the step after the end.
    known = getattr(gymnasium.vector, "AutoresetMode", None)
    if known is not None and isinstance(mode, known):
        return str(mode.name)
    own = (gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv)
    if known is None and isinstance(env.unwrapped, own):
        return NEXT_STEP
    raise InvalidArgument(
        f"When {type(env.unwrapped).__name__} resets its sub-environments is not "
        f'known: metadata["autoreset_mode"] is {mode!r}, and must be a '
        "gymnasium.vector.AutoresetMode (of Gymnasium 1.1 or later). Set it, for "
        'example env.metadata["autoreset_mode"] = '
        "gymnasium.vector.AutoresetMode.NEXT_STEP, or put Monitor around each of the "
        "environments, inside the functions that make them, with resume=True."
    )


def reset_indices(options: Mapping[str, Any] | None, count: int) -> list[int]:
    """Return which sub-environments a reset with these options resets.

    To be asked before the reset, which takes the mask out of the options.
    """
    mask = None if options is None else options.get("reset_mask")
    if mask is None or np.shape(mask) != (count,):
        # The vector environment says what is wrong with it.
        return list(range(count))
    return [int(index) for index in np.flatnonzero(mask)]
