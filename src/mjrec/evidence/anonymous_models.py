# SPDX-License-Identifier: Apache-2.0
"""Models without the remarks of their authors.

Comments in MJCF and metadata in PNG images are removed. No element or attribute
changes, so the model compiles to the same result. Names of bodies and files stay:
changing them would change the model.
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

# Inside CDATA, `<!--` does not begin a comment.
_BESIDE_THE_MODEL = re.compile(
    r"(?P<cdata><!\[CDATA\[.*?\]\]>)|<!--(?P<comment>.*?)-->", re.DOTALL
)
# Licences require that these comments be kept.
_LICENCE = re.compile(r"copyright|licen[cs]e|\(c\)|©", re.IGNORECASE)
_MAIL = re.compile(r"@[\w-]+\.\w")

_PNG = b"\x89PNG\r\n\x1a\n"
# Text, modification time and EXIF.
_PNG_METADATA = (b"tEXt", b"zTXt", b"iTXt", b"tIME", b"eXIf")

_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, RuntimeError)


def anonymous_sources(content: bytes, matcher: IdentityMatcher) -> bytes:
    """Return the zip file of a model's sources, without its authors' remarks.

    Comments that mention a licence stay, unless they contain the identity or an email
    address.

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
                new = _file(old, matcher)
                is_same = is_same and new == old
                changed.writestr(info, new)
    except _DAMAGE as error:
        raise ValueError(f"it is damaged ({error})") from error
    return content if is_same else image.getvalue()


def compiled_model(path: Path) -> bytes:
    """Return the uncompressed bytes of a gzipped compiled model.

    Raises:
        UnreadableFile: the file is damaged.
    """
    with unreadable(path):
        try:
            return gzip.decompress(path.read_bytes())
        except (EOFError, zlib.error) as error:
            raise ValueError(f"it is damaged ({error})") from error


def _file(content: bytes, matcher: IdentityMatcher) -> bytes:
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
        raise ValueError("removing the comments of its XML would change the model")
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
