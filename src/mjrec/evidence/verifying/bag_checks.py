# SPDX-License-Identifier: Apache-2.0
"""Whether a bag (BagIt, RFC 8493) holds exactly what its manifests say.

Read strictly: what is not said in `manifest-sha512.txt` and `tagmanifest-sha512.txt`
is not there, and what is there is said. Nothing is followed that leads out of the bag.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path

from ...formats.regular_files import read_regular
from ..layout import FORMAT_KEY, FORMAT_VERSION, PAYLOAD
from ..verification import Check, Level, Verdict
from .archive import BAG_DECLARATION
from .digests import digest_of
from .findings import Findings
from .portable_names import check_distinct, portable_parts
from .task import Count

_INFO = "bag-info.txt"
_MANIFEST = "manifest-sha512.txt"
# Of bags that leave files out; a packed run never does.
_FETCH = "fetch.txt"
_TAG_MANIFEST = "tagmanifest-sha512.txt"

_DECLARATION = re.compile(
    r"BagIt-Version: (1\.0|0\.97)\r?\nTag-File-Character-Encoding: UTF-8(\r?\n)?"
)
_LINE = re.compile(r"(?P<digest>[0-9a-fA-F]{128})[ \t]+\*?(?P<name>.+)")
# RFC 8493: the characters that would end a line, and the percent sign itself.
_ENCODED = re.compile("%(0[AaDd]|25)")

_LONGEST_TEXT = 1 << 26
_LONGEST_DECLARATION = 1000

CLAIM = "every file of the packed run is there, unchanged, and there are no others"
_DECLARED = "the packed run says what it is, in a version that is known"


def no_bag() -> Check:
    """Return what there is to say of recordings that were not packed."""
    return Check(
        level=Level.FILES,
        claim=CLAIM,
        subject="",
        verdict=Verdict.NOT_CHECKABLE,
        reason="it is not packed, so nothing says which files there were: mjrec pack",
    )


def check_bag(bag: Path, count: Count) -> Iterator[Check]:
    """Yield what is found about a bag as a whole.

    Args:
        bag: its folder.
        count: told how many bytes are checked.
    """
    declared = Findings(Level.FILES, _DECLARED)
    declared.look(BAG_DECLARATION, _objection_to_declaration(bag))
    declared.look(_INFO, _objection_to_info(bag))
    yield from declared.checks()
    found = Findings(Level.FILES, CLAIM)
    said = {
        **_said_in(bag, _MANIFEST, found, is_payload=True),
        **_said_in(bag, _TAG_MANIFEST, found, is_payload=False),
    }
    there = dict(_files_in(bag, found))
    if _FETCH in there:
        found.look(_FETCH, "it names files that are elsewhere")
    for name in sorted(said.keys() - there.keys()):
        found.look(name, "it is missing")
    # No manifest can hold its own digest.
    for name in sorted(there.keys() - said.keys() - {_TAG_MANIFEST}):
        found.look(name, "nothing says that it belongs there")
    total = sum(there.values())
    done = 0
    for name in sorted(said.keys() & there.keys()):
        found.look(name, _difference(bag / name, said[name]))
        done += there[name]
        count(done, total)
    yield from found.checks(passed="by SHA-512", bytes=total)


def _objection_to_declaration(bag: Path) -> str | None:
    try:
        text = _text_of(bag / BAG_DECLARATION, _LONGEST_DECLARATION)
    except (OSError, ValueError) as error:
        return _because(error)
    if not _DECLARATION.fullmatch(text):
        return "it is not that of a bag of BagIt 1.0 or 0.97 in UTF-8"
    return None


def _objection_to_info(bag: Path) -> str | None:
    try:
        text = _text_of(bag / _INFO, _LONGEST_TEXT)
    except (OSError, ValueError) as error:
        return _because(error)
    versions = [
        value.strip()
        for key, _, value in (line.partition(":") for line in text.splitlines())
        if key.strip() == FORMAT_KEY
    ]
    if versions == [str(FORMAT_VERSION)]:
        return None
    if len(versions) == 1 and re.fullmatch(r"\d{1,9}", versions[0], re.ASCII):
        return (
            f"it was packed by another mjrec, as version {versions[0]}, and this one "
            f"knows version {FORMAT_VERSION}: update mjrec"
        )
    return f"it does not say one {FORMAT_KEY}"


def _said_in(
    bag: Path, manifest: str, found: Findings, *, is_payload: bool
) -> Mapping[str, str]:
    """Return the digests that a manifest says, by the names of the files."""
    said: dict[str, str] = {}
    try:
        lines = _text_of(bag / manifest, _LONGEST_TEXT).splitlines()
    except (OSError, ValueError) as error:
        found.fail(manifest, _because(error))
        return said
    for number, line in enumerate(lines, 1):
        try:
            name, digest = _entry(line, is_payload=is_payload)
            if name in said:
                raise ValueError(f"{name[:200]!r} is there twice")
        except ValueError as error:
            found.fail(manifest, f"line {number}: {error}")
        else:
            said[name] = digest
    try:
        check_distinct(said)
    except ValueError as error:
        found.fail(manifest, str(error))
    return said


def _entry(line: str, *, is_payload: bool) -> tuple[str, str]:
    match = _LINE.fullmatch(line)
    if match is None:
        raise ValueError("it is not a SHA-512 and a name")
    name = _ENCODED.sub(lambda found: chr(int(found[1], 16)), match["name"])
    parts = portable_parts(name)
    if (parts[0] == PAYLOAD) is not is_payload:
        where = "inside" if is_payload else "outside"
        raise ValueError(f"{name[:200]!r} is not {where} {PAYLOAD}/")
    return name, match["digest"].lower()


def _files_in(bag: Path, found: Findings) -> Iterator[tuple[str, int]]:
    """Yield the names and sizes of the regular files of a bag."""
    folders = [bag]
    while folders:
        folder = folders.pop()
        with os.scandir(folder) as entries:
            for entry in entries:
                path = Path(entry.path)
                name = path.relative_to(bag).as_posix()
                status = entry.stat(follow_symlinks=False)
                if stat.S_ISDIR(status.st_mode):
                    folders.append(path)
                elif stat.S_ISREG(status.st_mode):
                    yield name, status.st_size
                else:
                    found.look(name, "it is neither a file nor a folder, but a link")


def _difference(path: Path, digest: str) -> str | None:
    try:
        found = digest_of(path, "sha512")
    except (OSError, ValueError) as error:
        return _because(error)
    if found == digest:
        return None
    return (
        f"it was changed: its SHA-512 begins with {found[:16]}, and the packed run "
        f"says {digest[:16]}"
    )


def _text_of(path: Path, limit: int) -> str:
    return read_regular(path, limit=limit).decode("utf-8")


def _because(error: Exception) -> str:
    if isinstance(error, UnicodeDecodeError):
        return "it is not UTF-8 text"
    reason = error.strerror if isinstance(error, OSError) else None
    return f"it cannot be read: {reason or error}"
