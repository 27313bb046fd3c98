# SPDX-License-Identifier: Apache-2.0
"""Processes that draw pictures, in order, for one caller."""

from __future__ import annotations

import collections
import logging
import os
import selectors
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from ..carried_errors import unpacked
from ..errors import ClosedError, Error, GLError, InvalidArgument
from ..frames import Frame
from ..gl.backends import (
    backend_in_environment,
    environment_for,
    rendering_is_off,
)
from ..patience import Patience
from ..simulation.model_trust import with_all_models_trusted
from .frame_ring import SLOTS, FrameRing
from .views import PlainCamera, View, plain_camera
from .worker_process import WorkerProcess

_LOG = logging.getLogger(__name__)

# Pictures that a worker draws one after the other before it leaves some out. While one
# half of its slots is read, the other half is drawn.
_RUN = SLOTS // 2
_TRIES = 2


class DrawingWorkers:
    """Draws pictures in processes of their own, and gives them in order.

    The processes are started as they are needed and stay until `close`, garbage
    collection or the end of this process. Each keeps at most four pictures that have
    not been asked for yet, however many are to come. One that dies is replaced, and
    what it was drawing is tried once more. One that hangs, having drawn no picture for
    `patience_s` while one was waited for, is ended and counts as dead; where it hung is
    in the log.

    They use the backend that `MUJOCO_GL` names. Where it names none, or turns rendering
    off (which is for the simulation), the first of them chooses one that works, as
    `mjrec.use_gl` does.

    For one thread at a time.

    ::

        with DrawingWorkers(2) as workers:
            for frame in workers.frames(path, range(100), View(height=48, width=64)):
                ...

    Args:
        count: how many processes; more than one use one CPU each.
        trust_models: whether they load compiled models that a stranger wrote; they do
            in any case where `MJREC_TRUST_MODELS` says so here.

    Raises:
        InvalidArgument: `count` is not a whole number of at least 1.
        UnknownName: `MUJOCO_GL` names no backend that there is.
    """

    def __init__(self, count: int, *, trust_models: bool = False) -> None:
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise InvalidArgument(
                f"workers must be a whole number of at least 1, got {count!r}."
            )
        self._environ = _environment(os.environ, alone=count == 1)
        if trust_models:
            self._environ = with_all_models_trusted(self._environ)
        self._seats = [_Seat() for _ in range(count)]
        self._selector = selectors.DefaultSelector()
        self._gl_facts: dict[str, Any] = {}
        self._has_drawn = False
        self._job: _Job | None = None
        self._jobs = 0
        self._closed = False
        self._process_id = os.getpid()

    @property
    def gl_facts(self) -> dict[str, Any]:
        """Who draws, as `gl_strings.current_gl_facts`; empty before anybody did."""
        return dict(self._gl_facts)

    def frames(
        self,
        trajectory: Path,
        indices: Sequence[int],
        view: View | None = None,
        *,
        cameras: Sequence[PlainCamera | None] | None = None,
    ) -> Iterator[Frame]:
        """Return the pictures of a trajectory, in the order of `indices`.

        The first is drawn before this returns. Each is a new array.

        Args:
            trajectory: its file.
            indices: the numbers of the frames, from 0; in any order, also repeated.
            view: how they are wanted; None is as recorded.
            cameras: several in place of that of the view; None among them is as
                recorded. A picture is then all that they show, in a grid.

        Raises:
            UnreadableFile: of the trajectory or its model.
            InvalidArgument: there is no such frame, no such camera in the model, or a
                size that the driver cannot draw.
            GLError: no backend works here, or all that was tried hangs.
            Error: a worker died twice at one picture; the message names the signal and
                what the worker said. Errors at later pictures are raised by the
                iterator, at their places.
        """
        drawing: dict[str, Any] = {
            "trajectory": str(Path(trajectory).absolute()),
            "view": (view or View()).as_json(),
        }
        if cameras is not None:
            drawing["cameras"] = [c if c is None else plain_camera(c) for c in cameras]
        return self.pictures(drawing, indices)

    def pictures(
        self, drawing: Mapping[str, Any], indices: Sequence[int]
    ) -> Iterator[Frame]:
        """Return the pictures of anything that `drawing.open_drawing` opens.

        As `frames`. Pictures that an earlier call has not given yet are given up.
        """
        self._check_usable()
        self._give_up()
        self._jobs += 1
        job = _Job(self._jobs, dict(drawing), [int(index) for index in indices])
        if not job.indices:
            return iter(())
        self._job = job
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
        if os.getpid() == self._process_id:
            for seat in self._seats:
                self._dismiss(seat)
                seat.ring.close()
        self._selector.close()

    def __enter__(self) -> DrawingWorkers:
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
            raise ClosedError("The drawing workers are closed.")
        if os.getpid() != self._process_id:
            raise ClosedError(
                f"The drawing workers belong to process {self._process_id}: make some "
                "in the process that uses them."
            )

    def _delivered(self, job: _Job) -> Iterator[Frame]:
        try:
            for position in range(len(job.indices)):
                self._settle(job, position)
                seat, slot = job.drawn.pop(position)
                frame = seat.ring.slot(slot).copy()
                seat.free.append(slot)
                # Before the caller has the frame: it may be busy with it for long.
                self._hand_out(job)
                yield frame
        finally:
            if self._job is job and not self._closed:
                self._give_up()

    def _settle(self, job: _Job, position: int) -> None:
        """Wait until a picture is drawn, or raise what there is instead of it."""
        self._check_usable()
        self._listen(0)
        while position not in job.drawn:
            self._check_usable()
            if self._job is not job:
                raise ClosedError("A later call has taken the drawing workers over.")
            if position in job.failed:
                raise job.failed[position]
            self._hand_out(job)
            self._wait_for_news()

    def _wait_for_news(self) -> None:
        """Wait until a worker says something; end those that have not for too long."""
        at_work = [seat for seat in self._seats if seat.owes]
        if not at_work:
            raise Error("No drawing worker was free, and none has anything to do.")
        self._listen(min(seat.patience.begin_slice() for seat in at_work))
        for seat in at_work:
            seat.patience.end_slice()
            if seat.was_heard or not seat.owes:
                seat.renew()
            elif seat.patience.is_over:
                self._end_hanging(seat)

    def _hand_out(self, job: _Job) -> None:
        """Order the next pictures from whoever has room and least to do."""
        while job.waiting:
            run = min(_RUN, -(-len(job.waiting) // len(self._seats)))
            able = [seat for seat in self._seats if len(seat.free) >= run]
            if not able:
                return
            seat = min(able, key=lambda seat: len(seat.owes))
            if seat.process is None and not self._may_start(seat):
                return
            self._order(job, seat, run)

    def _may_start(self, seat: _Seat) -> bool:
        """Start a process, unless it has to wait for the first to choose a backend."""
        knows_backend = "MUJOCO_GL" in self._environ
        if not knows_backend and any(other.process for other in self._seats):
            return False
        seat.process = WorkerProcess(seat.ring, self._environ)
        for pipe in (seat.process.answers, seat.process.words):
            self._selector.register(pipe, selectors.EVENT_READ, seat)
        return True

    def _order(self, job: _Job, seat: _Seat, count: int) -> None:
        assert seat.process is not None
        if not seat.owes:
            seat.renew()
        pictures = []
        for _ in range(count):
            position, slot = job.waiting.popleft(), seat.free.popleft()
            seat.owes[position] = slot
            pictures.append([position, job.indices[position], slot])
        seat.process.send(job=job.number, drawing=job.drawing, pictures=pictures)

    def _listen(self, seconds: float) -> None:
        """Take in what the workers say, waiting so long for it."""
        for key, _ in self._selector.select(seconds):
            seat: _Seat = key.data
            # Another event may have ended it.
            if seat.process is None:
                continue
            if key.fileobj is seat.process.answers:
                self._take_in(seat, seat.process.receive())
            elif not seat.process.listen():
                self._selector.unregister(key.fileobj)

    def _take_in(self, seat: _Seat, answers: list[dict[str, Any]] | None) -> None:
        if answers is None:
            assert seat.process is not None
            self._replace(seat, "died", seat.process.last_words())
            return
        for answer in answers:
            if "log" in answer:
                _LOG.log(answer["log"][0], "%s", answer["log"][1])
                continue
            seat.was_heard = True
            if "backend" in answer:
                self._environ = environment_for(answer["backend"], self._environ)
            elif "job" not in answer:
                self._fail_all(seat, unpacked(answer["error"]))
            elif self._job is not None and answer["job"] == self._job.number:
                self._take_in_of_job(self._job, seat, answer)

    def _take_in_of_job(
        self, job: _Job, seat: _Seat, answer: Mapping[str, Any]
    ) -> None:
        if "size" in answer:
            seat.ring.shape(*answer["size"])
            self._gl_facts = answer["gl"]
            return
        position = answer["position"]
        slot = seat.owes.pop(position)
        if "error" in answer:
            seat.free.append(slot)
            job.failed[position] = unpacked(answer["error"])
        else:
            job.drawn[position] = (seat, slot)
            self._has_drawn = True

    def _fail_all(self, seat: _Seat, error: Error) -> None:
        """Note that a worker cannot draw at all; it is not kept."""
        if self._job is not None:
            self._job.failed.update(dict.fromkeys(seat.owes, error))
        self._dismiss(seat)

    def _end_hanging(self, seat: _Seat) -> None:
        assert seat.process is not None
        _LOG.error(
            "A drawing worker hangs: it has drawn nothing for %g seconds, and is "
            "ended. What its threads were at:\n%s",
            seat.patience.seconds,
            seat.process.stacks(),
        )
        how = (
            f"it drew nothing for {seat.patience.seconds:g} seconds and was ended; "
            "where it hung is in the log"
        )
        # Where nothing was ever drawn, it is not for the sake of this picture.
        kind = Error if self._has_drawn else GLError
        self._replace(seat, "hung", how, kind=kind)

    def _replace(
        self, seat: _Seat, what: str, how: str, *, kind: type[Error] = Error
    ) -> None:
        """Give what a lost worker owed to others, the first of it just once more."""
        owed = sorted(seat.owes)
        self._dismiss(seat)
        if self._job is None or not owed:
            return
        job, first = self._job, owed[0]
        job.losses[first] += 1
        if job.losses[first] >= _TRIES:
            job.failed[first] = kind(
                f"A worker {what} while drawing picture {job.indices[first]} of {job}, "
                f"which was the second try: {how}"
            )
            owed = owed[1:]
        else:
            _LOG.warning("A drawing worker %s and is replaced: %s", what, how)
        job.waiting.extendleft(reversed(owed))

    def _give_up(self) -> None:
        """Want nothing more of the job there is."""
        job, self._job = self._job, None
        if job is None:
            return
        for seat in self._seats:
            if seat.owes and seat.process is not None:
                seat.process.send(cancel=job.number)
            # A worker does one thing after the other: by the time that it draws for
            # another job, it draws nothing of this one.
            seat.clear()

    def _dismiss(self, seat: _Seat) -> None:
        process, seat.process = seat.process, None
        if process is None:
            return
        for pipe in (process.answers, process.words):
            # That of the words is let go of when it ends.
            if pipe in self._selector.get_map():
                self._selector.unregister(pipe)
        process.end()
        seat.free.extend(seat.owes.values())
        seat.owes.clear()


class _Seat:
    """The place of a worker, which another one takes if it dies."""

    def __init__(self) -> None:
        self.process: WorkerProcess | None = None
        # The seat's, not the process's: what one has drawn outlives it.
        self.ring = FrameRing()
        self.patience = Patience()
        self.was_heard = False
        self.clear()

    def renew(self) -> None:
        """Begin to count the time without an answer anew."""
        self.patience.renew()
        self.was_heard = False

    def clear(self) -> None:
        """Forget what was to be drawn."""
        self.free = collections.deque(range(SLOTS))
        # The positions of pictures that are to be drawn, and into which slots.
        self.owes: dict[int, int] = {}


class _Job:
    """What one caller wants.

    A position is a picture's place in the caller's order. Each is waiting, owed by a
    seat, drawn, or failed; or has been given to the caller.
    """

    def __init__(
        self, number: int, drawing: Mapping[str, Any], indices: list[int]
    ) -> None:
        self.number = number
        self.drawing = drawing
        self.indices = indices
        self.waiting = collections.deque(range(len(indices)))
        self.drawn: dict[int, tuple[_Seat, int]] = {}
        self.failed: dict[int, Error] = {}
        # How often a worker was lost over a picture.
        self.losses: collections.Counter[int] = collections.Counter()

    def __str__(self) -> str:
        return str(self.drawing.get("trajectory", "the given states"))


def _environment(environ: Mapping[str, str], *, alone: bool) -> dict[str, str]:
    """Return the environment variables of workers.

    Without `MUJOCO_GL` the worker has to choose a backend.
    """
    backend = None if rendering_is_off(environ) else backend_in_environment(environ)
    changed = environment_for(backend, environ) if backend else dict(environ)
    if not backend:
        changed.pop("MUJOCO_GL", None)
    if changed.get("LP_NATIVE_VECTOR_WIDTH") == "512":
        _LOG.warning(
            "Workers that draw go without LP_NATIVE_VECTOR_WIDTH=512: Mesa crashes "
            "with it."
        )
        del changed["LP_NATIVE_VECTOR_WIDTH"]
    if not alone:
        # Mesa's rasteriser would start as many threads as there are CPUs, in each.
        changed.setdefault("LP_NUM_THREADS", "1")
    return changed
