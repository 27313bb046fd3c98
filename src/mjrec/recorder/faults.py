# SPDX-License-Identifier: Apache-2.0
"""What could not be recorded, and whether that ends the simulation."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from .options import WARN

logger = logging.getLogger(__name__)

What = Literal["video", "trajectory", "statistics", "journal", "model", "tracker"]


@dataclass(frozen=True)
class _Fault:
    episode_id: int | None
    what: What
    reason: str


class Faults:
    """The faults of one run.

    With `on_error="raise"` a fault is an error that the caller raises; with "warn" it
    is one warning and a line in the manifest, and the simulation goes on.

    Args:
        on_error: "raise" or "warn".
        write: writes a new one into the journal.
    """

    def __init__(self, on_error: str, write: Callable[[Any], object]) -> None:
        self._warns = on_error == WARN
        self._write = write
        self._faults: set[_Fault] = set()

    def tolerates(
        self, what: What, error: BaseException, *, episode_id: int | None
    ) -> bool:
        """Note a fault, and tell whether the simulation may go on.

        Args:
            what: could not be recorded.
            error: why.
            episode_id: of which episode; None for what belongs to none.
        """
        if not self._warns:
            return False
        if self.note(what, str(error), episode_id=episode_id):
            of = "" if episode_id is None else f" of episode {episode_id}"
            logger.warning("Not recorded whole: %s%s. %s", what, of, error)
        return True

    def note(self, what: What, reason: str, *, episode_id: int | None) -> bool:
        """Write a fault down; return whether it is a new one."""
        fault = _Fault(episode_id, what, reason)
        if fault in self._faults:
            return False
        self._faults.add(fault)
        self._write(vars(fault))
        return True
