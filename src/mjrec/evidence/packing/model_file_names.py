# SPDX-License-Identifier: Apache-2.0
"""The names of the files that a model is made from, without an identity in them.

Each part of a path that has the identity in it is called otherwise, in the names of the
files and in whatever refers to them. A mesh or texture that has no name of its own is
called by its file, and its geoms call it so: such a file keeps its name, and so do all
others of its model.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping
from xml.etree import ElementTree

from ...json_text import loads

# As `simulation.model_sources` lays the zip out.
CONTENTS = "contents.json"
SOURCE = "source/"

_DIRECTORIES = ("assetdir", "meshdir", "texturedir")
# Those elements are not called by the file that they refer to.
_NAMELESS = ("include", "model")
_REFERENCE = re.compile(
    r"(?P<begin>\b(?:file\w*|assetdir|meshdir|texturedir)\s*=\s*(?P<quote>[\"']))"
    r"(?P<path>[^\"'<>&]*)(?=(?P=quote))"
)


def is_xml(content: bytes) -> bool:
    """Tell whether a file looks like XML; MuJoCo takes any name for MJCF."""
    return content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


def with_other_names(
    members: Mapping[str, bytes], renamed: Callable[[str], str]
) -> dict[str, bytes] | None:
    """Return the members of a model's zip with other names, in the same order.

    Args:
        members: their content, by name.
        renamed: returns the new name of a file or directory, which may be the old one.

    Returns:
        None where they cannot have other names without the model being another one.

    Raises:
        ValueError: it is no such zip.
    """

    def path(old: str) -> str:
        return "/".join(renamed(part) for part in old.split("/"))

    names = {
        name: SOURCE + path(name.removeprefix(SOURCE))
        for name in members
        if name.startswith(SOURCE)
    }
    if len(set(names.values())) < len(names):
        return None
    new: dict[str, bytes] = {}
    for name, content in members.items():
        changed: bytes | None = content
        if name == CONTENTS:
            changed = _contents(content, path)
        elif name in names and is_xml(content):
            changed = _references(content.decode("utf-8"), path)
        if changed is None:
            return None
        new[names.get(name, name)] = changed
    return new


def _contents(content: bytes, path: Callable[[str], str]) -> bytes:
    said = loads(content)
    main = said.get("main") if isinstance(said, dict) else None
    if not isinstance(main, str) or path(main) == main:
        return content
    return json.dumps({**said, "main": path(main)}).encode()


def _references(text: str, path: Callable[[str], str]) -> bytes | None:
    new = _REFERENCE.sub(lambda m: m["begin"] + path(m["path"]), text)
    try:
        before, after = _parsed(text), _parsed(new)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is no XML: {error}") from error
    for element in before.iter():
        for key, value in _paths(element):
            if not _may_be_called(element, value, path(value)):
                return None
            element.set(key, path(value))
    # What only looks like such an attribute is a text of the model.
    is_same = ElementTree.tostring(before) == ElementTree.tostring(after)
    return new.encode() if is_same else None


def _parsed(text: str) -> ElementTree.Element:
    return ElementTree.fromstring(text.removeprefix("\ufeff"))


def _paths(element: ElementTree.Element) -> Iterator[tuple[str, str]]:
    for key, value in list(element.attrib.items()):
        if key.startswith("file") or key in _DIRECTORIES:
            yield key, value


def _may_be_called(element: ElementTree.Element, old: str, new: str) -> bool:
    is_called_by_file = element.tag not in _NAMELESS and "name" not in element.attrib
    is_same_file = old.rpartition("/")[2] == new.rpartition("/")[2]
    return is_same_file or not is_called_by_file or element.tag == "compiler"
