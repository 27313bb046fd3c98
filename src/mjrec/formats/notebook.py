# SPDX-License-Identifier: Apache-2.0
"""HTML that shows recordings in a notebook: video players and a table.

The videos are embedded in the HTML, as in mediapy, so a shared notebook still contains
them. All text comes from files, so it is escaped.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from .regular_files import read_regular

# A notebook stores every output, so videos beyond this limit are listed only by name.
MOST_BYTES = 20_000_000
_MOST_PLAYERS = 6


def shown(
    title: str,
    facts: Mapping[str, object] | None = None,
    videos: Iterable[Path] = (),
    *,
    columns: Sequence[str] = (),
    rows: Iterable[Sequence[object]] = (),
) -> str:
    """Return the HTML of a recording.

    Args:
        title: the first line.
        facts: facts about the recording, by name; None values are omitted.
        videos: the recording's videos. Those that fit are embedded as players, and the
            others are listed only by name.
        columns: the names of a table's columns.
        rows: the table's rows.
    """
    parts = [f"<strong>{html.escape(title)}</strong>"]
    known = {k: v for k, v in (facts or {}).items() if v is not None}
    if known:
        parts.append(_table((), known.items()))
    if columns:
        parts.append(_table(columns, rows))
    parts += _players(list(videos))
    return f"<div>{''.join(parts)}</div>"


def _table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    heads = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    lines = [f"<tr>{heads}</tr>"] if heads else []
    for row in rows:
        cells = "".join(f"<td>{html.escape(_text(each))}</td>" for each in row)
        lines.append(f"<tr>{cells}</tr>")
    return f"<table>{''.join(lines)}</table>"


def _text(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _players(videos: list[Path]) -> list[str]:
    parts, room = [], MOST_BYTES
    for number, path in enumerate(videos):
        name = html.escape(path.name)
        try:
            data = read_regular(path, limit=room) if number < _MOST_PLAYERS else None
        except (OSError, ValueError):
            data = None
        if data is None or path.suffix != ".mp4":
            parts.append(f"<div><code>{name}</code></div>")
            continue
        room -= len(data)
        text = base64.b64encode(data).decode("ascii")
        parts.append(
            '<figure style="display:inline-block;margin:4px">'
            '<video controls loop muted style="max-width:480px" '
            f'src="data:video/mp4;base64,{text}"></video>'
            f"<figcaption><code>{name}</code></figcaption></figure>"
        )
    return parts
