# SPDX-License-Identifier: Apache-2.0
"""What a model was made from: MJCF and the files it refers to, in one zip.

::

    contents.json          {"format": 1, "main": "humanoid.xml"}
    source/humanoid.xml    the files, laid out as their authors did
    source/meshes/...
    fields/<name>.npy      the fields in which the stored model is other than the
                           compiled sources: what an environment set by hand

The same content makes the same bytes. Compiling reads nothing but these files.
"""

from __future__ import annotations

import io
import json
import logging
import os
import posixpath
import re
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..formats.regular_files import open_regular
from ..json_text import loads
from .fields import apply_fields, differing_fields

logger = logging.getLogger(__name__)

_FORMAT = 1
_CONTENTS = "contents.json"
_SOURCE = "source/"
_FIELDS = "fields/"
_EPOCH = (1980, 1, 1, 0, 0, 0)

# Attributes of MJCF that say where the files are.
_DIRECTORIES = ("assetdir", "meshdir", "texturedir")
_XML_ELEMENTS = ("include", "model")

# A path is put together from several attributes, and each may go up so far. The files
# are compiled further below an empty directory than that: going up leads to nothing.
_MOST_UP = 4
_EMPTY = PurePosixPath(*["x"] * 8 * _MOST_UP)

# What MuJoCo raises where memory does not suffice, as a RuntimeError.
_MUJOCO_GAVE_UP = "Caught an unknown exception!"


@dataclass(frozen=True)
class AuthoredModel:
    """MJCF with every file that it depends on.

    Attributes:
        main: the name of the MJCF file that is compiled.
        files: the content of every file by its name: a relative path with `/`.
    """

    main: str
    files: Mapping[str, bytes]

    def plainly_named(self) -> AuthoredModel:
        """Return the same with names as short as they can be: no `./` in them."""
        files = {posixpath.normpath(name): self.files[name] for name in self.files}
        return AuthoredModel(posixpath.normpath(self.main), files)


def authored_from_file(path: Path) -> AuthoredModel | None:
    """Return an MJCF file and everything it includes and refers to.

    Returns:
        None where that cannot be found out or stored: a file is missing or named by
        an absolute path, a plugin is used, or it is no MJCF.
    """
    try:
        return _gathered(Path(os.path.abspath(path)))  # noqa: PTH100  resolve() would follow links, and names are relative to where a file is named
    except (ValueError, OSError):
        logger.debug("What %s is made from is not stored.", path, exc_info=True)
        return None


def write_authored(
    path: Path, authored: AuthoredModel, model: mujoco.MjModel, *, limit: int
) -> None:
    """Write what `model` was made from, and what was set in it by hand.

    Raises:
        ValueError: that would not give the same model.
    """
    authored = authored.plainly_named()
    compiled = compile_authored(authored)
    fields = differing_fields(compiled, model)
    members = {
        _CONTENTS: json.dumps({"format": _FORMAT, "main": authored.main}).encode(),
        **{_SOURCE + name: content for name, content in authored.files.items()},
        **{f"{_FIELDS}{name}.npy": _npy(value) for name, value in fields.items()},
    }
    if sum(map(len, members.values())) > limit:
        raise ValueError(f"it is larger than {limit} bytes")
    with zipfile.ZipFile(path, "w") as archive:
        for name in sorted(members):
            archive.writestr(_member(name), members[name])


def read_authored(path: Path, *, limit: int) -> mujoco.MjModel:
    """Return the model that `write_authored` was given, compiled by this MuJoCo.

    Only for a sandbox, see `source_compiler`: what is in a stranger's file may take any
    time and memory.

    Args:
        path: of the zip.
        limit: how many bytes its content may have.

    Raises:
        UnreadableFile: it is damaged or dangerous, or this MuJoCo refuses it.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            total = sum(member.file_size for member in archive.infolist())
            if total > limit:
                raise ValueError(f"its content is {total} bytes, and no model has that")
            members = {m.filename: _read(archive, m) for m in archive.infolist()}
        contents = loads(members.pop(_CONTENTS, b"null"))
        if not isinstance(contents, dict) or contents.get("format") != _FORMAT:
            raise ValueError("it holds no model of a format that this mjrec knows")
        sources = _below(_SOURCE, members)
        model = compile_authored(AuthoredModel(contents["main"], sources))
        fields = _below(_FIELDS, members)
        values = {n.removesuffix(".npy"): _array(fields[n]) for n in fields}
        apply_fields(model, values)
    # Whatever it is that zipfile, NumPy and MuJoCo raise for such a file.
    except Exception as error:
        reason = " ".join(str(error).split())
        if isinstance(error, MemoryError) or reason == _MUJOCO_GAVE_UP:
            reason = "it needs more memory than there is, or than it may have"
        raise UnreadableFile(path, reason.rstrip(".")) from error
    return model


def compile_authored(authored: AuthoredModel) -> mujoco.MjModel:
    """Return the compiled model; no file but those of `authored` is read.

    Raises:
        ValueError: MuJoCo refuses it, or a name in it leads elsewhere, or it uses a
            plugin.
    """
    for name in authored.files:
        _check_name(name)
    if _parsed(authored.main, authored.files[authored.main]).tag != "mujoco":
        raise ValueError(f"{authored.main} is not MJCF")
    # References are checked as the documents are read.
    _check_documents(authored)
    with tempfile.TemporaryDirectory(prefix="mjrec-model-") as directory:
        root = Path(directory) / _EMPTY
        for name, content in authored.files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(content)
        model = mujoco.MjModel.from_xml_path(str(root / authored.main))
        return with_embedded_files(model)


def with_embedded_files(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model with the textures in it that it only refers to."""
    # MuJoCo 3.17 brought such textures; what is not in the model has no address.
    if not hasattr(mujoco, "mj_embedAssets") or not (model.tex_adr < 0).any():
        return model
    return mujoco.mj_embedAssets(model)


@dataclass(frozen=True)
class _Document:
    """What one MJCF file refers to, as it is written there."""

    xml: frozenset[str]
    assets: frozenset[str]
    directories: frozenset[str]


def _document(name: str, content: bytes) -> _Document:
    root = _parsed(name, content)
    xml: set[str] = set()
    assets: set[str] = set()
    directories: set[str] = set()
    for element in root.iter():
        for attribute, value in element.attrib.items():
            if attribute in _DIRECTORIES:
                directories.add(_checked_reference(value))
            elif attribute.startswith("file") and value:
                kind = xml if element.tag in _XML_ELEMENTS else assets
                kind.add(_checked_reference(value))
    return _Document(frozenset(xml), frozenset(assets), frozenset(directories))


def _parsed(name: str, content: bytes) -> ElementTree.Element:
    """Return the XML, if MuJoCo's own parser cannot see another one in it."""
    text = content.decode("utf-8-sig")
    declared = re.match(r"\s*<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", text)
    if declared and declared[1].lower() != "utf-8":
        raise ValueError(f"{name} is written in {declared[1]}, not in UTF-8")
    if "\0" in text or re.search(r"<\s*!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise ValueError(f"{name} is no plain XML")
    if re.search(r"<\s*plugin\b", text):
        raise ValueError(f"{name} uses a plugin, and none is loaded for a recording")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"{name} is no XML: {error}") from error


def _checked_reference(value: str) -> str:
    # A colon is a drive, or what a resource provider is called by.
    if value.startswith(("/", "~")) or any(c in value for c in "\\:\0"):
        raise ValueError(f"it refers to {value!r}, which is no plain relative path")
    if value.split("/").count("..") > _MOST_UP:
        raise ValueError(f"it refers to {value!r}, which is outside")
    return value


def _check_name(name: str) -> None:
    _checked_reference(name)
    if not name or any(part in ("", ".", "..") for part in name.split("/")):
        raise ValueError(f"it holds a file called {name!r}")


def _check_documents(authored: AuthoredModel) -> None:
    """Check all files that may be read as MJCF, whatever they are called.

    Raises:
        ValueError: a file elsewhere might be read.
    """
    by_base_name: dict[str, list[str]] = {}
    for name in authored.files:
        by_base_name.setdefault(PurePosixPath(name).name, []).append(name)
    waiting = [authored.main]
    while waiting:
        name = waiting.pop()
        # Wherever they are: MuJoCo's rules for it have changed.
        for reference in _document(name, authored.files[name]).xml:
            # Taken out, so that nothing is looked at twice, however often it is named.
            waiting += by_base_name.pop(PurePosixPath(reference).name, [])


def _all_directories(documents: Iterable[_Document]) -> frozenset[str]:
    return frozenset().union({""}, *(d.directories for d in documents))


def _gathered(main: Path) -> AuthoredModel:
    documents: dict[Path, _Document] = {}
    waiting = [main]
    while waiting:
        path = waiting.pop()
        if path not in documents:
            documents[path] = _document(path.name, path.read_bytes())
            for reference in documents[path].xml:
                waiting += _existing({path.parent, main.parent}, {""}, reference)
    directories = _all_directories(documents.values())
    found = set(documents)
    for path, document in documents.items():
        for reference in document.assets:
            bases = {path.parent, main.parent}
            found.update(_existing(bases, directories, reference))
    root = Path(os.path.commonpath([path.parent for path in found]))
    files = {path.relative_to(root).as_posix(): path.read_bytes() for path in found}
    return AuthoredModel(main.relative_to(root).as_posix(), files)


def _existing(
    bases: Iterable[Path], directories: Iterable[str], reference: str
) -> list[Path]:
    """Return every file that the reference may stand for."""
    # `strippath` takes the directories away.
    names = {reference, PurePosixPath(reference).name}
    candidates = {
        Path(os.path.normpath(base / directory / name))
        for base in bases
        for directory in directories
        for name in names
    }
    found = [path for path in candidates if path.is_file()]
    if not found:
        raise ValueError(f"there is no {reference!r}")
    return found


def _npy(value: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, value, allow_pickle=False)
    return buffer.getvalue()


def _array(content: bytes) -> NDArray[Any]:
    return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))


def _below(prefix: str, members: Mapping[str, bytes]) -> dict[str, bytes]:
    return {
        name.removeprefix(prefix): content
        for name, content in members.items()
        if name.startswith(prefix)
    }


def _member(name: str) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name, _EPOCH)
    member.compress_type = zipfile.ZIP_DEFLATED
    member.create_system = 3  # Unix, wherever this runs
    member.external_attr = 0o644 << 16
    return member


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    with archive.open(member) as stream:
        # With a number: without one, it unpacks more than the size that is noted.
        return stream.read(member.file_size)
