# SPDX-License-Identifier: Apache-2.0
"""Whether a bag (BagIt, RFC 8493) holds exactly what its manifests say.

Read strictly: what is not said in `manifest-sha512.txt` and `tagmanifest-sha512.txt`
is not there, and what is there is said.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from ..formats.regular_files import read_regular
from .archive import BAG_DECLARATION, digest_of
from .findings import Finding, Outcome, Topic
from .layout import FORMAT_KEY, FORMAT_VERSION, PAYLOAD
from .portable_names import check_distinct, portable_parts

_INFO = "bag-info.txt"
_MANIFESTS = ("manifest-sha512.txt", "tagmanifest-sha512.txt")

_DECLARATION = re.compile(
    r"BagIt-Version: (1\.0|0\.97)\r?\nTag-File-Character-Encoding: UTF-8(\r?\n)?"
)
_LINE = re.compile(r"(?P<digest>[0-9a-fA-F]{128})[ \t]+\*?(?P<name>.+)")
# RFC 8493: the characters that would end a line, and the percent sign itself.
_ENCODED = re.compile("%(0[AaDd]|25)")
_LONGEST_TEXT = 1 << 26
_MOST_FAILURES = 100

_OnProgress = Callable[[int, int], object]


def check_bag(bag: Path, on_progress: _OnProgress) -> Iterator[Finding]:
    """Yield what is found about a bag as a whole.

    Args:
        bag: its folder.
        on_progress: told how many bytes are checked, and of how many.
    """
    objections = list(_objections(bag, on_progress))
    for name, reason in objections[:_MOST_FAILURES]:
        yield Finding(
            topic=Topic.FILES, item=name, outcome=Outcome.DIFFERENT, reason=reason
        )
    if len(objections) > _MOST_FAILURES:
        yield Finding(
            topic=Topic.FILES,
            item="",
            outcome=Outcome.DIFFERENT,
            reason="further files that are missing, changed or too many",
            count=len(objections) - _MOST_FAILURES,
        )


def unchanged(bag: Path) -> Finding:
    """Return that a bag to which nothing is to be objected is what it says."""
    return Finding(
        topic=Topic.FILES,
        item="",
        outcome=Outcome.NOTED,
        reason="they are those that the bag lists, and have the SHA-512 that it says",
        count=sum(path.is_file() for path in bag.rglob("*")),
    )


def _objections(bag: Path, on_progress: _OnProgress) -> Iterator[tuple[str, str]]:
    try:
        if not _DECLARATION.fullmatch(_text_of(bag / BAG_DECLARATION)):
            yield BAG_DECLARATION, "it is not that of a bag of BagIt 1.0 or 0.97"
        yield from ((_INFO, reason) for reason in _objections_to_info(bag))
        said = {
            **_said_in(bag, _MANIFESTS[0], is_payload=True),
            **_said_in(bag, _MANIFESTS[1], is_payload=False),
        }
    except (OSError, ValueError) as error:
        yield "", _because(error)
        return
    paths = [path for path in bag.rglob("*") if not path.is_dir()]
    there = {path.relative_to(bag).as_posix(): path.stat().st_size for path in paths}
    for name in sorted(said.keys() - there.keys()):
        yield name, "it is missing"
    known = {BAG_DECLARATION, _INFO, *_MANIFESTS}
    for name in sorted(said.keys() - known):
        if not name.startswith(f"{PAYLOAD}/"):
            yield name, "no packed run has such a file beside its data"
    # No manifest can hold its own digest.
    for name in sorted(there.keys() - said.keys() - {_MANIFESTS[1]}):
        yield name, "nothing says that it belongs there"
    total, done = sum(there.values()), 0
    for name in sorted(said.keys() & there.keys()):
        if digest_of(bag / name, "sha512") != said[name]:
            yield name, "it was changed: its SHA-512 is another one"
        done += there[name]
        on_progress(done, total)


def _objections_to_info(bag: Path) -> Iterator[str]:
    lines = _text_of(bag / _INFO).splitlines()
    fields = [
        (key.strip(), v.strip()) for key, _, v in (x.partition(":") for x in lines)
    ]
    versions = [value for key, value in fields if key == FORMAT_KEY]
    if versions != [str(FORMAT_VERSION)]:
        yield (
            f"it says {FORMAT_KEY} {', '.join(versions)[:80] or '(nothing)'}, and this "
            f"mjrec knows version {FORMAT_VERSION}: it was packed by another one"
        )


def _said_in(bag: Path, manifest: str, *, is_payload: bool) -> dict[str, str]:
    """Return the digests that a manifest says, by the names of the files."""
    said: dict[str, str] = {}
    for number, line in enumerate(_text_of(bag / manifest).splitlines(), 1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise ValueError(f"{manifest}, line {number}: no SHA-512 and a name")
        name = _ENCODED.sub(lambda found: chr(int(found[1], 16)), match["name"])
        if (portable_parts(name)[0] == PAYLOAD) is not is_payload or name in said:
            raise ValueError(f"{manifest}, line {number}: {name[:200]!r} is misplaced")
        said[name] = match["digest"].lower()
    check_distinct(said)
    return said


def _text_of(path: Path) -> str:
    return read_regular(path, limit=_LONGEST_TEXT).decode("utf-8")


def _because(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"{Path(str(error.filename)).name}: {error.strerror}"
    return (
        "it is not UTF-8 text" if isinstance(error, UnicodeDecodeError) else str(error)
    )
