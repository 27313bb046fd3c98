# SPDX-License-Identifier: Apache-2.0
"""Recordings that name nobody, of somebody who is named in all of them."""

import hashlib
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
from PIL import Image, PngImagePlugin

import mjrec
from mjrec.evidence.anonymity import make_anonymous
from mjrec.evidence.identity import Identity
from mjrec.evidence.identity_matching import remaining_identity
from mjrec.json_text import loads

NAMES = ("mbrunelli", "Brunelli", "Margherita", "brunelli-ws7", "brunlab")
WORDS = (*NAMES, "m.brunelli@uni-pavia.example", "secret-gait", "home/")

# What is run as that person, with the directories and the authors.
ANONYMOUS = """
import sys, pathlib
from mjrec.evidence.anonymity import make_anonymous
from mjrec.evidence.identity_matching import remaining_identity
from mjrec.evidence.identity import identity_of_user
from mjrec.evidence.statements import state
from mjrec.formats.manifest import read_manifest
for directory in map(pathlib.Path, sys.argv[1:]):
    manifests = map(read_manifest, directory.glob("*.manifest.json"))
    provenance = [manifest.mjrec["provenance"] for manifest in manifests]
    authors = ["Margherita Brunelli <m.brunelli@uni-pavia.example>"]
    stated = state(title=None, authors=authors, license=None)
    identity = identity_of_user(provenance, stated.authors)
    make_anonymous(directory, identity=identity)
    for where, what in remaining_identity(directory, identity):
        print(where, what)
"""

PACK = """
import sys, mjrec
authors = ["Margherita Brunelli <m.brunelli@uni-pavia.example>"]
source, target, how = sys.argv[1:]
mjrec.pack(source, target, authors=authors, anonymous=how == "anonymous")
"""


def models_have_paths():
    """Return whether compiled models have their files' directories; not in 3.3.0."""
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "model.xml")
        texture = '<texture name="t" type="2d" file="t.png"/>'
        model.write_text(f"<mujoco><asset>{texture}</asset></mujoco>")
        Image.new("RGB", (4, 4)).save(model.with_name("t.png"))
        paths = mujoco.MjModel.from_xml_path(str(model)).paths
        return folder.encode() in bytes(paths)


MODELS_HAVE_PATHS = models_have_paths()


class Somebody:
    """A person with an account, a machine, a repository and a model."""

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
        # On a machine of another name, if that may be.
        naming = 'hostname brunelli-ws7 && exec "$@"'
        self.host = ["unshare", "--uts", "sh", "-c", naming, "sh"]
        if not shutil.which("unshare") or not self.is_possible(*self.host, "true"):
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
        said = f"<!-- written by Margherita Brunelli -->\n{xml}"
        (models / "robot.xml").write_text(said)
        texts.add_text("Author", "M. Brunelli", zip=True)
        Image.new("RGB", (4, 4), (90, 0, 0)).save(models / "logo.png", pnginfo=texts)

    def python(self, *arguments):
        """Run Python with arguments, and return what it says."""
        return self.call(*self.host, sys.executable, *map(str, arguments))

    def is_possible(self, *command):
        return not subprocess.run(command, capture_output=True).returncode

    def call(self, *command):
        names = dict.fromkeys(("USER", "LOGNAME"), "mbrunelli")
        done = subprocess.run(
            command,
            cwd=self.work,
            env={**os.environ, **names, "HOME": str(self.home)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout


@pytest.fixture(scope="module")
def somebody(tmp_path_factory):
    return Somebody(tmp_path_factory.mktemp("disk"))


@pytest.fixture(scope="module")
def recorded(somebody):
    """Return a directory with a directory of each kind of recordings."""
    somebody.python("identity_recording.py", "runs")
    return somebody.work / "runs"


def contents(directory):
    return {p: p.read_bytes() for p in directory.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def anonymous(somebody, recorded, tmp_path_factory):
    """Copies of the recordings, as hard links, of which nobody says who made them."""
    stage = tmp_path_factory.mktemp("stage")
    for directory in recorded.iterdir():
        shutil.copytree(directory, stage / directory.name, copy_function=os.link)
    before = contents(recorded)
    assert somebody.python("-c", ANONYMOUS, stage / "pendulum", stage / "diary") == ""
    assert contents(recorded) == before
    return stage


@pytest.fixture(scope="module")
def packed(somebody, recorded, tmp_path_factory):
    """A directory of archives that name nobody, and one of archives that do."""
    directories = {how: tmp_path_factory.mktemp(how) for how in ("anonymous", "named")}
    for how, directory in directories.items():
        for kind in ("pendulum", "diary"):
            target = directory / f"{kind}.zip"
            somebody.python("-c", PACK, recorded / kind, target, how)
    return directories


def trajectories(directory):
    paths = sorted((directory / "pendulum").glob("*.h5"))
    return [mjrec.load_trajectory(path) for path in paths]


def read(path):
    return loads(path.read_bytes())


def test_nothing_of_the_identity_is_left(somebody, anonymous):
    """No login, host, home, repository, address or author, in no form in no file."""
    assert find(anonymous, [*WORDS, somebody.commit]) == []


@pytest.mark.thorough
def test_nothing_of_the_identity_is_packed(somebody, packed):
    """Nor is it in what describes the recordings; and the lists fit the new names."""
    assert find(packed["anonymous"], [*WORDS, somebody.commit]) == []
    for archive in packed["anonymous"].iterdir():
        assert mjrec.verify(archive, level="files").failures == ()


PLACES = [
    *(r"manifest\.json$", r"meta\.json$", r"\.jsonl$", r"\.h5 > /@facts"),
    *(r"diary\.video\d+\.json$", r"monitor\.csv \(name\)$", r"\.mp4 \(name\)"),
    *(r"model.*zip > source/robot\.xml$", r"model.*zip > source/logo\.png \(zTXt\)"),
    *(r"stats\.json \(name\)", r"environment\.json$", r"ro-crate-metadata\.json$"),
    *(r"CITATION\.cff$", r"README\.md$", r"statistics\.csv$"),
    *([r"mjb\.gz \(unpacked\)"] if MODELS_HAVE_PATHS else []),
]


def test_the_search_finds_it_where_it_was(packed):
    """In what was packed with names, the same search finds them in each place."""
    found = [place for place, _ in find(packed["named"], WORDS)]
    for where in PLACES:
        assert any(re.search(where, place) for place in found), where


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le", "utf-16-be"])
def test_the_search_and_the_gate_find_it_in_every_encoding(tmp_path, encoding):
    """Both find a name amid bytes that are no text."""
    content = bytes(range(256)) + "MBrunelli".encode(encoding) + b"\xff\xfe"
    (tmp_path / "file").write_bytes(content)
    identity = Identity(users={"mbrunelli"})
    assert find(tmp_path, ["mbrunelli"]) == [("file", "mbrunelli")]
    assert remaining_identity(tmp_path, identity) == [("file", "MBrunelli")]


def test_the_gate_finds_it_in_each_kind_of_place(recorded):
    """What looks last of all finds the identity wherever another search does."""
    identity = Identity(users={"mbrunelli"}, people={"Margherita Brunelli"})
    left = {where for where, _ in remaining_identity(recorded, identity)}
    endings = [r"manifest\.json", r"\.jsonl", r"\.csv", r"\.mp4", r"robot\.xml"]
    for ending in [*endings, *(["unpacked"] if MODELS_HAVE_PATHS else [])]:
        assert any(re.search(f"{ending}$", where) for where in left), ending
    assert any("@facts" in where for where in left)


def test_all_is_readable_and_says_the_same(recorded, anonymous):
    """Statistics, episodes, arrays, the model and the frames are as before."""
    old, new = (mjrec.load_results(d / "pendulum") for d in (recorded, anonymous))
    assert new["episode_rewards"] == old["episode_rewards"]
    assert new["timestamps"] == old["timestamps"]
    for directory in (recorded, anonymous):
        episodes = mjrec.iter_episodes(directory / "pendulum")
        assert [episode.length for episode in episodes] == [4, 4]
    pairs = zip(trajectories(recorded), trajectories(anonymous), strict=True)
    for before, after in pairs:
        for name in ("states", "actions", "rewards", "terminated", "frame_steps"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        np.testing.assert_equal(after.snapshots, before.snapshots)
    # From sources without comments, and without the compiled one if it had a path.
    assert any((anonymous / "pendulum").glob("*.mjb.gz")) != MODELS_HAVE_PATHS
    for name in ("qpos0", "geom_size", "body_mass", "tex_data", "names"):
        one, other = getattr(before.model(), name), getattr(after.model(), name)
        np.testing.assert_array_equal(one, other)
    [hashes] = (anonymous / "pendulum").glob("*.video000001.framehash")
    again = [hashlib.sha256(frame).hexdigest() for frame in mjrec.render(after)]
    lines = hashes.read_text().splitlines()
    assert again == [line.split()[-1] for line in lines if not line.startswith("#")]


def test_files_are_renamed_and_so_is_what_refers_to_them(anonymous):
    """The uid with the name in it is another one, in every file."""
    directory = anonymous / "pendulum"
    manifest = read(directory / "openaigym.manifest.0.user-final.manifest.json")
    assert manifest["stats"] == "openaigym.episode_batch.0.user-final.stats.json"
    for names in manifest["videos"]:
        assert all((directory / name).is_file() for name in names)
    assert {t.facts["infix"] for t in trajectories(anonymous)} == {"0.user-final"}
    metadata = read(directory / manifest["videos"][0][1])
    assert metadata["also_named"] == "user-run-episode-0.mp4"
    assert (directory / "user-run-episode-0.mp4").is_file()
    assert metadata["encoder_version"]["cmdline"][-1] == manifest["videos"][0][0]


def test_placeholders_stand_for_what_was_there(anonymous):
    """Options, arguments and reasons keep what names nobody."""
    [trajectory, _] = trajectories(anonymous)
    assert trajectory.facts["options"] == {"goal": "<path>/goal.npy"}
    kwargs = trajectory.facts["environment"]["kwargs"]
    assert kwargs["xml_file"] == "<path>/models/robot.xml"
    details = read(next((anonymous / "pendulum").glob("*.manifest.json")))["mjrec"]
    assert "no key in <path>/wandb.key" in details["faults"][0]["reason"]
    provenance, python = details["provenance"], Path(sys.executable).name
    assert provenance["command"] == [python, "identity_recording.py", "runs"]
    assert provenance["code"]["remote"] is None
    assert provenance["policy"]["file"] == "policy.pt"


def test_the_same_recordings_become_the_same_files(
    somebody, recorded, tmp_path, packed
):
    """However often, and whatever else was in the files' directory."""
    again = tmp_path / "pendulum.zip"
    somebody.python("-c", PACK, recorded / "pendulum", again, "anonymous")
    first = packed["anonymous"] / "pendulum.zip"
    assert again.read_bytes() == first.read_bytes()


def test_two_uids_do_not_become_one(tmp_path):
    """Of two that differ in what is taken out, one gets a number."""
    name = "openaigym.episodes.0.{}.jsonl"
    for uid in ("mbrunelli", "lovelace", "user"):
        (tmp_path / name.format(uid)).write_text(f'{{"by": "{uid}"}}\n')
    make_anonymous(tmp_path, identity=Identity(users={"lovelace", "mbrunelli"}))
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {name.format(uid) for uid in ("user", "user-2", "user-3")}


def test_commands_and_cards_name_nobody(tmp_path):
    """Names of environments stay, which device drew, and how many GPUs were given."""
    card = "GPU-8f1c2b0e-5d6a-4e3b-9c7d-112233445566"
    command = ["mjrec", "record", "dm_control/cartpole-balance", "/opt/lab/policy.pt"]
    variables = {"CUDA_VISIBLE_DEVICES": f"{card},GPU-8f,2"}
    provenance = {"command": command, "variables": variables}
    device = {"index": 1, "file": "/dev/dri/renderD129", "uuid": card}
    path = tmp_path / "openaigym.video.0.1.video000000.meta.json"
    path.write_text(json.dumps({"gl_device": device, "provenance": provenance}))
    make_anonymous(tmp_path, identity=Identity())
    said = read(path)
    assert said["gl_device"] == {"index": 1}
    assert said["provenance"]["command"] == [*command[:3], "policy.pt"]
    assert said["provenance"]["variables"] == {"CUDA_VISIBLE_DEVICES": "<gpu>,<gpu>,2"}


def test_texts_in_csv_and_in_torn_journals_are_nobodys(tmp_path):
    """The header of the one is JSON; of the other, what is no JSON is left out."""
    csv = tmp_path / "openaigym.results.0.7.monitor.csv"
    table = '#{"t_start": 1.5, "env_id": "/home/ada/a.xml"}\nr,l,t\n1.0,2,0.5\n'
    csv.write_text(table)
    journal = tmp_path / "openaigym.episodes.0.7.jsonl"
    journal.write_text('{"reward": 1e999, "seed": null}\n{"options": "/home/ada')
    make_anonymous(tmp_path, identity=Identity(homes={"/home/ada"}))
    assert csv.read_text() == table.replace("/home/ada", "<home>")
    assert journal.read_text() == '{"reward": 1e999, "seed": null}\n'


def test_films_are_searched_across_the_pieces_that_are_read(tmp_path):
    """They are too large to be read at once, and a name may lie where one ends."""
    begin = b"\0\0\0\x18ftyp"
    filling = b"\xff" * ((1 << 24) - len(begin) - 4)
    (tmp_path / "film").write_bytes(begin + filling + b"mbrunelli")
    identity = Identity(users={"mbrunelli"})
    assert remaining_identity(tmp_path, identity) == [("film", "mbrunelli")]


def test_what_cannot_be_unpacked_is_an_error_of_the_gate(tmp_path):
    """Nobody knows what is in it."""
    (tmp_path / "file").write_bytes(b"\x1f\x8b torn")
    with pytest.raises(mjrec.UnreadableFile, match="cannot be unpacked"):
        remaining_identity(tmp_path, Identity())


def test_bodies_that_name_somebody_are_found_by_the_gate(tmp_path):
    """What cannot be taken out of a model is said, with the place."""
    model = tmp_path / "openaigym.model.0123456789abcdef.zip"
    with zipfile.ZipFile(model, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("source/a.xml", '<mujoco><body name="mbrunelli"/></mujoco>')
    identity = Identity(users={"mbrunelli"})
    make_anonymous(tmp_path, identity=identity)
    place = f"{model.name}: source/a.xml"
    assert remaining_identity(tmp_path, identity) == [(place, "mbrunelli")]
