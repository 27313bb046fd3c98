# SPDX-License-Identifier: Apache-2.0
"""What a manifest says of what a recording was made with."""

import hashlib
import importlib.metadata
import json
import subprocess
import sys

import pytest

import mjrec
from mjrec.machine import machine_fingerprint
from mjrec.provenance import Provenance, installed_packages

PROGRAM = """
import gymnasium, mjrec
env = gymnasium.make("InvertedPendulum-v5")
with mjrec.Monitor(env, "out", render="off", policy_file="policy.bin") as env:
    env.reset(seed=0)
    env.step([0.1])
"""


def git(directory, *arguments):
    done = subprocess.run(
        ["git", "-c", "user.name=A", "-c", "user.email=a@b.c", *arguments],
        cwd=directory,
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip()


def provenance_of(directory):
    [manifest] = directory.glob("*.manifest.json")
    return json.loads(manifest.read_text())["mjrec"]["provenance"]


@pytest.fixture
def repository(tmp_path):
    """A repository with a program in it, which is committed."""
    (tmp_path / "train.py").write_text(PROGRAM)
    git(tmp_path, "init", "-q")
    git(tmp_path, "remote", "add", "origin", "https://example.org/robot.git")
    git(tmp_path, "add", "train.py")
    git(tmp_path, "commit", "-qm", "Train")
    (tmp_path / "policy.bin").write_bytes(b"weights")
    return tmp_path


def test_a_program_in_a_repository(repository):
    """Its command line, packages, variables, commit and policy are in the manifest."""
    subprocess.run([sys.executable, "train.py"], cwd=repository, check=True)
    found = provenance_of(repository / "out")
    assert found["command"][1:] == ["train.py"]
    assert found["working_directory"] == str(repository)
    assert found["machine"] == dict(machine_fingerprint())
    mujoco = found["packages"]["mujoco"]
    assert mujoco["version"] == importlib.metadata.version("mujoco")
    assert len(mujoco["record_sha256"]) == 64
    assert found["variables"]["MUJOCO_GL"]
    assert found["code"] == {
        "root": str(repository),
        "commit": git(repository, "rev-parse", "HEAD"),
        "dirty": False,
        "remote": "https://example.org/robot.git",
    }
    assert found["policy"] == {
        "file": str(repository / "policy.bin"),
        "sha256": hashlib.sha256(b"weights").hexdigest(),
    }


def test_code_that_changed_or_is_in_no_repository(
    repository, tmp_path_factory, corridor, tmp_path
):
    """Files that git knows count; elsewhere there is nothing to say of code.

    A policy's file must be there.
    """
    (repository / "train.py").write_text("pass\n")
    changed = Provenance(repository).found(wait=True)
    assert changed is not None
    assert changed["code"]["dirty"] is True
    elsewhere = Provenance(tmp_path_factory.mktemp("none")).found(wait=True)
    assert elsewhere is not None
    assert elsewhere["code"] is None
    # Else nobody would notice that its hash is missing, before the paper is out.
    with pytest.raises(mjrec.InvalidArgument, match="policy_file"):
        mjrec.Monitor(corridor, tmp_path / "out", policy_file=tmp_path / "none.zip")
    assert not (tmp_path / "out").exists()


# --- packages ---

RECORD = """\
gripper/__init__.py,sha256=abc,12
gripper/__pycache__/__init__.cpython-311.pyc,,
"gripper/with,comma.py",sha256=def,3
gripper-1.5.dist-info/RECORD,,
gripper-1.5.dist-info/INSTALLER,sha256=ghi,4
gripper-1.5.dist-info/METADATA,sha256=jkl,5
../../bin/gripper,sha256=mno,6
"""
OF_THE_WHEEL = """\
"gripper/with,comma.py",sha256=def,3
gripper-1.5.dist-info/METADATA,sha256=jkl,5
gripper/__init__.py,sha256=abc,12"""


def install(directory, version, record=None):
    """Put what an installer leaves of a package called Gripper into a directory."""
    info = directory / f"gripper-{version}.dist-info"
    info.mkdir(parents=True, exist_ok=True)
    (info / "METADATA").write_text(f"Name: Gripper\nVersion: {version}\n")
    if record is not None:
        (info / "RECORD").write_text(record)


@pytest.fixture(params=["child", "no child", "child that fails"])
def _way(request, monkeypatch, tmp_path):
    """Whoever reads the packages: another process, or this one where none can."""
    programs = {"no child": None, "child that fails": "#!/bin/sh\necho '{}'\nexit 3\n"}
    if request.param in programs:
        program, text = tmp_path / "python", programs[request.param]
        if text is not None:
            program.write_text(text)
            program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))


every_way = pytest.mark.usefixtures("_way")


def test_a_process_that_exits_at_once_says_nothing():
    """The child that lists the packages goes with it."""
    program = (
        "import logging; logging.basicConfig()\n"
        "from mjrec import child_python, provenance\n"
        "provenance.look_around()\n"
        "while not child_python._children: pass"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, check=True
    )
    assert done.stderr == b""


@every_way
def test_packages_are_those_that_python_itself_names():
    """All of them, in the order of their names, each with its version."""
    found = installed_packages()
    expected = {
        each.metadata["Name"]: importlib.metadata.version(each.metadata["Name"])
        for each in importlib.metadata.distributions()
    }
    assert {name: facts["version"] for name, facts in found.items()} == expected
    assert list(found) == sorted(found, key=str.lower)
    assert {"mjrec", "numpy", "mujoco"} <= found.keys()


def test_hashes_are_of_what_a_wheel_consists_of(tmp_path, monkeypatch):
    """Whatever the order of its lines, and whatever its installer adds to them.

    Of several versions the first on the path counts, which is the one imported.
    """
    install(tmp_path, "1.5")
    # What is no text on the path is passed over, as Python's own import does.
    monkeypatch.setattr(sys, "path", [tmp_path, None, str(tmp_path), *sys.path])
    found = installed_packages()["Gripper"]
    assert found == {"version": "1.5", "record_sha256": None}
    install(tmp_path, "1.5", RECORD)
    expected = hashlib.sha256(OF_THE_WHEEL.encode()).hexdigest()
    assert installed_packages()["Gripper"] == {
        "version": "1.5",
        "record_sha256": expected,
    }
    for version in ("3.0", "1.0"):
        install(tmp_path / version, version)
    others = [str(tmp_path / version) for version in ("1.0", "3.0")]
    monkeypatch.setattr(sys, "path", [*others, *sys.path])
    assert installed_packages()["Gripper"]["version"] == "1.0"
