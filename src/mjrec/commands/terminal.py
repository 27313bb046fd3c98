# SPDX-License-Identifier: Apache-2.0
"""What is shown to people, on a terminal or in a log."""

from __future__ import annotations

import rich.console

_LOG_WIDTH = 160


def result_console() -> rich.console.Console:
    """Return the console that results go to."""
    console = rich.console.Console()
    if console.is_terminal:
        return console
    # A log has no width, and a folded name cannot be copied.
    return rich.console.Console(width=_LOG_WIDTH)


def printable(text: str) -> str:
    """Return a text of a file's, or of foreign code's, that gives a terminal no orders.

    What cannot be printed stands there as Python writes it.
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
