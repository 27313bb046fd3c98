# SPDX-License-Identifier: Apache-2.0
"""What the arguments of an environment are, as text: those that make it another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

# How an environment is shown, on which no state and no reward depends.
VIEW_ARGUMENTS: Final = frozenset(
    (
        *("render_mode", "camera_name", "camera_id", "default_camera_config"),
        *("width", "height", "max_geom", "visual_options"),
    )
)
_MOST_CHARACTERS = 400


def shown_arguments(kwargs: Any) -> str:
    """Return `name=value, ...` of what an environment was made with.

    Args:
        kwargs: as a recording has them; they may be anything.

    Returns:
        "" where there are none but for how it is shown.
    """
    if not isinstance(kwargs, Mapping):
        return ""
    said = ", ".join(
        f"{name}={value!r:.100}"
        for name, value in kwargs.items()
        if name not in VIEW_ARGUMENTS
    )
    if len(said) > _MOST_CHARACTERS:
        return f"{said[:_MOST_CHARACTERS]} ..."
    return said
