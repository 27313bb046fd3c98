# SPDX-License-Identifier: Apache-2.0
"""Recordings of text environments in the asciicast format, version 1.

The format is asciinema's (https://docs.asciinema.org/manual/asciicast/v1/): one JSON
object with `version`, `width`, `height`, `duration`, `command`, `title`, `env` and
`stdout`. Each item of `stdout` is a delay in seconds and the text to print after it.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import re
from fractions import Fraction
from pathlib import Path
from typing import IO

from ..atomic_files import temporary_path, writing
from ..errors import InvalidFrame
from ..json_text import loads
from .json_fields import unreadable

# The frames come first, one per line. The fields that depend on all frames follow.
_BEGIN = '{"stdout": [\n'
_CLEAR_AND_HOME = "\x1b[2J\x1b[1;1H"
# Control sequences (colors, cursor) take up no space on the screen; see ECMA-48, 5.4.
_CONTROL_SEQUENCE = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")


def text_of_frame(frame: object) -> str:
    r"""Return the text of a frame that `render()` returned in `ansi` mode.

    Raises:
        InvalidFrame: the frame is neither a `str` nor a `StringIO`.
    """
    if isinstance(frame, io.StringIO):
        frame = frame.getvalue()
    if not isinstance(frame, str):
        raise InvalidFrame(
            f"A text frame must be a str or a StringIO, not {type(frame).__name__}."
        )
    return frame


class AsciicastWriter:
    """A writer for text frames, which are all shown for the same duration.

    Each frame is immediately written to a hidden file, which `close` renames to the
    recording's name.

    Args:
        path: the finished file.
        rate: frames per second.
    """

    def __init__(self, path: Path, *, rate: Fraction) -> None:
        self.path = path
        self.frame_count = 0
        self._rate = rate
        self._width = self._height = 0
        self._part = temporary_path(path)
        self._file: IO[str] | None = None

    def write(self, text: str) -> None:
        """Append a frame.

        Raises:
            FileNotWritten: the disk is full, or the directory was removed.
        """
        lines = text.replace("\r\n", "\n").split("\n")
        self._width = max(self._width, *(_columns(line) for line in lines))
        self._height = max(self._height, len(lines))
        event = [float(1 / self._rate), _CLEAR_AND_HOME + "\r\n".join(lines)]
        with writing(self.path):
            if self._file is None:
                self._file = self._part.open("w", encoding="utf-8")
            begin = ",\n" if self.frame_count else _BEGIN
            self._file.write(begin + json.dumps(event))
            # If the process is killed, only flushed data survives.
            self._file.flush()
        self.frame_count += 1

    def close(self) -> None:
        """Finish the file. If there are no frames, no file is created. Idempotent.

        Raises:
            FileNotWritten: the disk is full, or the directory was removed.
        """
        if self._file is None:
            return
        facts = {
            "version": 1,
            "width": self._width + 2,
            "height": self._height,
            "duration": float(self.frame_count / self._rate),
            "command": "-",
            "title": "mjrec recording",
            "env": {},
        }
        with writing(self.path):
            if not self._file.closed:
                self._file.write("\n], " + json.dumps(facts)[1:] + "\n")
                self._file.close()
            if self._part.exists():
                self._part.replace(self.path)

    def abort(self) -> None:
        """Stop without producing a file."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._part.unlink(missing_ok=True)

    def leave(self) -> None:
        """Close the unfinished file, so that another process can finish it."""
        if self._file is not None:
            self._file.close()


def unfinished_frames(path: Path) -> list[str]:
    """Return the text frames of an unfinished recording.

    Args:
        path: the hidden file that a killed process left. An incomplete frame at its end
            is ignored.

    Raises:
        UnreadableFile: the file is not such a recording, or contains no frames.
    """
    with unreadable(path):
        if not path.is_file() or path.is_symlink():
            raise ValueError("it is not a regular file")
        frames: list[str] = []
        with path.open(encoding="utf-8", errors="replace") as body:
            for line in itertools.islice(body, 1, None):
                try:
                    _, text = loads(line.rstrip().removesuffix(","))
                    text = text.removeprefix(_CLEAR_AND_HOME)
                    frames.append(text.replace("\r\n", "\n"))
                except (AttributeError, TypeError, RecursionError, ValueError):
                    break
        if not frames:
            raise ValueError("it contains no text frames")
        return frames


def _columns(line: str) -> int:
    return len(_CONTROL_SEQUENCE.sub("", line))
