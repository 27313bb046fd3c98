# SPDX-License-Identifier: Apache-2.0
"""Test anonymous copies of recordings that name their author everywhere."""

import hashlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from identity_search import find
from packed_runs import unpacked
from PIL import Image, PngImagePlugin
from recordings import hashes_at

import mjrec
from mjrec.evidence.anonymity import anonymous_sources, make_anonymous
from mjrec.evidence.identity import Identity
from mjrec.evidence.identity_matching import IdentityMatcher, remaining_identity
from mjrec.json_text import loads

MBRUNELLI = Identity(users={"mbrunelli"})
MATCHER = IdentityMatcher(MBRUNELLI)
NAMES = ("mbrunelli", "Brunelli", "Margherita", "brunelli-ws7", "brunlab")
WORDS = (*NAMES, "m.brunelli@uni-pavia.example", "secret-gait", "home/")

# This program runs under the author's account.
PACK = """
import sys, mjrec
authors = ["Margherita Brunelli <m.brunelli@uni-pavia.example>"]
source, target, how = sys.argv[1:]
mjrec.pack(source, target, authors=authors, anonymous=how == "anonymous")
"""


def models_have_paths():
    """Return whether compiled models contain paths; those of mujoco 3.3.0 do not."""
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "model.xml")
        texture = '<texture name="t" type="2d" file="t.png"/>'
        model.write_text(f"<mujoco><asset>{texture}</asset></mujoco>")
        Image.new("RGB", (4, 4)).save(model.with_name("t.png"))
        paths = mujoco.MjModel.from_xml_path(str(model)).paths
        return folder.encode() in bytes(paths)


MODELS_HAVE_PATHS = models_have_paths()


class Author:
    """An author with an account, a machine, a repository and a model."""

    def __init__(self, place):
        self.home = place / "home" / "mbrunelli"
        self.work = self.home / "secret-gait"
        (self.work / "models").mkdir(parents=True)
        shutil.copy(Path(__file__).with_name("identity_recording.py"), self.work)
        (self.work / "policy.pt").write_bytes(b"weights")
        self.write_model()
        for arguments in (
            ("init", "--quiet"),
            ("config", "user.email", "m.brunelli@uni-pavia.example"),
            ("config", "user.name", "Margherita Brunelli"),
            ("remote", "add", "origin", "git@github.com:brunlab/secret-gait.git"),
            ("add", "."),
            ("commit", "--quiet", "--message", "Walk"),
        ):
            self.call("git", *arguments)
        self.commit = self.call("git", "rev-parse", "HEAD").strip()
        # Run programs under another host name where the kernel permits it.
        naming = 'hostname brunelli-ws7 && exec "$@"'
        self.host = ["unshare", "--uts", "sh", "-c", naming, "sh"]
        tried = shutil.which("unshare") and subprocess.run([*self.host, "true"])
        if not tried or tried.returncode:
            self.host = []

    def write_model(self):
        assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
        texture = '<texture name="t" type="2d" file="logo.png"/>'
        xml = (assets / "inverted_pendulum.xml").read_text()
        xml = xml.replace(
            "<worldbody>",
            f'<asset>{texture}<material name="m" texture="t"/></asset><worldbody>'
            f"<!-- as measured in {self.home} -->",
        )
        models, texts = self.work / "models", PngImagePlugin.PngInfo()
        xml = f"<!-- written by Margherita Brunelli -->\n{xml}"
        (models / "robot.xml").write_text(xml)
        texts.add_text("Author", "M. Brunelli", zip=True)
        Image.new("RGB", (4, 4), (90, 0, 0)).save(models / "logo.png", pnginfo=texts)

    def python(self, *arguments):
        return self.call(*self.host, sys.executable, *map(str, arguments))

    def call(self, *command):
        names = dict.fromkeys(("USER", "LOGNAME"), "mbrunelli")
        done = subprocess.run(
            command,
            cwd=self.work,
            env={**os.environ, **names, "HOME": str(self.home)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout


@pytest.fixture(scope="module")
def author(tmp_path_factory):
    return Author(tmp_path_factory.mktemp("disk"))


@pytest.fixture(scope="module")
def recorded(author):
    """Return a directory with one subdirectory per kind of recording."""
    author.python("identity_recording.py", "runs")
    return author.work / "runs"


def contents(directory):
    return {p: p.read_bytes() for p in directory.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def packed(author, recorded, tmp_path_factory):
    """Return a directory of anonymous archives and one of archives that keep names."""
    before = contents(recorded)
    directories = {how: tmp_path_factory.mktemp(how) for how in ("anonymous", "named")}
    for how, directory in directories.items():
        for kind in ("pendulum", "diary"):
            target = directory / f"{kind}.zip"
            author.python("-c", PACK, recorded / kind, target, how)
    assert contents(recorded) == before
    return directories


@pytest.fixture(scope="module")
def anonymous(packed, tmp_path_factory):
    """Return the pendulum's recordings, unpacked from their anonymous archive."""
    archive = packed["anonymous"] / "pendulum.zip"
    return unpacked(archive, tmp_path_factory.mktemp("bag")) / "data" / "recordings"


def trajectories(directory):
    return [mjrec.load_trajectory(path) for path in sorted(directory.glob("*.h5"))]


def read(path):
    return loads(path.read_bytes())


def test_anonymous_archives_are_valid_and_contain_no_identity(author, packed):
    assert find(packed["anonymous"], [*WORDS, author.commit]) == []
    for archive in packed["anonymous"].iterdir():
        assert mjrec.verify(archive, level="files").failures == ()


def test_search_finds_the_identity_in_each_place_of_named_archives(packed):
    found = [place for place, _ in find(packed["named"], WORDS)]
    for where in (
        *(r"manifest\.json$", r"meta\.json$", r"\.jsonl$", r"\.h5 > /@facts"),
        *(r"diary\.video\d+\.json$", r"monitor\.csv \(name\)$", r"\.mp4 \(name\)"),
        r"model.*zip > source/robot\.xml$",
        r"model.*zip > source/logo\.png \(zTXt\)",
        *(r"stats\.json \(name\)", r"environment\.json$", r"ro-crate-metadata\.json$"),
        *(r"CITATION\.cff$", r"README\.md$", r"statistics\.csv$"),
        *[r"mjb\.gz \(unpacked\)"] * MODELS_HAVE_PATHS,
    ):
        assert any(re.search(where, place) for place in found), where


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le", "utf-16-be"])
def test_search_and_gate_find_names_in_each_encoding(tmp_path, encoding):
    """A name is found even between bytes that are not text."""
    content = bytes(range(256)) + "MBrunelli".encode(encoding) + b"\xff\xfe"
    (tmp_path / "file").write_bytes(content)
    assert find(tmp_path, ["mbrunelli"]) == [("file", "mbrunelli")]
    assert remaining_identity(tmp_path, MBRUNELLI) == [("file", "MBrunelli")]


def test_gate_finds_the_identity_in_each_kind_of_place(recorded):
    identity = Identity(users={"mbrunelli"}, people={"Margherita Brunelli"})
    left = [where for where, _ in remaining_identity(recorded, identity)]
    endings = [r"manifest\.json", r"\.jsonl", r"\.csv", r"\.mp4", r"robot\.xml"]
    for ending in [*endings, "@facts.*", *["unpacked"] * MODELS_HAVE_PATHS]:
        assert any(re.search(f"{ending}$", where) for where in left), ending


def test_anonymous_recordings_have_equal_contents(recorded, anonymous):
    """Anonymous copies keep statistics, episodes, arrays, models and frames."""
    directories = (recorded / "pendulum", anonymous)
    old, new = map(mjrec.load_results, directories)
    assert new["episode_rewards"] == old["episode_rewards"]
    assert new["timestamps"] == old["timestamps"]
    for directory in directories:
        episodes = mjrec.iter_episodes(directory)
        assert [episode.length for episode in episodes] == [4, 4]
    for before, after in zip(*map(trajectories, directories), strict=True):
        for name in ("states", "actions", "rewards", "terminated", "frame_steps"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        np.testing.assert_equal(after.snapshots, before.snapshots)
    # The compiled model is kept unless it contains a path.
    assert any(anonymous.glob("*.mjb.gz")) != MODELS_HAVE_PATHS
    old, new = before.model(), after.model()
    for name in ("qpos0", "geom_size", "body_mass", "tex_data", "names"):
        np.testing.assert_array_equal(getattr(old, name), getattr(new, name))
    [hashes] = anonymous.glob("*.video000001.framehash")
    rendered = [hashlib.sha256(frame).hexdigest() for frame in mjrec.render(after)]
    assert rendered == hashes_at(hashes)


def test_names_become_placeholders_in_files_and_references(anonymous):
    manifest = read(anonymous / "openaigym.manifest.0.user-final.manifest.json")
    assert manifest["stats"] == "openaigym.episode_batch.0.user-final.stats.json"
    for names in manifest["videos"]:
        assert all((anonymous / name).is_file() for name in names)
    metadata = read(anonymous / manifest["videos"][0][1])
    assert metadata["also_named"] == "user-run-episode-0.mp4"
    assert metadata["encoder_version"]["cmdline"][-1] == manifest["videos"][0][0]
    facts, other = (trajectory.facts for trajectory in trajectories(anonymous))
    assert facts["infix"] == other["infix"] == "0.user-final"
    assert facts["options"] == {"goal": "<path>/goal.npy"}
    assert facts["environment"]["kwargs"]["xml_file"] == "<path>/models/robot.xml"
    details = manifest["mjrec"]
    assert "no key in <path>/wandb.key" in details["faults"][0]["reason"]
    provenance, python = details["provenance"], Path(sys.executable).name
    assert provenance["command"] == [python, "identity_recording.py", "runs"]
    assert provenance["code"]["remote"] is None
    assert provenance["policy"]["file"] == "policy.pt"


def test_anonymous_archives_are_reproducible(author, recorded, tmp_path, packed):
    archive = tmp_path / "pendulum.zip"
    author.python("-c", PACK, recorded / "pendulum", archive, "anonymous")
    earlier = packed["anonymous"] / archive.name
    assert archive.read_bytes() == earlier.read_bytes()


def zipped(**members):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        # Text that only looks like a comment is kept.
        (b'<m><!-- mine -->\n<a b="&lt;!--"/></m>', b'<m>\n<a b="&lt;!--"/></m>'),
        (b"<m><![CDATA[<!-- a -->]]></m>", b"<m><![CDATA[<!-- a -->]]></m>"),
        # Licenses are kept unless they name the author or give an address.
        (b"<!-- Copyright 2020 The Robots --><m/>",) * 2,
        (b"<!-- Copyright mbrunelli --><m/>", b"<m/>"),
        (b"<!-- (c) me@lab.example --><m/>", b"<m/>"),
        # Names of elements are part of the model and must not change.
        (b'<m model="mbrunelli"><body name="mbrunelli"/></m>',) * 2,
    ],
)
def test_comments_of_models_are_removed_except_licenses(before, after):
    sources = anonymous_sources(zipped(file=before), MATCHER)
    with zipfile.ZipFile(io.BytesIO(sources)) as archive:
        assert archive.read("file") == after


def test_sources_without_names_are_returned_unchanged():
    content = zipped(a=b"<mujoco/>", b=b"{}")
    assert anonymous_sources(content, MATCHER) is content


@pytest.mark.parametrize("content", [b"", b"PK\3\4 torn", zipped(a=b"<mujoco><!--")])
def test_damaged_sources_are_rejected(content):
    with pytest.raises(ValueError, match=r"damaged|not valid XML"):
        anonymous_sources(content, MATCHER)


def test_distinct_uids_stay_distinct(tmp_path):
    """Uids that differ only in a removed name are numbered."""
    name = "openaigym.episodes.0.{}.jsonl"
    for uid in ("mbrunelli", "lovelace", "user"):
        (tmp_path / name.format(uid)).write_text(f'{{"by": "{uid}"}}\n')
    make_anonymous(tmp_path, identity=Identity(users={"lovelace", "mbrunelli"}))
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {name.format(uid) for uid in ("user", "user-2", "user-3")}


def test_commands_and_gpu_ids_become_placeholders(tmp_path):
    """Names of environments, device indices and GPU numbers are kept."""
    card = "GPU-8f1c2b0e-5d6a-4e3b-9c7d-112233445566"
    command = ["mjrec", "record", "dm_control/cartpole-balance", "/opt/lab/policy.pt"]
    variables = {"CUDA_VISIBLE_DEVICES": f"{card},GPU-8f,2"}
    provenance = {"command": command, "variables": variables}
    device = {"index": 1, "file": "/dev/dri/renderD129", "uuid": card}
    path = tmp_path / "openaigym.video.0.1.video000000.meta.json"
    path.write_text(json.dumps({"gl_device": device, "provenance": provenance}))
    make_anonymous(tmp_path, identity=Identity())
    metadata = read(path)
    assert metadata["gl_device"] == {"index": 1}
    provenance = metadata["provenance"]
    assert provenance["command"] == [*command[:3], "policy.pt"]
    assert provenance["variables"] == {"CUDA_VISIBLE_DEVICES": "<gpu>,<gpu>,2"}


def test_csv_headers_and_torn_journals_lose_names(tmp_path):
    """The last line of the journal is torn, so it is dropped."""
    csv = tmp_path / "openaigym.results.0.7.monitor.csv"
    table = '#{"t_start": 1.5, "env_id": "/home/ada/a.xml"}\nr,l,t\n1.0,2,0.5\n'
    csv.write_text(table)
    journal = tmp_path / "openaigym.episodes.0.7.jsonl"
    journal.write_text('{"reward": 1e999, "seed": null}\n{"options": "/home/ada')
    make_anonymous(tmp_path, identity=Identity(homes={"/home/ada"}))
    assert csv.read_text() == table.replace("/home/ada", "<home>")
    assert journal.read_text() == '{"reward": 1e999, "seed": null}\n'


def test_gate_finds_a_name_across_two_reads(tmp_path):
    begin = b"\0\0\0\x18ftyp"
    filling = b"\xff" * ((1 << 24) - len(begin) - 4)
    (tmp_path / "film").write_bytes(begin + filling + b"mbrunelli")
    assert remaining_identity(tmp_path, MBRUNELLI) == [("film", "mbrunelli")]


def test_gate_rejects_damaged_compression(tmp_path):
    (tmp_path / "file").write_bytes(b"\x1f\x8b torn")
    with pytest.raises(mjrec.UnreadableFile, match="cannot be unpacked"):
        remaining_identity(tmp_path, Identity())


def test_gate_finds_names_of_bodies_in_models(tmp_path):
    model = tmp_path / "openaigym.model.0123456789abcdef.zip"
    source = b'<mujoco><body name="mbrunelli"/></mujoco>'
    model.write_bytes(zipped(**{"source/a.xml": source}))
    make_anonymous(tmp_path, identity=MBRUNELLI)
    place = f"{model.name}: source/a.xml"
    assert remaining_identity(tmp_path, MBRUNELLI) == [(place, "mbrunelli")]
