# SPDX-License-Identifier: Apache-2.0
"""What a manifest says of what a recording was made with."""

import hashlib
import importlib.metadata
import subprocess
import sys

import pytest
from other_python import run_python
from recordings import manifest_of

import mjrec
from mjrec import provenance
from mjrec.machine import machine_fingerprint
from mjrec.provenance import Provenance, installed_packages

PROGRAM = """
import gymnasium, mjrec, mjrec.provenance
mjrec.provenance._SECONDS_AT_THE_END = 60
env = gymnasium.make("InvertedPendulum-v5")
with mjrec.Monitor(env, "out", render="off", policy_file="policy.bin") as env:
    env.reset(seed=0)
    env.step([0.1])
"""


def git(directory, *arguments):
    command = ["git", "-c", "user.name=A", "-c", "user.email=a@b.c", *arguments]
    return subprocess.check_output(command, cwd=directory, text=True).strip()


def test_a_program_in_a_repository(tmp_path, tmp_path_factory, monkeypatch):
    """Its command, packages, variables, commit and policy are in the manifest."""
    (tmp_path / "train.py").write_text(PROGRAM)
    git(tmp_path, "init", "-q")
    git(tmp_path, "remote", "add", "origin", "https://example.org/robot.git")
    git(tmp_path, "add", "train.py")
    git(tmp_path, "commit", "-qm", "Train")
    (tmp_path / "policy.bin").write_bytes(b"weights")
    subprocess.run([sys.executable, "train.py"], cwd=tmp_path, check=True)
    found = manifest_of(tmp_path / "out")["mjrec"]["provenance"]
    assert found["command"][1:] == ["train.py"]
    assert found["working_directory"] == str(tmp_path)
    assert found["machine"] == dict(machine_fingerprint())
    mujoco = found["packages"]["mujoco"]
    assert mujoco["version"] == importlib.metadata.version("mujoco")
    assert len(mujoco["record_sha256"]) == 64
    assert found["variables"]["MUJOCO_GL"]
    assert found["code"] == {
        "root": str(tmp_path),
        "commit": git(tmp_path, "rev-parse", "HEAD"),
        "dirty": False,
        "remote": "https://example.org/robot.git",
    }
    assert found["policy"] == {
        "file": str(tmp_path / "policy.bin"),
        "sha256": hashlib.sha256(b"weights").hexdigest(),
    }
    (tmp_path / "train.py").write_text("pass\n")
    # A busy machine takes longer than a monitor waits.
    monkeypatch.setattr(provenance, "_SECONDS_AT_THE_END", 60)
    assert Provenance(tmp_path).found(wait=True)["code"]["dirty"] is True
    elsewhere = tmp_path_factory.mktemp("none")
    assert Provenance(elsewhere).found(wait=True)["code"] is None


def test_a_policy_file_must_be_there(corridor, tmp_path):
    """Else its hash would be found missing when the paper is out."""
    with pytest.raises(mjrec.InvalidArgument, match="policy_file"):
        mjrec.Monitor(corridor, tmp_path / "out", policy_file=tmp_path / "none.zip")
    assert not (tmp_path / "out").exists()


def test_a_process_that_exits_at_once_says_nothing():
    """The child that lists the packages goes with it."""
    program = (
        "import logging; logging.basicConfig()\n"
        "from mjrec import child_python, provenance\n"
        "provenance.look_around()\n"
        "while not child_python._children: pass"
    )
    assert run_python(program).stderr == ""


@pytest.mark.parametrize("way", ["child", "no child", "child that fails"])
def test_packages_are_those_that_python_itself_names(way, tmp_path, monkeypatch):
    """All of them, in the order of their names, whichever process reads them."""
    program = tmp_path / "python"
    if way == "child that fails":
        program.write_text("#!/bin/sh\necho '{}'\nexit 3\n")
        program.chmod(0o755)
    if way != "child":
        monkeypatch.setattr(sys, "executable", str(program))
    found = installed_packages()
    expected = {
        each.metadata["Name"]: importlib.metadata.version(each.metadata["Name"])
        for each in importlib.metadata.distributions()
    }
    assert {name: facts["version"] for name, facts in found.items()} == expected
    assert list(found) == sorted(found, key=str.lower)


OF_THE_WHEEL = [
    '"gripper/with,comma.py",sha256=def,3',
    "gripper-1.5.dist-info/METADATA,sha256=jkl,5",
    "gripper/__init__.py,sha256=abc,12",
]
OF_THE_INSTALLER = [
    "gripper/__pycache__/__init__.cpython-311.pyc,,",
    "gripper-1.5.dist-info/RECORD,,",
    "gripper-1.5.dist-info/INSTALLER,sha256=ghi,4",
    "../../bin/gripper,sha256=mno,6",
]


def test_hashes_are_of_what_a_wheel_consists_of(tmp_path, monkeypatch):
    """In any order, without an installer's lines; of the first version on the path."""
    for version in ("1.5", "3.0"):
        info = tmp_path / version / f"gripper-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Name: Gripper\nVersion: {version}\n")
    places = [tmp_path / "1.5", None, str(tmp_path / "1.5"), str(tmp_path / "3.0")]
    # What is no text on the path is passed over, as Python's own import does.
    monkeypatch.setattr(sys, "path", [*places, *sys.path])
    found = installed_packages()["Gripper"]
    assert found == {"version": "1.5", "record_sha256": None}
    record = next(tmp_path.glob("1.5/*")) / "RECORD"
    record.write_text("\n".join(reversed(OF_THE_WHEEL + OF_THE_INSTALLER)) + "\n")
    expected = hashlib.sha256("\n".join(OF_THE_WHEEL).encode()).hexdigest()
    assert installed_packages()["Gripper"]["record_sha256"] == expected
