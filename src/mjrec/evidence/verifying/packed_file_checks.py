# SPDX-License-Identifier: Apache-2.0
"""Whether a packed run holds what a packed run holds, and nothing else.

A bag's manifests say which files belong to it, and whoever adds a file writes them
anew. What `mjrec pack` puts where is known besides; `recordings/` is looked at by
itself.
"""

from __future__ import annotations

import os
import stat
import urllib.parse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ...formats.json_fields import field, list_of, mapping, read_object, text
from ..layout import (
    CITATION,
    CRATE,
    ENVIRONMENT,
    PAYLOAD,
    README,
    RECORDINGS,
    STATISTICS,
)
from ..verification import Check, Level
from .archive import BAG_DECLARATION
from .findings import Findings

_DESCRIPTIONS = (CRATE, README, CITATION, ENVIRONMENT, STATISTICS)
_BAG = (
    *(BAG_DECLARATION, "bag-info.txt"),
    *("manifest-sha512.txt", "tagmanifest-sha512.txt"),
)
_ROOT = "./"


def check_packed_files(bag: Path) -> Iterator[Check]:
    """Yield what is found about the files around the recordings.

    Args:
        bag: the folder that is a bag.
    """
    payload = bag / PAYLOAD
    found = Findings(
        Level.FILES, "there is nothing in the packed run but what mjrec pack puts there"
    )
    _look_at_folder(bag, "", _BAG, PAYLOAD, found)
    _look_at_folder(payload, f"{PAYLOAD}/", _DESCRIPTIONS, RECORDINGS, found)
    yield from found.checks()
    yield from _check_crate(payload)


def _look_at_folder(
    folder: Path, prefix: str, names: tuple[str, ...], inner: str, found: Findings
) -> None:
    """Look for files of these names, one folder, and nothing else."""
    there = {entry.name: entry for entry in os.scandir(folder)}
    for name in sorted(there.keys() | set(names)):
        if name == inner:
            continue
        if name not in there:
            found.look(f"{prefix}{name}", "it is missing")
        elif name not in names:
            found.look(f"{prefix}{name}", "no packed run has such a file")
        else:
            is_file = there[name].is_file(follow_symlinks=False)
            found.look(f"{prefix}{name}", None if is_file else "it is no regular file")


def _check_crate(payload: Path) -> Iterator[Check]:
    found = Findings(Level.FILES, f"{CRATE} lists the files that are there")
    try:
        entities = _entities(payload / CRATE)
        said = dict(_said(entities))
        listed = _listed(entities)
    except (OSError, ValueError) as error:
        found.look(f"{PAYLOAD}/{CRATE}", f"it cannot be read: {error}")
        yield from found.checks()
        return
    there = dict(_sizes(payload))
    for name in sorted(there.keys() | said.keys() | listed):
        objection = None
        if name not in there:
            objection = "it is listed and not there"
        elif name not in said or name not in listed:
            objection = "it is there and not listed"
        elif said[name] != str(there[name]):
            size = f"{said[name][:30]} bytes, and has {there[name]}"
            objection = f"it is said to have {size}"
        found.look(f"{PAYLOAD}/{name[:200]}", objection)
    yield from found.checks()


def _entities(path: Path) -> Mapping[str, Mapping[str, Any]]:
    entities: dict[str, Mapping[str, Any]] = {}
    for entity in field(read_object(path), "@graph", list_of(mapping)):
        name = field(entity, "@id", text)
        if name in entities:
            raise ValueError(f"it describes {name[:200]!r} twice")
        entities[name] = entity
    return entities


def _said(entities: Mapping[str, Mapping[str, Any]]) -> Iterator[tuple[str, str]]:
    """Yield the names of the files that are described, each with its size."""
    for name, entity in entities.items():
        if entity.get("@type") == "File":
            yield urllib.parse.unquote(name), field(entity, "contentSize", text)


def _listed(entities: Mapping[str, Mapping[str, Any]]) -> set[str]:
    """Return the names of the files that are parts of the crate."""
    recordings = f"{RECORDINGS}/"
    names = set(_parts(entities, _ROOT))
    if recordings not in names:
        raise ValueError(f"it does not list {recordings}")
    return (names - {recordings}) | set(_parts(entities, recordings))


def _parts(entities: Mapping[str, Mapping[str, Any]], name: str) -> Iterator[str]:
    parts = entities.get(name, {}).get("hasPart", [])
    # One alone stands there without a list.
    for part in list_of(mapping)(parts if isinstance(parts, list) else [parts]):
        yield urllib.parse.unquote(field(part, "@id", text))


def _sizes(payload: Path) -> Iterator[tuple[str, int]]:
    """Yield the names and sizes of the files that a crate is to list."""
    for folder, prefix in ((payload, ""), (payload / RECORDINGS, f"{RECORDINGS}/")):
        for entry in os.scandir(folder):
            status = entry.stat(follow_symlinks=False)
            if stat.S_ISREG(status.st_mode) and f"{prefix}{entry.name}" != CRATE:
                yield f"{prefix}{entry.name}", status.st_size
