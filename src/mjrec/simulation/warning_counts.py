# SPDX-License-Identifier: Apache-2.0
"""How often MuJoCo has warned in a simulation since its data was reset."""

from __future__ import annotations

from typing import Any

import mujoco

_PREFIX = "mjWARN_"


def warning_counts(simulation: Any) -> dict[str, int]:
    """Return the counts that are not zero, by name, without `mjWARN_`.

    MuJoCo sets them to zero when the data is reset, as environments do at theirs, and
    also where it resets a simulation that has become unstable by itself; then the
    warning that says so is counted again.

    Args:
        simulation: has MuJoCo's `data`, or dm_control's wrapper of it, as attribute.
    """
    data = getattr(simulation.data, "ptr", simulation.data)
    counts = ((kind, int(data.warning[kind].number)) for kind in _kinds())
    return {kind.name.removeprefix(_PREFIX): n for kind, n in counts if n}


def _kinds() -> list[mujoco.mjtWarning]:
    members = mujoco.mjtWarning.__members__.values()
    # The last one is how many there are.
    return [kind for kind in members if kind.name.startswith(_PREFIX)]
