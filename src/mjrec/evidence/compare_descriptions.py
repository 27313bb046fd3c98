# SPDX-License-Identifier: Apache-2.0
"""Comparison of a packed run's descriptions with ones regenerated from its recordings.

The recordings are compared separately. README, citation, table and crate must follow
from the archive's manifests, metadata and trajectories alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from ..errors import Error, UnreadableFile
from ..formats.json_fields import read_object, unreadable
from ..formats.regular_files import read_regular
from .bag import bag_tags
from .claims import VERSION
from .descriptions import descriptions, packed_with
from .differences import Difference, Same, only_in, unlike
from .findings import Topic
from .layout import ENVIRONMENT, PAYLOAD, RECORDINGS
from .packed_run import read_run
from .read_inputs import packing_options

_LONGEST_FILE: Final = 1 << 28


def compare_descriptions(bag: Path) -> Iterator[Same | Difference]:
    """Compare the descriptions of a bag with regenerated ones."""
    try:
        texts = rewritten(bag)
    except Error as error:
        reason = error.reason if isinstance(error, UnreadableFile) else str(error)
        yield _difference(ENVIRONMENT, f"descriptions cannot be regenerated: {reason}")
        return
    payload = bag / PAYLOAD
    there = {path.name: path for path in payload.iterdir() if path.name != RECORDINGS}
    there |= {name: bag / name for name in texts if (bag / name).exists()}
    for name in sorted(there.keys() | texts.keys()):
        if name not in texts or name not in there:
            yield _difference(name, only_in(name in there, name))
        else:
            yield _compare(name, there[name], texts[name])


def rewritten(bag: Path) -> dict[str, str]:
    """Return a bag's descriptions, regenerated from its recordings, keyed by file name.

    Raises:
        Error: a file is damaged or has invalid contents.
    """
    path, recordings = bag / PAYLOAD / ENVIRONMENT, bag / PAYLOAD / RECORDINGS
    with unreadable(path):
        recorded = read_object(path).get("packed_with")
        if not isinstance(recorded, dict):
            raise ValueError("it lacks the versions of the software that packed it")
        options = packing_options(recorded.get("options") or {})
    run = read_run(recordings, options=options)
    texts = descriptions(run, recordings, packed_with=_claimed(recorded))
    return {**texts, **bag_tags(bag, date=run.date, title=run.title)}


def _claimed(recorded: dict[str, Any]) -> dict[str, str]:
    """Return the claimed versions of the software that packed the run."""
    claimed = {name: str(recorded.get(name)) for name in packed_with()}
    return {n: v for n, v in claimed.items() if VERSION.fullmatch(v)}


def _compare(name: str, path: Path, text: str) -> Same | Difference:
    with unreadable(path):
        given = read_regular(path, limit=_LONGEST_FILE)
    if given == text.encode():
        return Same(Topic.FILES, file=name)
    lines = (given.decode(errors="backslashreplace").split("\n"), text.split("\n"))
    added, missing = (_first_more(*each) for each in (lines, lines[::-1]))
    match added, missing:
        case (number, one), (_, other):
            return _difference(name, unlike(one, other), where=f"line {number}")
        case (number, one), None:
            return _difference(name, only_in(True, one), where=f"line {number}")
        case None, (_, other):
            return _difference(name, only_in(False, other))
    return _difference(name, "its whitespace or the order of its lines differs")


def _first_more(lines: list[str], others: list[str]) -> tuple[int, str] | None:
    """Return the first line that the others contain less often, with its number."""
    more = Counter(lines) - Counter(others)
    found = (
        (number, line)
        for number, line in enumerate(lines, start=1)
        if line in more and any(map(str.isalnum, line))
    )
    return next(found, None)


def _difference(name: str, how: str, *, where: str = "") -> Difference:
    return Difference(Topic.FILES, file=name, where=where, how=how)
