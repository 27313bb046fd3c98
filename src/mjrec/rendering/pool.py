# SPDX-License-Identifier: Apache-2.0
"""A pool of processes that draw frames, in order, for one caller."""

from __future__ import annotations

import collections
import contextlib
import fcntl
import json
import logging
import os
import selectors
import struct
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from ..carried_errors import unpacked
from ..child_python import Child
from ..errors import ClosedError, Error, GLError, InvalidArgument
from ..frames import Frame
from ..gl.backends import (
    backend_in_environment,
    environment_for,
    rendering_is_off,
)
from ..patience import Patience
from ..simulation.model_trust import with_all_models_trusted
from .views import PlainCamera, View, plain_camera

logger = logging.getLogger(__name__)

# What a worker sends is a kind, the number of the job, and so many bytes.
HEADER = struct.Struct("=cIQ")
FRAME, TEXT = b"F", b"T"

_MOST_BUFFERED = 2
# What users may have without privileges: one frame of 480x480, and more.
_PIPE_BYTES = 1 << 20


class WorkerPool:
    """Draws frames in processes of their own, and gives them in order.

    Of n workers, worker k draws frames k, k+n, k+2n ... of a job and writes them to its
    pipe. Of each at most two frames are kept here that were not asked for yet, however
    many are to come. One that dies is started again at the frame that it owes; the
    second time at one frame is an error. One that hangs, having sent nothing for
    `patience_s` while it was waited for, is ended and counts as dead; where it hung is
    in the log.

    The processes are started as they are needed, or by `start`, and stay until `close`,
    garbage collection or the end of this process.

    They use the backend that `MUJOCO_GL` names. Where it names none, or turns rendering
    off (which is for the simulation), the first of them chooses one that works, as
    `mjrec.use_gl` does.

    For one thread at a time.

    ::

        with WorkerPool(2) as pool:
            for frame in pool.frames(path, range(100), View(height=48, width=64)):
                ...

    Args:
        count: how many processes; more than one use one CPU each.
        trust_models: whether they load compiled models that a stranger wrote; they do
            in any case where `MJREC_TRUST_MODELS` says so here.

    Raises:
        InvalidArgument: `count` is not a whole number of at least 1.
        UnknownName: `MUJOCO_GL` names no backend that there is.

    Attributes:
        limit: how many of them draw the next job, up to `count`. The others stay.
        gl_facts: who draws, as `gl_strings.current_gl_facts`; empty before the first
            frame.
    """

    def __init__(self, count: int, *, trust_models: bool = False) -> None:
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InvalidArgument(
                f"workers must be a whole number of at least 1, got {count!r}."
            )
        self._environ = _environment(os.environ, alone=count == 1)
        if trust_models:
            self._environ = with_all_models_trusted(self._environ)
        self._workers = [_Worker() for _ in range(count)]
        self.limit = count
        self.gl_facts: dict[str, Any] = {}
        self._has_drawn = False
        self._job: _Job | None = None
        self._jobs = 0
        self._closed = False
        self._process_id = os.getpid()

    def start(self) -> None:
        """Start the workers now, so that the first frame comes sooner.

        Raises:
            Error: one cannot be started.
        """
        self._check_usable()
        for worker in self._workers[: self.limit]:
            if worker.child is None and self._can_start_one():
                worker.start(self._environ)

    def frames(
        self,
        trajectory: Path,
        indices: Sequence[int],
        view: View | None = None,
        *,
        cameras: Sequence[PlainCamera | None] | None = None,
    ) -> Iterator[Frame]:
        """Return the frames of a trajectory, in the order of `indices`.

        The first is drawn before this returns. Each is a new array.

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
            "view": (view or View()).as_json(),
        }
        if cameras is not None:
            drawing["cameras"] = [c if c is None else plain_camera(c) for c in cameras]
        return self.frames_of(drawing, indices)

    def frames_of(
        self, drawing: Mapping[str, Any], indices: Sequence[int]
    ) -> Iterator[Frame]:
        """Return the frames of anything that `drawing.open_drawing` opens.

        As `frames`. Frames that an earlier call has not given yet are given up.
        """
        self._check_usable()
        self._give_up()
        if not indices:
            return iter(())
        self._jobs += 1
        self._job = job = _Job(self._jobs, drawing, indices, stride=self.limit)
        for first, worker in enumerate(self._workers[: job.stride]):
            worker.take(job, first)
        try:
            self._settle(job, 0)
        except BaseException:
            self._give_up()
            raise
        return self._delivered(job)

    def close(self) -> None:
        """End the processes at once, whatever they are at. Idempotent."""
        self._closed = True
        self._job = None
        for worker in self._workers:
            worker.end()

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _check_usable(self) -> None:
        if self._closed:
            raise ClosedError("The pool of workers is closed.")
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"The pool of workers belongs to process {self._process_id}: make one "
                "in the process that uses it."
            )

    def _can_start_one(self) -> bool:
        # Where no backend is named, the first one chooses it for all.
        return "MUJOCO_GL" in self._environ or not any(w.child for w in self._workers)

    def _delivered(self, job: _Job) -> Iterator[Frame]:
        try:
            for position in range(len(job.indices)):
                worker = self._settle(job, position)
                frame = worker.arrived.popleft()
                # Before the caller has it: it may be busy with it for long.
                self._listen(job, 0)
                yield frame
        finally:
            if self._job is job and not self._closed:
                self._give_up()

    def _settle(self, job: _Job, position: int) -> _Worker:
        """Return the worker of a position when that frame is there, or raise."""
        worker = self._workers[position % job.stride]
        while True:
            self._check_usable()
            if self._job is not job:
                raise ClosedError("A later call has taken the workers over.")
            if worker.arrived:
                return worker
            if worker.error is not None:
                raise worker.error
            self._order(job)
            self._wait_for_news(job)

    def _order(self, job: _Job) -> None:
        """Let all begin who have not, and can."""
        for worker in self._workers[: job.stride]:
            if not worker.is_at_work:
                if worker.child is None:
                    if not self._can_start_one():
                        return
                    worker.start(self._environ)
                worker.begin()

    def _wait_for_news(self, job: _Job) -> None:
        """Wait until a worker says something; end those that have not for too long."""
        hungry = self._hungry(job)
        seconds = min(worker.patience.begin_slice() for worker in hungry)
        heard = self._listen(job, seconds)
        for worker in hungry:
            worker.patience.end_slice()
            if worker in heard:
                worker.patience.renew()
            elif worker.patience.is_over:
                self._end_hanging(job, worker)

    def _hungry(self, job: _Job) -> list[_Worker]:
        """Return the workers that are drawing and may send more."""
        return [
            worker
            for worker in self._workers[: job.stride]
            if worker.is_at_work and worker.may_send(job)
        ]

    def _listen(self, job: _Job, seconds: float) -> list[_Worker]:
        """Take in what the workers send, waiting so long for it; return who sent."""
        with selectors.PollSelector() as selector:
            for worker in self._hungry(job):
                assert worker.child is not None
                selector.register(worker.child.answers, selectors.EVENT_READ, worker)
            heard = [key.data for key, _ in selector.select(seconds)]
        for worker in heard:
            try:
                self._take_in(job, worker)
            except EOFError:
                self._replace(job, worker, "died", worker.last_words())
            except BaseException:
                # Ctrl-C, in the midst of a message: what follows cannot be understood.
                worker.end()
                raise
        return heard

    def _take_in(self, job: _Job, worker: _Worker) -> None:
        while worker.may_send(job) and (message := worker.next_message()):
            kind, number, content = message
            if kind == FRAME:
                if number == job.number:
                    self._has_drawn = True
                    frame = np.frombuffer(content, np.uint8).reshape(worker.shape)
                    worker.arrived.append(frame)
                    worker.owes += job.stride
                continue
            said = json.loads(content)
            if "log" in said:
                logger.log(said["log"][0], "%s", said["log"][1])
            elif "backend" in said:
                self._environ = environment_for(said["backend"], self._environ)
            elif number == job.number and "error" in said:
                worker.error = unpacked(said["error"])
            elif number == job.number:
                worker.shape = (*said["size"], 3)
                self.gl_facts = said["gl"]

    def _end_hanging(self, job: _Job, worker: _Worker) -> None:
        assert worker.child is not None
        seconds = worker.patience.seconds
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
        self._replace(job, worker, "hung", how, kind=kind)

    def _replace(
        self,
        job: _Job,
        worker: _Worker,
        what: str,
        how: str,
        *,
        kind: type[Error] = Error,
    ) -> None:
        """Let another one begin at the frame that a lost worker owes, just once."""
        worker.end()
        if worker.lost_at == worker.owes:
            worker.error = kind(
                f"A worker {what} while drawing frame {job.indices[worker.owes]} of "
                f"{job}, which was the second try: {how}"
            )
            return
        worker.lost_at = worker.owes
        logger.warning("A drawing worker %s and is replaced: %s", what, how)

    def _give_up(self) -> None:
        """Want nothing more of the job there is."""
        self._jobs += 1
        self._job = None
        for worker in self._workers:
            worker.drop(self._jobs)


class _Worker:
    """A worker's process, which may be a second one, and its part of a job.

    Attributes:
        arrived: the frames that it has sent and that were not taken.
        owes: the position of the next one.
        error: what there is instead of that.
        lost_at: the position that a process before has died at.
    """

    def __init__(self) -> None:
        self.child: Child | None = None
        self.patience = Patience()
        self.shape = (0, 0, 3)
        self.is_at_work = False
        self.arrived: collections.deque[Frame] = collections.deque()
        self.owes = 0
        self.error: Error | None = None
        self.lost_at: int | None = None
        self._job: _Job | None = None

    def start(self, environ: Mapping[str, str]) -> None:
        try:
            self.child = Child("mjrec.rendering.worker", environ=environ)
        except OSError as error:
            raise Error(
                f"No process that draws could be started: {sys.executable!r}: {error}."
            ) from error
        pipe = self.child.answers.fileno()
        os.set_blocking(pipe, False)
        # The system may grant no more than it has.
        with contextlib.suppress(OSError):
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._messages = _Messages(pipe)

    def take(self, job: _Job, first: int) -> None:
        """Take over a part of a job, from the position `first` on."""
        self._job = job
        self.owes = first

    def begin(self) -> None:
        """Tell the process what to draw."""
        assert self._job is not None
        self._send(self._job.order(self.owes))
        self.is_at_work = True
        self.patience.renew()

    def drop(self, later: int) -> None:
        """Forget the job, and let the process stop, whose next job is `later`."""
        if self.is_at_work:
            self._send({"job": later})
        self._job = self.error = self.lost_at = None
        self.is_at_work = False
        self.arrived.clear()

    def may_send(self, job: _Job) -> bool:
        is_done = self.error is not None or self.owes >= len(job.indices)
        return not is_done and len(self.arrived) < _MOST_BUFFERED

    def next_message(self) -> tuple[bytes, int, bytearray] | None:
        assert self.child is not None
        self.child.forget_words()
        return self._messages.next()

    def last_words(self) -> str:
        assert self.child is not None
        return self.child.last_words()

    def end(self) -> None:
        """End the process, whatever it is at. Idempotent."""
        child, self.child = self.child, None
        self.is_at_work = False
        if child is not None:
            child.end()

    def _send(self, order: Mapping[str, Any]) -> None:
        assert self.child is not None
        # One that has died is noticed when it is listened to. At interpreter exit the
        # pipe may be closed.
        with contextlib.suppress(OSError, ValueError):
            self.child.orders.write(json.dumps(order).encode() + b"\n")


class _Job:
    """What one caller wants; a position is a frame's place in the caller's order."""

    def __init__(
        self,
        number: int,
        drawing: Mapping[str, Any],
        indices: Sequence[int],
        *,
        stride: int,
    ) -> None:
        self.number = number
        self.stride = stride
        self.indices = indices
        self._drawing = drawing
        self._runs = _runs(indices)

    def order(self, first: int) -> dict[str, Any]:
        """Return what a worker is told that draws from the position `first` on."""
        return {
            "job": self.number,
            "drawing": self._drawing,
            "runs": self._runs,
            "first": first,
            "stride": self.stride,
        }

    def __str__(self) -> str:
        return str(self._drawing.get("trajectory", "the given states"))


class _Messages:
    """Puts together what comes through a pipe that is never waited for."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._header: tuple[bytes, int, int] | None = None
        self._content = bytearray(HEADER.size)
        self._missing = memoryview(self._content)

    def next(self) -> tuple[bytes, int, bytearray] | None:
        """Return kind, job and content of a whole message; None if there is none yet.

        Raises:
            EOFError: the pipe has ended.
        """
        while True:
            while self._missing:
                try:
                    count = os.readv(self._pipe, [self._missing])
                except BlockingIOError:
                    return None
                if not count:
                    raise EOFError
                self._missing = self._missing[count:]
            content = self._content
            if self._header is not None:
                (kind, job, _), self._header = self._header, None
                self._expect(HEADER.size)
                return kind, job, content
            self._header = HEADER.unpack(content)
            self._expect(self._header[2])

    def _expect(self, size: int) -> None:
        self._content = bytearray(size)
        self._missing = memoryview(self._content)


def _runs(indices: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return first, step and count of each even run in `indices`."""
    if isinstance(indices, range):
        return [(indices.start, indices.step, len(indices))]
    runs: list[tuple[int, int, int]] = []
    for index in map(int, indices):
        first, step, count = runs[-1] if runs else (0, 0, 0)
        if count == 1:
            runs[-1] = (first, index - first, 2)
        elif count > 1 and index == first + step * count:
            runs[-1] = (first, step, count + 1)
        else:
            runs.append((index, 0, 1))
    return runs


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
        # Mesa's rasteriser would start as many threads as there are CPUs, in each.
        changed.setdefault("LP_NUM_THREADS", "1")
    return changed
