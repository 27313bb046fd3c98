# SPDX-License-Identifier: Apache-2.0
"""Recordings that name nobody, of somebody who is named in all of them."""

import functools
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

WORDS = (
    "mbrunelli",
    "m.brunelli@uni-pavia.example",
    "Brunelli",
    "Margherita",
    "brunelli-ws7",
    "brunlab",
    "secret-gait",
    "home/",
)

# What is run as that person, with the directory and the authors.
_ANONYMOUS = """
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

_PACK = """
import sys, mjrec
authors = ["Margherita Brunelli <m.brunelli@uni-pavia.example>"]
source, target, how = sys.argv[1:]
mjrec.pack(source, target, authors=authors, anonymous=how == "anonymous")
"""


def _models_have_paths():
    """Return whether compiled models have their files' directories; not in 3.3.0."""
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "model.xml")
        texture = '<texture name="t" type="2d" file="t.png"/>'
        model.write_text(f"<mujoco><asset>{texture}</asset></mujoco>")
        Image.new("RGB", (4, 4)).save(model.with_name("t.png"))
        paths = mujoco.MjModel.from_xml_path(str(model)).paths
        return folder.encode() in bytes(paths)


MODELS_HAVE_PATHS = _models_have_paths()
of_models_with_paths = pytest.mark.skipif(
    not MODELS_HAVE_PATHS, reason="compiled models have no paths in this MuJoCo"
)


class Somebody:
    """A person with an account, a machine, a repository and a model.

    Args:
        place: where the home directories are.
    """

    def __init__(self, place):
        self.home = place / "home" / "mbrunelli"
        self.work = self.home / "secret-gait"
        (self.work / "models").mkdir(parents=True)
        shutil.copy(Path(__file__).with_name("identity_recording.py"), self.work)
        (self.work / "policy.pt").write_bytes(b"weights")
        self._write_model()
        self._git("init", "--quiet")
        self._git("config", "user.email", "m.brunelli@uni-pavia.example")
        self._git("config", "user.name", "Margherita Brunelli")
        self._git("remote", "add", "origin", "git@github.com:brunlab/secret-gait.git")
        self._git("add", ".")
        self._git("commit", "--quiet", "--message", "Walk")
        self.commit = self._git("rev-parse", "HEAD").strip()

    def run(self, *arguments):
        """Run Python with arguments, and return what it says."""
        return self._called([*_on_another_host(), sys.executable, *arguments])

    def record(self):
        """Return a directory with a directory of each kind of recordings."""
        self.run("identity_recording.py", "runs")
        return self.work / "runs"

    def _write_model(self):
        assets = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
        xml = (assets / "inverted_pendulum.xml").read_text()
        texture = '<texture name="t" type="2d" file="logo.png"/>'
        xml = xml.replace(
            "<worldbody>",
            f'<asset>{texture}<material name="m" texture="t"/></asset><worldbody>'
            f"<!-- as measured in {self.home} -->",
        )
        path = self.work / "models" / "robot.xml"
        path.write_text(f"<!-- written by Margherita Brunelli -->\n{xml}")
        texts = PngImagePlugin.PngInfo()
        texts.add_text("Author", "M. Brunelli", zip=True)
        Image.new("RGB", (4, 4), (90, 0, 0)).save(
            path.with_name("logo.png"), pnginfo=texts
        )

    def _git(self, *arguments):
        return self._called(["git", *arguments])

    def _called(self, command):
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


@functools.cache
def _on_another_host():
    """Return what makes a command run on a machine of another name, if it may be."""
    script = 'hostname brunelli-ws7 && exec "$@"'
    command = ["unshare", "--uts", "sh", "-c", script, "sh"]
    try:
        done = subprocess.run([*command, "true"], capture_output=True, check=False)
    except FileNotFoundError:
        return []
    return command if done.returncode == 0 else []


@pytest.fixture(scope="module")
def somebody(tmp_path_factory):
    return Somebody(tmp_path_factory.mktemp("disk"))


@pytest.fixture(scope="module")
def recorded(somebody):
    return somebody.record()


@pytest.fixture(scope="module")
def anonymous(somebody, recorded, tmp_path_factory):
    """Copies of the recordings, as hard links, of which nobody says who made them."""
    stage = tmp_path_factory.mktemp("stage")
    for directory in recorded.iterdir():
        shutil.copytree(directory, stage / directory.name, copy_function=os.link)
    before = _contents(recorded)
    said = somebody.run("-c", _ANONYMOUS, str(stage / "pendulum"), str(stage / "diary"))
    assert said == ""
    assert _contents(recorded) == before
    return stage


@pytest.fixture(scope="module")
def packed(somebody, recorded, tmp_path_factory):
    """A directory of archives that name nobody, and one of archives that do."""
    directories = {how: tmp_path_factory.mktemp(how) for how in ("anonymous", "named")}
    for how, directory in directories.items():
        for kind in ("pendulum", "diary"):
            source, target = str(recorded / kind), str(directory / f"{kind}.zip")
            somebody.run("-c", _PACK, source, target, how)
    return directories


def test_nothing_of_the_identity_is_left(somebody, anonymous):
    """No login, host, home, repository, address or author, in no form in no file."""
    assert find(anonymous, [*WORDS, somebody.commit]) == []


@pytest.mark.thorough
def test_nothing_of_the_identity_is_packed(somebody, packed):
    """Nor is it in what describes the recordings."""
    assert find(packed["anonymous"], [*WORDS, somebody.commit]) == []


@pytest.mark.parametrize(
    "where",
    [
        r"manifest\.json$",
        r"meta\.json$",
        r"\.jsonl$",
        r"\.h5 > /@facts",
        r"diary\.video\d+\.json$",
        r"monitor\.csv \(name\)$",
        r"model.*zip > source/robot\.xml$",
        r"model.*zip > source/logo\.png \(zTXt\)",
        pytest.param(r"mjb\.gz \(unpacked\)", marks=of_models_with_paths),
        r"\.mp4 \(name\)",
        r"stats\.json \(name\)",
        r"environment\.json$",
        r"ro-crate-metadata\.json$",
        r"CITATION\.cff$",
        r"README\.md$",
        r"statistics\.csv$",
    ],
)
def test_the_search_finds_it_where_it_was(packed, where):
    """In what was packed with names, the same search finds them in each place."""
    assert any(re.search(where, place) for place, _ in find(packed["named"], WORDS))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le", "utf-16-be"])
def test_the_search_and_the_gate_find_it_in_every_encoding(tmp_path, encoding):
    """Both find a name amid bytes that are no text."""
    content = bytes(range(256)) + "MBrunelli".encode(encoding) + b"\xff\xfe"
    (tmp_path / "file").write_bytes(content)
    identity = Identity(users={"mbrunelli"})
    assert find(tmp_path, ["mbrunelli"]) == [("file", "mbrunelli")]
    assert remaining_identity(tmp_path, identity) == [("file", "MBrunelli")]


def test_the_gate_finds_it_in_each_kind_of_place(somebody, recorded):
    """What looks last of all finds the identity wherever another search does."""
    identity = Identity(users={"mbrunelli"}, people={"Margherita Brunelli"})
    left = {where for where, _ in remaining_identity(recorded, identity)}
    endings = ["manifest.json", ".jsonl", ".csv", ".mp4", "robot.xml"]
    if MODELS_HAVE_PATHS:
        endings.append("unpacked")
    for ending in endings:
        assert any(where.endswith(ending) for where in left), ending
    assert any("@facts" in where for where in left)


def test_all_is_readable_and_says_the_same(recorded, anonymous):
    """Statistics, episodes and trajectories are as before, arrays bit for bit."""
    old, new = (mjrec.load_results(d / "pendulum") for d in (recorded, anonymous))
    assert new["episode_rewards"] == old["episode_rewards"]
    assert new["timestamps"] == old["timestamps"]
    episodes = [
        list(mjrec.iter_episodes(d / "pendulum")) for d in (recorded, anonymous)
    ]
    assert [e.length for e in episodes[0]] == [e.length for e in episodes[1]] == [4, 4]
    for before, after in zip(
        _trajectories(recorded), _trajectories(anonymous), strict=True
    ):
        for name in ("states", "actions", "rewards", "terminated", "frame_steps"):
            np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
        assert before.snapshots.keys() == after.snapshots.keys()
        for name, rows in before.snapshots.items():
            np.testing.assert_array_equal(rows, after.snapshots[name])


def test_files_are_renamed_and_so_is_what_refers_to_them(anonymous):
    """The uid with the name in it is another one, in every file."""
    directory = anonymous / "pendulum"
    manifest = _read(directory / "openaigym.manifest.0.user-final.manifest.json")
    assert manifest["stats"] == "openaigym.episode_batch.0.user-final.stats.json"
    for names in manifest["videos"]:
        assert all((directory / name).is_file() for name in names)
    assert {t.facts["infix"] for t in _trajectories(anonymous)} == {"0.user-final"}
    metadata = _read(directory / manifest["videos"][0][1])
    assert metadata["also_named"] == "user-run-episode-0.mp4"
    assert (directory / "user-run-episode-0.mp4").is_file()
    assert metadata["encoder_version"]["cmdline"][-1] == manifest["videos"][0][0]


def test_placeholders_stand_for_what_was_there(anonymous):
    """Options, arguments and reasons keep what names nobody."""
    [trajectory, _] = _trajectories(anonymous)
    assert trajectory.facts["options"] == {"goal": "<path>/goal.npy"}
    kwargs = trajectory.facts["environment"]["kwargs"]
    assert kwargs["xml_file"] == "<path>/models/robot.xml"
    details = _read(next((anonymous / "pendulum").glob("*.manifest.json")))["mjrec"]
    assert "no key in <path>/wandb.key" in details["faults"][0]["reason"]
    provenance = details["provenance"]
    assert provenance["command"] == [
        Path(sys.executable).name,
        "identity_recording.py",
        "runs",
    ]
    assert provenance["code"]["remote"] is None
    assert provenance["policy"]["file"] == "policy.pt"


def test_names_of_environments_stay_in_commands(tmp_path):
    """Only paths lose their directories."""
    command = ["mjrec", "record", "dm_control/cartpole-balance", "/opt/lab/policy.pt"]
    manifest = tmp_path / "openaigym.manifest.0.1.manifest.json"
    manifest.write_text(json.dumps({"mjrec": {"provenance": {"command": command}}}))
    make_anonymous(tmp_path, identity=Identity())
    kept = _read(manifest)["mjrec"]["provenance"]["command"]
    assert kept == [*command[:3], "policy.pt"]


def test_the_model_compiles_to_the_same(recorded, anonymous):
    """From sources without comments, and without the compiled one if it had a path."""
    assert any((anonymous / "pendulum").glob("*.mjb.gz")) != MODELS_HAVE_PATHS
    [old, new] = [_trajectories(d)[0].model() for d in (recorded, anonymous)]
    for name in ("qpos0", "geom_size", "body_mass", "tex_data", "names"):
        np.testing.assert_array_equal(getattr(old, name), getattr(new, name))


def test_frames_are_the_same(anonymous):
    """What is rendered of the recording without its author has the recorded hashes."""
    [trajectory, _] = _trajectories(anonymous)
    [hashes] = (anonymous / "pendulum").glob("*.video000000.framehash")
    again = [hashlib.sha256(frame).hexdigest() for frame in mjrec.render(trajectory)]
    lines = hashes.read_text().splitlines()
    assert again == [line.split()[-1] for line in lines if not line.startswith("#")]


@pytest.mark.thorough
def test_what_was_packed_is_whole(packed):
    """Its lists name the files as they are called now."""
    for archive in packed["anonymous"].iterdir():
        assert mjrec.verify(archive, level="files").failures == ()


def test_the_same_recordings_become_the_same_files(
    somebody, recorded, tmp_path, packed
):
    """However often, and whatever else was in the files' directory."""
    again = tmp_path / "pendulum.zip"
    somebody.run("-c", _PACK, str(recorded / "pendulum"), str(again), "anonymous")
    first = packed["anonymous"] / "pendulum.zip"
    assert again.read_bytes() == first.read_bytes()


def test_two_uids_do_not_become_one(tmp_path):
    """Of two that differ in what is taken out, one gets a number."""
    for uid in ("mbrunelli", "lovelace", "user"):
        (tmp_path / f"openaigym.episodes.0.{uid}.jsonl").write_text(
            f'{{"by": "{uid}"}}\n'
        )
    make_anonymous(tmp_path, identity=Identity(users={"lovelace", "mbrunelli"}))
    names = sorted(path.name for path in tmp_path.iterdir())
    uids = ("user", "user-2", "user-3")
    assert names == sorted(f"openaigym.episodes.0.{uid}.jsonl" for uid in uids)


def test_texts_in_csv_and_in_torn_journals_are_nobodys(tmp_path):
    """The header of the one is JSON; of the other, what is no JSON is left out."""
    csv = tmp_path / "openaigym.results.0.7.monitor.csv"
    csv.write_text('#{"t_start": 1.5, "env_id": "/home/ada/a.xml"}\nr,l,t\n1.0,2,0.5\n')
    journal = tmp_path / "openaigym.episodes.0.7.jsonl"
    journal.write_text('{"reward": 1e999, "seed": null}\n{"options": "/home/ada')
    make_anonymous(tmp_path, identity=Identity(homes={"/home/ada"}))
    assert csv.read_text() == (
        '#{"t_start": 1.5, "env_id": "<home>/a.xml"}\nr,l,t\n1.0,2,0.5\n'
    )
    assert journal.read_text() == '{"reward": 1e999, "seed": null}\n'


def test_single_cards_are_not_named(tmp_path):
    """Which of EGL's devices drew is left, and how many GPUs were given."""
    card = "GPU-8f1c2b0e-5d6a-4e3b-9c7d-112233445566"
    metadata = {
        "gl_device": {"index": 1, "file": "/dev/dri/renderD129", "uuid": card},
        "provenance": {"variables": {"CUDA_VISIBLE_DEVICES": f"{card},GPU-8f,2"}},
    }
    path = tmp_path / "openaigym.video.0.1.video000000.meta.json"
    path.write_text(json.dumps(metadata))
    make_anonymous(tmp_path, identity=Identity())
    assert _read(path) == {
        "gl_device": {"index": 1},
        "provenance": {"variables": {"CUDA_VISIBLE_DEVICES": "<gpu>,<gpu>,2"}},
    }


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
    assert remaining_identity(tmp_path, identity) == [
        (f"{model.name}: source/a.xml", "mbrunelli")
    ]


def _trajectories(directory):
    paths = sorted((directory / "pendulum").glob("*.h5"))
    return [mjrec.load_trajectory(path) for path in paths]


def _read(path):
    return loads(path.read_bytes())


def _contents(directory):
    return {p.name: p.read_bytes() for p in _files(directory)}


def _files(directory):
    return (path for path in sorted(directory.rglob("*")) if path.is_file())
