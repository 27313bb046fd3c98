# SPDX-License-Identifier: Apache-2.0
"""This process's connection to Ray, and what is known of the cluster.

Where the process has one, it is used and left as it is. Else one is made, to a cluster
or to a Ray that is started on this machine, and given up with the last run that needs
it.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import secrets
import signal
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import Error, InvalidArgument, MissingDependency
from ..machine import usable_cpus
from .gpu_shares import GpuShare

_ADDRESS = "RAY_ADDRESS"
_TOKEN = "RAY_AUTH_TOKEN"
_TOKEN_PATH = "RAY_AUTH_TOKEN_PATH"
# Ray starts with no less than 75 MiB; jobs and what comes of them need next to nothing.
_SMALLEST_STORE = 80 << 20
_SECONDS_BETWEEN_LOOKS = 2.0
_SECONDS_TO_STOP = 1.0
_SECONDS_TO_REACH = 10.0


def import_ray() -> Any:
    """Return the package `ray`.

    Raises:
        MissingDependency: it is not installed.
    """
    try:
        # Heavy, and optional.
        return importlib.import_module("ray")
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise MissingDependency(
            "ray", purpose='engine="ray"', install='pip install "mjrec[ray]"'
        ) from error


class RayConnection:
    """A share in this process's connection to Ray, until it is left.

    Args:
        address: of a cluster; None is the one that `RAY_ADDRESS` names, else a Ray that
            is started on this machine, which ends with the connection. Where this
            process is connected already, that is used.
        cpus: of a Ray that is started; None is those that may be used.
        payload_size: how many bytes its workers are given once.

    Raises:
        InvalidArgument: the address is one of Ray's client.
        Error: there is no such cluster, or it is of other versions; or no Ray can be
            started.
    """

    _made = 0
    _is_started = False
    _lock = threading.Lock()

    def __init__(
        self, address: str | None, *, cpus: int | None, payload_size: int
    ) -> None:
        self._ray = import_ray()
        self._is_left = False
        with self._lock:
            self._is_ours = not self._ray.is_initialized() or RayConnection._made > 0
            if not self._ray.is_initialized():
                RayConnection._is_started = _connect(
                    self._ray, address, cpus, payload_size
                )
            if self._is_ours:
                RayConnection._made += 1

    def lacks_gpus(self) -> bool:
        """Tell whether Ray was started here and has no GPU, and so never will."""
        is_ours = self._is_ours and RayConnection._is_started
        return is_ours and not self._ray.cluster_resources().get("GPU")

    def leave(self) -> None:
        """Give the connection up, if nobody else needs it. Idempotent."""
        if self._is_left:
            return
        self._is_left = True
        with self._lock:
            if not self._is_ours:
                return
            RayConnection._made -= 1
            if not RayConnection._made:
                self._ray.shutdown()
                _forget_token()


class ClusterWatch:
    """What is known of a cluster's nodes.

    They are asked for on a thread, because asking a cluster that is gone does not
    return.
    """

    def __init__(self) -> None:
        self._ray = import_ray()
        self._nodes: list[Mapping[str, Any]] = self._ray.nodes()
        self._heard = time.monotonic()
        self._asked = threading.Event()
        self._answered = threading.Event()
        self._is_stopped = False
        self._thread = threading.Thread(
            target=self._look, name="mjrec-ray-nodes", daemon=True
        )
        self._thread.start()

    @property
    def silent_s(self) -> float:
        """For how many seconds the cluster has not answered."""
        return max(0.0, time.monotonic() - self._heard - _SECONDS_BETWEEN_LOOKS)

    def look(self) -> None:
        """Ask now, and wait for the answer, but not for ever."""
        self._answered.clear()
        self._asked.set()
        self._answered.wait(_SECONDS_TO_REACH)

    @property
    def dead_nodes(self) -> frozenset[str]:
        """Those that have gone, by the last answer."""
        return frozenset(n["NodeID"] for n in self._nodes if not n["Alive"])

    def room_for(self, share: GpuShare) -> int:
        """Return how many workers the nodes have room for, when nothing else runs."""
        return sum(
            _room_of(node.get("Resources", {}), share)
            for node in self._nodes
            if node["Alive"]
        )

    def total(self, resource: str) -> float:
        """Return how much of `"CPU"` or `"GPU"` all nodes have."""
        resources = [n.get("Resources", {}) for n in self._nodes if n["Alive"]]
        return float(sum(each.get(resource, 0.0) for each in resources))

    def stop(self) -> None:
        """Look no more. Idempotent."""
        self._is_stopped = True
        self._asked.set()
        # It may be asking what does not answer.
        self._thread.join(_SECONDS_TO_STOP)

    def _look(self) -> None:
        while True:
            self._asked.wait(_SECONDS_BETWEEN_LOOKS)
            self._asked.clear()
            if self._is_stopped:
                return
            # What goes wrong is told by the silence.
            with contextlib.suppress(Exception):
                self._nodes = self._ray.nodes()
                self._heard = time.monotonic()
                self._answered.set()


def _room_of(resources: Mapping[str, float], share: GpuShare) -> int:
    room = int(resources.get("CPU", 0))
    if not share.asked_for:
        return room
    gpus = int(resources.get("GPU", 0))
    # Ray puts no worker on parts of two GPUs.
    fits = gpus // int(share.each) if share.each >= 1 else gpus * int(1 / share.each)
    return min(room, fits)


def _connect(ray: Any, address: str | None, cpus: int | None, payload: int) -> bool:
    """Connect to Ray, and return whether it had to be started."""
    address = address or os.environ.get(_ADDRESS) or None
    if address is not None and address.startswith("ray://"):
        raise InvalidArgument(
            f"{address} is an address for Ray's client, with which workers cannot be "
            "watched. Start mjrec on a machine of the cluster, with --address auto."
        )
    try:
        with _signals_as_they_are():
            if address is None or address == "local":
                _start(ray, cpus or usable_cpus(), payload)
                return True
            _check_reachable(address)
            ray.init(address=address, logging_level=logging.WARNING)
            return False
    # Ray has no class of its own for what goes wrong here.
    except Exception as error:
        with contextlib.suppress(Exception):
            ray.shutdown()
        raise Error(_why_not(address, error)) from error


def _check_reachable(address: str) -> None:
    """Raise OSError where nobody listens; Ray would try it for minutes."""
    if address == "auto":
        # What Ray has noted of a cluster that need not run any more; a private name.
        with contextlib.suppress(ImportError, AttributeError):
            services = importlib.import_module("ray._private.services")
            address = services.canonicalize_bootstrap_address(address) or ""
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host, int(port)), _SECONDS_TO_REACH).close()


def _why_not(address: str | None, error: Exception) -> str:
    told = " ".join(str(error).split()) or type(error).__name__
    if address is None or address == "local":
        return f"Ray could not be started on this machine: {told}"
    return (
        f"There is no Ray cluster to be had at {address}. It must be running "
        "(ray status), be reached from here, and have the same versions of Ray and "
        f"Python. Ray says: {told}"
    )


def _start(ray: Any, cpus: int, payload: int) -> None:
    with _environment(_private_environment()):
        ray.init(
            address="local",
            num_cpus=cpus,
            include_dashboard=False,
            object_store_memory=_SMALLEST_STORE + payload + payload // 4,
            logging_level=logging.ERROR,
        )


def _private_environment() -> dict[str, str]:
    """Return what a Ray of ours is started with."""
    environ = {
        "RAY_USAGE_STATS_ENABLED": "0",
        # Workers that were given no GPU see what they would without Ray.
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
        # Processes of jobs end by themselves, when they have closed their files.
        "RAY_kill_child_processes_on_worker_exit": "0",
    }
    known = (
        os.environ.get(_TOKEN)
        or os.environ.get(_TOKEN_PATH)
        or (Path.home() / ".ray" / "auth_token").exists()
    )
    if not known:
        # Else it would write one into the home, and leave it there.
        environ[_TOKEN] = secrets.token_hex(32)
    return environ


def _forget_token() -> None:
    """Let a later Ray of this process have another token than ours."""
    # Its place is private, and older ones have none.
    with contextlib.suppress(ImportError, AttributeError):
        raylet = importlib.import_module("ray._raylet")
        raylet.AuthenticationTokenLoader.instance().reset_cache()


@contextlib.contextmanager
def _environment(more: Mapping[str, str]) -> Iterator[None]:
    """Have environment variables for a while, and undo whatever else is set."""
    before = dict(os.environ)
    os.environ.update(more)
    try:
        yield
    finally:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        os.environ.update(before)


@contextlib.contextmanager
def _signals_as_they_are() -> Iterator[None]:
    """Undo what is done to handlers of signals, which Python does in one thread."""
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
