# SPDX-License-Identifier: Apache-2.0
"""A pool of processes that draw frames, in order, for one caller.

The machine's CPUs are shared by all processes that render into one directory. A CPU is
a lock file, `.openaigym.render.<number>.lock`; the process that holds it may keep one
worker busy. Eight environments in eight processes that record into one directory on a
machine with two CPUs so have two workers at work, not sixteen.
"""

from __future__ import annotations

import collections
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

from ..child_python import Child, wait_for_news
from ..errors import (
    ClosedError,
    Error,
    GLError,
)
from ..formats.dataclass_json import to_json
from ..formats.locks import Lock, try_lock
from ..formats.monitor_directory import render_lock_name
from ..frames import Frame
from ..gl import backend_for_children
from ..gl.backends import (
    BACKENDS,
    backend_in_environment,
    environment_for,
    rendering_is_off,
)
from ..machine import check_workers, usable_cpus
from ..messages import log_message, unpacked
from ..simulation.model_trust import ALL_MODELS, TRUST_VARIABLE
from ..timeouts import Timeout
from .views import PlainCamera, View, plain_camera

logger = logging.getLogger(__name__)

_MODULE = "mjrec.rendering.worker"
_MOST_BUFFERED = 2
_SECONDS_BETWEEN_TRIES = 0.1


class WorkerPool:
    """Draws frames in processes of their own, and gives them in order.

    Of n workers, worker k draws frames k, k+n, k+2n ... of a job and writes them to its
    pipe. Of each at most two frames are kept here that were not asked for yet, however
    many are to come. One that dies is started again at the frame that it owes; the
    second time at one frame is an error. One that hangs, having sent nothing for
    `timeout_s` while it was waited for, is ended and counts as dead; where it hung is
    in the log.

    The processes are started as they are needed, or by `start`, and stay until `close`,
    garbage collection or the end of this process. Only one that is given up in the
    midst of a job is ended, and started again for the next.

    They use the backend that `MUJOCO_GL` names. Where it names none, or turns rendering
    off (which is for the simulation), each begins with EGL and looks at a frame of its
    own before it draws others'; only where that fails, the first backend that works is
    looked for, as of `mjrec.use_gl`.

    For one thread at a time.

    ::

        with WorkerPool(2) as pool:
            for frame in pool.frames(path, range(100), View(height=48, width=64)):
                ...

    Args:
        workers: how many processes; more than one use one CPU each. None is one for
            each CPU of the directory that is free when a job begins.
        directory: whose CPUs are shared.
        trust_models: whether they load compiled models that a stranger wrote; they do
            in any case where `MJREC_TRUST_MODELS` says so here.
        forks: whether `start` forks this process, which then imports once for all. It
            has a single thread until then, and never uses OpenGL.

    Raises:
        InvalidArgument: `workers` is not a whole number of at least 1.
        UnknownName: `MUJOCO_GL` names no backend that there is.

    Attributes:
        gl_facts: who draws, as `gl_context.current_gl_facts`; empty before the first
            frame.
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
        self._environ = _environment(os.environ, alone=count == 1)
        # The user's backend, or one that was found to work, needs no trial.
        self._is_chosen = "MUJOCO_GL" in self._environ
        if trust_models:
            self._environ[TRUST_VARIABLE] = ALL_MODELS
        self._directory = directory
        # The CPUs of the directory that this process holds.
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
        """Start the workers now, so that the first frame comes sooner. Idempotent.

        Raises:
            DirectoryNotWritable: there can be no lock in the directory.
            Error: one cannot be started.
        """
        self._check_usable()
        for worker in self._workers[: self._free()]:
            self._start(worker)
        self.rest()

    def prepare(self, trajectory: Path) -> None:
        """Let the workers load what a trajectory is drawn with; it may come later.

        Those that are started and have nothing to draw. What fails, fails when frames
        are asked for.
        """
        if self._job is None:
            drawing = {"trajectory": str(trajectory), "view": to_json(View())}
            for worker in self._workers:
                if worker.child is not None:
                    worker.child.send(prepares=drawing)

    def rest(self) -> None:
        """Give the CPUs back: there is nothing to draw. The workers stay."""
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

        The first is drawn before this returns, for which a CPU has to be free. Each is
        a new array.

        Args:
            trajectory: its file.
            indices: the numbers of the frames, from 0; in any order, also repeated.
            view: how they are wanted; None is as recorded.
            cameras: several in place of that of the view; None among them is as
                recorded. A frame is then all that they show, in a grid.

        Raises:
            UnreadableFile: of the trajectory or its model.
            InvalidArgument: there is no such frame, no such camera in the model, or a
                size that the driver cannot draw.
            GLError: no backend works here, or all that was tried hangs.
            Error: a worker died twice at one frame; the message names the signal and
                what the worker said. Errors at later frames are raised by the
                iterator, at their places.
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
        """Return the frames of anything that `worker.open_drawing` opens.

        As `frames`. Frames that an earlier call has not given yet are given up.
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
        """End the processes at once, whatever they are at. Idempotent."""
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
            raise ClosedError("A later call has taken the workers over.")
        if self._closed:
            raise ClosedError("The pool of workers is closed.")
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"The pool of workers belongs to process {self._process_id}: make one "
                "in the process that uses it."
            )

    def _free(self) -> int:
        """Take the CPUs that are free; return how many workers may draw."""
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
            # No directory of others is kept from being removed or unmounted.
            worker.child = Child(
                _MODULE, environ=environ, cwd="/", fork=self._main_of_fork(environ)
            )
        except OSError as error:
            raise Error(
                f"No process that draws could be started: {sys.executable!r}: {error}."
            ) from error
        worker.is_tried = self._is_chosen
        worker.child.send(tries=not self._is_chosen)

    def _main_of_fork(self, environ: Mapping[str, str]) -> Callable[[], object] | None:
        if not self._forks or threading.active_count() > 1:
            return None
        before = dict(os.environ)
        # Read when mujoco is imported.
        os.environ.update(environ)
        try:
            # Not at the top: other processes that have a pool draw nothing.
            from .worker import main
        except Exception:
            # A process of its own says why; or another backend works.
            self._forks = False
            return None
        finally:
            # Which backend is the user's choice is asked again where this one fails.
            os.environ.clear()
            os.environ.update(before)
        return main

    def _choose_backend(self) -> None:
        """Look for the first backend that works; what was imported for EGL is no use.

        Raises:
            GLError: there is none.
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
                # Before the caller has it: it may be busy with it for long.
                self._listen(job, 0)
                yield frame
                self._check_usable(job)
        finally:
            if self._job is job:
                for worker in workers:
                    worker.leave()

    def _order(self, worker: _Worker, job: _Job) -> None:
        """Tell a worker what to draw, and start it if need be."""
        self._start(worker)
        assert worker.child is not None
        indices = [int(job.indices[position]) for position in worker.owes]
        self._timeout.renew()
        worker.child.send(drawing=job.drawing, indices=indices)

    def _wait_for_news(self, job: _Job) -> None:
        """Wait until a worker says something; end those that have not for too long."""
        hungry = [worker for worker in job.workers if worker.may_send]
        for worker in hungry:
            if worker.child is None:
                self._order(worker, job)
        self._timeout.wait(lambda seconds: self._listen(job, seconds))
        if self._timeout.is_over:
            # All that sent more have no room for it, or owe nothing.
            for worker in hungry:
                self._end_hanging(worker, job)
            self._timeout.renew()

    def _listen(self, job: _Job, seconds: float) -> bool:
        """Take in what the workers send, waiting so long for it; tell if they did."""
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
                # Ctrl-C, in the midst of a message: what follows makes no sense.
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
                # It ends, and another one takes its place.
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
            "A drawing worker hangs: it has drawn nothing for %g seconds, and is "
            "ended. What its threads were at:\n%s",
            seconds,
            worker.child.stacks(),
        )
        worker.child.kill()
        how = (
            f"it drew nothing for {seconds:g} seconds and was ended; where it hung is "
            "in the log"
        )
        # Where nothing was ever drawn, it is not for the sake of this frame.
        kind = Error if self._has_drawn else GLError
        self._lose(worker, job, "hung", how, kind=kind)

    def _lose(
        self,
        worker: _Worker,
        job: _Job,
        what: str,
        how: str,
        *,
        kind: type[Error] = Error,
    ) -> None:
        """End a worker's process; the second that is lost at a frame is an error."""
        worker.end()
        if not worker.is_tried:
            self._choose_backend()
            return
        position = worker.owes.start
        if worker.lost_at == position:
            source = job.drawing.get("trajectory", "the given states")
            worker.error = kind(
                f"A worker {what} while drawing frame {job.indices[position]} of "
                f"{source}, which was the second try: {how}"
            )
        else:
            logger.warning("A drawing worker %s and is replaced: %s", what, how)
        worker.lost_at = position


@dataclass(frozen=True)
class _Job:
    """What is drawn, which frames of it, and by which workers."""

    drawing: Mapping[str, Any]
    indices: Sequence[int]
    workers: Sequence[_Worker]


class _Worker:
    """A worker's process, which may be a second one, and its part of a job.

    Attributes:
        child: the process; None where there is none now.
        shape: of its frames.
        arrived: the frames that it has sent and that were not taken.
        owes: the positions of those that are to come.
        error: what there is instead of the next one.
        lost_at: the position at which a process was lost.
        is_tried: its backend is the user's, or has drawn what it should.
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
        """Whether there is something to come, and room for it."""
        is_full = len(self.arrived) >= _MOST_BUFFERED
        return bool(self.owes) and self.error is None and not is_full

    def leave(self) -> None:
        """Forget the job; a process that has more to send of it is ended."""
        if self.owes and self.error is None:
            self.end()
        self.owes = range(0)
        self.error = self.lost_at = None
        self.arrived.clear()

    def end(self) -> None:
        """End the process, whatever it is at. Idempotent."""
        child, self.child = self.child, None
        if child is not None:
            child.end()


def _environment(environ: Mapping[str, str], *, alone: bool) -> dict[str, str]:
    """Return the environment variables of workers.

    Without `MUJOCO_GL` the worker has to choose a backend.
    """
    backend = None if rendering_is_off(environ) else backend_in_environment(environ)
    changed = environment_for(backend, environ) if backend else dict(environ)
    if not backend:
        changed.pop("MUJOCO_GL", None)
    if changed.get("LP_NATIVE_VECTOR_WIDTH") == "512":
        logger.warning(
            "Workers that draw go without LP_NATIVE_VECTOR_WIDTH=512: Mesa crashes "
            "with it."
        )
        del changed["LP_NATIVE_VECTOR_WIDTH"]
    if not alone:
        # Mesa's rasteriser would start as many threads as there are CPUs, in each. One
        # of its own would only be waited for.
        changed.setdefault("LP_NUM_THREADS", "0")
    return changed
