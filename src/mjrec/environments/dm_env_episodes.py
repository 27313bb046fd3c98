# SPDX-License-Identifier: Apache-2.0
"""The end of dm_env episodes: whose end it is."""

from __future__ import annotations

import dm_env


def is_terminated(timestep: dm_env.TimeStep) -> bool:
    """Tell whether the task itself ended the episode: LAST with a discount of 0."""
    return bool(timestep.last() and not timestep.discount)


def is_truncated(timestep: dm_env.TimeStep) -> bool:
    """Tell whether a limit from outside ended the episode.

    That is LAST with another discount than 0: rewards would have followed.
    """
    return bool(timestep.last() and timestep.discount)
