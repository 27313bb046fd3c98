# SPDX-License-Identifier: Apache-2.0
"""The function that executors call to do a job in a child process.

A child is kept for later jobs in its run, so that a policy is loaded only once per
child. The child is terminated when its run is over. Every machine can detect this,
because the file `work.json` in the run's folder is then removed. The child also ends if
the process that started it ends.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..child_python import Child, wait_for_news
from ..gl.devices import CUDA_VISIBLE_DEVICES
from ..messages import Parent

# The file in a run's folder that describes the work. It exists as long as the run.
WORK = "work.json"
# The file in a run's folder that exists once a child has started.
BEGUN = "begun"

_SECONDS_BETWEEN_LOOKS = 0.2
_END_OF_WORDS = 2000

# `seat.gpus`: the GPUs that the engine assigned to this thread for its jobs, if any.
seat = threading.local()
# In a child, the connection to the process that started it.
parent: Parent | None = None


def do_job(place: str, job: Mapping[str, Any]) -> dict[str, Any]:
    """Do a job in a child process, and return the outcome as plain data.

    Args:
        place: the run's folder.
        job: the job's `key` and `arguments`.

    Returns:
        `value` or `failure` if the job is over; `died` and `begun` (whether the child
        had started) if the child died; `error` if the handler could not be created.
        `log` contains the child's log records at warning level and above.
    """
    kind = place, getattr(seat, "gpus", None)
    with _one_at_a_time:
        idle = _idle.get(kind)
        child = idle.pop() if idle else None
    try:
        child = child or _JobChild(*kind)
    except OSError as error:
        how = f"cannot be started: {sys.executable!r}: {error}"
        if not Path(place, WORK).exists():
            how = f"cannot see {place}, which all machines must see under the same path"
        return {"died": how, "begun": False}
    answer = child.do(job)
    if "died" in answer or "error" in answer:
        child.end()
    else:
        with _one_at_a_time:
            _idle.setdefault(kind, []).append(child)
    return answer


def end_idle_children(place: str) -> None:
    """End the idle children of a run. Idempotent."""
    with _one_at_a_time:
        kinds = [kind for kind in _idle if kind[0] == place]
        children = [child for kind in kinds for child in _idle.pop(kind)]
    for child in children:
        child.end()


@contextlib.contextmanager
def time_limit(seconds: float | None, file: Path, text: str) -> Iterator[None]:
    """Kill this child if the block takes longer than a limit.

    The parent process kills the child, because code that hangs may block the
    interpreter.

    Args:
        seconds: the limit; None means no limit.
        file: the file to which the parent process then appends `text`.
        text: the string to append.
    """
    if seconds is None or parent is None:
        yield
        return
    parent.send(limit=[seconds, str(file), text])
    try:
        yield
    finally:
        parent.send(limit=None)


class _JobChild(Child):
    """A process that does one run's jobs; see the module `child` for the messages.

    Its output is copied to standard error, line by line.

    Args:
        place: the run's folder.
        gpus: the GPUs on which the child renders, in the format of
            `CUDA_VISIBLE_DEVICES`; None means this process's own setting.

    Raises:
        OSError: the process cannot be started, or the run no longer exists.
    """

    def __init__(self, place: str, gpus: str | None) -> None:
        self._work = Path(place, WORK)
        work = json.loads(self._work.read_bytes())
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
        self._is_ready = False
        self._said = ""
        self._listener = threading.Thread(
            target=self._pass_on, args=[os.dup(self.words.fileno())], daemon=True
        )
        self._listener.start()
        self.send(place=place, **work)

    def do(self, job: Mapping[str, Any]) -> dict[str, Any]:
        """Do a job; see `do_job`."""
        self.send(**job)
        log: list[Any] = []
        limit: list[Any] | None = None
        ends_at = 0.0
        while True:
            try:
                message = self.receive()
            except EOFError:
                how = self.how_it_ended()
                break
            if not isinstance(message, dict):
                wait_for_news([self], _SECONDS_BETWEEN_LOOKS)
                if limit and time.monotonic() > ends_at:
                    self.kill()
                if not self._work.exists():
                    how = "was canceled"
                    break
            elif "log" in message:
                log.append(message["log"])
            elif "ready" in message:
                self._is_ready = True
                with contextlib.suppress(OSError):
                    self._work.with_name(BEGUN).touch()
            elif "limit" in message:
                limit = message["limit"]
                ends_at = time.monotonic() + (limit[0] if limit else 0)
            else:
                return {**message, "log": log}
        if limit and time.monotonic() > ends_at:
            with Path(limit[1]).open("a") as file:
                file.write(limit[2])
        self._listener.join(_SECONDS_BETWEEN_LOOKS)
        output = self._said.strip() or "(nothing)"
        died = f"{how}. Its last output: {output}"
        return {"died": died, "begun": self._is_ready, "log": log}

    def end(self) -> None:
        """Terminate the child and any processes that it started. Idempotent."""
        super().end()
        # Processes left behind by the child may keep the pipe open.
        self._listener.join(_SECONDS_BETWEEN_LOOKS)

    def _pass_on(self, words: int) -> None:
        # With universal newlines, a progress bar's carriage return ends a line.
        with open(words, errors="replace", newline=None) as lines:
            for line in lines:
                self._said = (self._said + line)[-_END_OF_WORDS:]
                # A progress bar may have replaced this stream.
                with contextlib.suppress(OSError, ValueError, AttributeError):
                    sys.stderr.write(line)
                    sys.stderr.flush()


_idle: dict[tuple[str, str | None], list[_JobChild]] = {}
_one_at_a_time = threading.Lock()

# After a fork, `Child` has already closed the child process's copies.
os.register_at_fork(after_in_child=_idle.clear)
