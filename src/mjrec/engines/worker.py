# SPDX-License-Identifier: Apache-2.0
"""Doing a job in a child process: what executors are given.

A child stays for later jobs of its run, so that a policy is read once for each child.
It ends when its run does: a file in the run's folder says so, or that the folder is
gone. Children and those who wait for them look, wherever they are.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import sys
import threading
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..child_python import Child
from ..gl.devices import CUDA_VISIBLE_DEVICES

logger = logging.getLogger(__name__)

# In a run's folder: the sign that all is over.
STOP = "stop"

# A monitor is closed in well under a second, on a slow network disk in a few; Slurm
# kills 30 seconds after its SIGTERM, Kubernetes too, docker after 10.
SECONDS_TO_CLOSE = 10.0

_SECONDS_BETWEEN_LOOKS = 0.2
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
        child = child or _JobChild(work, gpus)
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


class _JobChild(Child):
    """A process that does jobs of one run; the module `child` says what is sent.

    What it prints goes to the standard error, line by line.

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
        self._line = self._printed = b""
        environ = {**os.environ, **work["environ"]}
        if gpus is not None:
            environ[CUDA_VISIBLE_DEVICES] = gpus
        is_there = Path(work["directory"]).is_dir()
        super().__init__(
            "mjrec.engines.child",
            environ=environ,
            cwd=work["directory"] if is_there else None,
            is_heard=True,
        )
        os.set_blocking(self.words.fileno(), False)
        self._sources: list[Any] = [self, self.words]
        _alive.add(self)
        self.send(**work)

    @property
    def is_usable(self) -> bool:
        """Whether it can do another job."""
        return not self.has_ended and self._ends_at is None

    def do(self, key: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Do a job; see `do_job`."""
        # Its last words shall be about this job.
        self._pass_on_output()
        self._printed = b""
        self.send(key=key, arguments=dict(arguments))
        log: list[Any] = []
        answer = self._answer(log)
        if answer is None:
            how = self.how_it_ended()
            self._pass_on_output()
            said = self._printed.decode(errors="replace").strip() or "(nothing)"
            answer = {
                "died": f"{how}. The end of what it said: {said}",
                "begun": self._is_ready,
            }
        self._pass_on_output()
        if "died" in answer or "error" in answer:
            self.end()
        return {**answer, "log": log}

    def ask_to_end(self) -> None:
        """Let it close what it holds, and end. Idempotent."""
        if self._ends_at is None:
            self._ends_at = time.monotonic() + SECONDS_TO_CLOSE
            self.terminate()

    def end(self) -> None:
        """End it, at once or, where it was asked to, in some seconds. Idempotent."""
        if not self.has_ended:
            if self._ends_at is not None:
                self._answer([])
            self.kill()
            self._pass_on_output()
            self._pass_on_lines(is_last=True)
        super().end()

    def _answer(self, log: list[Any]) -> dict[str, Any] | None:
        """Return what it says of its job, waiting for it; None if it has ended.

        It is asked to end where the run is over.
        """
        while True:
            with contextlib.suppress(EOFError):
                while isinstance(message := self.receive(), dict):
                    if "log" in message:
                        log.append(message["log"])
                    elif "ready" in message:
                        self._is_ready = True
                    else:
                        return message
                if self._wait_for_news():
                    continue
            return None

    def _wait_for_news(self) -> bool:
        """Wait until there may be a message; False where it has not ended in time."""
        ready: list[Any] = []
        while self not in ready:
            ready, _, _ = select.select(self._sources, [], [], _SECONDS_BETWEEN_LOOKS)
            if self.words in ready and not self._pass_on_output():
                # Else `select` returns at once for ever.
                self._sources.remove(self.words)
            if self._ends_at is None:
                if self._stop.exists() or not self._stop.parent.exists():
                    self.ask_to_end()
            elif time.monotonic() > self._ends_at:
                logger.warning(
                    "A worker has not ended %g seconds after it was told to, and is "
                    "killed.",
                    SECONDS_TO_CLOSE,
                )
                return False
        return True

    def _pass_on_output(self) -> bool:
        """Pass on what it has printed; tell whether there may be more later."""
        while True:
            try:
                data = self.words.read(_ONE_READ)
            except (OSError, ValueError):
                return False
            if not data:
                self._pass_on_lines(is_last=data == b"")
                return data is None
            self._printed = (self._printed + data)[-_END_OF_WORDS:]
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


_idle: dict[tuple[str, str | None], list[_JobChild]] = {}
_alive: weakref.WeakSet[_JobChild] = weakref.WeakSet()
_one_at_a_time = threading.Lock()

# A forked child's copies were closed by `Child`.
os.register_at_fork(after_in_child=_idle.clear)
