# SPDX-License-Identifier: Apache-2.0
"""`mjrec pack`: it says what it made, and how that is verified."""

import hashlib
import json

import pytest
from packed_runs import the, unpacked
from recordings import videos_in

from mjrec.commands import main


@pytest.fixture(scope="module")
def recorded(pendulums):
    """Return a directory with two episodes, each with a video."""
    return str(pendulums(2, longest=3))


def test_it_says_what_it_made(recorded, tmp_path, capsys):
    """Where, how much, its hash, and the command that verifies it."""
    path = tmp_path / "run.zip"
    assert main(["pack", recorded, "-o", str(path), "--anonymous"]) == 0
    where, size, digest, advice = capsys.readouterr().out.splitlines()
    assert where == str(path)
    assert f"({path.stat().st_size} bytes)" in size
    assert digest == f"  sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}"
    assert advice.endswith(f"mjrec verify {path}")
    assert "withheld" in the(unpacked(path, tmp_path / "x"), "README.md").read_text()


def test_everything_can_be_stated(recorded, tmp_path):
    """Several authors, and a choice of episodes."""
    path = tmp_path / "run.zip"
    arguments = ["--title", "T", "--author", "A B", "--author", "C D"]
    more = ["--license", "MIT", "--episodes", "1, 1", "--max-size", "5M"]
    assert main(["pack", recorded, "--out", str(path), *arguments, *more]) == 0
    folder = unpacked(path, tmp_path / "x")
    crate = json.loads(the(folder, "ro-crate-metadata.json").read_text())
    root = next(entity for entity in crate["@graph"] if entity["@id"] == "./")
    assert root["name"] == "T"
    assert len(root["author"]) == 2
    assert root["license"]["@id"].endswith("/MIT")
    assert videos_in(folder / "data/recordings") == [1]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--episodes", "one"], "--episodes must be a comma-separated list"),
        (["--episodes", "7"], "Available: 0, 1."),
        (["--max-size", "1k"], "The largest files"),
    ],
)
def test_errors_are_one_message(arguments, part, recorded, tmp_path, capsys):
    """And nothing is made."""
    assert main(["pack", recorded, "-o", str(tmp_path / "run.zip"), *arguments]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert part in said.err
    assert list(tmp_path.iterdir()) == []
