# SPDX-License-Identifier: Apache-2.0
"""Models without what their authors say of themselves beside them.

Comments in MJCF and texts in PNG images are removed; no element or attribute changes,
so that the model compiles to the same. What it calls its bodies and files stays: a
model without that is another model.
"""

from __future__ import annotations

import gzip
import io
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from ..formats.json_fields import unreadable
from .identity_matching import IdentityMatcher

# What begins like a comment inside CDATA is none.
_BESIDE_THE_MODEL = re.compile(
    r"(?P<cdata><!\[CDATA\[.*?\]\]>)|<!--(?P<comment>.*?)-->", re.DOTALL
)
# The licence of a model asks that this is passed on.
_LICENCE = re.compile(r"copyright|licen[cs]e|\(c\)|©", re.IGNORECASE)
_MAIL = re.compile(r"@[\w-]+\.\w")

_PNG = b"\x89PNG\r\n\x1a\n"
# What a viewer shows beside an image: texts, a time, what a camera noted.
_PNG_METADATA = (b"tEXt", b"zTXt", b"iTXt", b"tIME", b"eXIf")

_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError)


def anonymous_sources(content: bytes, matcher: IdentityMatcher) -> bytes:
    """Return the zip of what a model was made from, without its authors' remarks.

    Comments that speak of a licence stay, unless the identity or an address of mail is
    in them.

    Args:
        content: of the zip.
        matcher: of the identity.

    Returns:
        The same bytes where nothing is to be removed.

    Raises:
        ValueError: it is damaged.
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
                new = _file(old, matcher)
                is_same = is_same and new == old
                changed.writestr(info, new)
    except _DAMAGE as error:
        raise ValueError(f"it is damaged ({error})") from error
    return content if is_same else image.getvalue()


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
    # MuJoCo takes any name for MJCF.
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
        raise ValueError("the comments in its XML cannot be told from the model")
    return new.encode()


def _elements(text: str) -> str:
    """Return the XML as a form in which only what is no comment counts."""
    try:
        return ElementTree.canonicalize(text.removeprefix("\ufeff"), strip_text=True)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from error


def _png_parts(content: bytes) -> Iterator[bytes]:
    yield _PNG
    start = len(_PNG)
    while start < len(content):
        (length,) = struct.unpack_from(">I", content, start)
        end = start + 12 + length
        if content[start + 4 : start + 8] not in _PNG_METADATA:
            yield content[start:end]
        start = end
