# SPDX-License-Identifier: Apache-2.0
"""Removal of the names of people and machines from recordings.

In a staged monitor directory, whose files are copies or links:

- strings in JSON (manifests, metadata, statistics, journals, text recordings), in
  trajectories' facts and in Stable-Baselines3's CSV get placeholders: `<home>`,
  `<path>`, `<user>`, `<host>`;
- in a recording's provenance, the command line is reduced to file names, the code's
  commit and location are removed, and so are directories in variables;
- of the device that rendered a video, only the index is kept, and UUIDs of GPUs become
  `<gpu>`, because each identifies a single card;
- in file names, an identity in a uid, a camera or a prefix becomes `user` or `host`,
  and references to these files are changed to match;
- comments are removed from the sources of models, and metadata from their images. No
  element or attribute changes, so the model compiles to the same result, and names are
  kept;
- a compiled model that contains the identity is removed. Only its author could have
  loaded it.

`identity_matching` defines the matching. Times and numbers are kept, including the
process id in a default uid. Any other trace of the identity remains, for example in a
body's name; `remaining_identity` finds such traces.
"""

from __future__ import annotations

import gzip
import io
import logging
import os
import re
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ..atomic_files import replacing, writing
from ..errors import InvalidArgument, UnreadableFile
from ..formats.json_fields import unreadable
from ..formats.monitor_directory import FILE_PREFIX, infix_of, is_second_name
from ..formats.trajectory_file import amend_trajectories
from ..json_text import dumps, loads
from .identity import Identity
from .identity_matching import IdentityMatcher

logger = logging.getLogger(__name__)

_JSON = re.compile(r".*\.json~*")
_MODEL = f"{FILE_PREFIX}.model."

# System directories are the same on every machine.
_SHARED = r"(?!(?:usr|bin|sbin|lib|lib64|opt|etc|proc|sys|dev)(?:/|$))"
_DIRECTORY = re.compile(rf"(?<![\w./])/{_SHARED}[^\s\"':,;<>=]+")
# Only text that is certainly a path, which `dm_control/cheetah-run` is not.
_PATH_OF_FILE = re.compile(
    r"(?<![\w.-])(?:[/~]|\.\.?/)[^\s\"':,;<>=]*|[^\s\"':,;<>=]*/[^\s\"':,;<>=/]*\.\w+"
)
# UUIDs of GPUs and MIG slices. `CUDA_VISIBLE_DEVICES` also accepts prefixes of them.
_GPU = re.compile(r"(?<![\w-])(?:GPU|MIG)-[0-9a-fA-F][0-9a-fA-F/-]*")
# A commit can be found with a search engine.
_CODE = {"remote": None, "root": "<path>", "commit": "<commit>"}

# Inside CDATA, `<!--` does not begin a comment.
_BESIDE_THE_MODEL = re.compile(
    r"(?P<cdata><!\[CDATA\[.*?\]\]>)|<!--(?P<comment>.*?)-->", re.DOTALL
)
# Licenses require that these comments be kept.
_LICENCE = re.compile(r"copyright|licen[cs]e|\(c\)|©", re.IGNORECASE)
_MAIL = re.compile(r"@[\w-]+\.\w")

_PNG = b"\x89PNG\r\n\x1a\n"
# Text, modification time and EXIF.
_PNG_METADATA = (b"tEXt", b"zTXt", b"iTXt", b"tIME", b"eXIf")

_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError)


def make_anonymous(recordings: Path, *, identity: Identity) -> None:
    """Remove an identity from a monitor directory that consists of copies or links.

    Nothing is written in place: a file that is a hard link to an original is replaced
    by a new file. After an error the directory is unusable.

    Args:
        recordings: the directory.
        identity: the identity to remove.

    Raises:
        UnreadableFile: a file is damaged, so its contents are unknown.
        InvalidArgument: two files would have the same name.
        FileNotWritten: the disk is full.
    """
    matcher = IdentityMatcher(identity)
    paths = sorted(path for path in recordings.iterdir() if path.is_file())
    texts = _Texts(matcher, [path.name for path in paths])
    names = {path: texts.name(path.name) for path in paths}
    name, count = Counter(names.values()).most_common(1)[0]
    if count > 1:
        raise InvalidArgument(
            f"Without the names of people and machines, two files would both be "
            f"named {name!r}. Record with different uids or camera names."
        )
    for path, new in names.items():
        _make_file_anonymous(path, texts, matcher)
        if new != path.name and path.exists():
            path.rename(path.with_name(new))


class _Texts:
    """Anonymizes strings, including the names of renamed files in them.

    Args:
        matcher: finds the identity.
        names: the names of all files.
    """

    def __init__(self, matcher: IdentityMatcher, names: list[str]) -> None:
        self._matcher = matcher
        self._infixes = _renamed_infixes(matcher, names)
        olds = sorted(self._infixes, key=len, reverse=True)
        any_old = "|".join(map(re.escape, olds)) if olds else r"(?!)"
        self._infix = re.compile(rf"(?<!\w)(?:{any_old})(?![\w-])")

    def name(self, name: str) -> str:
        """Return the new name of a file."""
        return self._matcher.replaced_in_name(self._with_new_infixes(name))

    def text(self, text: str) -> str:
        """Return a string with the identity removed."""
        is_of_monitor = text.startswith(f"{FILE_PREFIX}.")
        if is_second_name(text) or (is_of_monitor and not re.search(r"[/\s]", text)):
            return self.name(text)
        return self._matcher.replaced(self._with_new_infixes(text))

    def value(self, value: Any) -> Any:
        """Return a JSON value with the identity removed."""
        match value:
            case str():
                return self.text(value)
            case list():
                return [self.value(item) for item in value]
            case dict():
                return {
                    self.text(key): self.value(_general(key, item))
                    for key, item in value.items()
                }
            case _:
                return value

    def json(self, data: bytes) -> bytes:
        """Return JSON with the identity removed; the same bytes if nothing changes."""
        value = loads(data)
        new = self.value(value)
        return data if new == value else dumps(new).encode()

    def _with_new_infixes(self, text: str) -> str:
        return self._infix.sub(lambda match: self._infixes[match[0]], text)


def _make_file_anonymous(path: Path, texts: _Texts, matcher: IdentityMatcher) -> None:
    name = path.name
    if _JSON.fullmatch(name):
        _rewrite(path, texts.json)
    elif name.endswith(".jsonl"):
        _rewrite(path, lambda data: b"".join(_json_lines(data, texts)))
    elif name.endswith(".csv"):
        _rewrite(path, lambda data: b"".join(_csv_lines(data, texts)))
    elif name.endswith(".h5"):
        with writing(path):
            amend_trajectories({path: texts.value})
    elif name.startswith(_MODEL) and name.endswith(".zip"):
        _rewrite(path, lambda data: anonymous_sources(data, matcher))
    elif name.startswith(_MODEL):
        try:
            with unreadable(path):
                model = gzip.decompress(path.read_bytes())
        except (EOFError, zlib.error) as error:
            raise UnreadableFile(path, f"it is damaged ({error})") from error
        if matcher.found_in_bytes(model):
            logger.info("Leaving out %s: it contains the identity of its author.", name)
            path.unlink()


def _rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    with unreadable(path):
        old = path.read_bytes()
        new = change(old)
    if new != old:
        with writing(path), replacing(path) as temporary:
            temporary.write_bytes(new)


def _json_lines(data: bytes, texts: _Texts) -> Iterator[bytes]:
    for line in data.splitlines(keepends=True):
        text = line.rstrip(b"\n")
        try:
            yield texts.json(text) + line[len(text) :]
        except ValueError:
            # A torn line: readers skip it too.
            logger.info("Leaving out a journal line that is not valid JSON.")


def _csv_lines(data: bytes, texts: _Texts) -> Iterator[bytes]:
    for line in data.splitlines(keepends=True):
        if line.startswith(b"#"):
            yield b"#" + texts.json(line[1:].rstrip(b"\n")) + b"\n"
        else:
            yield texts.text(line.decode()).encode()


def _general(key: str, value: Any) -> Any:
    """Return a JSON key's value without traces of a person or a machine."""
    if key == "provenance" and isinstance(value, dict):
        return {k: _general_provenance(k, item) for k, item in value.items()}
    if key == "gl_device" and isinstance(value, dict):
        return {k: v for k, v in value.items() if k not in ("uuid", "file")}
    return value


def _general_provenance(key: str, value: Any) -> Any:
    match key, value:
        case "working_directory", _:
            return "<path>"
        case "command", list():
            return [_without_directories(each) for each in value]
        case "variables", dict():
            return {name: _general_variable(each) for name, each in value.items()}
        case "code", dict():
            return {**value, **{k: v for k, v in _CODE.items() if k in value}}
        case "policy", {"file": str(file)}:
            return {**value, "file": os.path.basename(file)}  # noqa: PTH119  text
        case _:
            return value


def _general_variable(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    return _GPU.sub("<gpu>", _DIRECTORY.sub("<path>", value))


def _without_directories(argument: Any) -> Any:
    if not isinstance(argument, str):
        return argument
    return _PATH_OF_FILE.sub(
        lambda match: match[0].rstrip("/").rpartition("/")[2] or "<path>", argument
    )


def _renamed_infixes(matcher: IdentityMatcher, names: list[str]) -> Mapping[str, str]:
    """Return the new infixes of monitors whose old infixes contain the identity."""
    old = sorted({infix for name in names if (infix := infix_of(name)) is not None})
    taken = {infix for infix in old if matcher.replaced_in_name(infix) == infix}
    new: dict[str, str] = {}
    for infix in old:
        if infix in taken:
            continue
        monitor_id, _, uid = infix.partition(".")
        uid, number = matcher.replaced_in_name(uid), 1
        candidate = f"{monitor_id}.{uid}"
        while candidate in taken:
            number += 1
            candidate = f"{monitor_id}.{uid}-{number}"
        new[infix] = candidate
        taken.add(new[infix])
    return new


def anonymous_sources(content: bytes, matcher: IdentityMatcher) -> bytes:
    """Return the zip file of a model's sources, without comments and metadata.

    Comments that mention a license are kept, unless they contain the identity or an
    email address.

    Args:
        content: the bytes of the zip file.
        matcher: finds the identity.

    Returns:
        The same bytes if there is nothing to remove.

    Raises:
        ValueError: the zip file or a file in it is damaged.
    """
    image = io.BytesIO()
    is_same = True
    try:
        with (
            zipfile.ZipFile(io.BytesIO(content)) as archive,
            zipfile.ZipFile(image, "w") as changed,
        ):
            for info in archive.infolist():
                old = archive.read(info)
                new = _source_file(old, matcher)
                is_same = is_same and new == old
                changed.writestr(info, new)
    except _DAMAGE as error:
        raise ValueError(f"it is damaged ({error})") from error
    return content if is_same else image.getvalue()


def _source_file(content: bytes, matcher: IdentityMatcher) -> bytes:
    if content.startswith(_PNG):
        return b"".join(_png_parts(content))
    # MJCF files may have any name.
    if content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        return _xml(content, matcher)
    return content


def _xml(content: bytes, matcher: IdentityMatcher) -> bytes:
    def kept(match: re.Match[str]) -> str:
        comment = match["comment"]
        may_stay = comment is None or (
            _LICENCE.search(comment) is not None
            and _MAIL.search(comment) is None
            and not matcher.found_in(comment)
        )
        return match[0] if may_stay else ""

    text = content.decode("utf-8")
    new = _BESIDE_THE_MODEL.sub(kept, text)
    if _elements(new) != _elements(text):
        raise ValueError("removing the comments from its XML would change the model")
    return new.encode()


def _elements(text: str) -> str:
    """Return the canonical form of XML, which leaves out comments."""
    try:
        return ElementTree.canonicalize(text.removeprefix("\ufeff"), strip_text=True)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not valid XML: {error}") from error


def _png_parts(content: bytes) -> Iterator[bytes]:
    yield _PNG
    start = len(_PNG)
    while start < len(content):
        (length,) = struct.unpack_from(">I", content, start)
        end = start + 12 + length
        if content[start + 4 : start + 8] not in _PNG_METADATA:
            yield content[start:end]
        start = end
