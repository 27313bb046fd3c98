# SPDX-License-Identifier: Apache-2.0
"""A process that does jobs: `python -m mjrec.engines.child`.

The first that its parent sends says what the work is: `entry`, `settings`, `place`,
`require_gpu`, `path`; see `jobs.Run`. Then comes one job after the other::

    {"key": "a", "arguments": {...}}

and this process sends::

    {"ready": true}                       there is a handler; before anything else
    {"error": {...}}                      instead of it: none could be made
    {"key": "a", "value": {...}}          a job is done
    {"key": "b", "failure": "..."}        or failed, with what the handler raised
    {"log": ["mjrec.x", 30, "..."]}       for the parent's log

On SIGTERM the handler is closed and the process ends; so it does when the parent has
died, in mid-job too, and when the run's folder says that all is over.
"""

from __future__ import annotations

import faulthandler
import importlib
import io
import logging
import operator
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from ..gl.devices import render_on_given_gpu
from ..messages import carried
from ..parent import Parent
from ..signals import Terminated, exiting_on_signals, received
from .worker import SECONDS_TO_CLOSE, STOP

# Not `__name__`, which is `__main__`.
logger = logging.getLogger("mjrec.engines.child")

_SECONDS_BETWEEN_LOOKS = 1.0


def main() -> None:
    """Do jobs until told to end."""
    parent = Parent()
    # As in a terminal: what is printed is there when the process dies.
    cast("io.TextIOWrapper", sys.stdout).reconfigure(line_buffering=True)
    # The parent may have done something to its own.
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGTERM])
    parent.send_warnings()
    parent.listen(_end_without_parent)
    with exiting_on_signals():
        work = parent.receive()
        handler = _handler(work, parent)
        try:
            parent.send(ready=True)
            while (job := _next_job(parent, Path(work["place"]))) is not None:
                _do(handler, job, parent)
        finally:
            _close(handler)


def _next_job(parent: Parent, place: Path) -> dict[str, Any] | None:
    """Return the next job, waiting for it; None where the run is over."""
    while True:
        try:
            return parent.receive(_SECONDS_BETWEEN_LOOKS)
        except queue.Empty:
            if (place / STOP).exists() or not place.exists():
                return None


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
    # It ends meanwhile, or is ended.
    time.sleep(2 * SECONDS_TO_CLOSE)


def _handler(work: Mapping[str, Any], parent: Parent) -> Any:
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
        module, _, name = work["entry"].partition(":")
        make = operator.attrgetter(name)(importlib.import_module(module))
        return make(work["settings"])
    except Exception as error:
        # Python 3.11 turns what is raised inside a class's body into a RuntimeError.
        if terminated := received():
            raise terminated from error
        parent.send(error=carried(error))
        raise SystemExit(1) from error


def _do(handler: Any, job: Mapping[str, Any], parent: Parent) -> None:
    try:
        parent.send(key=job["key"], value=dict(handler(job["arguments"])))
    except Terminated:
        raise
    # A policy that calls sys.exit() ends its job, and not the worker.
    except (Exception, SystemExit) as error:
        logger.warning("The job %s failed.", job["key"], exc_info=True)
        parent.send(key=job["key"], failure=_in_one_line(error))


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
