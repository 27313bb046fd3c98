# SPDX-License-Identifier: Apache-2.0
"""Recordings of text environments, as asciicast version 1.

The format is asciinema's (https://docs.asciinema.org/manual/asciicast/v1/): one JSON
object with `version`, `width`, `height`, `duration`, `command`, `title`, `env` and
`stdout`, a list of pairs of a delay in seconds and the text that is then printed.
"""

from __future__ import annotations

import io
import json
import re
import shutil
from fractions import Fraction
from pathlib import Path
from typing import IO

from .. import atomic_files
from ..errors import ClosedError, DirectoryNotWritable, InvalidFrame
from ..json_text import loads
from ..rates import rate_from_timestep
from .json_fields import unreadable

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

    Frames go to the disk as they come; the file gets its name in `close`.

    Args:
        path: the finished file.
        rate: frames per second.
    """

    def __init__(self, path: Path, *, rate: Fraction) -> None:
        self.path = path
        self.frame_count = 0
        self._delay = float(1 / rate)
        self._rate = rate
        self._width = 0
        self._height = 0
        self._body_path = atomic_files.temporary_path(path)
        self._body: IO[str] | None = None
        self._closed = False

    def write(self, text: str) -> None:
        """Append a frame.

        Raises:
            ClosedError: the writer is closed.
            DirectoryNotWritable: no file can be made beside `path`.
        """
        if self._closed:
            raise ClosedError(f"The text recording {self.path} is closed.")
        if self._body is None:
            self._body = self._opened()
        lines = text.replace("\r\n", "\n").split("\n")
        self._width = max(self._width, *(_columns(line) for line in lines))
        self._height = max(self._height, len(lines))
        event = [self._delay, _CLEAR_AND_HOME + "\r\n".join(lines)]
        separator = ",\n" if self.frame_count else ""
        self._body.write(separator + json.dumps(event))
        # A killed process leaves what is with the operating system.
        self._body.flush()
        self.frame_count += 1

    def close(self) -> None:
        """Finish the file; without a frame there is none. Idempotent.

        What raised or was interrupted can be tried again.
        """
        if self._closed:
            return
        if self._body is not None:
            self._body.close()
            with atomic_files.replacing(self.path) as temporary:
                self._assemble(temporary)
            self._body_path.unlink(missing_ok=True)
        self._closed = True

    def abort(self) -> None:
        """End without a file."""
        self._closed = True
        if self._body is not None:
            self._body.close()
            self._body_path.unlink(missing_ok=True)

    def leave(self) -> None:
        """Let go of the unfinished file, which others finish."""
        self._closed = True
        if self._body is not None:
            self._body.close()

    def _opened(self) -> IO[str]:
        try:
            return self._body_path.open("w", encoding="utf-8")
        except OSError as error:
            raise DirectoryNotWritable(self.path.parent, error.strerror) from error

    def _assemble(self, target: Path) -> None:
        header = {
            "version": 1,
            "width": self._width + 2,
            "height": self._height,
            "duration": float(self.frame_count / self._rate),
            "command": "-",
            "title": "mjrec recording",
            "env": {},
        }
        with (
            target.open("w", encoding="utf-8") as whole,
            self._body_path.open(encoding="utf-8") as body,
        ):
            whole.write(json.dumps(header)[:-1] + ', "stdout": [')
            shutil.copyfileobj(body, whole)
            whole.write("]}\n")


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
            for line in body:
                try:
                    delay, text = loads(line.rstrip().removesuffix(","))
                    frames.append(_frame_of(text))
                except (AttributeError, TypeError, RecursionError, ValueError):
                    break
        if not frames or not isinstance(delay, float | int) or not 0 < delay < 1e6:
            raise ValueError("it holds no text frame")
        return rate_from_timestep(delay), frames


def _frame_of(printed: str) -> str:
    return printed.removeprefix(_CLEAR_AND_HOME).replace("\r\n", "\n")


def _columns(line: str) -> int:
    return len(_CONTROL_SEQUENCE.sub("", line))
