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
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Self

from . import json_text
from .child_python import (
    Child,
    said_in,
    say_stacks_when_asked,
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
_LONGEST_LINE = 1 << 24


class Sandbox(Child):
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
        try:
            # MuJoCo's own log appears where it runs.
            super().__init__(module, environ=environ, cwd=str(place))
        except OSError as error:
            raise Error(
                f"No process with limits could be started: {sys.executable!r}: {error}."
            ) from error
        line = json_text.dumps({"request": request, "limits": limits}).encode()
        with contextlib.suppress(BrokenPipeError):
            self.orders.write(line + b"\n")

    def said(self, patience_s: float) -> Iterator[Mapping[str, Any] | None]:
        """Yield what it says until it ends; None once it was silent for so long."""
        rest = b""
        while len(rest) <= _LONGEST_LINE:
            ready, _, _ = select.select([self.answers], [], [], patience_s)
            if not ready:
                logger.warning("A process with limits hangs: %s", self.stacks())
                yield None
                return
            data = os.read(self.answers.fileno(), 1 << 16)
            *lines, rest = (rest + data).split(b"\n")
            yield from map(said_in, lines)
            if not data:
                return

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        # Those with a session of their own (who draw, ffmpeg) end with the pipes to it.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, signal.SIGKILL)
        self.end()


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
