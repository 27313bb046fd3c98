# SPDX-License-Identifier: Apache-2.0
"""Test the output and options of `mjrec pack`."""

import hashlib
import json

import pytest
from packed_runs import the, unpacked
from recordings import videos_in


@pytest.fixture(scope="module")
def recorded(pendulums):
    return pendulums(2, longest=3)


def test_output_has_path_size_hash_and_how_to_verify(recorded, tmp_path, command):
    path = tmp_path / "run.zip"
    out = command("pack", recorded, "-o", path, "--anonymous").out
    where, size, digest, advice = out.splitlines()
    assert where == str(path)
    assert f"({path.stat().st_size} bytes)" in size
    assert digest == f"  sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}"
    assert advice.endswith(f"mjrec verify {path}")
    assert "withheld" in the(unpacked(path, tmp_path / "x"), "README.md").read_text()


def test_options_set_statements_and_select_episodes(recorded, tmp_path, command):
    path = tmp_path / "run.zip"
    statements = ("--title", "T", "--author", "A B", "--author", "C D")
    more = ("--license", "MIT", "--episodes", "1, 1", "--max-size", "5M")
    command("pack", recorded, "--out", path, *statements, *more)
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
def test_error_leaves_only_a_message(arguments, part, recorded, tmp_path, command):
    path = tmp_path / "run.zip"
    out, err = command("pack", recorded, "-o", path, *arguments, status=1)
    assert out == ""
    assert part in err
    assert list(tmp_path.iterdir()) == []
