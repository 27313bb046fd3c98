# SPDX-License-Identifier: Apache-2.0
import json
import shutil

import pytest
from packed_runs import make_bag_fit, the, unpacked

import mjrec
from mjrec.commands import main

pytestmark = pytest.mark.usefixtures("default_signals")
TOPICS = (
    *("identity", "beginning", "physics", "rewards and ends"),
    *("selection of episodes", "videos shown", "pictures", "files"),
)


@pytest.fixture(scope="module")
def packed(pendulums, tmp_path_factory):
    """A packed run of one episode."""
    return mjrec.pack(pendulums(1), tmp_path_factory.mktemp("packed") / "run.zip")


def test_honest_run_passes_on_one_screen(packed, tmp_path, capsys):
    """The verdict first, then a line for each topic; and a page about it."""
    page = tmp_path / "verify.html"
    assert main(["verify", str(packed), "--report", str(page)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("PASS")
    assert len(lines) < 30
    for topic in TOPICS:
        assert any(line.strip().startswith(topic) for line in lines)
    assert "<html" in page.read_text()


def test_what_was_left_out_is_partly_and_status_3(packed, capsys):
    """A sample is chosen at random, and its seed is printed."""
    assert main(["verify", str(packed), "--sample", "2", "--verbose"]) == 3
    said = capsys.readouterr().out
    assert said.startswith("PARTLY")
    assert "--seed" in said


def test_forged_run_fails_with_status_1(packed, tmp_path, capsys):
    """The difference is named; names cannot give orders to the terminal."""
    bag = unpacked(packed, tmp_path / "bag")
    the(bag, "README.md").write_text("new \x1b[31m[bold]words")
    make_bag_fit(bag)
    assert main(["verify", str(bag)]) == 1
    said = capsys.readouterr().out
    assert said.startswith("FAIL")
    assert "README.md" in said
    assert "\x1b" not in said


def test_json_has_all(packed, capsys):
    """One object with stable fields, for scripts."""
    assert main(["verify", str(packed), "--level", "stats", "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert {"path", "level", "verdict", "findings", "excuses", "inputs"} <= set(said)
    assert said["verdict"] == "PARTLY"
    assert {each["topic"] for each in said["findings"]} <= set(TOPICS)
    assert set(said["facts"]) >= {"archive", "sample", "seed", "versions", "machine"}


def test_directory_that_was_not_packed_is_verified(pendulums, tmp_path, capsys):
    """Nothing is written into it."""
    folder = shutil.copytree(pendulums(1), tmp_path / "recordings")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert main(["verify", str(folder), "--level", "physics"]) == 3
    assert capsys.readouterr().out.startswith("PARTLY")
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--sample", "0"], "sample must be"),
        (["--allow", "gl"], "allow takes"),
        (["--report", "/no/such/place.html"], "no such directory"),
        ([], "mjrec: Cannot verify {}: it is not a zip file"),
    ],
)
def test_errors_are_one_message_and_status_1(arguments, said, tmp_path, capsys):
    """Options are checked before anything is unpacked."""
    path = tmp_path / "run.zip"
    path.write_bytes(b"PK\x03\x04")
    assert main(["verify", str(path), *arguments]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert said.format(path) in printed.err
