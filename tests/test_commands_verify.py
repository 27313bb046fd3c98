# SPDX-License-Identifier: Apache-2.0
import json
import shutil

import pytest
from packed_runs import make_bag_fit, the, unpacked

import mjrec

pytestmark = pytest.mark.usefixtures("default_signals")
TOPICS = (
    *("identity", "beginning", "physics", "rewards and ends"),
    *("selection of episodes", "videos shown", "pictures", "files"),
)


@pytest.fixture(scope="module")
def packed(pendulums, tmp_path_factory):
    return mjrec.pack(pendulums(1), tmp_path_factory.mktemp("packed") / "run.zip")


def test_honest_run_passes_with_a_line_per_topic_and_a_page(packed, tmp_path, command):
    page = tmp_path / "verify.html"
    lines = command("verify", packed, "--report", page).out.splitlines()
    assert lines[0].startswith("PASS")
    assert len(lines) < 30
    for topic in TOPICS:
        assert any(line.strip().startswith(topic) for line in lines)
    assert "<html" in page.read_text()


def test_sample_is_partly_verified_with_status_3(packed, command):
    """The sample is random, so its seed is printed."""
    out = command("verify", packed, "--sample", 2, "--verbose", status=3).out
    assert out.startswith("PARTLY")
    assert "--seed" in out


def test_forged_run_fails_with_status_1(packed, tmp_path, command):
    """The output names the changed file and contains no escape sequences from it."""
    bag = unpacked(packed, tmp_path / "bag")
    the(bag, "README.md").write_text("new \x1b[31m[bold]words")
    make_bag_fit(bag)
    out = command("verify", bag, status=1).out
    assert out.startswith("FAIL")
    assert "README.md" in out
    assert "\x1b" not in out


def test_json_has_all_fields(packed, command):
    out = command("verify", packed, "--level", "stats", "--json", status=3).out
    result = json.loads(out)
    assert {"path", "level", "verdict", "findings", "excuses", "inputs"} <= set(result)
    assert result["verdict"] == "PARTLY"
    assert {each["topic"] for each in result["findings"]} <= set(TOPICS)
    assert set(result["facts"]) >= {"archive", "sample", "seed", "versions", "machine"}


def test_verifying_recordings_writes_nothing_into_them(pendulums, tmp_path, command):
    folder = shutil.copytree(pendulums(1), tmp_path / "recordings")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    out = command("verify", folder, "--level", "physics", status=3).out
    assert out.startswith("PARTLY")
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--sample", "0"], "sample must be"),
        (["--allow", "gl"], "allow takes"),
        (["--report", "/no/such/place.html"], "no such directory"),
        ([], "mjrec: Cannot verify {}: it is not a zip file"),
    ],
)
def test_errors_are_one_message_and_status_1(arguments, message, tmp_path, command):
    """Options are checked before the archive is unpacked."""
    path = tmp_path / "run.zip"
    path.write_bytes(b"PK\x03\x04")
    out, err = command("verify", path, *arguments, status=1)
    assert out == ""
    assert message.format(path) in err
