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


def zipped(**members):
    image = io.BytesIO()
    with zipfile.ZipFile(image, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return image.getvalue()


def anonymous(content):
    """Return what becomes of one file."""
    new = anonymous_sources(zipped(file=content), MATCHER)
    with zipfile.ZipFile(io.BytesIO(new)) as archive:
        return archive.read("file")


@pytest.mark.parametrize(
    ("before", "after"),
    [
        # Comments go, and what is none stays byte for byte, in CDATA too.
        (b'<m><!-- mine -->\n<a b="&lt;!--"/></m>', b'<m>\n<a b="&lt;!--"/></m>'),
        (b"<m><![CDATA[<!-- a -->]]></m>", b"<m><![CDATA[<!-- a -->]]></m>"),
        # Licences stay, unless they name the author or give an address.
        (b"<!-- Copyright 2020 The Robots --><m/>",) * 2,
        (b"<!-- Copyright mbrunelli --><m/>", b"<m/>"),
        (b"<!-- (c) me@lab.example --><m/>", b"<m/>"),
        # A model whose bodies are called otherwise is another model.
        (b'<m model="mbrunelli"><body name="mbrunelli"/></m>',) * 2,
    ],
)
def test_comments_are_removed_but_licences(before, after):
    """They say who a model is of; its elements stay as they are."""
    assert anonymous(before) == after


def test_frames_lose_their_texts_and_no_pixel():
    """An editor writes its user's name into them."""
    file, texts = io.BytesIO(), PngImagePlugin.PngInfo()
    texts.add_text("Author", "mbrunelli", zip=True)
    Image.new("RGB", (3, 2), (1, 2, 3)).save(file, "PNG", pnginfo=texts)
    new = Image.open(io.BytesIO(anonymous(file.getvalue())))
    assert new.text == {}
    assert new.tobytes() == bytes((1, 2, 3)) * 6


def test_nothing_to_remove_leaves_the_same_bytes():
    """Then the zip is not even written anew."""
    content = zipped(a=b"<mujoco/>", b=b"{}")
    assert anonymous_sources(content, MATCHER) is content


@pytest.mark.parametrize("content", [b"", b"PK\3\4 torn", zipped(a=b"<mujoco><!--")])
def test_damage_is_said(content):
    """A zip that cannot be read, and XML that is none."""
    with pytest.raises(ValueError, match=r"damaged|not valid XML"):
        anonymous_sources(content, MATCHER)
