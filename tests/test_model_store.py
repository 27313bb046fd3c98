# SPDX-License-Identifier: Apache-2.0
"""Models are stored once, and damaged or hostile files are refused."""

import io
import json
import shutil
import zipfile

import mujoco
import numpy as np
import pytest
from full_disk import file_size_limit
from PIL import Image

from mjrec.errors import FileNotWritten, UnreadableFile
from mjrec.simulation.model_sources import AuthoredModel, authored_from_file
from mjrec.simulation.model_store import ModelStore, load_model

MAIN = """
<mujoco>
  <compiler meshdir="../meshes" texturedir="tex"/>
  <include file="parts/body.xml"/>
  <asset>
    <mesh file="m.obj"/>
    <texture name="t" type="2d" file="t.png"/>
    <material name="t" texture="t"/>
  </asset>
  <worldbody><geom type="mesh" mesh="m" material="t"/></worldbody>
</mujoco>
"""
BODY = """
<mujoco>
  <worldbody><body><joint/><geom size=".1" pos=".123456789123 0 0"/></body></worldbody>
</mujoco>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
SPHERE = '<mujoco><worldbody><geom size=".1"/></worldbody></mujoco>'


@pytest.fixture
def mjcf(tmp_path):
    """Return the path of a model whose four files are in three directories."""
    image = io.BytesIO()
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(image, "PNG")
    for name, content in {
        "model/main.xml": MAIN.encode(),
        "model/parts/body.xml": BODY.encode(),
        "model/tex/t.png": image.getvalue(),
        "meshes/m.obj": TETRAHEDRON.encode(),
        "meshes/unused.obj": b"",
    }.items():
        path = tmp_path / "authors" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return tmp_path / "authors/model/main.xml"


@pytest.fixture
def directory(tmp_path):
    path = tmp_path / "recordings"
    path.mkdir()
    return path


def content_of(model):
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def store_model(directory, model, authored=None):
    store = ModelStore(directory)
    facts = store.add(model, authored)
    store.finish()
    return json.loads(json.dumps(facts))


# Pretend that another MuJoCo version recorded the model.
OTHER_VERSION = {"mujoco": "3.1.4"}


def sphere():
    return mujoco.MjModel.from_xml_string(SPHERE)


def test_same_content_makes_the_same_files_once(directory, tmp_path, mjcf):
    """Existing files stay untouched."""
    authored = authored_from_file(mjcf)
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    facts = store_model(directory, model, authored)
    files = {path.name: path.read_bytes() for path in directory.iterdir()}
    assert sorted(files) == [facts["mjb"], facts["xml"]]
    assert files[facts["mjb"]][4:8] == bytes(4)  # Gzip must not store a time.
    with zipfile.ZipFile(directory / facts["xml"]) as archive:
        assert {member.date_time[0] for member in archive.infolist()} == {1980}
    other = tmp_path / "other"
    other.mkdir()
    backwards = dict(reversed(authored.files.items()))
    store_model(other, model, AuthoredModel(authored.main, backwards))
    assert {path.name: path.read_bytes() for path in other.iterdir()} == files
    times = [path.stat().st_mtime_ns for path in directory.iterdir()]
    store_model(directory, model, authored)
    assert [path.stat().st_mtime_ns for path in directory.iterdir()] == times


def test_storing_can_be_tried_again_after_a_full_disk(directory):
    store = ModelStore(directory)
    with file_size_limit(100):
        facts = store.add(sphere())
        for _ in range(2):
            with pytest.raises(FileNotWritten, match=facts["mjb"]):
                store.finish()
    assert list(directory.iterdir()) == []
    store.finish()
    # There was no room for the trust list either.
    assert load_model(directory, facts, trust_models=True).ngeom == 1
    store.finish()


def test_another_version_compiles_the_sources(directory, mjcf):
    """The original files may be gone, and later model changes are applied again."""
    authored = authored_from_file(mjcf)
    assert authored.main == "model/main.xml"
    assert sorted(authored.files) == [
        *("meshes/m.obj", "model/main.xml", "model/parts/body.xml", "model/tex/t.png")
    ]
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    model.vis.global_.offwidth = 1234
    model.opt.gravity[:] = [0, 1, 2]
    model.geom_rgba[0] = [0.1, 0.2, 0.3, 1]
    model.stat.extent = 3.5
    facts = store_model(directory, model, authored)
    shutil.rmtree(mjcf.parents[1])
    again = load_model(directory, {**facts, **OTHER_VERSION})
    assert (again.vis.global_.offwidth, again.stat.extent) == (1234, 3.5)
    np.testing.assert_array_equal(again.opt.gravity, [0, 1, 2])
    # `_sizes` and these addresses depend on the location of the files.
    names = [n for n in dir(model) if isinstance(getattr(model, n), np.ndarray)]
    for name in names:
        if not name.endswith("pathadr") and name != "_sizes":
            expected = getattr(model, name)
            np.testing.assert_array_equal(getattr(again, name), expected, name)


@pytest.mark.skipif(
    not hasattr(mujoco, "mj_embedAssets"), reason="no textures by reference before 3.17"
)
def test_textures_by_reference_are_stored_with_the_model(directory, mjcf):
    mjcf.write_text(MAIN.replace("<compiler ", '<compiler passthrough="textures" '))
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    assert model.ntexdata == 0
    facts = store_model(directory, model, authored_from_file(mjcf))
    shutil.rmtree(mjcf.parents[1])
    for again in (
        load_model(directory, facts),
        load_model(directory, {**facts, **OTHER_VERSION}),
    ):
        assert again.ntexdata == 48


TEXT = "<mujoco><custom><text name='t' data='{}'/></custom></mujoco>"


@pytest.mark.parametrize(
    "other",
    [
        SPHERE.replace("<geom", "<geom type='box'").replace(".1", ".1 .1 .1"),
        TEXT.format("one"),
    ],
    ids=["other shape", "other text"],
)
def test_sources_of_another_model_are_not_stored(directory, other):
    """The compiled model is stored, and an error in another version says what to do."""
    source = TEXT.format("two") if "text" in other else SPHERE
    model = mujoco.MjModel.from_xml_string(other)
    authored = AuthoredModel("a.xml", {"a.xml": source.encode()})
    facts = store_model(directory, model, authored)
    assert [path.name for path in directory.iterdir()] == [facts["mjb"]]
    assert content_of(load_model(directory, facts)) == content_of(model)
    with pytest.raises(UnreadableFile, match=r"requires mujoco 3\.1\.4, but"):
        load_model(directory, {**facts, **OTHER_VERSION})


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('file="m.obj"', 'file="/m.obj"'),
        ('file="m.obj"', 'file="gone.obj"'),
        ("<asset>", '<extension><plugin plugin="mujoco.pid"/></extension><asset>'),
        ("<mujoco>", "<mujoco"),
    ],
    ids=["absolute", "missing", "plugin", "broken"],
)
def test_unsafe_or_broken_sources_are_left_out(mjcf, old, new):
    mjcf.write_text(MAIN.replace(old, new))
    assert authored_from_file(mjcf) is None


@pytest.mark.parametrize("kind", ["mjb", "xml"])
@pytest.mark.parametrize("damage", ["truncated", "changed"])
def test_damaged_file_is_one_error(directory, mjcf, kind, damage):
    """A damaged compiled model is compiled again from valid sources."""
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    facts = store_model(directory, model, authored_from_file(mjcf))
    path = directory / facts[kind]
    content = path.read_bytes()
    middle = len(content) // 2
    end = b"" if damage == "truncated" else b"\xff\x00\xff" + content[middle + 3 :]
    path.write_bytes(content[:middle] + end)
    others = {} if kind == "mjb" else OTHER_VERSION
    if kind == "mjb":
        assert load_model(directory, facts).nmesh == 1
        facts["xml"] = None
    with pytest.raises(UnreadableFile, match=path.name):
        load_model(directory, {**facts, **others})


@pytest.mark.parametrize(
    "name", ["../openaigym.model.0123456789abcdef.zip", "/etc/passwd", 7, "model.zip"]
)
def test_facts_cannot_name_other_files(directory, name):
    """For a missing model, the error says where to copy it from."""
    facts = store_model(directory, sphere())
    (directory / facts["mjb"]).unlink()
    with pytest.raises(UnreadableFile, match="copy it from the directory"):
        load_model(directory, facts)
    for kind in ("mjb", "xml"):
        with pytest.raises(UnreadableFile, match="which is not a valid name"):
            load_model(directory, {**facts, kind: name})
