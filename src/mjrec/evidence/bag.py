# SPDX-License-Identifier: Apache-2.0
"""BagIt bags (RFC 8493): writing and checking them, and packing a folder as a zip file.

The bag's files are written here because `bagit.make_bag` writes version 0.97, in
directory order, and changes the working directory of the whole process. The tests use
that package to validate the bags.

The zip file is reproducible byte for byte: its order, times, modes and system are
fixed, and owners are left out. Files that are already compressed are stored. All others
are deflated, which gives the same result with the same version of zlib.

Bags are checked strictly: every file must be listed in a manifest, and every listed
file must exist.
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from ..atomic_files import writing
from ..errors import PackError
from ..formats.regular_files import read_regular
from .archive import BAG_DECLARATION, digest_of
from .findings import Finding, Outcome, Topic
from .layout import FORMAT_KEY, FORMAT_VERSION, PAYLOAD
from .portable_names import check_distinct, portable_parts

# Extensions of files that are already compressed.
STORED = (".mp4", ".avi", ".h5", ".gz", ".zip")
# Advice for a full disk.
TRY_AGAIN = "then pack again"

_ALGORITHM = "sha512"
_LEVEL = 6
_UNIX = 3
_MODE = (stat.S_IFREG | 0o644) << 16
# The earliest time that a zip file can store.
_TIME = (1980, 1, 1, 0, 0, 0)
_BLOCK = 1 << 20

_INFO = "bag-info.txt"
_MANIFESTS = ("manifest-sha512.txt", "tagmanifest-sha512.txt")

_DECLARATION = re.compile(
    r"BagIt-Version: (1\.0|0\.97)\r?\nTag-File-Character-Encoding: UTF-8(\r?\n)?"
)
_VERSION = re.compile(rf"^[ \t]*{FORMAT_KEY}[ \t]*:(.*)", re.MULTILINE)
_LINE = re.compile(r"(?P<digest>[0-9a-fA-F]{128})[ \t]+\*?(?P<name>.+)")
# RFC 8493: the characters that would end a line, and the percent sign itself.
_ENCODED = re.compile("%(0[AaDd]|25)")
_LONGEST_TEXT = 1 << 26
_MOST_FAILURES = 100

_OnProgress = Callable[[int, int], object]


def bag_tags(folder: Path, *, date: str, title: str) -> dict[str, str]:
    """Return the contents of a bag's tag files, keyed by file name.

    Args:
        folder: the bag's folder, with its payload already in `data`.
        date: the run's date.
        title: the run's title.
    """
    payload = _files(folder / PAYLOAD)
    size = sum(path.stat().st_size for path in payload)
    # Version 1.0 writes a percent sign in a name as %25, which the `bagit` package and
    # `sha512sum --check` do not decode. Names of cameras may contain one.
    version = "0.97" if any("%" in path.name for path in payload) else "1.0"
    declared = {"BagIt-Version": version, "Tag-File-Character-Encoding": "UTF-8"}
    info = {
        "Bag-Software-Agent": "mjrec <https://pypi.org/project/mjrec/>",
        "Bagging-Date": date,
        "External-Description": title,
        FORMAT_KEY: str(FORMAT_VERSION),
        "Payload-Oxum": f"{size}.{len(payload)}",
    }
    return {BAG_DECLARATION: _lines_of(declared), _INFO: _lines_of(info)}


def make_bag(folder: Path, *, date: str, title: str) -> None:
    """Turn a folder into a bag.

    Args:
        folder: the bag's folder, with its payload already in `data`.
        date: the run's date.
        title: the run's title.

    Raises:
        PackError: a file changed while it was being packed.
    """
    for name, text in bag_tags(folder, date=date, title=title).items():
        (folder / name).write_text(text, encoding="utf-8", newline="\n")
    _write_manifest(folder, "manifest", _files(folder / PAYLOAD))
    _write_manifest(folder, "tagmanifest", sorted(folder.glob("*.txt")))
    for name, reason in _objections(folder):
        raise PackError(
            f"The new bag is invalid: {name}: {reason}. A file changed while it was "
            "being packed, or this is a bug in mjrec."
        )


def write_zip(folder: Path, path: Path) -> None:
    """Write a folder as a zip file, with that folder as its only top-level entry.

    The file has been synced to disk when this returns.

    Raises:
        FileNotWritten: the disk is full.
    """
    with writing(path, then=TRY_AGAIN), path.open("xb") as file:
        with zipfile.ZipFile(file, "w") as archive:
            for source in _files(folder):
                name = source.relative_to(folder.parent).as_posix()
                _add(archive, source, name)
        file.flush()
        os.fsync(file.fileno())


def check_bag(bag: Path, on_progress: _OnProgress) -> Iterator[Finding]:
    """Yield the findings about a bag as a whole.

    Args:
        bag: the bag's folder.
        on_progress: called with the number of bytes checked so far and in total.
    """
    objections = list(_objections(bag, on_progress))
    for name, reason in objections[:_MOST_FAILURES]:
        yield Finding(Topic.FILES, name, Outcome.DIFFERENT, reason)
    if (more := len(objections) - _MOST_FAILURES) > 0:
        reason = "more files that are missing, changed or not listed"
        yield Finding(Topic.FILES, "", Outcome.DIFFERENT, reason, count=more)


def unchanged(bag: Path) -> Finding:
    """Return the finding for a bag that is intact."""
    reason = "the files and their SHA-512 digests are those that the bag lists"
    count = len(_files(bag))
    return Finding(Topic.FILES, "", Outcome.NOTED, reason, count=count)


def _files(folder: Path) -> list[Path]:
    found = (path for path in folder.rglob("*") if path.is_file())
    # Sorted by their names in the archive: the system's order varies.
    return sorted(found, key=lambda path: path.relative_to(folder).as_posix())


def _lines_of(tags: Mapping[str, str]) -> str:
    return "".join(f"{key}: {value}\n" for key, value in tags.items())


def _write_manifest(folder: Path, kind: str, files: Iterable[Path]) -> None:
    text = "".join(
        f"{digest_of(path, _ALGORITHM)}  {path.relative_to(folder).as_posix()}\n"
        for path in files
    )
    path = folder / f"{kind}-{_ALGORITHM}.txt"
    path.write_text(text, encoding="utf-8", newline="\n")


def _add(archive: zipfile.ZipFile, source: Path, name: str) -> None:
    info = zipfile.ZipInfo(name, _TIME)
    info.create_system = _UNIX
    info.external_attr = _MODE
    info.file_size = source.stat().st_size
    stored = source.name.endswith(STORED)
    info.compress_type = zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED
    # Public only since Python 3.13, as `compress_level`; `open` reads it in all
    # versions.
    info._compresslevel = None if stored else _LEVEL  # type: ignore[attr-defined]  # see above
    with source.open("rb") as file, archive.open(info, "w") as entry:
        shutil.copyfileobj(file, entry, _BLOCK)


def _objections(
    bag: Path, on_progress: _OnProgress = lambda *_: None
) -> Iterator[tuple[str, str]]:
    try:
        if not _DECLARATION.fullmatch(_text_of(bag / BAG_DECLARATION)):
            yield BAG_DECLARATION, "it does not declare BagIt 1.0 or 0.97"
        versions = [found.strip() for found in _VERSION.findall(_text_of(bag / _INFO))]
        if versions != [str(FORMAT_VERSION)]:
            said = ", ".join(versions)[:80] or "(missing)"
            yield (
                _INFO,
                f"its {FORMAT_KEY} is {said}, but this version of mjrec reads "
                f"{FORMAT_VERSION}",
            )
        listed = {
            **_said_in(bag, _MANIFESTS[0], is_payload=True),
            **_said_in(bag, _MANIFESTS[1], is_payload=False),
        }
    except (OSError, ValueError) as error:
        yield "", _because(error)
        return
    paths = [path for path in bag.rglob("*") if not path.is_dir()]
    there = {path.relative_to(bag).as_posix(): path.stat().st_size for path in paths}
    for name in sorted(listed.keys() - there.keys()):
        yield name, "it is missing"
    known = {BAG_DECLARATION, _INFO, *_MANIFESTS}
    for name in sorted(listed.keys() - known):
        if not name.startswith(f"{PAYLOAD}/"):
            yield name, "packed runs have no such file outside data/"
    # No manifest can contain its own digest.
    for name in sorted(there.keys() - listed.keys() - {_MANIFESTS[1]}):
        yield name, "no manifest lists it"
    total, done = sum(there.values()), 0
    for name in sorted(listed.keys() & there.keys()):
        if digest_of(bag / name, _ALGORITHM) != listed[name]:
            yield name, "it was changed: its SHA-512 differs from the listed one"
        done += there[name]
        on_progress(done, total)


def _said_in(bag: Path, manifest: str, *, is_payload: bool) -> dict[str, str]:
    """Return the digests that a manifest lists, keyed by file name."""
    listed: dict[str, str] = {}
    for number, line in enumerate(_text_of(bag / manifest).splitlines(), 1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise ValueError(
                f"{manifest}, line {number}: not a SHA-512 digest and a name"
            )
        name = _ENCODED.sub(lambda found: chr(int(found[1], 16)), match["name"])
        if (portable_parts(name)[0] == PAYLOAD) is not is_payload or name in listed:
            raise ValueError(f"{manifest}, line {number}: {name[:200]!r} is misplaced")
        listed[name] = match["digest"].lower()
    check_distinct(listed)
    return listed


def _text_of(path: Path) -> str:
    return read_regular(path, limit=_LONGEST_TEXT).decode("utf-8")


def _because(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"{Path(str(error.filename)).name}: {error.strerror}"
    return (
        "it is not UTF-8 text" if isinstance(error, UnicodeDecodeError) else str(error)
    )
