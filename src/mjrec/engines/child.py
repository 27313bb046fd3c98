# SPDX-License-Identifier: Apache-2.0
"""A child process that does jobs: `python -m mjrec.engines.child`.

The first message from the parent describes the work (see `jobs.Run`). Jobs follow, one
at a time::

    {"key": "a", "arguments": {...}}

The child sends::

    {"ready": true}                       the handler was created; sent first
    {"error": {...}}                      sent instead if creating the handler failed
    {"key": "a", "value": {...}}          a job is done
    {"key": "b", "failure": "..."}        a job failed: the handler's error
    {"log": ["mjrec.x", 30, "..."]}       a record for the parent's log
    {"limit": [2.0, "FILE", "..."]}       see `worker.time_limit`

The child exits immediately, even in the middle of a job, if the pipe from the parent
closes or if it receives SIGTERM or SIGUSR2.
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
from ..messages import Parent, carried
from . import worker

# Not `__name__`, which is `__main__`.
logger = logging.getLogger("mjrec.engines.child")

_SECONDS_BETWEEN_LOOKS = 1.0
_SECONDS_TO_LEAVE = 2.0


def main() -> None:
    """Do jobs until the run ends."""
    parent = worker.parent = Parent()
    # Use line buffering, as in a terminal, so that printed lines survive the process's
    # death.
    cast("io.TextIOWrapper", sys.stdout).reconfigure(line_buffering=True)
    parent.send_warnings()
    handler: Any = None
    is_leaving = threading.Lock()

    def leave(*_: object) -> None:
        # Leave only once, even if both a signal and the end of the pipe arrive. The
        # second call waits for the first.
        if is_leaving.acquire(timeout=_SECONDS_TO_LEAVE) and hasattr(handler, "leave"):
            handler.leave()
        # Not `sys.exit`, which would wait for a driver.
        os._exit(0)

    # Slurm sends these signals to all processes of a job, not only to the first one.
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
    """Wait for the next job and return it, or return None if the run is over."""
    while True:
        try:
            return parent.receive(_SECONDS_BETWEEN_LOOKS)
        except queue.Empty:
            if not work.exists():
                return None


def _handler(work: Mapping[str, Any], parent: Parent) -> Any:
    """Create the handler, or report the error to the parent and exit."""
    try:
        # This machine's own entries in `sys.path` come first.
        known = {*sys.path}
        more = (entry for entry in work["path"] if entry not in known)
        sys.path += [entry for entry in more if Path(entry).exists()]
        if work["require_gpu"] is not None:
            # This must precede the import of the handler's module, which may import
            # mujoco.
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
    # A policy that calls sys.exit() must end its job, not the worker.
    except (Exception, SystemExit) as error:
        logger.warning("The job %s failed.", job["key"], exc_info=True)
        text = " ".join(str(error).split())
        kind = type(error).__name__
        parent.send(key=job["key"], failure=f"{kind}: {text}" if text else kind)


if __name__ == "__main__":
    main()
