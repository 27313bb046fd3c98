# SPDX-License-Identifier: Apache-2.0
"""A process that does jobs: `python -m mjrec.engines.child SOCKET`.

On the socket, a file descriptor, both sides say one JSON object a line. The first line
says what the work is: `entry`, `settings`, `place`, `require_gpu`, `path`; see
`jobs.Run`. Then comes one job after the other::

    {"key": "a", "arguments": {...}}

and this process says::

    {"ready": true}                       there is a handler; before anything else
    {"error": {...}}                      instead of it: none could be made
    {"key": "a", "value": {...}}          a job is done
    {"key": "b", "failure": "..."}        or failed, with what the handler raised
    {"log": ["mjrec.x", 30, "..."]}       for the parent's log

On SIGTERM the handler is closed and the process ends; so it does when the socket ends
because the parent has died, in mid-job too, and when the run's folder says that all is
over.
"""

from __future__ import annotations

import faulthandler
import importlib
import io
import json
import logging
import operator
import os
import queue
import signal
import socket
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from ..child_python import carried, say_stacks_when_asked
from ..gl.devices import render_on_given_gpu
from ..signals import Terminated, exiting_on_signals, received
from .worker import PAYLOAD, SECONDS_TO_CLOSE, STOP

# Not `__name__`, which is `__main__`.
logger = logging.getLogger("mjrec.engines.child")

_SECONDS_BETWEEN_LOOKS = 1.0


def main() -> None:
    """Do jobs until told to end."""
    say_stacks_when_asked()
    # As in a terminal: what is printed is there when the process dies.
    cast("io.TextIOWrapper", sys.stdout).reconfigure(line_buffering=True)
    # The parent may have done something to its own.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    parent = _Parent(socket.socket(fileno=int(sys.argv[1])))
    logging.getLogger().addHandler(_ToParent(parent))
    with exiting_on_signals():
        work = parent.take()
        handler = _handler(work, parent)
        try:
            parent.say(ready=True)
            while (job := parent.next_job(Path(work["place"]))) is not None:
                _do(handler, job, parent)
        finally:
            _close(handler)


class _Parent:
    """Who gives the jobs. Its words are read on a thread, to notice its end."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._one_at_a_time = threading.Lock()
        self._said: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        # The connection ends with this process, whatever a policy has started.
        connection.set_inheritable(False)
        # Detached, because the file that is read from would keep it open.
        os.register_at_fork(after_in_child=lambda: os.close(connection.detach()))
        threading.Thread(target=self._read, name="mjrec-jobs", daemon=True).start()

    def take(self, *, seconds: float | None = None) -> dict[str, Any]:
        """Return the next thing that it says, waiting for it.

        Raises:
            queue.Empty: it has said nothing for so long.
        """
        return self._said.get(timeout=seconds)

    def next_job(self, place: Path) -> dict[str, Any] | None:
        """Return the next job, waiting for it; None where the run is over."""
        while True:
            try:
                return self.take(seconds=_SECONDS_BETWEEN_LOOKS)
            except queue.Empty:
                if (place / STOP).exists() or not place.exists():
                    return None

    def say(self, **said: Any) -> None:
        """Say something, from any thread."""
        self.say_line(json.dumps(said))

    def say_line(self, line: str) -> None:
        """Say what is JSON already."""
        try:
            with self._one_at_a_time:
                self._connection.sendall(line.encode() + b"\n")
        except OSError:
            # It has died; the thread sees to it.
            return

    def _read(self) -> None:
        try:
            with self._connection.makefile("rb") as lines:
                for line in lines:
                    self._said.put(json.loads(line))
        except OSError:
            # Reset, because it died before it had read everything.
            pass
        _end_without_parent()


class _ToParent(logging.Handler):
    """Lets the parent log what is worth a warning here, under the same name."""

    def __init__(self, parent: _Parent) -> None:
        super().__init__(logging.WARNING)
        self._parent = parent

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._parent.say(log=[record.name, record.levelno, self.format(record)])
        except Exception:
            # As all handlers: who logs is not disturbed by it.
            self.handleError(record)


def _end_without_parent() -> None:
    """Do what SIGTERM does, and make sure that it is the end."""
    # Nobody reads what is printed from now on; that must not disturb the closing.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (1, 2):
        os.dup2(nowhere, descriptor)
    # Needs no interpreter, which may be held by what hangs.
    faulthandler.dump_traceback_later(SECONDS_TO_CLOSE, exit=True)
    if received() is None:
        # To the thread that has to wake up.
        main_thread = threading.main_thread().ident
        assert main_thread is not None
        signal.pthread_kill(main_thread, signal.SIGTERM)


def _handler(work: Mapping[str, Any], parent: _Parent) -> Any:
    """Make the handler; tell the parent why there is none."""
    try:
        known = {*sys.path}
        # What this machine has of its own comes first.
        sys.path += [
            entry
            for entry in work["path"]
            if entry not in known and Path(entry).exists()
        ]
        if work["require_gpu"] is not None:
            # Before the handler's module, which may import mujoco.
            render_on_given_gpu(required=work["require_gpu"])
        payload = Path(work["place"], PAYLOAD)
        module, _, name = work["entry"].partition(":")
        make = operator.attrgetter(name)(importlib.import_module(module))
        return make(
            work["settings"], payload.read_bytes() if payload.exists() else None
        )
    except Exception as error:
        # Python 3.11 turns what is raised inside a class's body into a RuntimeError.
        if terminated := received():
            raise terminated from error
        parent.say(error=carried(error))
        raise SystemExit(1) from error


def _do(handler: Any, job: Mapping[str, Any], parent: _Parent) -> None:
    try:
        value = dict(handler(job["arguments"]))
        done = json.dumps({"key": job["key"], "value": value})
    except Terminated:
        raise
    # A policy that calls sys.exit() ends its job, and not the worker.
    except (Exception, SystemExit) as error:
        logger.warning("The job %s failed.", job["key"], exc_info=True)
        parent.say(key=job["key"], failure=_in_one_line(error))
    else:
        parent.say_line(done)


def _in_one_line(error: BaseException) -> str:
    kind, text = type(error).__name__, " ".join(str(error).split())
    return f"{kind}: {text}" if text else kind


def _close(handler: Any) -> None:
    # What has begun to close is not interrupted once more; SIGKILL is still there.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        handler.close()
    except Exception:
        logger.exception("A worker could not close what it held.")


if __name__ == "__main__":
    main()
