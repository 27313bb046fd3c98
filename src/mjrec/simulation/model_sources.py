# SPDX-License-Identifier: Apache-2.0
"""The sources of a model: its MJCF and the files that it refers to, in one zip file.

::

    contents.json          {"format": 1, "main": "humanoid.xml"}
    source/humanoid.xml    the files, in their authors' layout
    source/meshes/...
    fields/<name>.npy      the fields in which the stored model differs from the
                           compiled sources, because an environment set them

The same content always yields the same bytes. Compiling reads no other files.
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
from xml.etree import ElementTree

import mujoco
import numpy as np

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

# Attributes of MJCF that name directories of files.
_DIRECTORIES = ("assetdir", "meshdir", "texturedir")
_XML_ELEMENTS = ("include", "model")

# A path is composed of several attributes, and each may go up this many levels. The
# files are compiled at a greater depth in an empty directory, so `..` leads nowhere.
_MOST_UP = 4
_EMPTY = PurePosixPath(*["x"] * 8 * _MOST_UP)

# The message of the RuntimeError that MuJoCo raises if memory runs out.
_MUJOCO_GAVE_UP = "Caught an unknown exception!"


@dataclass(frozen=True)
class AuthoredModel:
    """An MJCF file with every file that it depends on.

    Attributes:
        main: the name of the MJCF file to compile.
        files: the content of every file, keyed by a relative path with `/`.
    """

    main: str
    files: Mapping[str, bytes]


def authored_from_file(path: Path) -> AuthoredModel | None:
    """Return an MJCF file and everything that it includes and refers to.

    Returns:
        The files, or None if they cannot be determined or stored. That is the case if a
        file is missing or given by an absolute path, if a plugin is used, or if the
        file is not MJCF.
    """
    try:
        return _gathered(Path(os.path.abspath(path)))  # noqa: PTH100  resolve() would follow links, and names are relative to where a file is named
    except (ValueError, OSError):
        logger.debug("The sources of %s are not stored.", path, exc_info=True)
        return None


def write_authored(path: Path, authored: AuthoredModel, model: mujoco.MjModel) -> None:
    """Write the sources of `model`, and the fields that were set after compiling.

    Raises:
        ValueError: the sources do not compile to the same model.
    """
    # Some names are like `./meshes/../a.obj`.
    files = {posixpath.normpath(name): data for name, data in authored.files.items()}
    authored = AuthoredModel(posixpath.normpath(authored.main), files)
    fields = differing_fields(_compile(authored), model)
    contents = {"format": _FORMAT, "main": authored.main}
    members = {_CONTENTS: json.dumps(contents).encode()}
    members |= {_SOURCE + name: data for name, data in files.items()}
    for name, value in fields.items():
        buffer = io.BytesIO()
        np.save(buffer, value, allow_pickle=False)
        members[f"{_FIELDS}{name}.npy"] = buffer.getvalue()
    with zipfile.ZipFile(path, "w") as archive:
        for name in sorted(members):
            member = zipfile.ZipInfo(name, _EPOCH)
            member.compress_type = zipfile.ZIP_DEFLATED
            member.create_system = 3  # Unix, wherever this runs
            member.external_attr = 0o644 << 16
            archive.writestr(member, members[name])


def read_authored(path: Path) -> mujoco.MjModel:
    """Return the model passed to `write_authored`, compiled by the installed MuJoCo.

    Use this only in a sandbox, because an untrusted file may take any amount of time
    and memory.

    Raises:
        UnreadableFile: the file is damaged or dangerous, or MuJoCo rejects it.
    """
    sources, fields = {}, {}
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            contents = loads(archive.read(_CONTENTS))
            for name in archive.namelist():
                if name.startswith(_SOURCE):
                    sources[name.removeprefix(_SOURCE)] = archive.read(name)
                elif name.startswith(_FIELDS):
                    field = name.removeprefix(_FIELDS).removesuffix(".npy")
                    value = np.load(io.BytesIO(archive.read(name)), allow_pickle=False)
                    fields[field] = np.asarray(value)
        if not isinstance(contents, dict) or contents.get("format") != _FORMAT:
            raise ValueError("its format is not known to this version of mjrec")
        model = _compile(AuthoredModel(contents["main"], sources))
        apply_fields(model, fields)
    # zipfile, NumPy and MuJoCo may raise any error for an untrusted file.
    except Exception as error:
        reason = " ".join(str(error).split())
        if isinstance(error, MemoryError) or reason == _MUJOCO_GAVE_UP:
            reason = "it needs more memory than is available or allowed"
        raise UnreadableFile(path, reason.rstrip(".")) from error
    return model


def with_embedded_files(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model with all textures embedded, including those it refers to."""
    # MuJoCo 3.17 introduced such textures. Their address in the model is negative.
    if not hasattr(mujoco, "mj_embedAssets") or not (model.tex_adr < 0).any():
        return model
    return mujoco.mj_embedAssets(model)


def _compile(authored: AuthoredModel) -> mujoco.MjModel:
    """Compile a model, reading only the files in `authored`.

    Raises:
        ValueError: MuJoCo rejects the model, it refers to a file outside its folder, or
            it uses a plugin.
    """
    by_base_name: dict[str, list[str]] = {}
    for name in authored.files:
        _check_reference(name)
        if any(part in ("", ".", "..") for part in name.split("/")):
            raise ValueError(f"it contains a file named {name!r}")
        by_base_name.setdefault(PurePosixPath(name).name, []).append(name)
    if _parsed(authored.main, authored.files[authored.main]).tag != "mujoco":
        raise ValueError(f"{authored.main} is not MJCF")
    # Every file that MuJoCo may read as MJCF is checked, whatever its name or folder,
    # because MuJoCo's rules for finding files have changed.
    waiting, goes_up = [authored.main], False
    while waiting:
        name = waiting.pop()
        references = _References(name, authored.files[name])
        goes_up |= references.go_up
        for reference in references.xml:
            # Removed, so that no file is checked twice, even with several references.
            waiting += by_base_name.pop(PurePosixPath(reference).name, [])
    with tempfile.TemporaryDirectory(prefix="mjrec-model-") as directory:
        # Only if needed: creating the folders takes longer than most compilations.
        root = Path(directory) / _EMPTY if goes_up else Path(directory)
        for name, content in authored.files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(content)
        model = mujoco.MjModel.from_xml_path(str(root / authored.main))
        return with_embedded_files(model)


class _References:
    """The files that one MJCF file refers to, under the names used in it.

    Attributes:
        xml: other MJCF files.
        assets: all other files.
        directories: the directories to search for the other files.
        go_up: whether a path leaves a folder with `..`.

    Raises:
        ValueError: the file is not plain MJCF, or refers to files outside its folder.
    """

    def __init__(self, name: str, content: bytes) -> None:
        self.xml: set[str] = set()
        self.assets: set[str] = set()
        self.directories = {""}
        self.go_up = False
        for element in _parsed(name, content).iter():
            for attribute, value in element.attrib.items():
                if attribute in _DIRECTORIES:
                    kind = self.directories
                elif attribute.startswith("file") and value:
                    kind = self.xml if element.tag in _XML_ELEMENTS else self.assets
                else:
                    continue
                _check_reference(value)
                self.go_up |= ".." in value
                kind.add(value)


def _parsed(name: str, content: bytes) -> ElementTree.Element:
    """Return the XML, unless MuJoCo's parser might read it differently."""
    text = content.decode("utf-8-sig")
    declared = re.match(r"\s*<\?xml[^>]*encoding\s*=\s*[\"']([^\"']*)", text)
    if declared and declared[1].lower() != "utf-8":
        raise ValueError(f"{name} is encoded in {declared[1]}, not in UTF-8")
    if "\0" in text or re.search(r"<\s*!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise ValueError(f"{name} is not plain XML")
    if re.search(r"<\s*plugin\b", text):
        raise ValueError(f"{name} uses a plugin, but plugins are not loaded here")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"{name} is not XML: {error}") from error


def _check_reference(value: str) -> None:
    # A colon marks a drive or the name of a resource provider.
    if value.startswith(("/", "~")) or any(c in value for c in "\\:\0"):
        raise ValueError(f"it refers to {value!r}, which is not a plain relative path")
    if value.split("/").count("..") > _MOST_UP:
        raise ValueError(f"it refers to {value!r}, which is outside its directory")


def _gathered(main: Path) -> AuthoredModel:
    documents: dict[Path, _References] = {}
    waiting = [main]
    while waiting:
        path = waiting.pop()
        if path not in documents:
            documents[path] = _References(path.name, path.read_bytes())
            for reference in documents[path].xml:
                waiting += _existing({path.parent, main.parent}, {""}, reference)
    directories = set().union(*(each.directories for each in documents.values()))
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
    """Return every file that the reference may refer to."""
    # MJCF's `strippath` removes the directories from a name.
    names = {reference, PurePosixPath(reference).name}
    candidates = {
        Path(os.path.normpath(base / directory / name))
        for base in bases
        for directory in directories
        for name in names
    }
    found = [path for path in candidates if path.is_file()]
    if not found:
        raise ValueError(f"{reference!r} does not exist")
    return found
