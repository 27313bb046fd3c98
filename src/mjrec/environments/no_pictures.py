# SPDX-License-Identifier: Apache-2.0
"""What stands for the pictures of an environment that cannot be drawn live."""

from __future__ import annotations

from typing import Any


class NoPictureSource:
    """Gives no pictures.

    Args:
        missing: what the environment lacks, and what to do about it.
    """

    render_mode = None

    def __init__(self, missing: str) -> None:
        self.missing = missing

    def render(self) -> None:
        """Return None: there is no picture."""

    def facts(self) -> dict[str, Any]:
        """Return nothing: there is no video."""
        return {}
