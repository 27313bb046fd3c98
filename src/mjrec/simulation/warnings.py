# SPDX-License-Identifier: Apache-2.0
"""What MuJoCo warns of."""

from __future__ import annotations

import logging
import re
from typing import Any

import mujoco

logger = logging.getLogger(__name__)

_PREFIX = "mjWARN_"
_NUMBERS = re.compile(r"[\d.]+")


def log_mujoco_warnings() -> None:
    """Log each kind of MuJoCo's warnings once, for the rest of this process.

    MuJoCo itself would write `MUJOCO_LOG.TXT` into the working directory; a full scene,
    for one, warns at each frame. For processes of our own only: there is one handler
    in a process.
    """
    warned: set[str] = set()

    def warn(text: str) -> None:
        # One that says when it was, or where, is no other warning the next time.
        kind = _NUMBERS.sub("", text)
        if kind not in warned:
            warned.add(kind)
            logger.warning("MuJoCo: %s", text)

    mujoco.set_mju_user_warning(warn)


def warning_counts(simulation: Any) -> dict[str, int]:
    """Return how often MuJoCo has warned in a simulation since its data was reset.

    MuJoCo resets the counts, too, where it resets a simulation that has become unstable
    by itself; then the warning that says so is counted again.

    Args:
        simulation: has MuJoCo's `data`, or dm_control's wrapper of it, as attribute.

    Returns:
        The counts that are not zero, by name, without `mjWARN_`.
    """
    data = getattr(simulation.data, "ptr", simulation.data)
    kinds = {
        name.removeprefix(_PREFIX): kind
        for name, kind in mujoco.mjtWarning.__members__.items()
        # The last one is how many there are.
        if name.startswith(_PREFIX)
    }
    counts = {name: int(data.warning[kind].number) for name, kind in kinds.items()}
    return {name: count for name, count in counts.items() if count}
