# SPDX-License-Identifier: Apache-2.0
"""What a Gymnasium environment says of an episode's success."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

# Gymnasium-Robotics' Fetch and Hand environments say the first, its Adroit and maze
# environments the second, as MetaWorld and others do.
_KEYS = ("is_success", "success")


def success_in(info: Mapping[str, Any]) -> bool | None:
    """Return whether an episode was a success; None where nothing is said.

    Args:
        info: of its last step. `is_success` is looked at, else `success`: a truth
            value or a number, or an array of one.
    """
    for key in _KEYS:
        value = info.get(key)
        if isinstance(value, bool | int | float | np.bool_ | np.number):
            return bool(value)
        if isinstance(value, np.ndarray) and value.size == 1:
            return bool(value.item())
    return None
