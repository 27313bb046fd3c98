# SPDX-License-Identifier: Apache-2.0
import json
import subprocess
import sys
from fractions import Fraction

import pytest
from full_disk import file_size_limit
from other_python import run_python

from mjrec import FileNotWritten
from mjrec.formats.asciicast import AsciicastWriter


def test_frames_last_one_over_the_rate_and_clear_the_screen(tmp_path):
    """An accented letter counts as one column and a color code as none."""
    path = tmp_path / "a.json"
    writer = AsciicastWriter(path, rate=Fraction(4))
    writer.write("éé\n\x1b[41mx\x1b[0m\n")
    assert [p.suffix for p in tmp_path.iterdir()] == [".part"]
    writer.write("world\n")
    writer.close()
    writer.close()
    assert list(tmp_path.iterdir()) == [path]
    cast = json.loads(path.read_text())
    assert [delay for delay, _ in cast["stdout"]] == [0.25, 0.25]
    assert (cast["version"], cast["duration"]) == (1, 0.5)
    assert (cast["width"], cast["height"]) == (7, 3)
    assert cast["stdout"][1][1] == "\x1b[2J\x1b[1;1Hworld\r\n"
    player = [sys.executable, "-m", "asciinema", "play", "--speed", "100", str(path)]
    done = run_python(f"import pty; pty.spawn({player})", stdin=subprocess.DEVNULL)
    assert "éé" in done.stdout
    assert "world" in done.stdout


def test_empty_or_failed_casts_leave_no_file(tmp_path):
    AsciicastWriter(tmp_path / "a.json", rate=Fraction(1)).close()
    writer = AsciicastWriter(tmp_path / "a.json", rate=Fraction(1))
    with file_size_limit(10), pytest.raises(FileNotWritten, match=r"a\.json"):
        writer.write("a\n")
    writer.abort()
    assert not list(tmp_path.iterdir())
