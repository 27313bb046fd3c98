# SPDX-License-Identifier: Apache-2.0
"""A process that does jobs: `python -m mjrec.engines.child`.

The first that its parent sends says what the work is, see `jobs.Run`. Then comes one
job after the other::

    {"key": "a", "arguments": {...}}

and this process sends::

    {"ready": true}                       there is a handler; before anything else
    {"error": {...}}                      instead of it: none could be made
    {"key": "a", "value": {...}}          a job is done
    {"key": "b", "failure": "..."}        or failed, with what the handler raised
    {"log": ["mjrec.x", 30, "..."]}       for the parent's log
    {"limit": [2.0, "FILE", "..."]}       see `worker.time_limit`

It ends at once, in mid-job too, when the pipe from its parent ends, or by SIGTERM
or SIGUSR2.
"""

from __future__ import annotations

import importlib
import io
import logging
import operator
import os
import queue
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from ..gl.devices import render_on_given_gpu
from ..messages import carried
from ..parent import Parent
from . import worker

# Not `__name__`, which is `__main__`.
logger = logging.getLogger("mjrec.engines.child")

_SECONDS_BETWEEN_LOOKS = 1.0
_SECONDS_TO_LEAVE = 2.0


def main() -> None:
    """Do jobs until the run is over."""
    parent = worker.parent = Parent()
    # As in a terminal: what is printed is there when the process dies.
    cast("io.TextIOWrapper", sys.stdout).reconfigure(line_buffering=True)
    parent.send_warnings()
    handler: Any = None
    is_leaving = threading.Lock()

    def leave(*_: object) -> None:
        # Once: both a signal and the pipe's end may come. The second waits for the end.
        if is_leaving.acquire(timeout=_SECONDS_TO_LEAVE) and hasattr(handler, "leave"):
            handler.leave()
        # Not `sys.exit`, which would wait for a driver.
        os._exit(0)

    # Slurm sends them to all processes of a job, and not to the first one only.
    for signum in (signal.SIGTERM, signal.SIGUSR2):
        signal.signal(signum, leave)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signum])
    parent.listen(leave)
    work = parent.receive()
    handler = _handler(work, parent)
    parent.send(ready=True)
    file = Path(work["place"], worker.WORK)
    while (job := _next_job(parent, file)) is not None:
        _do(handler, job, parent)


def _next_job(parent: Parent, work: Path) -> dict[str, Any] | None:
    """Return the next job, waiting for it; None where the run is over."""
    while True:
        try:
            return parent.receive(_SECONDS_BETWEEN_LOOKS)
        except queue.Empty:
            if not work.exists():
                return None


def _handler(work: Mapping[str, Any], parent: Parent) -> Any:
    """Make the handler; tell the parent why there is none."""
    try:
        # What this machine has of its own comes first.
        known = {*sys.path}
        more = (entry for entry in work["path"] if entry not in known)
        sys.path += [entry for entry in more if Path(entry).exists()]
        if work["require_gpu"] is not None:
            # Before the handler's module, which may import mujoco.
            render_on_given_gpu(required=work["require_gpu"])
        module, _, name = work["entry"].partition(":")
        make = operator.attrgetter(name)(importlib.import_module(module))
        return make(work["settings"])
    except Exception as error:
        parent.send(error=carried(error))
        raise SystemExit(1) from error


def _do(handler: Any, job: Mapping[str, Any], parent: Parent) -> None:
    try:
        parent.send(key=job["key"], value=dict(handler(job["arguments"])))
    # A policy that calls sys.exit() ends its job, and not the worker.
    except (Exception, SystemExit) as error:
        logger.warning("The job %s failed.", job["key"], exc_info=True)
        text = " ".join(str(error).split())
        kind = type(error).__name__
        parent.send(key=job["key"], failure=f"{kind}: {text}" if text else kind)


if __name__ == "__main__":
    main()
