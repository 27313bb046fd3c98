# SPDX-License-Identifier: Apache-2.0
"""Claims of an archive: versions and hardware that differ from the reader's.

The same code recorded both runs, so each states its own versions and hardware. Each
difference between the two is a claim.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

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
# A version may not be a sentence.
VERSION: Final = re.compile(r"[\w.+-]{1,40}", re.ASCII)
# Other keys are not claims of versions: some excuses have other names.
_PACKAGES: Final = frozenset(("python", *PACKAGES, "zlib"))
_RECORDING: Final = "recording "
_GL: Final = ("gl_vendor", "gl_renderer", "gl_version")


def claimed_excuses(given: Path, made: Path) -> list[Excuse]:
    """Return the excuses that follow from two runs' folders (their `data/`)."""
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
        # The comparison reports unreadable files.
        with contextlib.suppress(Error, OSError, ValueError):
            yield from list(_claims(path, other, f"{_RECORDING}{infix}"))
    with contextlib.suppress(OSError, ValueError, KeyError):
        said = read_object(given / ENVIRONMENT)["packed_with"]
        yield from list(_versions(said, packed_with()))


def _claims(given: Path, made: Path, recording: str) -> Iterator[Excuse]:
    name = given.name
    if name.endswith(".jsonl"):
        runs = [_first_line(path).get("run") for path in (given, made)]
        one, other = (facts_in(run).get("versions") for run in runs)
        yield from _versions(one, other, recording)
    elif name.endswith(".h5"):
        with open_trajectory(given) as a, open_trajectory(made) as b:
            yield from _machine(a.facts, b.facts, recording)
    elif name.endswith(".meta.json"):
        claimed, here = read_object(given), read_object(made)
        video = name.removesuffix(".meta.json")
        items = [f"{video}{end}" for end in (".mp4", ".meta.json", ".framehash")]
        yield from _versions(
            claimed.get("rendered_with"), here.get("rendered_with"), *items
        )
        yield from _machine(claimed, here, *items)
        yield from _claim("gl", _joined(claimed), _joined(here), *items)
        if claimed.get("ffmpeg_sha256") != here.get("ffmpeg_sha256"):
            yield excuse_of("ffmpeg", _encoder(claimed), _encoder(here), *items)


def _versions(given: Any, made: Any, *items: str) -> Iterator[Excuse]:
    one, other = facts_in(given), facts_in(made)
    for package in dict.fromkeys((*one, *other)):
        if package in _PACKAGES:
            claimed, here = (str(each.get(package, "none")) for each in (one, other))
            if VERSION.fullmatch(claimed):
                yield from _claim(package, claimed, here, *items)


def _machine(
    given: Mapping[str, Any], made: Mapping[str, Any], *items: str
) -> Iterator[Excuse]:
    values = []
    for facts in (given, made):
        machine = facts_in(facts.get("machine"))
        # The beginning is enough to distinguish the flags of CPUs.
        values.append(" ".join(str(v)[:16] for v in machine.values()).strip())
    yield from _claim("machine", *values, *items)


def _claim(name: str, claimed: str, here: str, *items: str) -> Iterator[Excuse]:
    if claimed != here:
        yield excuse_of(name, claimed[:200], here[:200], *items)


def _joined(metadata: Mapping[str, Any]) -> str:
    return ", ".join(str(metadata[key]) for key in _GL if metadata.get(key))


def _encoder(metadata: Mapping[str, Any]) -> str:
    version = facts_in(metadata.get("encoder_version")).get("version")
    return str(version)[:60]


def _first_line(path: Path) -> Mapping[str, Any]:
    with open_regular(path) as file:
        return json_object(file.readline(_LONGEST_LINE))
