# SPDX-License-Identifier: Apache-2.0
"""Claims made by an archive: versions and hardware that differ from the reader's.

The same code recorded both runs, so each states its own versions and hardware. Each
difference between the two is a claim.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

from ..errors import Error
from ..formats.json_fields import facts_in, json_object, read_object
from ..formats.monitor_directory import infix_of
from ..formats.regular_files import open_regular
from ..formats.trajectory_file import open_trajectory
from ..provenance import PACKAGES
from .compare_models import models_of
from .descriptions import packed_with
from .excuses import excuse_of
from .findings import Excuse
from .layout import ENVIRONMENT, RECORDINGS

_LONGEST_LINE: Final = 1 << 24
_COMPILING: Final = ("mujoco", "machine")
# A version must be short, and cannot be a sentence.
VERSION: Final = re.compile(r"[\w.+-]{1,40}", re.ASCII)
# Only these names claim versions; some excuses have other names.
_PACKAGES: Final = frozenset(("python", *PACKAGES, "hdf5", "zlib"))
_RECORDING: Final = "recording "
_METADATA: Final = ".meta.json"
# For each name, the value to compare and the value to show, which may be the same.
_Stated: TypeAlias = Mapping[str, tuple[str, ...]]
_NONE: Final = ("none",)
_GL: Final = ("gl_vendor", "gl_renderer", "gl_version")


def claimed_excuses(given: Path, made: Path) -> list[Excuse]:
    """Return the excuses that follow from comparing two runs' `data/` folders."""
    found = list(_all_claims(given, made))
    if not any(excuse.name in _COMPILING for excuse in found):
        return found
    models = models_of(given / RECORDINGS)
    return [
        _with_models(each, models) if each.name in _COMPILING else each
        for each in found
    ]


def _with_models(excuse: Excuse, models: Mapping[str, Iterable[str]]) -> Excuse:
    """Return an excuse extended to the compiled models of its recordings."""
    infixes = (i.removeprefix(_RECORDING) for i in excuse.items if _RECORDING in i)
    names = {name for infix in infixes for name in models.get(infix, ())}
    compiled = sorted(name for name in names if name.endswith(".mjb.gz"))
    return dataclasses.replace(excuse, items=(*excuse.items, *compiled))


def _all_claims(given: Path, made: Path) -> Iterator[Excuse]:
    looked_at = set()
    for path in sorted((given / RECORDINGS).glob("openaigym.*")):
        other = made / RECORDINGS / path.name
        infix = infix_of(path.name)
        if infix is None or not other.is_file():
            continue
        if path.suffix == ".h5":
            # All trajectories of a recording come from one machine.
            if infix in looked_at:
                continue
            looked_at.add(infix)
        items = [f"{_RECORDING}{infix}"]
        if path.name.endswith(_METADATA):
            video = path.name.removesuffix(_METADATA)
            items = [f"{video}{end}" for end in (".mp4", _METADATA, ".framehash")]
        # The comparison reports unreadable files.
        with contextlib.suppress(Error, OSError, ValueError):
            yield from _claims(_stated(path), _stated(other), items)
    with contextlib.suppress(OSError, ValueError, KeyError):
        said = read_object(given / ENVIRONMENT)["packed_with"]
        yield from _claims(_versions(said), _versions(packed_with()), ())


def _claims(given: _Stated, made: _Stated, items: Iterable[str]) -> Iterator[Excuse]:
    for name in dict.fromkeys((*given, *made)):
        one, other = given.get(name, _NONE), made.get(name, _NONE)
        is_valid = name not in _PACKAGES or VERSION.fullmatch(one[-1])
        if one != other and is_valid:
            yield excuse_of(name, one[-1][:200], other[-1][:200], *items)


def _stated(path: Path) -> _Stated:
    """Return the versions and hardware that are stated in a recording's file."""
    if path.suffix == ".jsonl":
        with open_regular(path) as file:
            line = json_object(file.readline(_LONGEST_LINE))
        return _versions(facts_in(line.get("run")).get("versions"))
    if path.suffix == ".h5":
        with open_trajectory(path) as reader:
            return {"machine": _machine(reader.facts)}
    if not path.name.endswith(_METADATA):
        return {}
    facts = read_object(path)
    encoder = facts_in(facts.get("encoder_version")).get("version")
    return {
        **_versions(facts.get("rendered_with")),
        "machine": _machine(facts),
        "gl": (", ".join(str(facts[key]) for key in _GL if facts.get(key)),),
        "ffmpeg": (str(facts.get("ffmpeg_sha256")), str(encoder)[:60]),
    }


def _versions(said: Any) -> _Stated:
    known = facts_in(said)
    return {name: (str(known[name]),) for name in known if name in _PACKAGES}


def _machine(facts: Mapping[str, Any]) -> tuple[str]:
    # A prefix is enough to tell the flags of different CPUs apart.
    values = facts_in(facts.get("machine")).values()
    return (" ".join(str(value)[:16] for value in values).strip(),)
