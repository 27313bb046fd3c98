# SPDX-License-Identifier: Apache-2.0
"""The author's MJCF file of an archive, as it was when it was simulated."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from ..environments.recreate import NotRecreated
from ..errors import UnreadableFile
from ..simulation.model_sources import read_authored

_SOURCE = "source/"


def unpack_sources(path: Path, into: Path) -> tuple[Path, Any]:
    """Return an MJCF file, with all that it refers to beside it, and its model.

    Args:
        path: of the zip file that a recorder wrote.
        into: a folder.

    Raises:
        NotRecreated: it is not there, damaged or dangerous, or MuJoCo refuses it.
    """
    try:
        # It looks at all names in it.
        model = read_authored(path)
    except (OSError, UnreadableFile) as error:
        raise NotRecreated(f"its model cannot be compiled: {error}") from error
    folder = into / path.stem
    with zipfile.ZipFile(path) as archive:
        main = json.loads(archive.read("contents.json"))["main"]
        for name in archive.namelist():
            if name.startswith(_SOURCE):
                target = folder / name.removeprefix(_SOURCE)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(archive.read(name))
    return folder / main, model
