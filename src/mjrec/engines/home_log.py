# SPDX-License-Identifier: Apache-2.0
"""What workers log, logged by whoever waits for them."""

from __future__ import annotations

import logging
from collections.abc import Iterable


class HomeLog:
    """Logs here what was logged elsewhere, each text once in a run.

    A hundred workers have the same to complain of.
    """

    def __init__(self) -> None:
        self._told: set[tuple[str, int, str]] = set()

    def tell(self, lines: Iterable[tuple[str, int, str]]) -> None:
        """Log some: the logger's name, the level, the text of each."""
        for name, level, text in lines:
            if (name, level, text) not in self._told:
                self._told.add((name, level, text))
                logging.getLogger(name).log(level, "%s", text)
