# SPDX-License-Identifier: Apache-2.0
"""Two texts, line by line: README, citation, the table of episodes, frame hashes.

Texts are made of what stands elsewhere in the archive. So a line may differ only in
numbers that an excuse allows, or where it names a version or hardware.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular
from .compare_json import KEYS, Own, Rule, Rules
from .differences import Aspect, Difference, Same, only_in, relative_error, unlike
from .findings import Topic
from .layout import STATISTICS_COLUMNS

_LONGEST_LINE: Final = 1 << 20
# How lines of the README begin that name what it was made with, and whose claim it is.
_CLAIMS: Final = {
    "- Versions:": "versions",
    "- OpenGL:": "gl",
    "- C library:": "machine",
}
# The bag's own: how many bytes its files have.
_COUNTED: Final = b"Payload-Oxum:"
_NUMBER: Final = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_HASH_BEGINS: Final = re.compile(rb"0, +\d+, +\d+, +1, +\d+, ")


def compare_texts(
    given: Path, made: Path, file: str, rules: Rules
) -> Iterator[Same | Difference]:
    """Yield how two texts differ, line by line."""
    for number, a, b in _different_lines(given, made):
        if a is not None and (rules.translated(a) == b or a.startswith(_COUNTED)):
            continue
        yield _line_difference(file, f"line {number}", a, b)


def compare_tables(
    given: Path, made: Path, file: str, own: Own
) -> Iterator[Same | Difference]:
    """Yield how two tables of episodes differ, cell by cell.

    Args:
        given: the archive's.
        made: made again.
        file: the name of both, below `data/`.
        own: tells whether a video's hash is that of the archive's own video.
    """
    columns = STATISTICS_COLUMNS
    for number, a, b in _different_lines(given, made):
        cells = [_text(line or b"").split(",") for line in (a, b)]
        if any(len(each) < len(columns) for each in cells):
            yield _line_difference(file, f"line {number}", a, b)
            continue
        # A seed may have commas of its own: it is a list. The last columns have none.
        for name, one, other in _cells(columns, *cells):
            is_own = name == "video_sha256" and own(cells[0][-3], one)
            if one != other and not is_own:
                where = f"line {number}: {name}"
                yield _difference(file, where, one, other, KEYS.get(name))


def compare_frame_hashes(
    given: Path, made: Path, file: str
) -> Iterator[Same | Difference]:
    """Yield how the hashes of two videos' frames differ, and how many are equal."""
    differing, first, total = 0, "", -1
    with unreadable(given), open_regular(made) as other:
        total = sum(1 for line in other if _HASH_BEGINS.match(line))
    for number, a, b in _different_lines(given, made):
        begins = [_HASH_BEGINS.match(line or b"") for line in (a, b)]
        if not all(begins) or begins[0][0] != begins[1][0]:  # type: ignore[index]
            yield _line_difference(file, f"line {number}", a, b)
        elif a is not None and b is not None:
            differing += 1
            first = first or _text(a).split(",")[1].strip()
    if differing:
        yield Difference(
            topic=Topic.PICTURES,
            file=file,
            count=differing,
            unit="frame hash",
            aspect=Aspect.HASH,
            where=f"frame {first}",
            how="its hash is another",
        )
    if total > differing:
        count = total - differing
        yield Same(topic=Topic.PICTURES, file=file, count=count, unit="frame")


def _different_lines(
    given: Path, made: Path
) -> Iterator[tuple[int, bytes | None, bytes | None]]:
    with unreadable(given), open_regular(given) as one, open_regular(made) as other:
        pairs = itertools.zip_longest(_lines(one), _lines(other))
        for number, pair in enumerate(pairs, start=1):
            if pair[0] != pair[1]:
                yield number, *pair


def _lines(file: BinaryIO) -> Iterator[bytes]:
    while line := file.readline(_LONGEST_LINE):
        yield line


def _cells(
    columns: tuple[str, ...], a: list[str], b: list[str]
) -> Iterator[tuple[str, str, str]]:
    seed = columns.index("seed")
    behind = len(columns) - seed - 1
    for cells in (a, b):
        cells[seed : len(cells) - behind] = [
            ",".join(cells[seed : len(cells) - behind])
        ]
    yield from zip(columns, a, b, strict=True)


def _line_difference(
    file: str, where: str, a: bytes | None, b: bytes | None
) -> Difference:
    if a is not None and b is not None:
        return _difference(file, where, _text(a), _text(b), None)
    how = only_in(b is None, _text(a or b or b""))
    return Difference(topic=Topic.FILES, file=file, unit="value", where=where, how=how)


def _difference(file: str, where: str, a: str, b: str, rule: Rule | None) -> Difference:
    found: dict[str, Any] = {"topic": rule.topic if rule else Topic.FILES}
    claims = [claim for begin, claim in _CLAIMS.items() if a.startswith(begin)]
    if claims and b.startswith(a.partition(":")[0]):
        found |= {"aspect": Aspect.CLAIM, "claim": claims[0]}
    elif _NUMBER.sub("#", a) == _NUMBER.sub("#", b) and (
        rule is None or rule.aspect is Aspect.DERIVED
    ):
        # Only its numbers differ.
        found |= {"aspect": Aspect.DERIVED, "size": _error(a, b)}
    return Difference(file=file, unit="value", where=where, how=unlike(a, b), **found)


def _error(a: str, b: str) -> float:
    pairs = zip(*(map(float, _NUMBER.findall(each)) for each in (a, b)), strict=True)
    return max((relative_error(x, y) for x, y in pairs), default=0.0)


def _text(line: bytes) -> str:
    return line.decode(errors="backslashreplace").rstrip("\n")
