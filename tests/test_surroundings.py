# SPDX-License-Identifier: Apache-2.0
"""What a manifest says of what a recording was made with."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import mjrec
from mjrec.machine import machine_fingerprint
from mjrec.surroundings import Surroundings

PROGRAM = """
import gymnasium, mjrec
env = gymnasium.make("InvertedPendulum-v5")
with mjrec.Monitor(env, "out", render="off", policy_file="policy.bin") as env:
    env.reset(seed=0)
    env.step([0.1])
"""


def git(directory: Path, *arguments: str) -> str:
    done = subprocess.run(
        ["git", "-c", "user.name=A", "-c", "user.email=a@b.c", *arguments],
        cwd=directory,
        check=True,
        capture_output=True,
        text=True,
    )
    return done.stdout.strip()


def surroundings_of(directory: Path) -> dict[str, Any]:
    [manifest] = directory.glob("*.manifest.json")
    found: dict[str, Any] = json.loads(manifest.read_text())["mjrec"]["surroundings"]
    return found


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository with a program in it, which is committed."""
    (tmp_path / "train.py").write_text(PROGRAM)
    git(tmp_path, "init", "-q")
    git(tmp_path, "remote", "add", "origin", "https://example.org/robot.git")
    git(tmp_path, "add", "train.py")
    git(tmp_path, "commit", "-qm", "Train")
    (tmp_path / "policy.bin").write_bytes(b"weights")
    return tmp_path


def test_a_program_in_a_repository(repository: Path) -> None:
    """Its command line, packages, variables, commit and policy are in the manifest."""
    subprocess.run([sys.executable, "train.py"], cwd=repository, check=True)
    found = surroundings_of(repository / "out")
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


def test_changed_code_is_dirty(repository: Path) -> None:
    """A file that git knows and that is other than committed."""
    around = Surroundings(repository).found(wait=True)
    assert around is not None
    assert around["code"]["dirty"] is False
    (repository / "train.py").write_text("pass\n")
    around = Surroundings(repository).found(wait=True)
    assert around is not None
    assert around["code"]["dirty"] is True


def test_code_in_no_repository(tmp_path: Path) -> None:
    """Then there is nothing to say of it, and the rest is there."""
    around = Surroundings(tmp_path).found(wait=True)
    assert around is not None
    assert around["code"] is None
    assert "numpy" in around["packages"]


def test_the_policys_file_must_be_there(corridor: Any, tmp_path: Path) -> None:
    """Else nobody would notice that its hash is missing, before the paper is out."""
    with pytest.raises(mjrec.InvalidArgument, match="policy_file"):
        mjrec.Monitor(corridor, tmp_path / "out", policy_file=tmp_path / "none.zip")
    assert not (tmp_path / "out").exists()
