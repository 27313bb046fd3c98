# SPDX-License-Identifier: Apache-2.0
"""Comparison of two models: their sources and the compiled models.

Sources must be equal, except for the name of their main file. A compiled model's name
contains its hash, which depends on the version of MuJoCo that compiled it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from .. import json_text
from ..errors import Error, UnreadableFile
from ..formats.json_fields import facts_in, json_object
from ..formats.monitor_directory import infix_of
from ..formats.trajectory_hdf5 import open_hdf5
from .differences import STORED_DIFFERENTLY, Aspect, Difference, Same
from .findings import Topic
from .hidden_bytes import LARGEST_MODEL, compressed_sources, unpacked_model
from .zip_contents import open_plain_zip

_MODEL: Final = re.compile(r"openaigym\.model\.[0-9a-f]{16}")
# Four numbers. The last one is the version.
_MODEL_HEAD: Final = 16
_SOURCES: Final = "*.model.*.zip"
# In the zip file of the sources.
_CONTENTS: Final = "contents.json"


RECOMPILED: Final = Difference(
    Topic.IDENTITY,
    aspect=Aspect.MODEL,
    unit="compiled model",
    how="it was compiled differently",
)


def model_name(file: str) -> str:
    """Return a model's name without its extensions; "" for other files."""
    found = _MODEL.match(file.rpartition("/")[2])
    return found[0] if found else ""


def renamed_models(given: Path, made: Path) -> dict[str, str]:
    """Map models to their recreated names if only the names differ, not the sources."""
    sources: list[dict[str, str]] = []
    for folder in (given, made):
        names: dict[str, str] = {}
        for path in folder.rglob(_SOURCES):
            # The comparison reports damaged files.
            with contextlib.suppress(UnreadableFile):
                names[_sources(path)] = model_name(path.name)
        sources.append(names)
    return {
        name: sources[1][digest]
        for digest, name in sources[0].items()
        if sources[1].get(digest, name) != name
    }


def models_of(recordings: Path) -> dict[str, set[str]]:
    """Return the names of each recording's model files, keyed by infix."""
    found: dict[str, set[str]] = {}
    for path in recordings.glob("openaigym.trajectory.*.h5"):
        # The comparison reports damaged files.
        with contextlib.suppress(Error), open_hdf5(path) as reader:
            said = facts_in(reader.facts.get("model"))
            names = {str(name) for key in ("mjb", "xml") if (name := said.get(key))}
            found.setdefault(infix_of(path.name) or "", set()).update(names)
    return found


def compare_sources(given: Path, made: Path, _: object) -> Iterator[Same | Difference]:
    """Yield the difference between two models' sources whose bytes differ."""
    if _sources(given) != _sources(made):
        yield Difference(
            Topic.IDENTITY, how="its sources differ from those of the recreated model"
        )
        return
    # The contents state the name of the main file, which may differ.
    files = [compressed_sources(path, made) for path in (given, made)]
    streams = [
        sorted(each[name] for name in each if name != _CONTENTS) for each in files
    ]
    if streams[0] != streams[1]:
        yield STORED_DIFFERENTLY


def compare_models(given: Path, made: Path, _: object) -> Iterator[Same | Difference]:
    """Compare two compiled models whose bytes differ."""
    contents = [unpacked_model(path) for path in (given, made)]
    if contents[0][:_MODEL_HEAD] == contents[1][:_MODEL_HEAD]:
        # The header contains the version of MuJoCo that wrote the model.
        yield Same(Topic.IDENTITY, unit="compiled model")
    if contents[0] != contents[1]:
        yield RECOMPILED
    else:
        yield STORED_DIFFERENTLY


def _sources(path: Path) -> str:
    """Return the hash of a model's sources, ignoring the name of their main file.

    Some environments give that file a random name.
    """
    digest = hashlib.sha256()
    try:
        with open_plain_zip(path) as sources:
            if sum(each.file_size for each in sources.infolist()) > LARGEST_MODEL:
                raise ValueError("its sources are too large")
            text = sources.read(_CONTENTS)
            contents = json_object(text)
            if json.dumps(contents).encode() != text:
                raise ValueError("its contents are not what mjrec writes")
            main = f"source/{contents.get('main')}"
            digest.update(json_text.dumps({**contents, "main": ""}).encode())
            names = [name for name in sources.namelist() if name != _CONTENTS]
            for name in [main, *sorted(set(names) - {main})]:
                content = sources.read(name)
                shown = "" if name == main else name
                digest.update(f"{shown!r}: {len(content)}\n".encode())
                digest.update(content)
    except (KeyError, OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UnreadableFile(path, error) from error
    return digest.hexdigest()
