# SPDX-License-Identifier: Apache-2.0
"""A folder as a BagIt bag (RFC 8493): a checksum for every file, and for the checksums.

The files of the bag are written here, because `bagit.make_bag` writes the version 0.97,
in the order in which the directory happens to be, and changes the working directory of
the whole process meanwhile. What is written is then validated by the `bagit` package,
which knows nothing of this one.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ...errors import MissingDependency, PackError
from ..layout import PAYLOAD

_ALGORITHM = "sha512"


def check_bagit() -> None:
    """Check that the `bagit` package is there.

    Raises:
        MissingDependency: it is not.
    """
    if importlib.util.find_spec("bagit") is None:
        raise MissingDependency(
            "bagit", purpose="Packing a run", install='pip install "mjrec[evidence]"'
        )


def make_bag(folder: Path, info: Mapping[str, str]) -> None:
    """Make a bag of a folder, whose payload is in `data` already.

    Args:
        folder: the bag's.
        info: what `bag-info.txt` says, besides what the payload amounts to.

    Raises:
        PackError: the `bagit` package does not take the bag for a valid one.
    """
    payload = sorted(
        (path for path in (folder / PAYLOAD).rglob("*") if path.is_file()),
        key=lambda path: path.relative_to(folder).as_posix(),
    )
    size = sum(path.stat().st_size for path in payload)
    _write_lines(
        folder / "bagit.txt",
        [
            f"BagIt-Version: {_version(payload)}",
            "Tag-File-Character-Encoding: UTF-8",
        ],
    )
    tags = {**info, "Payload-Oxum": f"{size}.{len(payload)}"}
    _write_lines(
        folder / "bag-info.txt", [f"{key}: {tags[key]}" for key in sorted(tags)]
    )
    _write_manifest(folder, "manifest", payload)
    _write_manifest(folder, "tagmanifest", sorted(folder.glob("*.txt")))
    _validate(folder)


def _version(payload: Iterable[Path]) -> str:
    """Return the version of BagIt by which the names are written.

    Since 1.0 a percent sign in a name is written as %25, which the `bagit` package and
    `sha512sum --check` do not know. Such names (of cameras with a slash, say) are
    written as they are, as 0.97 has it.
    """
    return "0.97" if any("%" in path.name for path in payload) else "1.0"


def _write_manifest(folder: Path, kind: str, files: Iterable[Path]) -> None:
    _write_lines(
        folder / f"{kind}-{_ALGORITHM}.txt",
        [f"{_digest(path)}  {path.relative_to(folder).as_posix()}" for path in files],
    )


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, _ALGORITHM).hexdigest()


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    text = "".join(f"{line}\n" for line in lines)
    path.write_text(text, encoding="utf-8", newline="\n")


def _validate(folder: Path) -> None:
    # Optional, so it is not imported with this module; it has no types.
    bagit: Any = importlib.import_module("bagit")
    try:
        bagit.Bag(str(folder)).validate()
    except bagit.BagError as error:
        raise PackError(
            f"The bag that was made is not valid: {error}. A file has been changed "
            "while it was packed, or this is a mistake in mjrec."
        ) from error
