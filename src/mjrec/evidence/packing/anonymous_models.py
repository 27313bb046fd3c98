# SPDX-License-Identifier: Apache-2.0
"""Models without what their authors say of themselves beside them.

Comments and metadata are removed, and files get other names (`model_file_names`); no
other element or attribute of a model changes, so that it compiles to the same. What it
is called itself, or calls its bodies, stays: a model without that is another model.
"""

from __future__ import annotations

import gzip
import io
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from ...formats.json_fields import unreadable
from .identity_matching import IdentityMatcher
from .model_file_names import is_xml, with_other_names

# What begins like a comment inside CDATA is none.
_BESIDE_THE_MODEL = re.compile(
    r"(?P<cdata><!\[CDATA\[.*?\]\]>)|<!--(?P<comment>.*?)-->", re.DOTALL
)
# Whoever gives a model away may ask that this is passed on.
_LICENCE = re.compile(r"copyright|licen[cs]e|\(c\)|©", re.IGNORECASE)
_MAIL = re.compile(r"@[\w-]+\.\w")

_PNG = b"\x89PNG\r\n\x1a\n"
# What a viewer shows beside a picture: texts, a time, what a camera noted.
_PNG_METADATA = (b"tEXt", b"zTXt", b"iTXt", b"tIME", b"eXIf")
_STL_HEADER = 80

_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError)


def anonymous_sources(content: bytes, matcher: IdentityMatcher) -> bytes:
    """Return the zip of what a model was made from, without its authors' remarks.

    Of MJCF, comments are removed; those that speak of a licence stay, unless the
    identity or an address of mail is in them. Of pictures, texts are removed; of
    meshes, comments and headers that have the identity in them.

    Args:
        content: of the zip.
        matcher: of the identity.

    Returns:
        The same bytes where nothing is to be removed.

    Raises:
        ValueError: it is damaged.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            members = {info.filename: archive.read(info) for info in infos}
        files = {name: _file(old, matcher) for name, old in members.items()}
    except _DAMAGE as error:
        raise ValueError(f"it is damaged ({error})") from error
    changed = with_other_names(files, matcher.replaced_in_name) or files
    if changed == members:
        return content
    return _zip(infos, changed)


def _zip(infos: Sequence[zipfile.ZipInfo], members: Mapping[str, bytes]) -> bytes:
    image = io.BytesIO()
    with zipfile.ZipFile(image, "w") as archive:
        for info, (name, data) in zip(infos, members.items(), strict=True):
            member = zipfile.ZipInfo(name, info.date_time)
            member.compress_type = info.compress_type
            member.create_system = info.create_system
            member.external_attr = info.external_attr
            archive.writestr(member, data)
    return image.getvalue()


def compiled_model(path: Path) -> bytes:
    """Return what is in a packed compiled model.

    Raises:
        UnreadableFile: it is damaged.
    """
    with unreadable(path):
        try:
            return gzip.decompress(path.read_bytes())
        except (EOFError, zlib.error) as error:
            raise ValueError(f"it is damaged ({error})") from error


def _file(content: bytes, matcher: IdentityMatcher) -> bytes:
    if content.startswith(_PNG):
        return b"".join(_png_parts(content))
    if is_xml(content):
        return _xml(content, matcher)
    if b"\0" not in content[:_STL_HEADER] and matcher.found_in_bytes(content):
        return _without_remarks(content, matcher)
    return _with_plain_header(content, matcher)


def _xml(content: bytes, matcher: IdentityMatcher) -> bytes:
    text = content.decode("utf-8")

    def kept(match: re.Match[str]) -> str:
        return match[0] if _may_stay(match, matcher) else ""

    new = _BESIDE_THE_MODEL.sub(kept, text)
    if _elements(new) != _elements(text):
        raise ValueError("the comments in its XML cannot be told from the model")
    return new.encode()


def _may_stay(match: re.Match[str], matcher: IdentityMatcher) -> bool:
    comment = match["comment"]
    if comment is None:
        return match["cdata"] is not None
    return (
        _LICENCE.search(comment) is not None
        and _MAIL.search(comment) is None
        and not matcher.found_in(comment)
    )


def _elements(text: str) -> str:
    """Return the XML as a form in which only what is no comment counts."""
    try:
        return ElementTree.canonicalize(text.removeprefix("\ufeff"), strip_text=True)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from error


def _without_remarks(content: bytes, matcher: IdentityMatcher) -> bytes:
    """Return a text of lines (Wavefront's OBJ) without the remarks that name one."""
    lines = content.splitlines(keepends=True)
    return b"".join(
        b"#\n"
        if line.lstrip().startswith(b"#") and matcher.found_in_bytes(line)
        else line
        for line in lines
    )


def _with_plain_header(content: bytes, matcher: IdentityMatcher) -> bytes:
    """Return a binary STL whose 80 bytes for a remark are empty, if they name one."""
    header = content[:_STL_HEADER]
    if len(content) < _STL_HEADER + 4:
        return content
    (count,) = struct.unpack_from("<I", content, _STL_HEADER)
    is_stl = len(content) == _STL_HEADER + 4 + 50 * count
    if not is_stl or not matcher.found_in_bytes(header):
        return content
    return bytes(_STL_HEADER) + content[_STL_HEADER:]


def _png_parts(content: bytes) -> Iterator[bytes]:
    yield _PNG
    start = len(_PNG)
    while start < len(content):
        (length,) = struct.unpack_from(">I", content, start)
        end = start + 12 + length
        if content[start + 4 : start + 8] not in _PNG_METADATA:
            yield content[start:end]
        start = end
