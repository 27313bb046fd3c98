# SPDX-License-Identifier: Apache-2.0
"""A process with limits, in which a module of ours reads what strangers have written.

Whatever a hostile file does to HDF5's, MuJoCo's, OpenGL's or ffmpeg's code, it does it
there. Both sides speak JSON, a line each. The parent sends one request and keeps the
pipe open, whose end is the order to end; the child says what it finds, and starts by
calling `enter`.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import resource
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Self

from . import json_text
from .child_python import (
    environment_of_child,
    how_it_ended,
    python_command,
    said_in,
    say_stacks_when_asked,
    stacks_said_in,
    take_standard_output,
)
from .errors import Error

logger = logging.getLogger(__name__)

_GIB = 1 << 30
# Of each process that takes part. What is mapped and never touched counts for the
# address space only, and OpenGL's drivers map a lot. Drawing 1280x720 pictures with
# llvmpipe takes 0.35 GiB of the one and 0.9 GiB of the other (measured).
LIMITS: Final[Mapping[str, int]] = {
    "RLIMIT_DATA": 8 * _GIB,
    "RLIMIT_AS": 128 * _GIB,
    "RLIMIT_FSIZE": 8 * _GIB,
    "RLIMIT_NOFILE": 1024,
    "RLIMIT_CORE": 0,
    # Seconds: a day.
    "RLIMIT_CPU": 86_400,
}

# Says that a stranger's compiled models may be loaded.
_TRUST_VARIABLE = "MJREC_TRUST_MODELS"
# Says to what runs in a sandbox, and to what that starts, that it does.
_INSIDE_VARIABLE = "MJREC_SANDBOX"

_NOTHING: Mapping[str, str] = {}
_STANDARD_INPUT = 0
_SECONDS_TO_DIE = 5.0
_LONGEST_LINE = 1 << 24
_MOST_OF_STDERR = 20_000
_END_OF_STDERR = 500


class Sandbox:
    """The process, seen from its parent. Leaving `with` ends it and its group.

    Args:
        module: what runs in it; it calls `enter`.
        request: what it is asked for, JSON.
        place: an empty folder for what it leaves behind: its working directory, and
            where its temporary files are.
        limits: by their names in `resource`.
        more_environ: environment variables besides this process's.

    Raises:
        Error: it cannot be started.
    """

    def __init__(
        self,
        module: str,
        request: Mapping[str, Any],
        *,
        place: Path,
        limits: Mapping[str, int] = LIMITS,
        more_environ: Mapping[str, str] = _NOTHING,
    ) -> None:
        environ = {k: v for k, v in os.environ.items() if k != _TRUST_VARIABLE}
        environ |= {**more_environ, "TMPDIR": str(place), _INSIDE_VARIABLE: "1"}
        self._stderr = (place / "words.txt").open("w+b")
        try:
            self._process = subprocess.Popen(
                python_command(module),
                env=environment_of_child(environ),
                # MuJoCo's own log appears where it runs.
                cwd=place,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._stderr,
                start_new_session=True,
            )
        except OSError as error:
            self._stderr.close()
            raise Error(
                f"No process with limits could be started: {sys.executable!r}: {error}."
            ) from error
        try:
            assert self._process.stdin is not None
            line = json_text.dumps({"request": request, "limits": limits}).encode()
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(line + b"\n")
                self._process.stdin.flush()
        except BaseException:
            self.close()
            raise

    def said(self, patience_s: float) -> Iterator[Mapping[str, Any] | None]:
        """Yield what it says until it ends; None once it was silent for so long."""
        assert self._process.stdout is not None
        descriptor = self._process.stdout.fileno()
        rest = b""
        while len(rest) <= _LONGEST_LINE:
            deadline = time.monotonic() + patience_s
            ready, _, _ = select.select([descriptor], [], [], patience_s)
            if not ready and time.monotonic() >= deadline:
                stacks = stacks_said_in(self._stderr, self._process.pid)
                logger.warning("A process with limits hangs: %s", stacks)
                yield None
                return
            data = os.read(descriptor, 1 << 16)
            *lines, rest = (rest + data).split(b"\n")
            yield from map(said_in, lines)
            if not data:
                return

    def what_became_of_it(self) -> str:
        """Return how it ended, and its last words, after it has said all."""
        try:
            how = how_it_ended(self._process.wait(_SECONDS_TO_DIE))
        except subprocess.TimeoutExpired:
            return "lives and has closed its pipe"
        return f"{how}. The end of what it said: {self._last_words()}"

    def close(self) -> None:
        """End it and what it has started; idempotent."""
        # Those with a session of their own (who draw, ffmpeg) end with the pipes to it.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_SECONDS_TO_DIE)
        for pipe in (self._process.stdin, self._process.stdout, self._stderr):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _last_words(self) -> str:
        descriptor = self._stderr.fileno()
        begin = max(0, os.fstat(descriptor).st_size - _MOST_OF_STDERR)
        said = os.pread(descriptor, _MOST_OF_STDERR, begin).decode(errors="replace")
        # What Python says of a crash ends with the names of dozens of modules.
        words = " ".join(said.partition("\nExtension modules:")[0].split())
        return words[-_END_OF_STDERR:] or "(nothing)"


def is_inside() -> bool:
    """Tell whether this process runs in a sandbox already."""
    return _INSIDE_VARIABLE in os.environ


def enter() -> tuple[Any, Callable[..., None]]:
    """Keep this process to its limits, and let it end with its parent.

    Returns:
        The request; and what says its keyword arguments to the parent.
    """
    answers = take_standard_output()
    say_stacks_when_asked()
    told = json_text.loads(sys.stdin.buffer.readline())
    for name, wanted in told["limits"].items():
        kind = getattr(resource, name)
        _, most = resource.getrlimit(kind)
        allowed = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
        resource.setrlimit(kind, (allowed, allowed))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    return told["request"], functools.partial(_say, answers)


def _say(answers: int, **said: Any) -> None:
    line = json_text.dumps(said).encode() + b"\n"
    while line:
        line = line[os.write(answers, line) :]


def _end_with_parent() -> None:
    """End this process and those of its group when the parent is gone."""
    # Not through `sys.stdin`, whose lock the interpreter would want at its end.
    with contextlib.suppress(OSError):
        while os.read(_STANDARD_INPUT, 1 << 16):
            pass
    os.killpg(0, signal.SIGKILL)
