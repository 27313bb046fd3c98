# SPDX-License-Identifier: Apache-2.0
"""What a worker is on a Ray cluster: an actor that holds a `Host`.

Its methods run on threads, so that it hears of its end in mid-job.
"""

from __future__ import annotations

import json
import platform
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

import mjrec

from .hosting import Host, HostedWork

# A job, and the end of all jobs.
METHODS_AT_ONCE = 2
_SECONDS_BETWEEN_LOOKS = 0.1


class RayWorker:
    """Does one job after the other in a process beside its own.

    Where a SIGTERM comes, as when a node is taken away, the job is closed and not done.
    Where Ray kills this process, the other one notices, and closes what it is at.

    Args:
        hosted: the work, as JSON.
        payload: of it.
    """

    def __init__(self, hosted: bytes, payload: bytes | None) -> None:
        self._ending = threading.Event()
        self._one_at_a_time = threading.Lock()
        _when_terminated(self._ending.set)
        self._host = Host(HostedWork.from_json(hosted), payload, gpus=_given_gpus())

    def __repr__(self) -> str:
        # Ray puts it before whatever is printed.
        return "mjrec worker"

    def hello(self) -> bytes:
        """Return where this is, as JSON."""
        import ray  # optional, and only on a cluster

        return json.dumps(
            {
                "node": ray.get_runtime_context().get_node_id(),
                "machine": platform.node(),
                "version": mjrec.__version__,
            }
        ).encode()

    def do(self, line: bytes) -> bytes | None:
        """Do a job and return what goes home; None if it is not done, for it ends."""
        with self._one_at_a_time:
            if self._ending.is_set():
                return None
            self._host.submit(line)
            for said in self._host.lines(patience_s=_SECONDS_BETWEEN_LOOKS):
                if said is not None:
                    return said
                if self._ending.is_set():
                    break
            self._host.close()
            return None

    def end(self) -> None:
        """Let the job close its files, and do no other. Idempotent."""
        self._ending.set()
        with self._one_at_a_time:
            self._host.close()


def _given_gpus() -> list[str]:
    import ray  # optional, and only on a cluster

    return [str(gpu) for gpu in ray.get_gpu_ids()]


def _when_terminated(tell: Callable[[], None]) -> None:
    """Let a SIGTERM be told of, besides what Ray does about it."""
    # Ray makes actors in the main thread, whatever thread their methods run on.
    if threading.current_thread() is not threading.main_thread():
        return
    rays: Any = signal.getsignal(signal.SIGTERM)

    def hear(signum: int, frame: FrameType | None) -> None:
        tell()
        if callable(rays):
            rays(signum, frame)

    signal.signal(signal.SIGTERM, hear)
