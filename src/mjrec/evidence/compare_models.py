# SPDX-License-Identifier: Apache-2.0
"""Two models: what they were made from, and what MuJoCo compiled of that.

Sources have to be equal, but for the name of their main file. What is compiled of them
has its hash in its name, and is another one where another MuJoCo has compiled it.
"""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from .. import json_text
from ..errors import UnreadableFile
from ..formats.json_fields import json_object
from .differences import Aspect, Difference, Same
from .findings import Topic
from .zip_contents import check_entries, check_table

_MODEL: Final = re.compile(r"openaigym\.model\.[0-9a-f]{16}")
# Four numbers; the last is the version. A model of 1 GiB is beyond any.
_MODEL_HEAD: Final = 16
_LARGEST_MODEL: Final = 1 << 30
_SOURCES: Final = "*.model.*.zip"
# In the zip file of its sources.
_CONTENTS: Final = "contents.json"


def model_name(file: str) -> str:
    """Return the name of a model without what it is followed by; "" of other files."""
    found = _MODEL.match(file.rpartition("/")[2])
    return found[0] if found else ""


def renamed_models(given: Path, made: Path) -> dict[str, str]:
    """Return the models that have another name when recreated, of the same sources."""
    sources: list[dict[str, str]] = []
    for folder in (given, made):
        names: dict[str, str] = {}
        for path in folder.rglob(_SOURCES):
            # What is damaged is found when it is compared.
            with contextlib.suppress(UnreadableFile):
                names[_sources(path)] = model_name(path.name)
        sources.append(names)
    return {
        name: sources[1][digest]
        for digest, name in sources[0].items()
        if sources[1].get(digest, name) != name
    }


def compare_sources(given: Path, made: Path, file: str) -> Iterator[Same | Difference]:
    """Yield how the sources of two models differ that are not the same bytes."""
    is_equal = _sources(given) == _sources(made)
    yield Difference(
        topic=Topic.IDENTITY,
        file=file,
        # The name of the main file is a statement.
        aspect=Aspect.STATEMENT if is_equal else Aspect.EXACT,
        how="its sources are not those of the model that was recreated",
    )


def compare_models(given: Path, made: Path, file: str) -> Iterator[Same | Difference]:
    """Yield how two compiled models differ that are not the same bytes."""
    contents = []
    for path in (given, made):
        try:
            with gzip.open(path) as model:
                contents.append(model.read(_LARGEST_MODEL))
        except (OSError, EOFError, zlib.error) as error:
            raise UnreadableFile(path, error) from error
    if contents[0][:_MODEL_HEAD] == contents[1][:_MODEL_HEAD]:
        # The head has the version of MuJoCo that wrote it.
        yield Same(topic=Topic.IDENTITY, file=file, unit="compiled model")
    if contents[0] != contents[1]:
        yield recompiled(file)
    else:
        yield Difference(
            topic=Topic.FILES,
            file=file,
            aspect=Aspect.STORED,
            how="the same model, compressed otherwise",
        )


def recompiled(file: str) -> Difference:
    """Return that a model was compiled otherwise."""
    return Difference(
        topic=Topic.IDENTITY,
        file=file,
        aspect=Aspect.MODEL,
        unit="compiled model",
        how="it was compiled otherwise",
    )


def _sources(path: Path) -> str:
    """Return the hash of a model's sources, whatever their main file is called.

    Some environments write it under a name that is random.
    """
    digest = hashlib.sha256()
    try:
        check_table(path)
        with zipfile.ZipFile(path) as sources:
            check_entries(sources)
            if sum(each.file_size for each in sources.infolist()) > _LARGEST_MODEL:
                raise ValueError("its sources are larger than any")
            contents = json_object(sources.read(_CONTENTS))
            main = f"source/{contents.get('main')}"
            digest.update(json_text.dumps({**contents, "main": ""}).encode())
            names = [name for name in sources.namelist() if name != _CONTENTS]
            for name in [main, *sorted(set(names) - {main})]:
                content = sources.read(name)
                said = "" if name == main else name
                digest.update(f"{said!r}: {len(content)}\n".encode())
                digest.update(content)
    except (KeyError, OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise UnreadableFile(path, error) from error
    return digest.hexdigest()
