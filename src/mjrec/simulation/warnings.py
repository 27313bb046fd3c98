# SPDX-License-Identifier: Apache-2.0
"""MuJoCo's warnings."""

from __future__ import annotations

import logging
import re
from typing import Any

import mujoco

logger = logging.getLogger(__name__)

_PREFIX = "mjWARN_"
_NUMBERS = re.compile(r"[\d.]+")


def log_mujoco_warnings() -> None:
    """Log each kind of MuJoCo warning once, for the rest of this process.

    MuJoCo itself would write `MUJOCO_LOG.TXT` to the working directory. A full scene,
    for example, causes a warning at each frame. Use this only in processes that mjrec
    starts, because a process can have only one warning handler.
    """
    warned: set[str] = set()

    def warn(text: str) -> None:
        # A warning that differs only in its numbers (a time, an index) is not new.
        kind = _NUMBERS.sub("", text)
        if kind not in warned:
            warned.add(kind)
            logger.warning("MuJoCo: %s", text)

    mujoco.set_mju_user_warning(warn)


def warning_counts(simulation: Any) -> dict[str, int]:
    """Return the counts of MuJoCo warnings since a simulation's data was last reset.

    When a simulation becomes unstable, MuJoCo resets its data, including these counts,
    and then counts the warning about the instability.

    Args:
        simulation: an object with the attribute `data`, which is MuJoCo's own object or
            dm_control's wrapper around it.

    Returns:
        The nonzero counts by name, without the prefix `mjWARN_`.
    """
    data = getattr(simulation.data, "ptr", simulation.data)
    kinds = {
        name.removeprefix(_PREFIX): kind
        for name, kind in mujoco.mjtWarning.__members__.items()
        # The last member of the enum, mjNWARNING, is their number.
        if name.startswith(_PREFIX)
    }
    counts = {name: int(data.warning[kind].number) for name, kind in kinds.items()}
    return {name: count for name, count in counts.items() if count}
