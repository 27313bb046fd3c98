# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import json
import subprocess
import sys
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from mjrec import ClosedError, DirectoryNotWritable, InvalidFrame
from mjrec.formats.asciicast import AsciicastWriter, text_of_frame


def write(path: Path, *frames: str, rate: int = 4) -> dict[str, Any]:
    writer = AsciicastWriter(path, rate=Fraction(rate))
    for frame in frames:
        writer.write(frame)
    writer.close()
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def test_each_frame_lasts_one_over_the_rate(tmp_path: Path) -> None:
    """Delays and the duration follow from the rate."""
    cast = write(tmp_path / "a.json", "a\n", "b\n", rate=4)
    assert [delay for delay, _ in cast["stdout"]] == [0.25, 0.25]
    assert cast["duration"] == 0.5
    assert cast["version"] == 1


def test_frame_clears_the_screen_first(tmp_path: Path) -> None:
    """Lines end as a terminal needs them."""
    cast = write(tmp_path / "a.json", "ab\ncd\n")
    assert cast["stdout"][0][1] == "\x1b[2J\x1b[1;1Hab\r\ncd\r\n"


def test_size_counts_characters_and_not_bytes(tmp_path: Path) -> None:
    """An accent is one column wide and a colour none."""
    cast = write(tmp_path / "a.json", "éé\n\x1b[41mx\x1b[0m\n")
    assert (cast["width"], cast["height"]) == (4, 3)


def test_asciinema_accepts_it(tmp_path: Path) -> None:
    """The real player plays the frames on a terminal."""
    path = tmp_path / "a.json"
    write(path, "hello\n", "world\n")
    player = [sys.executable, "-m", "asciinema", "play", "--speed", "100", str(path)]
    done = subprocess.run(
        [sys.executable, "-c", f"import pty; pty.spawn({player})"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "hello" in done.stdout
    assert "world" in done.stdout


def test_no_frame_leaves_no_file(tmp_path: Path) -> None:
    """Nothing recorded, nothing written."""
    AsciicastWriter(tmp_path / "a.json", rate=Fraction(1)).close()
    assert not list(tmp_path.iterdir())


def test_unfinished_has_no_final_name(tmp_path: Path) -> None:
    """Before close there is only a temporary file; abort removes it."""
    writer = AsciicastWriter(tmp_path / "a.json", rate=Fraction(1))
    writer.write("a\n")
    assert [p.suffix for p in tmp_path.iterdir()] == [".part"]
    writer.abort()
    assert not list(tmp_path.iterdir())


def test_missing_directory_is_an_error(tmp_path: Path) -> None:
    """The same as for videos."""
    writer = AsciicastWriter(tmp_path / "no" / "a.json", rate=Fraction(1))
    with pytest.raises(DirectoryNotWritable, match="no"):
        writer.write("a")


def test_write_after_close_is_an_error(tmp_path: Path) -> None:
    """A closed recording takes no frame."""
    writer = AsciicastWriter(tmp_path / "a.json", rate=Fraction(1))
    writer.close()
    with pytest.raises(ClosedError):
        writer.write("a\n")


def test_text_frames_are_text_or_stringio() -> None:
    """Both are what `render()` may give in the mode ansi."""
    assert text_of_frame("a") == text_of_frame(io.StringIO("a")) == "a"
    with pytest.raises(InvalidFrame, match="NoneType"):
        text_of_frame(None)
