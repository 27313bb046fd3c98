# SPDX-License-Identifier: Apache-2.0
"""Search for bytes of a stored file that no reader of its contents sees.

Such bytes could say anything, and no claim of another version or machine explains them.
"""

from __future__ import annotations

import filecmp
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import h5py

from ..errors import UnreadableFile
from ..formats.json_fields import unreadable
from ..formats.regular_files import open_regular
from ..formats.trajectory_hdf5 import open_hdf5, write_hdf5
from .differences import STORED_DIFFERENTLY, Difference, differs
from .findings import Topic
from .zip_contents import open_plain_zip

# Deflate shrinks data at most to this fraction.
_MOST_EXPANSION: Final = 1032
# Before HDF5 2.0, the header of each group holds four times, as this flag says.
_WITH_TIMES: Final = 0x20
_TIMES_SIZE: Final = 16
# These are the same for all files that mjrec writes into a zip file.
_USUAL: Final = (
    *("date_time", "compress_type", "extra", "create_system", "create_version"),
    *("extract_version", "reserved", "volume", "internal_attr", "external_attr"),
)
# No real model reaches 1 GiB.
LARGEST_MODEL: Final = 1 << 30


def hidden_in_trajectory(path: Path) -> Iterator[Difference]:
    """Compare a trajectory with the file that mjrec writes from its contents.

    All versions of HDF5 and zlib store its contents in the same structure; only the
    compressed data may differ.

    Raises:
        UnreadableFile: the trajectory is damaged.
        FileNotWritten: the disk is full.
    """
    with tempfile.TemporaryDirectory() as folder:
        again = Path(folder, path.name)
        with open_hdf5(path) as reader:
            rows = reader.row_count + reader.frame_count
            if rows * reader.dtype.itemsize > _MOST_EXPANSION * path.stat().st_size:
                raise UnreadableFile(path, "it is too small for its datasets")
            write_hdf5(reader, again)
        names = ["/"]
        with h5py.File(again, "r") as file:
            file.visit(names.append)
        sizes = [_size_beside(names, each) for each in (path, again)]
        if sizes[0] != sizes[1]:
            shown = [f"{size} bytes" for size in sizes]
            yield differs(Topic.FILES, "space outside its data", *shown)
        elif not filecmp.cmp(path, again, shallow=False):
            yield STORED_DIFFERENTLY


def _size_beside(names: Sequence[str], path: Path) -> int:
    """Return the size of a file without the bytes that may differ between versions."""
    try:
        with h5py.File(path, "r") as file:
            return path.stat().st_size - sum(_varying(file[name]) for name in names)
    except (LookupError, OSError, RuntimeError, ValueError, zlib.error) as error:
        raise UnreadableFile(path, error) from error


def _varying(item: Any) -> int:
    """Return the number of an object's bytes that may differ between versions."""
    is_timed = h5py.h5o.get_info(item.id).hdr.flags & _WITH_TIMES
    size = _TIMES_SIZE if is_timed else 0
    if not isinstance(item, h5py.Dataset):
        return size
    if item.chunks is None:
        return size + int(item.id.get_storage_size())
    for part in item.iter_chunks():
        skipped, content = item.id.read_direct_chunk([each.start for each in part])
        stream = zlib.decompressobj()
        if not skipped:
            # HDF5 ignores what follows the compressed data.
            stream.decompress(content)
        size += len(content) - len(stream.unused_data)
    return size


def unpacked_model(path: Path) -> bytes:
    """Return a compiled model from its gzip file, which must hold nothing else.

    Raises:
        UnreadableFile: the file is damaged, or holds something else.
    """
    stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
    with unreadable(path), open_regular(path) as file:
        content = file.read()
        if any(content[3:8]):
            raise ValueError("its gzip header has a name, a comment, a time or more")
        try:
            model = stream.decompress(content, LARGEST_MODEL)
        except zlib.error as error:
            raise ValueError(error) from error
        if not stream.eof or stream.unused_data:
            raise ValueError("it holds more or less than one gzip stream")
    return model


def compressed_sources(path: Path, made: Path) -> dict[str, bytes]:
    """Return the compressed files in the sources of a model, keyed by name.

    Args:
        path: the zip file of the sources, which may hold nothing else.
        made: a zip file of sources that mjrec wrote on this machine, as a model of the
            layout.

    Raises:
        UnreadableFile: the zip file is damaged, or holds something else.
    """
    found: dict[str, bytes] = {}
    with (
        unreadable(path),
        open_plain_zip(made) as other,
        open_plain_zip(path) as archive,
    ):
        usual, content, end = other.infolist()[0], path.read_bytes(), 0
        for info in sorted(archive.infolist(), key=lambda info: info.filename):
            header = info.FileHeader(zip64=False)
            begin = end + len(header)
            compressed = content[begin : begin + info.compress_size]
            stream = zlib.decompressobj(-zlib.MAX_WBITS)
            size = len(stream.decompress(compressed, LARGEST_MODEL))
            is_plain = content[end:begin] == header and all(
                getattr(info, name) == getattr(usual, name) for name in _USUAL
            )
            if not is_plain or stream.unused_data or size != info.file_size:
                raise ValueError(f"{info.filename!r} has more than its content")
            end = begin + info.compress_size
            found[info.filename] = compressed
        if end != archive.start_dir:
            raise ValueError("it has more than its files")
    return found
