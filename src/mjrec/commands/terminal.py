# SPDX-License-Identifier: Apache-2.0
"""Output for people, on a terminal or in a log, and for programs."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence

import rich.box
import rich.console
import rich.table

from .. import json_text

# Exit statuses. The second is what shells report for a process ended by Ctrl-C.
FAILED, INTERRUPTED = 1, 130

_LOG_WIDTH = 160
# The number of rows that determine the column widths of a long table.
_ROWS_MEASURED = 1000


def result_console() -> rich.console.Console:
    """Return the console that results are printed to."""
    console = rich.console.Console()
    if console.is_terminal:
        return console
    # A log has no width, and a wrapped name cannot be copied.
    return rich.console.Console(width=_LOG_WIDTH)


def printable(text: str) -> str:
    """Return untrusted text (from files or foreign code) made safe for a terminal.

    Unprintable characters are replaced by their Python escapes.
    """
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def names_by(reasons: Mapping[str, str]) -> dict[str, list[str]]:
    """Group names by reason."""
    names: dict[str, list[str]] = {}
    for name, reason in reasons.items():
        names.setdefault(reason, []).append(name)
    return names


def print_lines(console: rich.console.Console, lines: Iterable[str]) -> None:
    """Print lines verbatim, without wrapping, so that names can be copied."""
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def print_json(value: object) -> None:
    """Print a value as one line of JSON."""
    sys.stdout.write(json_text.dumps(value) + "\n")


def table(names: Iterable[str]) -> rich.table.Table:
    """Return an empty table of numbers; only the column `task` holds text."""
    made = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    for name in names:
        is_text = name == "task"
        made.add_column(name, justify="left" if is_text else "right", overflow="fold")
    return made


def print_rows(
    names: Sequence[str], rows: Iterator[Sequence[str]], *, left: Sequence[str]
) -> bool:
    """Print a table of any length, keeping only its first rows in memory.

    Args:
        names: the column names.
        rows: the cells of each row, which may contain untrusted text.
        left: names of the text columns, which are left-aligned; all others contain
            numbers.

    Returns:
        Whether there was at least one row.
    """
    first = list(itertools.islice(rows, _ROWS_MEASURED))
    widths = [max(map(len, column)) for column in zip(names, *first, strict=True)]
    places = ["<" if name in left else ">" for name in names]

    def shown(cells: Sequence[str]) -> str:
        parts = zip(map(printable, cells), places, widths, strict=True)
        return "  ".join(f"{c:{place}{width}}" for c, place, width in parts).rstrip()

    if first:
        for cells in itertools.chain([names], first, rows):
            sys.stdout.write(f"{shown(cells)}\n")
    return bool(first)
