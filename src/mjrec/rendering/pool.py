# SPDX-License-Identifier: Apache-2.0
"""A pool of processes that draw frames, in order, for one caller.

All processes that render into one directory share the machine's CPUs. Each CPU is
represented by a lock file, `.openaigym.render.<number>.lock`, and the process that
holds it may keep one worker busy. If eight processes record into one directory on a
machine with two CPUs, only two workers are busy, not sixteen.
"""

from __future__ import annotations

import collections
import contextlib
import itertools
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from ..child_python import Child, changed_environ, wait_for_news
from ..errors import ClosedError, Error, GLError
from ..formats.json_fields import to_json
from ..formats.locks import Lock, try_lock
from ..formats.monitor_directory import render_lock_name
from ..frames import Frame
from ..gl.backends import (
    BACKENDS,
    backend_in_environment,
    environment_for,
    rendering_is_off,
)
from ..gl.choice import backend_for_children
from ..machine import check_workers, usable_cpus
from ..messages import log_message, unpacked
from ..simulation.model_trust import ALL_MODELS, TRUST_VARIABLE
from ..timeouts import Timeout
from .jobs import PlainCamera, View, plain_camera

logger = logging.getLogger(__name__)

_MODULE = "mjrec.rendering.worker"
_MOST_BUFFERED = 2
_SECONDS_BETWEEN_TRIES = 0.1


class WorkerPool:
    """Draws frames in worker processes and returns them in order.

    With n workers, worker k draws frames k, k+n, k+2n ... of a job and writes them to
    its pipe. At most two frames per worker are buffered here. A worker that dies is
    restarted at the frame it owes. If it dies twice at the same frame, an error is
    raised. A worker that sends nothing for `timeout_s` while the pool waits for it is
    killed and counts as dead; the log shows where it hung.

    The processes start when needed, or with `start`, and stay until `close`, garbage
    collection or the end of this process. Only a worker whose job is abandoned midway
    is terminated, and it is restarted for the next job.

    Workers use the backend that `MUJOCO_GL` names. If it names none or turns rendering
    off (which applies only to the simulation), each worker starts with EGL and first
    checks a test frame. Only if that fails does the pool look for the first backend
    that works, like `mjrec.use_gl`.

    Use a pool from one thread at a time.

    ::

        with WorkerPool(2) as pool:
            for frame in pool.frames(path, range(100), View(height=48, width=64)):
                ...

    Args:
        workers: number of processes. If there are several, each uses one CPU. None
            means one for each of the directory's CPUs that is free when a job begins.
        directory: the directory whose CPU locks are used.
        trust_models: whether workers load compiled models from untrusted sources. They
            always do so if this process's `MJREC_TRUST_MODELS` allows it.
        forks: whether `start` forks this process, so that modules are imported only
            once. It must have a single thread until then, and must never use OpenGL.

    Raises:
        InvalidArgument: `workers` is not a whole number of at least 1.
        UnknownName: `MUJOCO_GL` names an unknown backend.

    Attributes:
        gl_facts: facts about the renderer, from `gl_context.current_gl_facts`; empty
            before the first frame.
    """

    def __init__(
        self,
        workers: int | None,
        *,
        directory: Path | None = None,
        trust_models: bool = False,
        forks: bool = False,
    ) -> None:
        self._fixed = check_workers(workers)
        count = self._fixed or usable_cpus()
        # A pool that forks draws alongside a simulation, which needs the other CPUs.
        self._environ = _environment(os.environ, alone=count == 1 and not forks)
        # A backend that the user chose, or that is known to work, needs no test.
        self._is_chosen = "MUJOCO_GL" in self._environ
        if trust_models:
            self._environ[TRUST_VARIABLE] = ALL_MODELS
        self._directory = directory
        # The locks of the directory's CPUs that this process holds.
        self._held: dict[int, Lock] = {}
        self._workers = [_Worker() for _ in range(count)]
        self._forks = forks
        self._timeout = Timeout()
        self.gl_facts: dict[str, Any] = {}
        self._has_drawn = False
        self._job: _Job | None = None
        self._closed = False
        self._process_id = os.getpid()

    def start(self) -> None:
        """Start the workers now, so that the first frame is ready sooner. Idempotent.

        Errors are reported when frames are requested.
        """
        with contextlib.suppress(Error):
            self._check_usable()
            for worker in self._workers[: self._free()]:
                self._start(worker)
        self.rest()

    def prepare(self, trajectory: Path) -> None:
        """Make idle workers load a trajectory's model, which may not exist yet.

        Nothing is done while a job is running, or by workers that have not started.
        Errors are reported when frames are requested.
        """
        if self._job is None:
            drawing = {"trajectory": str(trajectory), "view": to_json(View())}
            for worker in self._workers:
                if worker.child is not None:
                    worker.child.send(prepares=drawing)

    def rest(self) -> None:
        """Release the CPUs while there is nothing to draw. The workers stay."""
        while self._held:
            _, lock = self._held.popitem()
            lock.release()

    def frames(
        self,
        trajectory: Path,
        indices: Sequence[int],
        view: View | None = None,
        *,
        cameras: Sequence[PlainCamera | None] | None = None,
    ) -> Iterator[Frame]:
        """Return the frames of a trajectory, in the order of `indices`.

        This waits for a free CPU and draws the first frame before it returns. Each
        frame is a new array.

        Args:
            trajectory: the trajectory's file.
            indices: the numbers of the frames, from 0, in ascending order.
            view: the camera, size and quality; None means as recorded.
            cameras: the cameras to use in place of the view's; None in the list stands
                for the recorded camera. Each frame is then a grid of their frames.

        Raises:
            UnreadableFile: the trajectory or its model cannot be read.
            InvalidArgument: a frame does not exist, the model lacks the camera, or the
                driver cannot draw frames of this size.
            GLError: no backend works on this machine, or all attempts to draw hang.
            Error: a worker died twice at the same frame. The message contains the
                signal and the worker's last output. Errors at later frames are raised
                when the iterator reaches them.
        """
        drawing: dict[str, Any] = {
            "trajectory": str(Path(trajectory).absolute()),
            "view": to_json(view or View()),
        }
        if cameras is not None:
            drawing["cameras"] = [c if c is None else plain_camera(c) for c in cameras]
        return self.frames_of(drawing, indices)

    def frames_of(
        self, drawing: Mapping[str, Any], indices: Sequence[int]
    ) -> Iterator[Frame]:
        """Return the frames of any drawing that `worker.open_drawing` can open.

        This works like `frames`. The remaining frames of an earlier call are abandoned.
        """
        self._check_usable()
        for worker in self._workers:
            worker.leave()
        while not (limit := self._free()):
            time.sleep(_SECONDS_BETWEEN_TRIES)
        self._job = _Job(dict(drawing), indices, self._workers[:limit])
        drawn = self._drawn(self._job)
        first = list(itertools.islice(drawn, 1))
        return itertools.chain(first, drawn)

    def close(self) -> None:
        """End the processes immediately, whatever they are doing. Idempotent."""
        self._closed = True
        for worker in self._workers:
            worker.end()
        self.rest()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _check_usable(self, job: _Job | None = None) -> None:
        if job is not None and job is not self._job:
            raise ClosedError("A later call has taken over the workers.")
        if self._closed:
            raise ClosedError("The worker pool is closed.")
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"The worker pool belongs to process {self._process_id}. Create one in "
                "the process that uses it."
            )

    def _free(self) -> int:
        """Lock the free CPUs, and return the number of workers that may draw."""
        if self._fixed is not None or self._directory is None:
            return len(self._workers)
        for number in range(len(self._workers)):
            if number not in self._held:
                path = self._directory / render_lock_name(number)
                lock = try_lock(path)
                if lock is not None:
                    self._held[number] = lock
        return len(self._held)

    def _start(self, worker: _Worker) -> None:
        if worker.child is not None:
            return
        environ = self._environ
        if not self._is_chosen:
            environ = environment_for(BACKENDS[0], environ)
        try:
            # The working directory is "/", so that workers do not prevent any directory
            # from being removed or unmounted.
            worker.child = Child(
                _MODULE, environ=environ, cwd="/", fork=self._main_of_fork(environ)
            )
        except OSError as error:
            raise Error(
                f"A render worker could not be started: {sys.executable!r}: {error}."
            ) from error
        worker.is_tried = self._is_chosen
        worker.child.send(tries=not self._is_chosen)

    def _main_of_fork(self, environ: Mapping[str, str]) -> Callable[[], object] | None:
        if not self._forks or threading.active_count() > 1:
            return None
        try:
            # mujoco reads these variables when it is imported. If this backend fails,
            # the user's choice is looked up again.
            with changed_environ(environ):
                # Imported here because other processes that have a pool never draw.
                from .worker import main
        except Exception:
            # A separate worker process reports the reason or uses another backend.
            self._forks = False
            return None
        return main

    def _choose_backend(self) -> None:
        """Choose the first backend that works, and stop forking.

        This process has imported mujoco for EGL, so its forks could not use another
        backend.

        Raises:
            GLError: no backend works.
        """
        if not self._is_chosen:
            self._environ = environment_for(backend_for_children(), self._environ)
            self._is_chosen, self._forks = True, False

    def _drawn(self, job: _Job) -> Iterator[Frame]:
        count, workers = len(job.indices), job.workers
        try:
            for first, worker in enumerate(workers):
                worker.owes = range(first, count, len(workers))
                if worker.owes:
                    self._order(worker, job)
            for position in range(count):
                worker = workers[position % len(workers)]
                while not worker.arrived:
                    if worker.error is not None:
                        raise worker.error
                    self._wait_for_news(job)
                    self._check_usable(job)
                frame = worker.arrived.popleft()
                self._timeout.renew()
                # Listen before yielding, because the caller may be busy for a while.
                self._listen(job, 0)
                yield frame
                self._check_usable(job)
        finally:
            if self._job is job:
                for worker in workers:
                    worker.leave()

    def _order(self, worker: _Worker, job: _Job) -> None:
        """Send a worker its part of a job, starting it if necessary."""
        self._start(worker)
        assert worker.child is not None
        indices = [int(job.indices[position]) for position in worker.owes]
        self._timeout.renew()
        worker.child.send(drawing=job.drawing, indices=indices)

    def _wait_for_news(self, job: _Job) -> None:
        """Wait until a worker sends something; kill workers that exceed the timeout."""
        hungry = [worker for worker in job.workers if worker.may_send]
        for worker in hungry:
            if worker.child is None:
                self._order(worker, job)
        self._timeout.wait(lambda seconds: self._listen(job, seconds))
        if self._timeout.is_over:
            # The other workers have full buffers or owe nothing, so none is hanging.
            for worker in hungry:
                self._end_hanging(worker, job)
            self._timeout.renew()

    def _listen(self, job: _Job, seconds: float) -> bool:
        """Read the workers' messages, waiting at most `seconds` for one.

        Returns:
            Whether there was a message.
        """
        by_child = {
            worker.child: worker
            for worker in job.workers
            if worker.child is not None and worker.may_send
        }
        heard = [by_child[child] for child in wait_for_news(by_child, seconds)]
        for worker in heard:
            assert worker.child is not None
            try:
                self._take_in(worker, worker.child)
            except EOFError:
                self._lose(worker, job, "died", f"it {worker.child.last_words()}")
            except BaseException:
                # After Ctrl-C within a message, the rest of the pipe cannot be decoded.
                worker.end()
                raise
        return bool(heard)

    def _take_in(self, worker: _Worker, child: Child) -> None:
        while worker.may_send:
            child.forget_words()
            message = child.receive()
            if message is None:
                return
            if isinstance(message, bytearray):
                self._has_drawn = True
                frame = np.frombuffer(message, np.uint8).reshape(worker.shape)
                worker.arrived.append(frame)
                worker.owes = worker.owes[1:]
            elif log_message(message):
                continue
            elif "untried" in message:
                logger.info("A worker cannot draw with EGL: %s", message["untried"])
                # The worker exits and is replaced.
                self._choose_backend()
            elif "error" in message:
                worker.error = unpacked(message["error"])
            else:
                worker.is_tried = True
                worker.shape = (*message["size"], 3)
                self.gl_facts = message["gl"]

    def _end_hanging(self, worker: _Worker, job: _Job) -> None:
        assert worker.child is not None
        seconds = self._timeout.seconds
        logger.error(
            "A render worker hangs: it has drawn nothing for %g seconds and is being "
            "killed. Its threads' stacks:\n%s",
            seconds,
            worker.child.stacks(),
        )
        worker.child.kill()
        how = (
            f"it drew nothing for {seconds:g} seconds and was killed; the log shows "
            "where it hung"
        )
        self._lose(worker, job, "hung", how)

    def _lose(self, worker: _Worker, job: _Job, what: str, how: str) -> None:
        """Replace a lost worker. A second loss at the same frame is an error."""
        worker.end()
        if not worker.is_tried:
            self._choose_backend()
            return
        position = worker.owes.start
        if worker.lost_at == position:
            source = job.drawing.get("trajectory", "the given states")
            # If nothing was ever drawn, this frame did not cause the hang.
            kind = Error if self._has_drawn or what == "died" else GLError
            worker.error = kind(
                f"A worker {what} while drawing frame {job.indices[position]} of "
                f"{source} for the second time: {how}"
            )
        else:
            logger.warning("A render worker %s and is being replaced: %s", what, how)
        worker.lost_at = position


@dataclass(frozen=True)
class _Job:
    """A drawing, the numbers of the frames to draw, and the workers that draw them."""

    drawing: Mapping[str, Any]
    indices: Sequence[int]
    workers: Sequence[_Worker]


class _Worker:
    """A worker's process, which may be a replacement, and its part of a job.

    Attributes:
        child: the process; None if it is not running.
        shape: the shape of its frames.
        arrived: the frames that it has sent and that have not been taken yet.
        owes: the positions of the frames that it still has to send.
        error: the error that replaces the next frame.
        lost_at: the position of the frame at which a process was last lost.
        is_tried: whether its backend is the user's choice, or has passed its test.
    """

    def __init__(self) -> None:
        self.child: Child | None = None
        self.shape = (0, 0, 3)
        self.arrived: collections.deque[Frame] = collections.deque()
        self.owes = range(0)
        self.error: Error | None = None
        self.lost_at: int | None = None
        self.is_tried = False

    @property
    def may_send(self) -> bool:
        """Whether the worker owes a frame and its buffer has room for one."""
        is_full = len(self.arrived) >= _MOST_BUFFERED
        return bool(self.owes) and self.error is None and not is_full

    def leave(self) -> None:
        """Forget the job, ending the process if it has more to send."""
        if self.owes and self.error is None:
            self.end()
        self.owes = range(0)
        self.error = self.lost_at = None
        self.arrived.clear()

    def end(self) -> None:
        """End the process, whatever it is doing. Idempotent."""
        child, self.child = self.child, None
        if child is not None:
            child.end()


def _environment(environ: Mapping[str, str], *, alone: bool) -> dict[str, str]:
    """Return the environment variables for workers.

    `MUJOCO_GL` is left out if a backend must still be chosen.

    Args:
        environ: this process's environment variables.
        alone: whether a single worker may use all CPUs.
    """
    backend = None if rendering_is_off(environ) else backend_in_environment(environ)
    changed = environment_for(backend, environ) if backend else dict(environ)
    if not backend:
        changed.pop("MUJOCO_GL", None)
    if changed.get("LP_NATIVE_VECTOR_WIDTH") == "512":
        logger.warning(
            "Render workers run without LP_NATIVE_VECTOR_WIDTH=512, because Mesa "
            "crashes with it."
        )
        del changed["LP_NATIVE_VECTOR_WIDTH"]
    if not alone:
        # In each worker, Mesa's rasterizer would start one thread per CPU. Even a
        # single extra thread gains nothing, because the worker would wait for it.
        changed.setdefault("LP_NUM_THREADS", "0")
    return changed
