# SPDX-License-Identifier: Apache-2.0
"""Doing a job in a child process: what executors are given.

A child stays for later jobs of its run, so that a policy is read once for each child.
It ends when its run does: a file in the run's folder says so, or that the folder is
gone. Children and those who wait for them look, wherever they are.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import select
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from ..child_python import (
    environment_of_child,
    how_it_ended,
    python_command,
    said_in,
)
from ..gl.devices import CUDA_VISIBLE_DEVICES

logger = logging.getLogger(__name__)

# Added to the arguments of a job that a child has begun before.
AGAIN = "again"

# In a run's folder: what each child reads once, and the sign that all is over.
PAYLOAD, STOP = "payload", "stop"

# A monitor is closed in well under a second, on a slow network disk in a few; Slurm
# kills 30 seconds after its SIGTERM, Kubernetes too, docker after 10.
SECONDS_TO_CLOSE = 10.0

_SECONDS_BETWEEN_LOOKS = 0.2
_SECONDS_TO_DIE = 5.0
_ONE_READ = 1 << 16
_LONGEST_LINE = 1 << 13
_END_OF_WORDS = 2000

# `seat.gpus`: of the thread that does a job, where an engine shares GPUs out.
seat = threading.local()


def do_job(message: Mapping[str, Any]) -> dict[str, Any]:
    """Do a job in a child process, and return its end as plain data.

    Args:
        message: `work`, `key` and `arguments`, as `jobs.Run` hands them out.

    Returns:
        `value` or `failure` where the job is over; `died`, and whether it had `begun`,
        where the child has died; `error` where no handler can be made. With `log`, what
        the child logged as a warning or worse.
    """
    work = message["work"]
    gpus: str | None = getattr(seat, "gpus", None)
    kind = work["place"], gpus
    with _one_at_a_time:
        idle = _idle.get(kind)
        child = idle.pop() if idle else None
    try:
        child = child or _Child(work, gpus)
    except OSError as error:
        how = f"cannot be started: {sys.executable!r}: {error}"
        return {"died": how, "begun": False}
    answer = child.do(message["key"], message["arguments"])
    if child.is_usable:
        with _one_at_a_time:
            _idle.setdefault(kind, []).append(child)
    return answer


def end_idle_children(place: str) -> None:
    """End the children of a run that have nothing to do. Idempotent."""
    with _one_at_a_time:
        kinds = [kind for kind in _idle if kind[0] == place]
        children = [child for kind in kinds for child in _idle.pop(kind)]
    for child in children:
        child.ask_to_end()
    for child in children:
        child.end()


def ask_all_to_end() -> None:
    """Let all children close what they hold, and end; their jobs have died."""
    for child in [*_alive]:
        child.ask_to_end()


class _Child:
    """A process that does jobs of one run; the module `child` says what is spoken.

    It has a session of its own, so that Ctrl-C in the terminal reaches only its parent,
    and ends when that dies, of whatever. What it prints goes to the standard error.

    Args:
        work: what it does.
        gpus: that it draws on, as `CUDA_VISIBLE_DEVICES` names them; None is what this
            process has.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, work: Mapping[str, Any], gpus: str | None) -> None:
        self._stop = Path(work["place"], STOP)
        self._ends_at: float | None = None
        self._is_ready = False
        self._rest = self._line = self._words = b""
        environ = {**os.environ, **work["environ"]}
        if gpus is not None:
            environ[CUDA_VISIBLE_DEVICES] = gpus
        is_there = Path(work["directory"]).is_dir()
        self._socket, theirs = socket.socketpair()
        try:
            self._process = subprocess.Popen(
                [*python_command("mjrec.engines.child"), str(theirs.fileno())],
                env=environment_of_child(environ),
                cwd=work["directory"] if is_there else None,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=[theirs.fileno()],
                bufsize=0,
                start_new_session=True,
            )
        except BaseException:
            self._socket.close()
            raise
        finally:
            theirs.close()
        assert self._process.stdout is not None
        self._output = self._process.stdout
        os.set_blocking(self._output.fileno(), False)
        self._sources: list[Any] = [self._socket, self._output]
        self._end = weakref.finalize(
            self, _end, self._process, (self._socket, self._output), os.getpid()
        )
        _alive.add(self)
        self._send(work)

    @property
    def is_usable(self) -> bool:
        """Whether it can do another job."""
        return self._end.alive and self._ends_at is None

    def do(self, key: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Do a job; see `do_job`."""
        # Its last words shall be about this job.
        self._pass_on_output()
        self._words = b""
        self._send({"key": key, "arguments": dict(arguments)})
        log: list[Any] = []
        answer = self._answer(log)
        self._pass_on_output()
        if answer is None:
            answer = {"died": self._last_words(), "begun": self._is_ready}
        if "died" in answer or "error" in answer:
            self.end()
        return {**answer, "log": log}

    def ask_to_end(self) -> None:
        """Let it close what it holds, and end. Idempotent."""
        if self._ends_at is None:
            self._ends_at = time.monotonic() + SECONDS_TO_CLOSE
            self._process.terminate()

    def end(self) -> None:
        """End it, at once or, where it was asked to, in some seconds. Idempotent."""
        if not self._end.alive:
            return
        if self._ends_at is not None:
            self._answer([])
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(max(0.0, self._ends_at - time.monotonic()))
        self._pass_on_output()
        self._pass_on_lines(is_last=True)
        self._end()

    def leave_to_parent(self) -> None:
        """Close a forked child's copies, or the process would not notice its end."""
        self._socket.close()
        self._output.close()

    def _answer(self, log: list[Any]) -> dict[str, Any] | None:
        """Return what it says of its job, waiting for it; None if it has ended."""
        for said in self._answers():
            if "log" in said:
                log.append(said["log"])
            elif "ready" in said:
                self._is_ready = True
            else:
                return said
        return None

    def _answers(self) -> Iterator[dict[str, Any]]:
        """Yield what it says until its end, which comes where the run is over."""
        while True:
            ready, _, _ = select.select(self._sources, [], [], _SECONDS_BETWEEN_LOOKS)
            if self._output in ready and not self._pass_on_output():
                # Else `select` returns at once for ever.
                self._sources.remove(self._output)
            if self._socket in ready:
                try:
                    data = self._socket.recv(_ONE_READ)
                except OSError:
                    data = b""
                if not data:
                    return
                *lines, self._rest = (self._rest + data).split(b"\n")
                yield from (said for line in lines if (said := said_in(line)))
            elif self._ends_at is None:
                if self._stop.exists() or not self._stop.parent.exists():
                    self.ask_to_end()
            elif time.monotonic() > self._ends_at:
                logger.warning(
                    "A worker has not ended %g seconds after it was told to, and is "
                    "killed.",
                    SECONDS_TO_CLOSE,
                )
                return

    def _send(self, said: Mapping[str, Any]) -> None:
        # That it has died is noticed where its answer is waited for.
        with contextlib.suppress(OSError):
            self._socket.sendall(json.dumps(said).encode() + b"\n")

    def _last_words(self) -> str:
        """Return what became of it, and the end of what it printed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_SECONDS_TO_DIE)
        self._pass_on_output()
        said = self._words.decode(errors="replace").strip() or "(nothing)"
        status = self._process.returncode
        # Without its number, so that the same death reads the same in two runs.
        how = "lives and is silent" if status is None else how_it_ended(status)
        return f"{how}. The end of what it said: {said}"

    def _pass_on_output(self) -> bool:
        """Pass on what it has printed; tell whether there may be more later."""
        while True:
            try:
                data = self._output.read(_ONE_READ)
            except (OSError, ValueError):
                return False
            if not data:
                self._pass_on_lines(is_last=data == b"")
                return data is None
            self._words = (self._words + data)[-_END_OF_WORDS:]
            self._line += data
            self._pass_on_lines()

    def _pass_on_lines(self, *, is_last: bool = False) -> None:
        """Pass on whole lines, so that those of several children do not mix."""
        # Progress bars go back to the beginning of their line.
        end = max(self._line.rfind(b"\n"), self._line.rfind(b"\r")) + 1
        if is_last or len(self._line) - end > _LONGEST_LINE:
            end = len(self._line)
        whole, self._line = self._line[:end], self._line[end:]
        # Python's own, which a progress bar may have taken over. There may be none.
        if whole and sys.stderr is not None:
            with contextlib.suppress(OSError, ValueError):
                sys.stderr.write(whole.decode(errors="replace"))
                sys.stderr.flush()


_idle: dict[tuple[str, str | None], list[_Child]] = {}
_alive: weakref.WeakSet[_Child] = weakref.WeakSet()
_one_at_a_time = threading.Lock()


def _leave_all_to_parent() -> None:
    for child in list(_alive):
        child.leave_to_parent()
    _idle.clear()


os.register_at_fork(after_in_child=_leave_all_to_parent)


def _end(
    process: subprocess.Popen[bytes],
    files: tuple[socket.socket | IO[bytes], ...],
    owner: int,
) -> None:
    # A forked child's copies; the process is its parent's.
    if os.getpid() != owner:
        return
    process.kill()
    # A process inside a driver call that never returns cannot be killed.
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_SECONDS_TO_DIE)
    for file in files:
        file.close()
