# SPDX-License-Identifier: Apache-2.0
"""Finding and replacing an identity in strings, file names, bytes and files.

Matching ignores case. The rules are:

- Repository URLs, email addresses and ORCIDs: anywhere.
- Paths of homes and working directories: together with the rest of any path that begins
  with them. Any `/home/<name>` or `/Users/<name>` matches too.
- Full names: their words in this order or with the last one first, joined by a space,
  a dot, a comma, a hyphen, an underscore or nothing. The last word matches alone if it
  has at least six letters and no letters next to it.
- Login names and host names of at least six letters: anywhere, even inside other
  words. Those of four or five letters: with no letters next to them, or as a word in
  `CamelCase`.
- Shorter names, and those that are ordinary words here (`root`, `user`, `hopper`): only
  as a whole part of a path, before `@` and a host name, or after `@`. HalfCheetah has
  joints called `rootx`, which is not the name of an account.

In files, archives are opened, compressed files are decompressed, and every name,
attribute and string in HDF5 files is checked.
"""

from __future__ import annotations

import gzip
import importlib.resources
import io
import re
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..errors import UnreadableFile
from ..formats.trajectory_hdf5 import SIGNATURE
from .identity import HOME_OF_ANYBODY, Identity

_ORDINARY_WORDS = frozenset(
    importlib.resources.files(__package__)
    .joinpath("ordinary_words.txt")
    .read_text("utf-8")
    .split()
)
_SHORTEST_INSIDE_WORDS = 6
_SHORTEST_WORD = 4
_SHORTEST_PERSON_INSIDE_WORDS = 9

_NO_LETTER_BEFORE = r"(?<![^\W\d_])"
_NO_LETTER_AFTER = r"(?![^\W\d_])"
_JOINTS = r"[\s._,-]*"
# The characters that may follow a part of a path.
_PART_END = r"(?=[/\\\s\"':,;)\]>]|$)"
_MACHINE = r"[a-z0-9][\w.-]*"

# Runs of printable characters in binary data, of at least _SHORTEST_INSIDE_WORDS.
_ASCII_RUN = re.compile(rb"[\x20-\x7e]{6,}")
_UTF16_RUNS = {
    "utf-16-le": re.compile(rb"(?:[\x20-\x7e]\0){6,}"),
    "utf-16-be": re.compile(rb"(?:\0[\x20-\x7e]){6,}"),
}
# Any four letters occur by chance in every few hundred megabytes of compressed data or
# numbers, but not inside a run of printable characters of this length.
_LONG_RUN = 12

_ESCAPED = re.compile(r"\\u([0-9a-fA-F]{4})")

_GZIP = b"\x1f\x8b"
_ZIP = b"PK\3\4"
_FILM = re.compile(rb"....ftyp|RIFF....AVI ", re.DOTALL)
# Maximum depth of archives inside archives.
_DEEPEST = 8
_PIECE = 1 << 24
_LONGEST_NAME = 1 << 12

# A place, its content (a name or bytes), and whether the bytes may contain short
# strings by chance.
_Place = tuple[str, str | bytes, bool]

_DAMAGE = (
    OSError,
    EOFError,
    RuntimeError,
    LookupError,
    ValueError,
    TypeError,
    zlib.error,
    zipfile.BadZipFile,
)


class IdentityMatcher:
    """Finds an identity in strings, file names and bytes.

    Args:
        identity: the identity to look for.
    """

    def __init__(self, identity: Identity) -> None:
        patterns = list(_patterns(identity))
        self._texts = _alternatives(patterns)
        self._names = _alternatives([*patterns, *_short_parts(identity)])
        self._literals = [
            (text, text.encode(encoding, errors="replace"))
            for texts in vars(identity).values()
            for text in sorted(texts)
            if not text.isascii() and len(text) > 1
            for encoding in ("utf-8", *_UTF16_RUNS)
        ]

    def replaced(self, text: str) -> str:
        """Return a string with placeholders: `<home>`, `<path>`, `<user>`, `<host>`."""
        return self._texts.sub(lambda match: f"<{_placeholder(match)}>", text)

    def replaced_in_name(self, name: str) -> str:
        """Return a file name, or a part of one, with portable words as placeholders.

        Short login names also match between dots, hyphens and underscores.
        """
        return self._names.sub(_placeholder, name)

    def found_in(self, text: str) -> list[str]:
        """Return the parts of the identity found in a string, without duplicates."""
        return _unique(match[0] for match in self._texts.finditer(text))

    def found_in_name(self, name: str) -> list[str]:
        """Return the parts of the identity found in a file name, without duplicates."""
        return _unique(match[0] for match in self._names.finditer(name))

    def found_in_bytes(self, content: bytes, *, by_chance: bool = False) -> list[str]:
        r"""Return the parts of the identity in UTF-8 or UTF-16 bytes, once each.

        The bytes may be text or contain text. In binary data, matches of fewer than six
        letters count only in a run of at least twelve characters, because they occur
        by chance in numbers and in compressed data. JSON escapes such as `\u00e9` are
        decoded.

        Args:
            content: the bytes.
            by_chance: whether the bytes are compressed data or numbers, which contain
                no UTF-16.
        """
        found = [text for text, data in self._literals if data in content]
        try:
            text = "" if by_chance else content.decode()
        except UnicodeDecodeError:
            text = ""
        if text:
            unescaped = _ESCAPED.sub(lambda match: chr(int(match[1], 16)), text)
            found = [*self.found_in(text), *self.found_in(unescaped), *found]
        else:
            found += self._found_in_runs(_ASCII_RUN, content, "ascii")
        for encoding, runs in {} if by_chance else _UTF16_RUNS.items():
            found += self._found_in_runs(runs, content, encoding)
        return _unique(found)

    def _found_in_runs(
        self, runs: re.Pattern[bytes], content: bytes, encoding: str
    ) -> Iterator[str]:
        # Search the joined runs in one go, because there are many.
        text = "\n".join(run.decode(encoding) for run in runs.findall(content))
        for match in self._texts.finditer(text):
            start = text.rfind("\n", 0, match.start()) + 1
            end = text.find("\n", match.end())
            run = (len(text) if end < 0 else end) - start
            if len(match[0]) >= _SHORTEST_INSIDE_WORDS or run >= _LONG_RUN:
                yield match[0]


def _alternatives(patterns: Iterable[tuple[str, str]]) -> re.Pattern[str]:
    """Return one pattern whose group names each end in a placeholder."""
    groups = (
        f"(?P<_{number}_{placeholder}>{pattern})"
        for number, (placeholder, pattern) in enumerate(patterns)
    )
    return re.compile("|".join(groups), re.IGNORECASE)


def _placeholder(match: re.Match[str]) -> str:
    return str(match.lastgroup).rpartition("_")[2]


def _patterns(identity: Identity) -> Iterator[tuple[str, str]]:
    """Yield placeholders and the patterns they replace; the first match wins."""
    for remote in _longest_first(identity.remotes):
        yield "path", re.escape(remote)
    for address in _longest_first(identity.addresses):
        yield "user", rf"(?<!\w){re.escape(address)}(?!\w)"
    for path in _longest_first(identity.homes | identity.directories):
        kind = "home" if path in identity.homes else "path"
        yield kind, rf"(?<!\w){re.escape(path)}(?![\w-])"
    yield "home", rf"(?<!\w){HOME_OF_ANYBODY}"
    people = [re.findall(r"[^\s._,-]+", n) for n in _longest_first(identity.people)]
    for words in filter(None, people):
        yield "user", _of_person(words)
    for host in _longest_first(identity.hosts):
        yield "host", _of_name(host, rf"(?<=\w@){re.escape(host)}(?![\w-])")
    for user in _longest_first(identity.users):
        before_machine = rf"(?<![\w.+-]){re.escape(user)}(?=@{_MACHINE})"
        yield "user", _of_name(user, before_machine)
    for *_, last in filter(None, people):
        if _is_distinctive(last, _SHORTEST_INSIDE_WORDS):
            yield "user", f"{_NO_LETTER_BEFORE}{re.escape(last)}{_NO_LETTER_AFTER}"


def _of_person(words: Sequence[str]) -> str:
    *first, last = map(re.escape, words)
    orders = {_JOINTS.join(order) for order in ([*first, last], [last, *first])}
    pattern = "|".join(sorted(orders))
    if sum(map(len, words)) >= _SHORTEST_PERSON_INSIDE_WORDS:
        return pattern
    # Otherwise "An Li" would match "italian".
    return f"{_NO_LETTER_BEFORE}(?:{pattern}){_NO_LETTER_AFTER}"


def _of_name(name: str, beside_at: str) -> str:
    escaped = re.escape(name)
    if _is_distinctive(name, _SHORTEST_INSIDE_WORDS):
        return escaped
    if _is_distinctive(name, _SHORTEST_WORD):
        capital = re.escape(name[0].upper() + name[1:].lower())
        return (
            rf"{_NO_LETTER_BEFORE}{escaped}{_NO_LETTER_AFTER}"
            rf"|(?-i:(?<![A-Z]){capital}(?![a-z]))"
        )
    return rf"(?<=[/\\]){escaped}{_PART_END}|{beside_at}"


def _short_parts(identity: Identity) -> Iterator[tuple[str, str]]:
    for placeholder, names in (("user", identity.users), ("host", identity.hosts)):
        for name in _longest_first(names):
            if _is_distinctive(name, 1):
                yield placeholder, rf"(?<![^\W_]){re.escape(name)}(?![^\W_])"


def _is_distinctive(name: str, length: int) -> bool:
    """Return whether a name has at least `length` characters and is distinctive.

    It must contain a letter and must not be an ordinary word.
    """
    has_letters = any(character.isalpha() for character in name)
    return len(name) >= length and has_letters and name.lower() not in _ORDINARY_WORDS


def _longest_first(texts: Iterable[str]) -> list[str]:
    return sorted(texts, key=lambda text: (-len(text), text))


def _unique(found: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(found))


def remaining_identity(stage: Path, identity: Identity) -> list[tuple[str, str]]:
    """Return the names of people and machines that remain below a directory.

    Args:
        stage: the directory; its own name and path are not searched.
        identity: the identity to look for.

    Returns:
        Sorted pairs of a place and the string found there, without duplicates. A place
        is a file's path relative to `stage`, followed by the place inside the file.

    Raises:
        UnreadableFile: a file cannot be unpacked.
    """
    matcher = IdentityMatcher(identity)
    found: set[tuple[str, str]] = set()
    for path in sorted(stage.rglob("*")):
        where = path.relative_to(stage).as_posix()
        found.update((where, what) for what in matcher.found_in_name(path.name))
        if not path.is_file():
            continue
        try:
            for place, content, by_chance in _places_in_file(path, where):
                whats = (
                    matcher.found_in_name(content)
                    if isinstance(content, str)
                    else matcher.found_in_bytes(content, by_chance=by_chance)
                )
                found.update((place, what) for what in whats)
        except _DAMAGE as error:
            raise UnreadableFile(path, f"it cannot be unpacked ({error})") from error
    return sorted(found)


def _places_in_file(path: Path, where: str) -> Iterator[_Place]:
    with path.open("rb") as file:
        piece = file.read(_PIECE)
        if not _FILM.match(piece):
            yield from _places(where, piece + file.read(), 0)
            return
        # Videos are large, and contain no compressed data that could name a person.
        while piece:
            following = file.read(_PIECE)
            yield where, piece + following[:_LONGEST_NAME], True
            piece = following


def _places(where: str, content: bytes, depth: int) -> Iterator[_Place]:
    if depth > _DEEPEST:
        raise ValueError(f"it contains archives more than {_DEEPEST} levels deep")
    is_packed = content.startswith((SIGNATURE, _ZIP, _GZIP))
    # Compressed data is included, because its header may contain a file's name.
    yield where, content, is_packed
    if content.startswith(SIGNATURE):
        yield from _places_in_hdf5(where, content)
    elif content.startswith(_ZIP):
        yield from _places_in_zip(where, content, depth)
    elif content.startswith(_GZIP):
        yield from _places(f"{where}, unpacked", gzip.decompress(content), depth + 1)


def _places_in_zip(where: str, content: bytes, depth: int) -> Iterator[_Place]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        yield where, archive.comment, False
        for info in archive.infolist():
            inside = f"{where}: {info.filename}"
            yield inside, info.filename, False
            yield inside, info.comment + info.extra, False
            yield from _places(inside, archive.read(info), depth + 1)


def _places_in_hdf5(where: str, content: bytes) -> Iterator[_Place]:
    """Yield the strings in an HDF5 file; its places are `/group/dataset@attribute`."""
    found: list[tuple[str, Any]] = []
    with h5py.File(io.BytesIO(content), "r") as file:
        file.visititems(lambda name, item: found.append((name, item)))
        for name, item in [("", file), *found]:
            inside = f"{where}: /{name}"
            yield inside, name, False
            for key in item.attrs:
                yield inside, key, False
                yield from _texts(f"{inside}@{key}", item.attrs[key])
            if isinstance(item, h5py.Dataset):
                for member in item.dtype.names or ():
                    yield inside, member, False
                if item.dtype.kind in "OUS":
                    yield from _texts(inside, item[()])


def _texts(where: str, value: Any) -> Iterator[_Place]:
    array = np.asarray(value)
    for item in array.reshape(-1).tolist() if array.dtype.kind in "OUS" else ():
        text = item if isinstance(item, bytes) else str(item).encode(errors="replace")
        yield where, text, False
