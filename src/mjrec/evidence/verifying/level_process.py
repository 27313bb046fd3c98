# SPDX-License-Identifier: Apache-2.0
"""The process that does the checks, seen from its parent."""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from ... import json_text
from ...child_python import (
    environment_of_child,
    python_command,
    said_in,
    stacks_said_in,
)
from ...errors import Error
from ..verification import Check, Level, Verdict
from .carried_checks import check_from_json, task_to_json
from .task import Task

logger = logging.getLogger(__name__)

_MODULE = "mjrec.evidence.verifying.child"
# Says that a stranger's compiled models may be loaded.
_TRUST_VARIABLE = "MJREC_TRUST_MODELS"

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

# Compiling a model may take 300 of them.
_PATIENCE_S = 900.0
_SECONDS_TO_DIE = 5.0
_LONGEST_LINE = 1 << 24
_MOST_OF_STDERR = 20_000
_END_OF_STDERR = 500

# How it may be told of progress: the level, how much is done, and of how much.
Told = Callable[[Level, int, int], object]


def checks_of(
    task: Task,
    *,
    bag: Path | None,
    place: Path,
    told: Told,
    limits: Mapping[str, int] = LIMITS,
    patience_s: float = _PATIENCE_S,
) -> Generator[Check, None, None]:
    """Yield the checks of a task, done in a process of their own.

    Where that process dies, hangs or is at the end of its means, one failed check says
    so, and those levels that it had not come to are not checkable.

    Args:
        task: what is asked for.
        bag: the folder that is a bag; None where nothing was packed.
        place: an empty folder for what it leaves behind.
        told: called with its progress.
        limits: by their names in `resource`.
        patience_s: seconds that it may say nothing.

    Raises:
        Error: it cannot be started.
    """
    request = {
        "task": task_to_json(task),
        "bag": None if bag is None else str(bag),
        "limits": dict(limits),
    }
    words = place / "words.txt"
    with words.open("w+b") as stderr, _running(request, place, stderr) as process:
        yield from _Conversation(process, stderr, task.level, told).checks(patience_s)


class _Conversation:
    """What is said by the process.

    Args:
        process: runs.
        stderr: what it prints.
        level: the deepest that was asked for.
        told: called with its progress.
    """

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        stderr: Any,
        level: Level,
        told: Told,
    ) -> None:
        self._process = process
        self._stderr = stderr
        self._levels = level.included
        self._told = told
        self._at: Level = Level.FILES
        self._last = ""
        self._failure: str | None = None
        self._has_ended = False

    def checks(self, patience_s: float) -> Iterator[Check]:
        """Yield what it finds, and at the end what became of it."""
        assert self._process.stdout is not None
        for line in _lines(self._process.stdout.fileno(), patience_s):
            if line is None:
                stacks = stacks_said_in(self._stderr, self._process.pid)
                logger.warning("The checks hang: %s", stacks)
                self._failure = f"nothing was heard of it for {patience_s:g} seconds"
                break
            yield from self._understood(said_in(line))
        if not self._has_ended:
            yield from self._broken_off()

    def _understood(self, said: Mapping[str, Any]) -> Iterator[Check]:
        if "check" in said:
            check = check_from_json(said["check"])
            self._last = check.subject
            yield check
        elif "level" in said:
            self._at, self._last = Level(said["level"]), ""
        elif "count" in said:
            self._told(self._at, *said["count"])
        elif "failure" in said:
            self._failure = str(said["failure"])
        self._has_ended = self._has_ended or "end" in said

    def _broken_off(self) -> Iterator[Check]:
        after = f" after {self._last}" if self._last else ""
        yield Check(
            level=self._at,
            claim="the checks of this level come to an end",
            subject="",
            verdict=Verdict.FAIL,
            reason=f"they ended{after}: {self._failure or self._what_became()}",
        )
        for level in self._levels[self._levels.index(self._at) + 1 :]:
            yield Check(
                level=level,
                claim="the checks of this level come to an end",
                subject="",
                verdict=Verdict.NOT_CHECKABLE,
                reason=f"the level {self._at.value}, before it, ended with a failure",
            )

    def _what_became(self) -> str:
        status: int | None = None
        with contextlib.suppress(subprocess.TimeoutExpired):
            status = self._process.wait(_SECONDS_TO_DIE)
        if status is None:
            return "their process lives and has closed its pipe"
        if status < 0:
            how = f"was killed by {_signal_name(-status)}"
        else:
            how = f"ended with status {status}"
        return f"their process {how}. The end of what it said: {self._last_words()}"

    def _last_words(self) -> str:
        descriptor = self._stderr.fileno()
        begin = max(0, os.fstat(descriptor).st_size - _MOST_OF_STDERR)
        said = os.pread(descriptor, _MOST_OF_STDERR, begin).decode(errors="replace")
        # What Python says of a crash ends with the names of dozens of modules.
        words = " ".join(said.partition("\nExtension modules:")[0].split())
        return words[-_END_OF_STDERR:] or "(nothing)"


@contextlib.contextmanager
def _running(
    request: Mapping[str, Any], place: Path, stderr: Any
) -> Iterator[subprocess.Popen[bytes]]:
    """Run the process; it and its group are gone afterwards, whatever happens."""
    environ = {k: v for k, v in os.environ.items() if k != _TRUST_VARIABLE}
    try:
        process = subprocess.Popen(
            python_command(_MODULE),
            env=environment_of_child({**environ, "TMPDIR": str(place)}),
            # MuJoCo's own log appears where it runs.
            cwd=place,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            start_new_session=True,
        )
    except OSError as error:
        raise Error(
            f"No process that checks could be started: {sys.executable!r}: {error}."
        ) from error
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(json_text.dumps(request).encode() + b"\n")
            process.stdin.flush()
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    # Also what it has started. Those with a session of their own (who draw, ffmpeg) end
    # with the pipes to it.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_SECONDS_TO_DIE)
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):
                pipe.close()


def _lines(descriptor: int, patience_s: float) -> Iterator[bytes | None]:
    """Yield what is said, line by line; None once patience is at its end."""
    rest = b""
    while True:
        deadline = time.monotonic() + patience_s
        ready, _, _ = select.select([descriptor], [], [], patience_s)
        if not ready and time.monotonic() >= deadline:
            yield None
            return
        data = os.read(descriptor, 1 << 16)
        *lines, rest = (rest + data).split(b"\n")
        yield from lines
        if not data or len(rest) > _LONGEST_LINE:
            return


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
