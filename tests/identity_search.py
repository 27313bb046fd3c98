# SPDX-License-Identifier: Apache-2.0
"""Search for words in files, archives and compressed data, without using mjrec."""

import gzip
import io
import zipfile
import zlib

import h5py
import numpy as np

_ENCODINGS = ("utf-8", "utf-16-le", "utf-16-be")
_PNG = b"\x89PNG\r\n\x1a\n"


def find(path, words):
    """Return the place and the word of each match in a file or directory.

    The search includes file names, even those in archives and HDF5 files.
    """
    forms = [(word, {word.lower().encode(e) for e in _ENCODINGS}) for word in words]
    return [
        (where, word)
        for where, content in _everything(path)
        for word, encoded in forms
        if any(form in content.lower() for form in encoded)
    ]


def _everything(path):
    paths = sorted(path.rglob("*")) if path.is_dir() else [path]
    for one in paths:
        where = one.relative_to(path).as_posix()
        yield f"{where} (name)", where.encode()
        if one.is_file():
            yield from _inside(where, one.read_bytes())


def _inside(where, content):
    yield where, content
    if content[:4] == b"PK\3\4":
        yield from _inside_zip(where, content)
    elif content[:2] == b"\x1f\x8b":
        yield from _inside(f"{where} (unpacked)", gzip.decompress(content))
    elif content[:8] == b"\x89HDF\r\n\x1a\n":
        yield from _inside_hdf5(where, content)
    elif content[:8] == _PNG:
        yield from _inside_png(where, content)


def _inside_zip(where, content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        yield f"{where} (comment)", archive.comment
        for member in archive.infolist():
            inside = f"{where} > {member.filename}"
            yield f"{inside} (name)", member.filename.encode()
            yield f"{inside} (beside)", member.comment + member.extra
            yield from _inside(inside, archive.read(member))


def _inside_hdf5(where, content):
    items = []
    with h5py.File(io.BytesIO(content), "r") as file:
        file.visit(items.append)
        for name in ["/", *items]:
            item = file[name]
            yield f"{where} > {name} (name)", name.encode()
            for key, value in item.attrs.items():
                yield f"{where} > {name}@{key}", key.encode() + b"\0" + _bytes(value)
            if isinstance(item, h5py.Dataset):
                names = " ".join(item.dtype.names or ())
                yield f"{where} > {name} (fields)", names.encode()
                yield f"{where} > {name}", _bytes(item[()])


def _bytes(value):
    array = np.asarray(value)
    if array.dtype.kind not in "OUS":
        return array.tobytes()
    items = array.reshape(-1).tolist()
    return b"\0".join(i if isinstance(i, bytes) else str(i).encode() for i in items)


def _inside_png(where, content):
    """Yield the text chunks of a PNG image, decompressed."""
    start = len(_PNG)
    while start < len(content):
        end = start + 12 + int.from_bytes(content[start : start + 4])
        kind, data = content[start + 4 : start + 8], content[start + 8 : end - 4]
        if kind == b"zTXt":
            yield f"{where} (zTXt)", zlib.decompress(data.partition(b"\0")[2][1:])
        start = end
