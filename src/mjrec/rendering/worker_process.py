# SPDX-License-Identifier: Apache-2.0
"""One drawing worker, seen from its parent."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import weakref
from collections.abc import Mapping
from typing import IO, Any

from ..child_python import (
    MOST_OF_STACKS,
    ask_for_stacks,
    environment_of_child,
    how_it_ended,
    python_command,
    said_in,
    stacks_in,
)
from ..errors import Error
from .frame_ring import FrameRing

_END_OF_STDERR = 2000
_SECONDS_TO_DIE = 5.0
_SECONDS_TO_SAY_STACKS = 5.0
_SECONDS_BETWEEN_WORDS = 0.3


class WorkerProcess:
    """A process that draws into a ring; `worker` says what is spoken.

    It has a session of its own, so that Ctrl-C in the terminal reaches only the parent.
    It ends at `end`, when this object is garbage collected, at interpreter exit, and
    whenever and however the parent dies, because its standard input ends then.

    Args:
        ring: where it draws; nobody else may draw there while it lives.
        environ: its environment variables, besides the module search path.

    Raises:
        Error: it cannot be started.
    """

    def __init__(self, ring: FrameRing, environ: Mapping[str, str]) -> None:
        self._rest = b""
        self._stderr = b""
        self._has_ended = False
        try:
            self._process = subprocess.Popen(
                [*python_command("mjrec.rendering.worker"), str(ring.descriptor)],
                env=environment_of_child(environ),
                # Nobody's directory is kept from being removed or unmounted.
                cwd="/",
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                pass_fds=[ring.descriptor],
                bufsize=0,
                start_new_session=True,
            )
        except OSError as error:
            raise Error(
                f"No process that draws could be started: {sys.executable!r}: {error}."
            ) from error
        self._end = weakref.finalize(
            self, _end, self._process, _pipes(self._process), os.getpid()
        )
        _running.add(self)
        for pipe in (self.answers, self.words):
            os.set_blocking(pipe.fileno(), False)

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    @property
    def answers(self) -> IO[bytes]:
        """What to wait for before `receive`."""
        assert self._process.stdout is not None
        return self._process.stdout

    @property
    def words(self) -> IO[bytes]:
        """What to wait for before `listen`."""
        assert self._process.stderr is not None
        return self._process.stderr

    def send(self, **order: Any) -> None:
        """Say something; one that has died is noticed by `receive`."""
        assert self._process.stdin is not None
        # ValueError: it was ended, and its pipes closed.
        with contextlib.suppress(OSError, ValueError):
            self._process.stdin.write(json.dumps(order).encode() + b"\n")

    def receive(self) -> list[dict[str, Any]] | None:
        """Return the answers that are there, without waiting; None after its end."""
        data = self.answers.read(1 << 16)
        if data is None:
            return []
        if not data:
            self._has_ended = True
            return None
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [said for line in lines if (said := said_in(line))]

    def listen(self) -> bool:
        """Keep the end of what it prints; return whether there may be more later."""
        while data := self.words.read(1 << 16):
            self._stderr = (self._stderr + data)[-_END_OF_STDERR:]
        return data is None

    def stacks(self) -> str:
        """Return what the threads of one that hangs are at, for the log."""
        self.listen()
        ask_for_stacks(self.pid)
        said, patience_s = b"", _SECONDS_TO_SAY_STACKS
        while len(said) < MOST_OF_STACKS:
            ready, _, _ = select.select([self.words], [], [], patience_s)
            data = self.words.read(1 << 16) if ready else None
            if not data:
                break
            said, patience_s = said + data, _SECONDS_BETWEEN_WORDS
        return stacks_in(said)

    def end(self) -> None:
        """End it at once. Idempotent."""
        _running.discard(self)
        self._end()

    def last_words(self) -> str:
        """Return what became of it, and the end of what it printed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            # One that has closed its pipe takes no time to end; others live.
            self._process.wait(_SECONDS_TO_DIE if self._has_ended else 0)
        self.listen()
        said = self._stderr.decode(errors="replace").strip() or "(nothing)"
        return f"{self._what_became()}. The end of what it said: {said}"

    def _what_became(self) -> str:
        status = self._process.returncode
        if status is None:
            return f"process {self.pid} lives and is silent"
        return f"process {self.pid} {how_it_ended(status)}"

    def leave_to_parent(self) -> None:
        """Close a forked child's copies of the pipes, or the worker would not end."""
        for pipe in _pipes(self._process):
            pipe.close()


_running: weakref.WeakSet[WorkerProcess] = weakref.WeakSet()


def _leave_all_to_parent() -> None:
    for process in list(_running):
        process.leave_to_parent()


os.register_at_fork(after_in_child=_leave_all_to_parent)


def _pipes(process: subprocess.Popen[bytes]) -> list[IO[bytes]]:
    pipes = (process.stdin, process.stdout, process.stderr)
    return [pipe for pipe in pipes if pipe is not None]


def _end(
    process: subprocess.Popen[bytes],
    pipes: list[IO[bytes]],
    owner: int,
) -> None:
    # A forked child's copies; the process is its parent's.
    if os.getpid() != owner:
        return
    # It has nothing to put in order: no file of it is anybody's.
    process.kill()
    # One whose driver does not return cannot die; nobody waits for that.
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_SECONDS_TO_DIE)
    for pipe in pipes:
        pipe.close()
