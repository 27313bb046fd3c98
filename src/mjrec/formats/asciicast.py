# SPDX-License-Identifier: Apache-2.0
"""Recordings of text environments, as asciicast version 1.

The format is asciinema's (https://docs.asciinema.org/manual/asciicast/v1/): one JSON
object with `version`, `width`, `height`, `duration`, `command`, `title`, `env` and
`stdout`, a list of pairs of a delay in seconds and the text that is then printed.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import re
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import IO

from ..atomic_files import temporary_path
from ..errors import FileNotWritten, InvalidFrame
from ..json_text import loads
from ..rates import rate_from_timestep
from .json_fields import unreadable

# Frames come first in the file, a line each, and then what all of them decide.
_BEGIN = '{"stdout": [\n'
_CLEAR_AND_HOME = "\x1b[2J\x1b[1;1H"
# Control sequences (colours, cursor) take no room on the screen. ECMA-48, 5.4.
_CONTROL_SEQUENCE = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")


def text_of_frame(frame: object) -> str:
    r"""Return the text of what `render()` gave in the mode `ansi`.

    Raises:
        InvalidFrame: it is neither text nor a `StringIO`.
    """
    if isinstance(frame, io.StringIO):
        frame = frame.getvalue()
    if not isinstance(frame, str):
        raise InvalidFrame(
            f"A text frame must be a str or a StringIO, got {type(frame).__name__}."
        )
    return frame


class AsciicastWriter:
    """Writes text frames, each shown for the same time, into one file.

    Frames go to the disk as they come, into the hidden file that gets the recording's
    name in `close`.

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
            FileNotWritten: the disk is full, or the directory is gone.
        """
        lines = text.replace("\r\n", "\n").split("\n")
        self._width = max(self._width, *(_columns(line) for line in lines))
        self._height = max(self._height, len(lines))
        event = [float(1 / self._rate), _CLEAR_AND_HOME + "\r\n".join(lines)]
        with self._naming_the_file():
            if self._file is None:
                self._file = self._part.open("w", encoding="utf-8")
            begin = ",\n" if self.frame_count else _BEGIN
            self._file.write(begin + json.dumps(event))
            # A killed process leaves what is with the operating system.
            self._file.flush()
        self.frame_count += 1

    def close(self) -> None:
        """Finish the file; without a frame there is none. Idempotent.

        Raises:
            FileNotWritten: as `write`.
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
        with self._naming_the_file():
            if not self._file.closed:
                self._file.write("\n], " + json.dumps(facts)[1:] + "\n")
                self._file.close()
            if self._part.exists():
                self._part.replace(self.path)

    def abort(self) -> None:
        """End without a file."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._part.unlink(missing_ok=True)

    def leave(self) -> None:
        """Let go of the unfinished file, which others finish."""
        if self._file is not None:
            self._file.close()

    @contextlib.contextmanager
    def _naming_the_file(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise FileNotWritten(self.path, error.strerror) from error


def unfinished_recording(path: Path) -> tuple[Fraction, list[str]]:
    """Return the rate and the text frames of a recording that was cut off.

    Args:
        path: the hidden file that a killed process has left. What was torn at its end
            is left out.

    Raises:
        UnreadableFile: it is no such file, or holds no frame.
    """
    with unreadable(path):
        if not path.is_file() or path.is_symlink():
            raise ValueError("it is not a regular file")
        frames: list[str] = []
        delay = 0.0
        with path.open(encoding="utf-8", errors="replace") as body:
            for line in itertools.islice(body, 1, None):
                try:
                    delay, text = loads(line.rstrip().removesuffix(","))
                    text = text.removeprefix(_CLEAR_AND_HOME)
                    frames.append(text.replace("\r\n", "\n"))
                except (AttributeError, TypeError, RecursionError, ValueError):
                    break
        if not frames or not isinstance(delay, float | int) or not 0 < delay < 1e6:
            raise ValueError("it holds no text frame")
        return rate_from_timestep(delay), frames


def _columns(line: str) -> int:
    return len(_CONTROL_SEQUENCE.sub("", line))
