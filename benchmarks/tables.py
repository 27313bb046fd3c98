# SPDX-License-Identifier: Apache-2.0
"""Printable tables of results."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from .results import Result

_COLUMNS = ("", "median", "half within", "compared", "half within", "promise", "kept")


def table_of(title: str, results: Sequence[Result]) -> Table:
    """Return the table for one measurement."""
    table = Table(title=title, title_justify="left")
    for number, name in enumerate(_COLUMNS):
        table.add_column(name, justify="left" if number == 0 else "right")
    table.add_column("notes")
    for number, result in enumerate(results):
        if number == 0 or results[number - 1].subject != result.subject:
            table.add_section()
            table.add_row(f"[bold]{result.subject}[/bold]")
        table.add_row(*_cells(result))
    return table


def _cells(result: Result) -> list[str]:
    if not result.samples:
        return [result.variant, "not measured", "", "", "", "", "", result.note]
    return [
        result.variant,
        f"{_number(result.median)} {result.unit}",
        _range(result.quartiles) if len(result.samples) > 1 else "",
        _comparison(result),
        _range(result.compared_quartiles) if len(result.samples) > 1 else "",
        str(result.promise or ""),
        _kept(result.is_kept),
        result.note,
    ]


def _comparison(result: Result) -> str:
    if result.reference is None or result.compared is None:
        return ""
    if result.reference.is_ratio:
        return f"{_number(result.compared)} of {result.reference.name}"
    return f"{result.compared:+.1f} over {result.reference.name}"


def _kept(is_kept: bool | None) -> str:
    if is_kept is None:
        return ""
    return "[green]yes[/green]" if is_kept else "[bold red]NO[/bold red]"


def _range(pair: tuple[float, float] | None) -> str:
    return "" if pair is None else " to ".join(map(_number, pair))


def _number(value: float) -> str:
    """Format a number with three significant digits, or as a whole number if large."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
