# SPDX-License-Identifier: Apache-2.0
"""An engine for Ray: each job is a Ray task that runs in a child of a Ray worker.

If this process is already connected to Ray, that connection is used and left open.
Otherwise the engine connects to a cluster, or starts Ray on this machine.
"""

from __future__ import annotations

import collections
import contextlib
import importlib
import logging
import os
import secrets
import signal
import socket
import threading
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import mjrec

from ..child_python import changed_environ
from ..errors import ClosedError, Error, GLError, InvalidArgument, optional_module
from ..machine import usable_cpus
from .local import GpuShare, check_worker_count

logger = logging.getLogger(__name__)

# Ray's minimum is 75 MiB; jobs and their outcomes need very little memory.
_SMALLEST_STORE = 80 << 20
_SECONDS_TO_REACH = 10.0


class RayEngine(Executor):
    """An engine that runs jobs on a Ray cluster.

    Args:
        workers: maximum number of simultaneous workers. None means as many as the
            cluster has room for, even as it grows.
        address: address of the cluster. None means `RAY_ADDRESS`. If that is also
            unset, Ray is started on this machine, without usage statistics or a
            dashboard, and stopped together with the engine. If this process is already
            connected to Ray, that connection is used and left open.
        gpus: number of GPUs for each worker, which may be a fraction: with 0.25, four
            workers share a GPU.
        require_gpu: whether a worker that was given a GPU but renders in software is an
            error instead of a warning.

    Raises:
        InvalidArgument: `workers` is not a whole number of at least 1, or `gpus` is not
            a valid share.
        MissingDependency: Ray is not installed.
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        address: str | None = None,
        gpus: float = 0.0,
        require_gpu: bool = False,
    ) -> None:
        self.workers = check_worker_count(workers)
        self.address = address
        self.share = GpuShare(each=gpus, required=require_gpu)
        self._ray = optional_module("ray", purpose='engine="ray"', install="mjrec[ray]")
        self._task: Any = None
        self._disconnect: weakref.finalize[Any, Any] | None = None
        self._is_shut_down = False
        # The arguments of the calls that Ray has, keyed by their object reference.
        self._calls: dict[Any, tuple[Any, ...]] = {}
        self._waiting: collections.deque[tuple[Future[Any], Any]] = collections.deque()
        self._one_at_a_time = threading.RLock()

    def __repr__(self) -> str:
        gpus = f", gpus={self.share.each:g}" if self.share.asked_for else ""
        address = f", address={self.address!r}" if self.address else ""
        return f"RayEngine(workers={self.workers}{address}{gpus})"

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Call `fn` in a Ray task; see `concurrent.futures.Executor`.

        Raises:
            ClosedError: the engine was shut down.
            GLError: a GPU is required, but Ray was started on this machine and finds
                none.
            Error: the cluster does not answer, or Ray cannot be started.
        """
        if self._is_shut_down:
            raise ClosedError("The engine was shut down.")
        if self._task is None:
            self._connect()
        future: Future[Any] = Future()
        self._waiting.append((future, (fn, args, kwargs)))
        self._begin()
        return future

    def end_run(self, place: str) -> None:
        """Cancel a run's calls that no Ray worker has begun. Idempotent."""
        with self._one_at_a_time:
            of_run = [ref for ref, args in self._calls.items() if place in args]
        # Otherwise `cancel` would start a new Ray.
        for ref in of_run if self._ray.is_initialized() else ():
            self._ray.cancel(ref)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Accept no more calls, and close the engine's own connection. Idempotent."""
        del wait, cancel_futures
        self._is_shut_down = True
        if self._disconnect is not None:
            self._disconnect()

    def _connect(self) -> None:
        if not self._ray.is_initialized():
            is_started = _connect(self._ray, self.address, self.workers)
            self._disconnect = weakref.finalize(self, _disconnect, self._ray)
            # A worker must not wait forever for a GPU that does not exist.
            has_gpus = self._ray.cluster_resources().get("GPU")
            if is_started and self.share.asked_for and not has_gpus:
                lack = "GPUs were requested, but Ray finds none on this machine."
                if self.share.required:
                    raise GLError(f"{lack} `nvidia-smi -L` lists GPUs.")
                logger.warning("%s Workers render in software.", lack)
                self.share = GpuShare()
        self._task = self._ray.remote(
            # The `Run` itself reports and resubmits lost tasks.
            num_cpus=1,
            num_gpus=self.share.each,
            max_retries=0,
        )(_call)

    def _begin(self) -> None:
        with self._one_at_a_time:
            while self._waiting and len(self._calls) < (self.workers or float("inf")):
                future, call = self._waiting.popleft()
                if future.set_running_or_notify_cancel():
                    ref = self._task.remote(mjrec.__version__, *call)
                    self._calls[ref] = call[1]
                    ref.future().add_done_callback(
                        lambda done, ref=ref, to=future: self._end(done, ref, to)
                    )

    def _end(self, done: Future[Any], ref: Any, future: Future[Any]) -> None:
        with self._one_at_a_time:
            del self._calls[ref]
        error = done.exception()
        if error is None:
            future.set_result(done.result())
        else:
            # A task's exception arrives as one of Ray's errors, with the original as
            # its cause.
            cause = getattr(error, "cause", None)
            future.set_exception(cause if isinstance(cause, Error) else error)
        self._begin()


def _call(
    version: str, fn: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> Any:
    """Call a function in a Ray worker if that worker has the same version of mjrec."""
    if version != mjrec.__version__:
        raise Error(
            f"The driver has mjrec {version}, but a Ray worker has "
            f"{mjrec.__version__}. Install the same version on all machines."
        )
    # `ray.cancel` would interrupt a call that has begun. A job that has begun ends with
    # its run.
    before = signal.signal(signal.SIGINT, lambda *_: None)
    try:
        return fn(*args, **kwargs)
    finally:
        signal.signal(signal.SIGINT, before)


def _disconnect(ray: Any) -> None:
    with contextlib.suppress(Exception):
        ray.shutdown()
    # If this process restarts Ray, it must not reuse our token. The cache is a private
    # API, which older versions lack.
    with contextlib.suppress(ImportError, AttributeError):
        raylet = importlib.import_module("ray._raylet")
        raylet.AuthenticationTokenLoader.instance().reset_cache()


def _connect(ray: Any, address: str | None, cpus: int | None) -> bool:
    """Connect to Ray, and return whether it had to be started."""
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    if address.startswith("ray://"):
        raise InvalidArgument(
            f"{address} is an address for Ray's client, which cannot monitor "
            "workers. Start mjrec on a machine in the cluster, with --address auto."
        )
    try:
        with _signals_as_they_are():
            if address == "local":
                _start(ray, cpus or usable_cpus())
                return True
            _check_reachable(address)
            ray.init(address=address, logging_level=logging.WARNING)
            return False
    # Ray has no error class of its own for these failures.
    except Exception as error:
        with contextlib.suppress(Exception):
            ray.shutdown()
        reason = " ".join(str(error).split()) or type(error).__name__
        if address == "local":
            why = f"Ray could not be started on this machine: {reason}"
        else:
            why = (
                f"No Ray cluster answers at {address}. It must be running (ray "
                "status), be reachable from this machine, and have the same versions "
                f"of Ray and Python. Ray's error: {reason}"
            )
        raise Error(why) from error


def _check_reachable(address: str) -> None:
    """Raise OSError if no cluster is listening. Ray itself would retry for minutes."""
    if address == "auto":
        # This private API returns Ray's record of a cluster, which may have stopped.
        with contextlib.suppress(ImportError, AttributeError):
            services = importlib.import_module("ray._private.services")
            address = services.canonicalize_bootstrap_address(address) or ""
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host, int(port)), _SECONDS_TO_REACH).close()


def _start(ray: Any, cpus: int) -> None:
    environ = {
        "RAY_USAGE_STATS_ENABLED": "0",
        # Workers without a GPU see the same GPUs as without Ray.
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
        # The children exit on their own after sending their last message.
        "RAY_kill_child_processes_on_worker_exit": "0",
    }
    is_token_known = (
        {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}
        & {*filter(os.environ.get, os.environ)}
    ) or (Path.home() / ".ray" / "auth_token").exists()
    if not is_token_known:
        # Otherwise Ray would write a token to the home directory and leave it there.
        environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    with changed_environ(environ):
        ray.init(
            address="local",
            num_cpus=cpus,
            include_dashboard=False,
            object_store_memory=_SMALLEST_STORE,
            logging_level=logging.ERROR,
        )


@contextlib.contextmanager
def _signals_as_they_are() -> Iterator[None]:
    """Restore signal handlers after the block. Only the main thread can do so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {s: signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for signum, handler in before.items():
            if handler is not None:
                signal.signal(signum, handler)
