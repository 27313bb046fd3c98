# SPDX-License-Identifier: Apache-2.0
"""Sources of models without what their authors say of themselves."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Mapping

import pytest
from PIL import Image, PngImagePlugin

from mjrec.evidence.packing.anonymous_models import anonymous_sources
from mjrec.evidence.packing.identity import Identity
from mjrec.evidence.packing.identity_matching import IdentityMatcher

MATCHER = IdentityMatcher(Identity(users=("mbrunelli",)))


def _zip(members: Mapping[str, bytes]) -> bytes:
    image = io.BytesIO()
    with zipfile.ZipFile(image, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return image.getvalue()


def _anonymous_members(members: Mapping[str, bytes]) -> dict[str, bytes]:
    new = anonymous_sources(_zip(members), MATCHER)
    with zipfile.ZipFile(io.BytesIO(new)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _anonymous(content: bytes) -> bytes:
    """Return what becomes of one file."""
    return _anonymous_members({"source/file": content})["source/file"]


def test_comments_are_removed() -> None:
    """They say who a model is of; its elements stay as they are, byte for byte."""
    assert _anonymous(b'<mujoco><!-- mine -->\n<a b="&lt;!--"/></mujoco>') == (
        b'<mujoco>\n<a b="&lt;!--"/></mujoco>'
    )


def test_what_looks_like_a_comment_and_is_none_stays() -> None:
    """In CDATA it is a text of the model."""
    xml = b"<mujoco><![CDATA[<!-- a -->]]></mujoco>"
    assert _anonymous(xml) == xml


def test_licences_stay() -> None:
    """Unless they name the one who must not be named, or give an address."""
    xml = b"<!-- Copyright 2020 The Robots Authors --><mujoco/>"
    assert _anonymous(xml) == xml
    assert _anonymous(b"<!-- Copyright mbrunelli --><mujoco/>") == b"<mujoco/>"
    assert _anonymous(b"<!-- (c) me@lab.example --><mujoco/>") == b"<mujoco/>"


def test_pictures_lose_their_texts_and_no_pixel() -> None:
    """An editor writes its user's name into them."""
    file, texts = io.BytesIO(), PngImagePlugin.PngInfo()
    texts.add_text("Author", "mbrunelli", zip=True)
    Image.new("RGB", (3, 2), (1, 2, 3)).save(file, "PNG", pnginfo=texts)
    new = Image.open(io.BytesIO(_anonymous(file.getvalue())))
    assert new.text == {}
    assert new.tobytes() == bytes((1, 2, 3)) * 6


def test_meshes_lose_remarks_that_name_somebody() -> None:
    """In Wavefront's comments, and in the header of a binary STL."""
    assert _anonymous(b"# by mbrunelli\nv 0 0 1\n") == b"#\nv 0 0 1\n"
    triangle = struct.pack("<I", 1) + bytes(range(50))
    header = b"solid by mbrunelli".ljust(80, b"\0")
    assert _anonymous(header + triangle) == bytes(80) + triangle


def test_nothing_to_remove_leaves_the_same_bytes() -> None:
    """Then the zip is not even written anew."""
    content = _zip({"source/a.xml": b"<mujoco/>", "contents.json": b"{}"})
    assert anonymous_sources(content, MATCHER) is content


@pytest.mark.parametrize("content", [b"", b"PK\3\4 torn", _zip({"a": b"<mujoco><!--"})])
def test_damage_is_said(content: bytes) -> None:
    """A zip that cannot be read, and XML that is none."""
    with pytest.raises(ValueError, match=r"damaged|no XML"):
        anonymous_sources(content, MATCHER)


def test_files_get_other_names_and_references_follow() -> None:
    """The main file's, an included one's, and those of directories and named meshes."""
    main = (
        b'<mujoco><compiler meshdir="../mbrunelli/stl"/>'
        b"<include file='by_mbrunelli.xml'/>"
        b'<asset><mesh name="arm" file="mbrunelli.stl"/></asset></mujoco>'
    )
    members = _anonymous_members(
        {
            "contents.json": b'{"format": 1, "main": "xml/mbrunelli.xml"}',
            "source/xml/mbrunelli.xml": main,
            "source/xml/by_mbrunelli.xml": b"<mujoco/>",
            "source/mbrunelli/stl/mbrunelli.stl": b"",
        }
    )
    assert members == {
        "contents.json": b'{"format": 1, "main": "xml/user.xml"}',
        "source/xml/user.xml": main.replace(b"mbrunelli", b"user"),
        "source/xml/by_user.xml": b"<mujoco/>",
        "source/user/stl/user.stl": b"",
    }


def test_files_keep_names_that_are_names_of_the_model() -> None:
    """A mesh that has no name of its own is called by its file."""
    xml = b'<mujoco><asset><mesh file="mbrunelli.stl"/></asset></mujoco>'
    members = {"source/a.xml": xml, "source/mbrunelli.stl": b""}
    assert _anonymous_members(members) == members


def test_files_that_would_become_one_keep_their_names() -> None:
    """There is another one of the new name already."""
    members = {"source/mbrunelli.stl": b"1", "source/user.stl": b"2"}
    assert _anonymous_members(members) == members


def test_bodies_keep_their_names() -> None:
    """A model whose bodies are called otherwise is another model."""
    xml = b'<mujoco model="mbrunelli"><body name="mbrunelli"/></mujoco>'
    assert _anonymous(xml) == xml
