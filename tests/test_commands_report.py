# SPDX-License-Identifier: Apache-2.0
"""`mjrec report` writes a page and says where it is."""

import json

import pytest

from mjrec.commands.report import report
from mjrec.errors import InvalidArgument
from report_recordings import GYM, entry, write_journal


@pytest.fixture
def recordings(tmp_path):
    write_journal(tmp_path / "run", "0.a", "X-v0", [entry(i) for i in range(3)])
    return tmp_path / "run"


def test_it_writes_a_folder_and_prints_its_page(recordings, tmp_path, capsys):
    """Of several directories."""
    page = tmp_path / "r" / "index.html"
    directories = (recordings, GYM / "0.7.4" / "plain")
    assert report(directories, out=page.parent, title="Both") == 0
    assert capsys.readouterr().out == f"{page}\n"
    text = page.read_text()
    assert "<title>Both</title>" in text
    assert "X-v0" in text
    assert "Tiny-v0" in text


def test_json_names_the_page(recordings, tmp_path, capsys, monkeypatch):
    """With its whole path; in a folder called report, if none is given."""
    monkeypatch.chdir(tmp_path)
    assert report((recordings,), as_json=True) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == {"page": str(tmp_path / "report" / "index.html")}


def test_a_single_file_and_a_verdict(recordings, tmp_path):
    """What the options say reaches the page."""
    said = {"path": "run", "level": "stats", "verdict": "FAIL", "findings": []}
    path = tmp_path / "said.json"
    path.write_text(json.dumps(said))
    page = tmp_path / "one.html"
    assert report((recordings,), out=page, single_file=True, verification=(path,)) == 0
    assert "said.json" in page.read_text()
    with pytest.raises(InvalidArgument, match="max_single_file_bytes"):
        report((recordings,), out=page, single_file=True, max_single_file_bytes=10)
