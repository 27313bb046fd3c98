# SPDX-License-Identifier: Apache-2.0
"""`mjrec recover` reports what it did, in text or as JSON."""

import json

from trajectories_by_hand import write_log

from mjrec.commands import main

LOG = "openaigym.trajectory.0.7.episode00000"


def test_what_was_done_is_listed(tmp_path, capsys):
    """A line a file, and nothing the second time."""
    write_log(tmp_path, 0)
    write_log(tmp_path, 1, ended=False)
    assert main(["recover", str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"Recovered in {tmp_path}:",
        f"  {LOG}0.h5: 4 steps",
        f"  {LOG}1.h5: 4 steps, incomplete: killed",
        "  openaigym.episode_batch.0.7.stats.json: 0 episodes",
        "  openaigym.manifest.0.7.manifest.json: 0 videos, 2 pending: mjrec render",
    ]
    assert main(["recover", str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"Nothing to recover in {tmp_path}.\n"


def test_failures_are_listed(tmp_path, capsys):
    """The exit status says so too. A newer version's log is left as it is."""
    write_log(tmp_path, 0)
    [log] = tmp_path.glob("*.log")
    [journal] = tmp_path.glob("*.jsonl")
    spoilt = journal.read_bytes().replace(b'"version": 1', b'"version": 9', 1)
    journal.write_bytes(spoilt)
    content = log.read_bytes()
    assert main(["recover", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "Not recovered:\n" in said
    assert f"  {log.name}: " in said
    assert log.read_bytes() == content
    assert main(["recover", str(tmp_path / "missing")]) == 1
    assert capsys.readouterr().err.startswith("mjrec: Cannot recover")


def test_json_is_one_object(tmp_path, capsys):
    """With the same content."""
    write_log(tmp_path, 0)
    assert main(["recover", str(tmp_path), "--timeout", "0", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["directory"] == str(tmp_path)
    assert content["files"][0] == {"name": f"{LOG}0.h5", "what": "4 steps"}
    assert (content["failures"], content["open_monitors"]) == ([], [])
