# SPDX-License-Identifier: Apache-2.0
"""One worker of the local engine, seen from its parent."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from ..child_python import how_it_ended, python_command, said_in
from ..errors import Error

_END_OF_WORDS = 2000
_SECONDS_TO_DIE = 5.0
_ONE_READ = 1 << 16
# As much as a pipe holds, and more: what a worker's own children still print is not
# waited for.
_LAST_READS = 32
_LONGEST_LINE = 1 << 13


class WorkerProcess:
    """A process that does jobs; `local_worker` says what is spoken.

    It has a session of its own, so that Ctrl-C in the terminal reaches only the parent.
    What it prints is passed on to the standard
    error, whole lines at a time, and the end of it is kept. It ends at `end`, when this
    object is garbage collected, at interpreter exit, and soon after the parent's death,
    whatever that died of.

    Args:
        work: descriptor of the file that says what is to be done.
        environ: all of its environment variables.
        directory: its working directory; the caller's, if None.

    Raises:
        Error: it cannot be started.
    """

    def __init__(
        self,
        work: int,
        environ: Mapping[str, str],
        *,
        directory: Path | None = None,
    ) -> None:
        self._rest = b""
        self._line = b""
        self._said = b""
        self._has_ended = False
        try:
            self.answers, self._process = _started(work, environ, directory)
        except OSError as error:
            raise Error(
                f"No worker could be started: {sys.executable!r}: {error}."
            ) from error
        assert self._process.stdout is not None
        self.words: IO[bytes] = self._process.stdout
        os.set_blocking(self.words.fileno(), False)
        self._end = weakref.finalize(
            self, _end, self._process, self.answers, self.words, os.getpid()
        )
        _running.add(self)

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    def send(self, line: bytes) -> None:
        """Say a line; that it has died is noticed by `receive`."""
        with contextlib.suppress(OSError):
            self.answers.sendall(line + b"\n")

    def receive(self) -> list[dict[str, Any]] | None:
        """Return the answers that are there, without waiting; None after its end."""
        try:
            data = self.answers.recv(_ONE_READ, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._has_ended = True
            return None
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [said for line in lines if (said := said_in(line))]

    def listen(self) -> bool:
        """Pass on what it prints; return whether there may be more later."""
        return self._hear() != b""

    def forget_words(self) -> None:
        """Keep nothing of what it has printed so far."""
        self._said = b""

    def ask_to_end(self) -> None:
        """Let it close what it is at, and end."""
        self._process.terminate()

    def end(self) -> None:
        """End it at once. Idempotent."""
        if self._end.alive:
            self._pass_on_rest()
        _running.discard(self)
        self._end()

    def last_words(self) -> str:
        """Return what became of it, and the end of what it printed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            # One that has closed its socket takes no time to end; others live.
            self._process.wait(_SECONDS_TO_DIE if self._has_ended else 0)
        self._pass_on_rest()
        said = self._said.decode(errors="replace").strip() or "(nothing)"
        return f"{self._what_became()}. The end of what it said: {said}"

    def leave_to_parent(self) -> None:
        """Close a forked child's copies, or the worker would not end."""
        self.answers.close()
        self.words.close()

    # Without its number, so that the same death reads the same in two runs.
    def _what_became(self) -> str:
        status = self._process.returncode
        if status is None:
            return "lives and is silent"
        return how_it_ended(status)

    def _pass_on_rest(self) -> None:
        for _ in range(_LAST_READS):
            if not self._hear():
                break
        _to_standard_error(self._line)
        self._line = b""

    def _hear(self) -> bytes | None:
        """Pass on what is there; return it, None if there is nothing yet."""
        data = self.words.read(_ONE_READ)
        if data:
            self._said = (self._said + data)[-_END_OF_WORDS:]
            self._pass_on(data)
        return data

    def _pass_on(self, data: bytes) -> None:
        """Pass on whole lines, so that those of several workers do not mix."""
        self._line += data
        # Progress bars go back to the beginning of their line.
        end = max(self._line.rfind(b"\n"), self._line.rfind(b"\r")) + 1
        if len(self._line) - end > _LONGEST_LINE:
            end = len(self._line)
        whole, self._line = self._line[:end], self._line[end:]
        _to_standard_error(whole)


_running: weakref.WeakSet[WorkerProcess] = weakref.WeakSet()


def _leave_all_to_parent() -> None:
    for process in list(_running):
        process.leave_to_parent()


os.register_at_fork(after_in_child=_leave_all_to_parent)


def _started(
    work: int, environ: Mapping[str, str], directory: Path | None
) -> tuple[socket.socket, subprocess.Popen[bytes]]:
    ours, theirs = socket.socketpair()
    with theirs:
        descriptors = [theirs.fileno(), work]
        try:
            process = subprocess.Popen(
                [
                    *python_command("mjrec.engines.local_worker"),
                    *map(str, descriptors),
                ],
                env=environ,
                cwd=directory,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=descriptors,
                bufsize=0,
                start_new_session=True,
            )
        except BaseException:
            ours.close()
            raise
    return ours, process


def _end(
    process: subprocess.Popen[bytes],
    answers: socket.socket,
    words: IO[bytes],
    owner: int,
) -> None:
    # A forked child's copies; the process is its parent's.
    if os.getpid() != owner:
        return
    process.kill()
    # One whose driver does not return cannot die; nobody waits for that.
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_SECONDS_TO_DIE)
    answers.close()
    words.close()


def _to_standard_error(said: bytes) -> None:
    # By way of Python's own, which a progress bar may have taken over to keep itself
    # below what is printed. There may be none, and it may be closed or full.
    if said and sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.write(said.decode(errors="replace"))
            sys.stderr.flush()
