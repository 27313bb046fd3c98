# SPDX-License-Identifier: Apache-2.0
"""What is known of an episode when it begins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class BegunEpisode:
    """What is known of an episode when it begins.

    Attributes:
        episode_id: its number.
        type: `"t"` for training, `"e"` for evaluation.
        start_time: wall clock just before the reset, in seconds since the epoch.
        seed: as given to `reset`.
        options: as given to `reset`.
        random_state: of the environment's generator before the reset, for JSON; None
            where it is not known or not needed.
    """

    episode_id: int
    type: str
    start_time: float
    seed: Any
    options: Any
    random_state: Any = None
