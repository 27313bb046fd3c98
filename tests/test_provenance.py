# SPDX-License-Identifier: Apache-2.0
"""Test the provenance of a recording in its manifest."""

import hashlib
import importlib.metadata
import subprocess
import sys

import pytest
from other_python import run_python
from recordings import manifest_of

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


def test_provenance_of_a_program(tmp_path, tmp_path_factory, monkeypatch):
    """The manifest has the command, packages, variables, commit and policy."""
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
    # A busy machine may need more time than the monitor's timeout.
    monkeypatch.setattr(provenance, "_SECONDS_AT_THE_END", 60)
    assert Provenance(tmp_path).found(wait=True)["code"]["dirty"] is True
    elsewhere = tmp_path_factory.mktemp("none")
    assert Provenance(elsewhere).found(wait=True)["code"] is None


def test_short_process_exits_silently():
    """The child process that lists packages ends silently with its parent."""
    program = (
        "import logging; logging.basicConfig()\n"
        "from mjrec import child_python, provenance\n"
        "provenance.look_around()\n"
        "while not child_python._children: pass"
    )
    assert run_python(program).stderr == ""


@pytest.mark.parametrize("way", ["child", "no child", "child that fails"])
def test_packages_equal_those_of_importlib(way, tmp_path, monkeypatch):
    """If the child process fails, the parent lists the packages itself."""
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


WHEEL_LINES = [
    '"gripper/with,comma.py",sha256=def,3',
    "gripper-1.5.dist-info/METADATA,sha256=jkl,5",
    "gripper/__init__.py,sha256=abc,12",
]
INSTALLER_LINES = [
    "gripper/__pycache__/__init__.cpython-311.pyc,,",
    "gripper-1.5.dist-info/RECORD,,",
    "gripper-1.5.dist-info/INSTALLER,sha256=ghi,4",
    "../../bin/gripper,sha256=mno,6",
]


def test_package_hashes_cover_the_wheel_alone(tmp_path, monkeypatch):
    """Only the first version on the path counts, without lines that installers add."""
    for version in ("1.5", "3.0"):
        info = tmp_path / version / f"gripper-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Name: Gripper\nVersion: {version}\n")
    places = [tmp_path / "1.5", None, str(tmp_path / "1.5"), str(tmp_path / "3.0")]
    # Entries that are not strings are skipped, as in imports.
    monkeypatch.setattr(sys, "path", [*places, *sys.path])
    found = installed_packages()["Gripper"]
    assert found == {"version": "1.5", "record_sha256": None}
    record = next(tmp_path.glob("1.5/*")) / "RECORD"
    record.write_text("\n".join(reversed(WHEEL_LINES + INSTALLER_LINES)) + "\n")
    expected = hashlib.sha256("\n".join(WHEEL_LINES).encode()).hexdigest()
    assert installed_packages()["Gripper"]["record_sha256"] == expected
