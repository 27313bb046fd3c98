# SPDX-License-Identifier: Apache-2.0
"""Finishing recordings beside a simulation, in a process of its own.

`Background` lives in the simulation's process and does next to nothing there: no
thread, no simulator and no OpenGL comes into it. It starts the process that does the
work, `python -m mjrec.rendering.background DIRECTORY --workers N|auto [--strict]`, and
sends it::

    {"expected": "<name>"|null}     a video will have to be rendered, that of a
                                    recording which begins now, where it has one
    {"recording": "<name>"}         an ended trajectory, or the first part of a clip
    {"waited_for": true}            nothing more comes for now

The process sends::

    {"progress": {"videos_done": 0, "videos": 2, "frames_done": 40, "frames": 2002}}
    {"done": "<recording>", "failures": {"<video or trajectory>": "..."}}
    {"log": ["mjrec.x", 30, "..."]}

It ends at once, leaving the rest as it is, when the simulation's process does.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..child_python import Child, wait_for_news
from ..errors import Error
from ..formats.monitor_directory import infix_of
from ..machine import check_workers
from ..messages import log_message
from ..parent import Parent
from ..timeouts import Timeout, timeout_s
from .jobs import Progress, VideoJob, key_of

if TYPE_CHECKING:
    from .finisher import Finisher

# Not `__name__`, which is `__main__` in the process.
logger = logging.getLogger("mjrec.rendering.background")

_MODULE = "mjrec.rendering.background"
_NICE = 10
_SECONDS_BETWEEN_REPORTS = 0.2
_SECONDS_BETWEEN_LOOKS = 0.05
_SECONDS_TO_LEAVE = 2.0
# What the process waits for itself, it gives up after one timeout.
_PATIENCES = 3


class Background:
    """Turns ended recordings into trajectories and videos, beside the caller.

    `expect`, or the first recording, starts the process that does it, which stays with
    its workers until `stop`. Where it dies, another one goes on with what is left; what
    that one does not do either is left pending. One that hangs while it is waited for
    is ended and has died. It belongs to the process that made this object.

    Args:
        directory: the monitor directory.
        workers: how many processes draw; None is one for each CPU that can be used,
            shared by all that render into the directory.
        strict: whether a video that shows nothing counts as one that could not be
            rendered, though it is there.

    Raises:
        InvalidArgument: `workers` is no number of processes.

    Attributes:
        failures: why videos could not be rendered, by their base names; for an episode
            without a video, that of the trajectory.
        waiting: the recordings that were taken over and are not done, in their order.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        workers: int | None,
        strict: bool = False,
    ) -> None:
        self._directory = Path(directory).absolute()
        count = str(check_workers(workers) or "auto")
        self._arguments = [str(self._directory), "--workers", count]
        self._arguments += ["--strict"] * strict
        self._process_id = os.getpid()
        self._child: Child | None = None
        self._is_waited_for = self._is_prepared = False
        self._progress = Progress()
        self._is_stopped = self._waits_later = False
        # How processes have died; the second death is the last.
        self._deaths: list[str] = []
        self.failures: dict[str, str] = {}
        # A dictionary for its order.
        self.waiting: dict[str, None] = {}

    def share(self) -> Share:
        """Return what one of several monitors has of it."""
        return Share(self)

    def expect(self, recording: Path | None = None) -> None:
        """Start all processes: a video will have to be rendered. Idempotent.

        Args:
            recording: as of `recorder.finishers.Finisher`. Only the first is used.
        """
        is_news = self._child is None or (recording and not self._is_prepared)
        if is_news and not self._was_forked():
            self._is_prepared |= recording is not None
            self._send(expected=None if recording is None else recording.name)

    def submit(self, recording: Path) -> None:
        """Take over an ended trajectory, or a clip. Never waits, raises no failure.

        After `stop` nothing is done: the recording stays as it is.

        Raises:
            Error: in a process forked from the one that this belongs to.
        """
        if self._was_forked():
            raise Error(
                f"Process {self._process_id} renders into {self._directory}, and this "
                f"is {os.getpid()}, forked from it. Make a monitor of its own here."
            )
        name = Path(recording).name
        self.waiting[name] = None
        self._send(recording=name)

    def wait(self, on_progress: Callable[[Progress], object] = lambda _: None) -> None:
        """Return when all that was taken over is done, or the process has died.

        What could not be done is in `failures`. May be interrupted (Ctrl-C); then
        `stop` ends it, and another `wait` waits on.

        Args:
            on_progress: called now and then with a `Progress`.
        """
        if self._was_forked() or self._is_stopped or self._waits_later:
            return
        timeout, cpu_seconds = Timeout(_PATIENCES * timeout_s()), 0.0
        while self.waiting and (child := self._child) is not None:
            if not self._is_waited_for:
                self._send(waited_for=True)
                self._is_waited_for = True
            on_progress(self._progress)
            has_news = timeout.wait(lambda slice_: wait_for_news([child], slice_))
            # What it waits for itself, it looks at every second. Blocked for good, by
            # a disk that does not answer for example, it uses no CPU.
            before, cpu_seconds = cpu_seconds, child.cpu_seconds()
            self._listen()
            if cpu_seconds > before:
                timeout.renew()
            elif not has_news and timeout.is_over:
                logger.error(
                    "The process that renders the videos of %s has given no sign of "
                    "life for %g seconds, and is ended. What its threads were at:\n%s",
                    self._directory,
                    timeout.seconds,
                    child.stacks(),
                )
                child.kill()
                self._replace(f"it hung for {timeout.seconds:g} seconds and was ended")
                timeout.renew()
        on_progress(self._progress)
        if self.waiting:
            reason = f"the process that renders is gone: {self._deaths[-1]}"
            self.failures.update(dict.fromkeys(self.waiting, reason))
            self.waiting.clear()

    @contextlib.contextmanager
    def waiting_at_the_end(
        self, on_progress: Callable[[Progress], object]
    ) -> Iterator[None]:
        """Let no monitor wait inside the block, and wait for all at its end.

        The process is waited for once all monitors have said what there is.
        """
        self._waits_later = True
        try:
            yield
        finally:
            self._waits_later = False
        self.wait(on_progress)

    def stop(self) -> None:
        """Stop at once; what is not done stays pending. Idempotent."""
        self._is_stopped = True
        child, self._child = self._child, None
        if child is not None and not self._was_forked():
            # What it has told of failures belongs into the manifest.
            with contextlib.suppress(EOFError):
                self._take_from(child)
            if not self.waiting:
                # There is nothing that it would have to clean up.
                child.kill()
            child.end()

    def _was_forked(self) -> bool:
        return os.getpid() != self._process_id

    def _send(self, **message: Any) -> None:
        """Send the process something; it is started if need be."""
        if self._is_stopped or len(self._deaths) > 1:
            return
        try:
            if self._child is None:
                self._child = Child(_MODULE, *self._arguments, environ=_environ())
        except OSError as error:
            self._replace(f"it could not be started: {error}")
            return
        self._is_waited_for = False
        self._child.send(**message)
        self._listen()

    def _listen(self) -> None:
        """Take what was sent."""
        if (child := self._child) is not None:
            try:
                self._take_from(child)
            except EOFError:
                self._replace(f"it {child.last_words()}")

    def _take_from(self, child: Child) -> None:
        while (message := child.receive()) is not None:
            assert isinstance(message, dict)
            if log_message(message):
                continue
            if "progress" in message:
                self._progress = Progress(**message["progress"])
            else:
                self.waiting.pop(message["done"], None)
                self.failures.update(message["failures"])

    def _replace(self, how: str) -> None:
        """Let another process do what one that has died left; it is the last."""
        if self._child is not None:
            self._child.end()
            self._child = None
        self._deaths.append(how)
        is_last = len(self._deaths) > 1
        logger.warning(
            "The process that renders the videos of %s is gone%s: %s",
            self._directory,
            ", and they stay pending" if is_last else ", and another one goes on",
            how,
        )
        for name in list(self.waiting):
            self._send(recording=name)


class Share:
    """What one of several monitors has of a `Background`, which it does not stop."""

    def __init__(self, background: Background) -> None:
        self._background = background
        self._infixes: set[str | None] = set()
        self.expect = background.expect
        self.wait = background.wait

    @property
    def failures(self) -> Mapping[str, str]:
        """Why videos of this monitor could not be rendered, by their base names."""
        failures = self._background.failures.items()
        return {name: why for name, why in failures if infix_of(name) in self._infixes}

    def submit(self, recording: Path) -> None:
        """Take over an ended recording; see `Background.submit`."""
        self._infixes.add(infix_of(Path(recording).name))
        self._background.submit(recording)

    def stop(self) -> None:
        """Do nothing: other monitors go on."""


class _Stopped(BaseException):
    """Raised in the main thread of the process, wherever it is: clean up and leave."""


def main() -> None:
    """Finish the recordings that the simulation's process names, until it ends."""
    # Not at the top: the simulation's process needs none of it.
    from .pool import WorkerPool

    parser = argparse.ArgumentParser()
    parser.add_argument("directory", type=Path)
    parser.add_argument("--workers", required=True)
    parser.add_argument("--strict", action="store_true")
    arguments = parser.parse_args()
    directory = arguments.directory
    workers = None if arguments.workers == "auto" else int(arguments.workers)
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    parent = Parent()
    parent.send_warnings()
    with contextlib.suppress(_Stopped, EOFError):
        signal.signal(signal.SIGTERM, _stop)
        first = parent.receive()
        pool = WorkerPool(workers, directory=directory, forks=True)
        with contextlib.closing(pool):
            if "expected" in first:
                # Before there is a second thread, which a fork would not have. What is
                # in the way is said when there is something to draw.
                with contextlib.suppress(Error):
                    pool.start()
            # They make their contexts while the rest is imported.
            from .finisher import Finisher

            finisher = Finisher(pool)
            parent.listen(_leave)
            _Work(finisher, directory, parent, strict=arguments.strict).do(first)


def _stop(signum: int, frame: object) -> None:
    del frame
    # One is enough, and cleaning up must not be disturbed.
    signal.signal(signum, signal.SIG_IGN)
    raise _Stopped


def _leave() -> None:
    # To the main thread, wherever it waits. Should it not come out of that, it is of no
    # use any more.
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_SECONDS_TO_LEAVE)


class _Work:
    """What the process does.

    Args:
        finisher: does it.
        directory: the monitor directory.
        parent: the simulation's process.
        strict: as of `Background`.
    """

    def __init__(
        self, finisher: Finisher, directory: Path, parent: Parent, *, strict: bool
    ) -> None:
        self._finisher = finisher
        self._directory = directory
        self._parent = parent
        self._strict = strict
        self._is_waited_for = False
        self._last_report = 0.0
        finisher.on_progress = self._look_up

    def do(self, first: Mapping[str, Any]) -> None:
        """Do what the parent sends, and send the results, to the process's end."""
        finisher = self._finisher
        self._take_in(first)
        while True:
            self._take_in_all()
            if not finisher:
                self._take_in(self._parent.receive())
            elif finisher.is_ready() or self._is_waited_for:
                job, result = finisher.do_next()
                if not finisher:
                    # Before the parent knows: it may end this process then.
                    finisher.rest()
                self._parent.send(progress=vars(finisher.progress))
                failures = {**result.failures, **result.blank}
                self._parent.send(done=job.recording, failures=failures)
            else:
                # The simulation is still writing the model.
                time.sleep(_SECONDS_BETWEEN_LOOKS)

    def _take_in_all(self) -> None:
        while self._parent.has_said_something:
            self._take_in(self._parent.receive())

    def _take_in(self, message: Mapping[str, Any]) -> None:
        self._is_waited_for = "waited_for" in message
        if "expected" in message:
            self._finisher.start_workers()
            if (name := message["expected"]) is not None:
                self._finisher.prepare(self._directory / name)
        elif "recording" in message:
            name = message["recording"]
            job = VideoJob(
                directory=self._directory, recording=name, strict=self._strict
            )
            if key_of(name) is None or not self._finisher.add(job):
                self._parent.send(done=name, failures={})

    def _look_up(self, progress: Progress) -> None:
        """Listen and report, in the midst of work."""
        now = time.monotonic()
        if now - self._last_report >= _SECONDS_BETWEEN_REPORTS:
            self._last_report = now
            self._take_in_all()
            # It is read only then, and a pipe's room is limited.
            if self._is_waited_for:
                self._parent.send(progress=vars(progress))


def _environ() -> dict[str, str]:
    """Return the environment variables of the process."""
    environ = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    # Beside a simulation a single worker, too, has one CPU to itself and no more: the
    # threads of Mesa's rasteriser would get in the way of the steps.
    environ.setdefault("LP_NUM_THREADS", "0")
    return environ


if __name__ == "__main__":
    main()
