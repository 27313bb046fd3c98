# SPDX-License-Identifier: Apache-2.0
"""Sources of models without what their authors say of themselves."""

import io
import zipfile

import pytest
from PIL import Image, PngImagePlugin

from mjrec.evidence.anonymity import anonymous_sources
from mjrec.evidence.identity import Identity
from mjrec.evidence.identity_matching import IdentityMatcher

MATCHER = IdentityMatcher(Identity(users={"mbrunelli"}))


def _zip(members):
    image = io.BytesIO()
    with zipfile.ZipFile(image, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return image.getvalue()


def _anonymous(content):
    """Return what becomes of one file."""
    new = anonymous_sources(_zip({"source/file": content}), MATCHER)
    with zipfile.ZipFile(io.BytesIO(new)) as archive:
        return archive.read("source/file")


def test_comments_are_removed():
    """They say who a model is of; its elements stay as they are, byte for byte."""
    assert _anonymous(b'<mujoco><!-- mine -->\n<a b="&lt;!--"/></mujoco>') == (
        b'<mujoco>\n<a b="&lt;!--"/></mujoco>'
    )


def test_what_looks_like_a_comment_and_is_none_stays():
    """In CDATA it is a text of the model."""
    xml = b"<mujoco><![CDATA[<!-- a -->]]></mujoco>"
    assert _anonymous(xml) == xml


def test_licences_stay():
    """Unless they name the one who must not be named, or give an address."""
    xml = b"<!-- Copyright 2020 The Robots Authors --><mujoco/>"
    assert _anonymous(xml) == xml
    assert _anonymous(b"<!-- Copyright mbrunelli --><mujoco/>") == b"<mujoco/>"
    assert _anonymous(b"<!-- (c) me@lab.example --><mujoco/>") == b"<mujoco/>"


def test_frames_lose_their_texts_and_no_pixel():
    """An editor writes its user's name into them."""
    file, texts = io.BytesIO(), PngImagePlugin.PngInfo()
    texts.add_text("Author", "mbrunelli", zip=True)
    Image.new("RGB", (3, 2), (1, 2, 3)).save(file, "PNG", pnginfo=texts)
    new = Image.open(io.BytesIO(_anonymous(file.getvalue())))
    assert new.text == {}
    assert new.tobytes() == bytes((1, 2, 3)) * 6


def test_nothing_to_remove_leaves_the_same_bytes():
    """Then the zip is not even written anew."""
    content = _zip({"source/a.xml": b"<mujoco/>", "contents.json": b"{}"})
    assert anonymous_sources(content, MATCHER) is content


@pytest.mark.parametrize("content", [b"", b"PK\3\4 torn", _zip({"a": b"<mujoco><!--"})])
def test_damage_is_said(content):
    """A zip that cannot be read, and XML that is none."""
    with pytest.raises(ValueError, match=r"damaged|not valid XML"):
        anonymous_sources(content, MATCHER)


def test_bodies_keep_their_names():
    """A model whose bodies are called otherwise is another model."""
    xml = b'<mujoco model="mbrunelli"><body name="mbrunelli"/></mujoco>'
    assert _anonymous(xml) == xml
