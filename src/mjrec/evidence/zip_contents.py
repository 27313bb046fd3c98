# SPDX-License-Identifier: Apache-2.0
"""Checks on a zip file's declared contents, made before anything is unpacked.

Only plain archives are accepted: files and folders below one folder, one after another
from the first byte to the table of contents, which ends the file. Anything else in the
file (a comment, bytes before, between or after entries, two entries over the same
bytes) is visible to some programs but not to others, so two readers could end up
checking different content.
"""

from __future__ import annotations

import contextlib
import stat
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ..formats.regular_files import open_regular
from .layout import MOST_ENTRIES
from .portable_names import check_distinct, portable_parts

_LONGEST_TABLE = 1 << 26

# `end of central directory`, its zip64 form, and the locator of that form.
_END = struct.Struct("<4s4H2LH")
_END_64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR_64 = struct.Struct("<4sLQL")
_LOCAL = struct.Struct("<4s5H3L2H")
_FULL_16, _FULL_32 = 0xFFFF, 0xFFFF_FFFF

# If bit 3 of the flags is set, a descriptor of one of four sizes follows the data.
_DESCRIPTOR = 0x0008
_DESCRIPTOR_SIZES = (12, 16, 20, 24)
# The flags for: encrypted, patched, strongly encrypted, with a masked table.
_UNREADABLE = 0x0001 | 0x0020 | 0x0040 | 0x2000

# The extra fields that are accepted: sizes beyond 4 GiB, times and owners. Others can
# give an entry a second name, which some programs read and others do not.
_KNOWN_EXTRAS = (0x0001, 0x000A, 0x5455, 0x5855, 0x7855, 0x7875)

# Text compresses about tenfold, and deflate reaches at most a thousandfold.
_ALWAYS_FINE = 1 << 26
_MOST_EXPANSION = 100


@contextlib.contextmanager
def open_plain_zip(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip file after checking that all programs agree on its entries.

    Raises:
        ValueError: the file is not a zip file, or not a plain one.
        OSError: the file cannot be read.
    """
    with open_regular(path) as file:
        # Comes first, because it limits how much `zipfile` reads.
        table = _place_of_table(file)
        with zipfile.ZipFile(file) as archive:
            if archive.start_dir != table:
                raise ValueError("it has two tables of contents")
            for info in archive.infolist():
                _check_entry(info)
            _check_places(archive)
            # Two names may be one file on some systems; a folder may be listed twice.
            names = (i.filename for i in archive.infolist() if not i.is_dir())
            check_distinct(names)
            yield archive


def in_order(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the entries in the order of their positions in the archive."""
    return sorted(archive.infolist(), key=lambda info: info.header_offset)


def top_folder(archive: zipfile.ZipFile) -> str:
    """Return the one folder that contains everything in an archive.

    Raises:
        ValueError: there is no such folder, or the archive is a zip bomb.
    """
    infos = archive.infolist()
    tops = {portable_parts(info.filename.rstrip("/"))[0] for info in infos}
    if len(tops) != 1 or any("/" not in info.filename for info in infos):
        raise ValueError(
            "its content is not in one folder: a packed run has a single folder at the "
            f"top, but this has {len(tops)}"
        )
    size = sum(info.file_size for info in infos)
    packed = sum(info.compress_size for info in infos)
    if size > max(_ALWAYS_FINE, _MOST_EXPANSION * packed):
        raise ValueError(f"its {packed} bytes would expand to {size}, as in a zip bomb")
    return tops.pop()


def _place_of_table(file: BinaryIO) -> int:
    """Check the end of a zip file, and return where its table of contents begins."""
    table_size, offset, entries, end = _table_of(file, file.seek(0, 2))
    if entries > MOST_ENTRIES or table_size > _LONGEST_TABLE:
        raise ValueError(
            f"it claims to contain {entries} files, more than the limit of "
            f"{MOST_ENTRIES}"
        )
    if offset + table_size != end:
        raise ValueError(
            "it has extra bytes before its first file or after its table of contents"
        )
    return offset


def _table_of(file: BinaryIO, size: int) -> tuple[int, int, int, int]:
    """Return the table's size, offset and number of entries, and where it must end."""
    if size < _END.size:
        raise ValueError("it is not a zip file")
    file.seek(size - _END.size)
    mark, disk, first_disk, here, entries, table_size, offset, comment = _END.unpack(
        file.read(_END.size)
    )
    if mark != b"PK\x05\x06":
        raise ValueError(
            "it is not a zip file, or has a comment or extra bytes at its end"
        )
    if comment or disk or first_disk or here != entries:
        raise ValueError("it has a comment, or is one part of a split archive")
    end = size - _END.size
    if _FULL_16 not in (entries,) and _FULL_32 not in (table_size, offset):
        return table_size, offset, entries, end
    return _large_table_of(file, end)


def _large_table_of(file: BinaryIO, end: int) -> tuple[int, int, int, int]:
    begin = end - _LOCATOR_64.size - _END_64.size
    if begin < 0:
        raise ValueError("it is damaged: its table of contents cannot be found")
    file.seek(begin)
    mark, rest, _, _, disk, first_disk, _, entries, table_size, offset = _END_64.unpack(
        file.read(_END_64.size)
    )
    locator, _, place, disks = _LOCATOR_64.unpack(file.read(_LOCATOR_64.size))
    is_plain = (
        (mark, locator) == (b"PK\x06\x06", b"PK\x06\x07")
        and rest == _END_64.size - 12
        and (disk, first_disk, disks, place) == (0, 0, 1, begin)
    )
    if not is_plain:
        raise ValueError("it is damaged: its table of contents cannot be found")
    return table_size, offset, entries, begin


def _check_entry(info: zipfile.ZipInfo) -> None:
    # zipfile truncates a name at its first NUL; other programs may not.
    name = info.orig_filename
    portable_parts(name.removesuffix("/"))
    kind = stat.S_IFMT(info.external_attr >> 16)
    fitting = stat.S_IFDIR if info.is_dir() else stat.S_IFREG
    if kind not in (0, fitting):
        raise ValueError(f"{name!r} is neither a file nor a folder (a link, perhaps)")
    if info.flag_bits & _UNREADABLE:
        raise ValueError(f"{name!r} is encrypted")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name!r} uses an unsupported compression method")
    if info.is_dir() and info.file_size:
        raise ValueError(f"{name!r} is a folder, but has content")
    if info.compress_type == zipfile.ZIP_STORED and (
        info.compress_size != info.file_size
    ):
        raise ValueError(f"{name!r} has two sizes")
    if info.comment:
        raise ValueError(f"{name!r} has a comment")
    _check_extra(name, info.extra)


def _check_extra(name: str, extra: bytes) -> None:
    while extra:
        kind, size = struct.unpack("<2H", extra[:4].ljust(4, b"\0"))
        if kind not in _KNOWN_EXTRAS or len(extra) < 4 + size:
            raise ValueError(
                f"{name!r} has an extra field {kind:#06x} that not all programs read"
            )
        extra = extra[4 + size :]


def _check_places(archive: zipfile.ZipFile) -> None:
    """Check that the entries follow one another with nothing between them."""
    end, may_have_descriptor = 0, False
    for info in in_order(archive):
        _check_gap(info.header_offset - end, may_have_descriptor, info.filename)
        end = _end_of(archive, info)
        may_have_descriptor = bool(info.flag_bits & _DESCRIPTOR)
    _check_gap(archive.start_dir - end, may_have_descriptor, "the table of contents")


def _check_gap(gap: int, may_have_descriptor: bool, before: str) -> None:
    allowed = _DESCRIPTOR_SIZES if may_have_descriptor else (0,)
    if gap not in allowed:
        what = "overlaps the entry before it" if gap < 0 else "follows hidden bytes"
        raise ValueError(f"{before!r} {what}")


def _end_of(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> int:
    """Return the end offset of an entry's data, according to the header before it."""
    assert archive.fp is not None
    archive.fp.seek(info.header_offset)
    header = archive.fp.read(_LOCAL.size)
    if len(header) < _LOCAL.size or header[:4] != b"PK\x03\x04":
        raise ValueError(f"{info.filename!r} is not at its stated position")
    fields = _LOCAL.unpack(header)
    name = archive.fp.read(fields[-2])
    encoding = "utf-8" if fields[2] & 0x0800 else "cp437"
    if fields[2:4] != (info.flag_bits, info.compress_type) or (
        name.decode(encoding, errors="replace") != info.orig_filename
    ):
        raise ValueError(
            f"{info.filename!r} has a header that contradicts the table of contents"
        )
    name_size, extra_size = int(fields[-2]), int(fields[-1])
    _check_extra(info.filename, archive.fp.read(extra_size))
    begin = info.header_offset + _LOCAL.size + name_size + extra_size
    return begin + info.compress_size
