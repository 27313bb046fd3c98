# SPDX-License-Identifier: Apache-2.0
"""A separate process that finishes recordings while a simulation runs.

`Background` runs in the simulation's process, without a thread, a simulator or OpenGL.
It starts the process that does the work, `python -m mjrec.rendering.background OPTIONS`
(a JSON object), and sends it::

    {"expected": "<name>"|null}     a video will have to be rendered; the name is that
                                    of a recording that begins now, if any
    {"recording": "<name>"}         an ended trajectory, or the first part of a clip
    {"waited_for": true}            nothing more will come for now

The process sends::

    {"progress": {"videos_done": 0, "videos": 2, "frames_done": 40, "frames": 2002}}
    {"done": "<recording>", "failures": {"<video or trajectory>": "..."}}
    {"log": ["mjrec.x", 30, "..."]}

When the simulation's process ends, this process exits immediately and leaves the
remaining work unfinished.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..child_python import Child, wait_for_news
from ..errors import Error
from ..formats.video_metadata import note_failure, reason_of
from ..machine import check_workers
from ..messages import Parent, log_message
from ..timeouts import Timeout, timeout_s
from .jobs import Progress, VideoJob, key_of

if TYPE_CHECKING:
    from .finisher import Finisher

# Not `__name__`, which is `__main__` in the child process.
logger = logging.getLogger("mjrec.rendering.background")

_MODULE = "mjrec.rendering.background"
_NICE = 10
_SECONDS_BETWEEN_REPORTS = 0.2
_SECONDS_BETWEEN_LOOKS = 0.05
_SECONDS_TO_LEAVE = 2.0
# The child process itself gives up after one timeout, so wait for several timeouts.
_TIMEOUTS = 3


class Background:
    """Turns ended recordings into trajectories and videos while the caller continues.

    `expect`, or the first recording, starts the process that does the work. That
    process and its workers run until `stop`. If the process dies, a second one
    continues; if that one dies too, the rest stays pending. A process that hangs during
    `wait` is killed and counts as dead. Forked processes must not use this object.

    Args:
        directory: the monitor directory.
        workers: number of processes that draw. None means one for each usable CPU,
            shared by all processes that render into the directory.
        strict: whether a blank video counts as a failure, although it is written.

    Raises:
        InvalidArgument: `workers` is not a valid number of processes.

    Attributes:
        failures: reasons for missing videos, keyed by base name. For an episode without
            a video, the key is the trajectory's base name.
        waiting: the submitted recordings that are not done yet, in order.
    """

    def __init__(
        self,
        directory: str | os.PathLike[str],
        *,
        workers: int | None,
        strict: bool = False,
    ) -> None:
        self._directory = Path(directory).absolute()
        options = {"workers": check_workers(workers), "strict": strict}
        self._options = json.dumps({"directory": str(self._directory), **options})
        self._process_id = os.getpid()
        self._child: Child | None = None
        self._is_waited_for = self._is_prepared = False
        self._progress = Progress()
        self._is_stopped = self._waits_later = False
        # How processes have died. After the second death, no new process is started.
        self._deaths: list[str] = []
        self.failures: dict[str, str] = {}
        # A dict used as an ordered set.
        self.waiting: dict[str, None] = {}

    def expect(self, recording: Path | None = None) -> None:
        """Start all processes ahead of a video that must be rendered. Idempotent.

        Args:
            recording: see `recorder.finishers.Finisher`. Only the first is used.
        """
        is_news = self._child is None or (recording and not self._is_prepared)
        if is_news and not self._was_forked():
            self._is_prepared |= recording is not None
            self._send(expected=None if recording is None else recording.name)

    def submit(self, recording: Path) -> None:
        """Accept an ended trajectory, or a clip, without waiting.

        Later failures are not raised but collected in `failures`. After `stop`, nothing
        is done, and the recording stays as it is.

        Raises:
            Error: this process was forked from the one that owns the object.
        """
        if self._was_forked():
            raise Error(
                f"Process {self._process_id} renders into {self._directory}, but this "
                f"process, {os.getpid()}, was forked from it. Create a separate "
                "monitor here."
            )
        name = Path(recording).name
        self.waiting[name] = None
        self._send(recording=name)

    def wait(self, on_progress: Callable[[Progress], object] = lambda _: None) -> None:
        """Wait until all submitted recordings are done, or the process is gone.

        Recordings that could not be finished are listed in `failures`. Ctrl-C may
        interrupt the wait. Afterwards, `stop` ends the process, and another `wait`
        resumes waiting.

        Args:
            on_progress: called from time to time with a `Progress`.
        """
        if self._was_forked() or self._is_stopped or self._waits_later:
            return
        timeout, cpu_seconds = Timeout(_TIMEOUTS * timeout_s()), 0.0
        while self.waiting and (child := self._child) is not None:
            if not self._is_waited_for:
                # If the process has died, this replaces it.
                self._send(waited_for=True)
                continue
            on_progress(self._progress)
            has_news = timeout.wait(lambda slice_: wait_for_news([child], slice_))
            # While the process itself waits, it polls every second and uses CPU time.
            # If it is blocked forever (by a dead disk, for example), it does not.
            before, cpu_seconds = cpu_seconds, child.cpu_seconds()
            self._listen()
            if cpu_seconds > before:
                timeout.renew()
            elif not has_news and timeout.is_over:
                logger.error(
                    "The process that renders the videos of %s has shown no activity "
                    "for %g seconds and is being killed. Its threads' stacks:\n%s",
                    self._directory,
                    timeout.seconds,
                    child.stacks(),
                )
                child.kill()
                self._replace(f"it hung for {timeout.seconds:g} seconds and was killed")
                timeout.renew()
        on_progress(self._progress)
        if self.waiting:
            reason = f"the rendering process is gone: {self._deaths[-1]}"
            self.failures.update(dict.fromkeys(self.waiting, reason))
            for key in filter(None, map(key_of, self.waiting)):
                video = self._directory / key.shown_name
                # Usually the process has already recorded the reason.
                if reason_of(video) is None:
                    note_failure(video, reason)
            self.waiting.clear()

    @contextlib.contextmanager
    def waiting_at_the_end(
        self, on_progress: Callable[[Progress], object]
    ) -> Iterator[None]:
        """Make `wait` return immediately inside the block, and wait at its end.

        This lets all monitors submit their recordings before the first wait.
        """
        self._waits_later = True
        try:
            yield
        finally:
            self._waits_later = False
        self.wait(on_progress)

    def stop(self) -> None:
        """Stop immediately. Unfinished recordings stay pending. Idempotent."""
        self._is_stopped = True
        child, self._child = self._child, None
        if child is not None and not self._was_forked():
            # Collect the failures that the process has reported, for the manifest.
            with contextlib.suppress(EOFError):
                self._take_from(child)
            if not self.waiting:
                # The process has nothing to clean up.
                child.kill()
            child.end()

    def _was_forked(self) -> bool:
        return os.getpid() != self._process_id

    def _send(self, **message: Any) -> None:
        """Send the process a message, starting it if necessary."""
        if self._is_stopped or len(self._deaths) > 1:
            return
        try:
            if self._child is None:
                environ = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
                self._child = Child(_MODULE, self._options, environ=environ)
        except OSError as error:
            self._replace(f"it could not be started: {error}")
            return
        self._is_waited_for = "waited_for" in message
        self._child.send(**message)
        self._listen()

    def _listen(self) -> None:
        """Read the messages that have arrived."""
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
        """Replace a process that has died, unless it was the second one.

        Args:
            how: how the process died.
        """
        if self._child is not None:
            self._child.end()
            self._child = None
        self._deaths.append(how)
        is_last = len(self._deaths) > 1
        logger.warning(
            "The process that renders the videos of %s is gone%s: %s",
            self._directory,
            "; the videos stay pending" if is_last else "; a new process takes over",
            how,
        )
        for name in list(self.waiting):
            self._send(recording=name)


class Share:
    """A `Background` that several monitors share. None of them stops it."""

    def __init__(self, background: Background) -> None:
        self.expect, self.submit = background.expect, background.submit
        self.wait, self.failures = background.wait, background.failures

    def stop(self) -> None:
        """Do nothing, because other monitors still need the process."""


class _Stopped(BaseException):
    """Raised in the main thread of the process to make it clean up and exit."""


def main() -> None:
    """Finish recordings on behalf of the simulation's process until that ends."""
    # Imported here because the simulation's process does not need it.
    from .pool import WorkerPool

    options = json.loads(sys.argv[1])
    directory = Path(options["directory"])
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    parent = Parent()
    parent.send_warnings()
    with contextlib.suppress(_Stopped, EOFError):
        signal.signal(signal.SIGTERM, _stop)
        first = parent.receive()
        with WorkerPool(options["workers"], directory=directory, forks=True) as pool:
            if "expected" in first:
                # Fork before a second thread exists, which the fork would lose.
                pool.start()
            # The workers create their contexts during the following import.
            from .finisher import Finisher

            parent.listen(_leave)
            _Work(Finisher(pool), parent, directory, options["strict"]).do(first)


def _stop(signum: int, frame: object) -> None:
    del frame
    # Ignore further signals, so that nothing interrupts the cleanup.
    signal.signal(signum, signal.SIG_IGN)
    raise _Stopped


def _leave() -> None:
    # The signal wakes the main thread, wherever that waits. If the thread does not exit
    # in time, the process is terminated after this function returns.
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_SECONDS_TO_LEAVE)


@dataclass
class _Work:
    """The main loop of the process.

    Attributes:
        finisher: finishes the recordings.
        parent: the simulation's process.
        directory: the monitor directory.
        strict: see `Background`.
        is_waited_for: whether the parent is waiting.
        last_report: the time of the last report.
    """

    finisher: Finisher
    parent: Parent
    directory: Path
    strict: bool
    is_waited_for: bool = False
    last_report: float = 0.0

    def do(self, first: Mapping[str, Any]) -> None:
        """Handle the parent's messages and send back the results. Never returns.

        Args:
            first: the first message.
        """
        finisher = self.finisher
        finisher.on_progress = self._look_up
        self._take_in(first)
        while True:
            self._take_in_all()
            if not finisher:
                self._take_in(self.parent.receive())
            elif finisher.is_ready() or self.is_waited_for:
                job, result = finisher.do_next()
                if not finisher:
                    # Do this before notifying the parent, which may then end this
                    # process.
                    finisher.pool.rest()
                self.parent.send(progress=vars(finisher.progress))
                failures = {**result.failures, **result.blank}
                self.parent.send(done=job.recording, failures=failures)
            else:
                # The simulation is still writing the model.
                time.sleep(_SECONDS_BETWEEN_LOOKS)

    def _take_in_all(self) -> None:
        while self.parent.has_said_something:
            self._take_in(self.parent.receive())

    def _take_in(self, message: Mapping[str, Any]) -> None:
        self.is_waited_for = "waited_for" in message
        if "expected" in message:
            self.finisher.pool.start()
            if (name := message["expected"]) is not None:
                # The recording may still be running.
                self.finisher.pool.prepare(self.directory / name)
        elif "recording" in message:
            name, at = message["recording"], self.directory
            job = VideoJob(directory=at, recording=name, strict=self.strict)
            if key_of(name) is None or not self.finisher.add(job):
                self.parent.send(done=name, failures={})

    def _look_up(self, progress: Progress) -> None:
        """Read the parent's messages and report progress while work is in progress."""
        now = time.monotonic()
        if now - self.last_report >= _SECONDS_BETWEEN_REPORTS:
            self.last_report = now
            self._take_in_all()
            # The parent reads only while it waits, and a pipe's buffer is small.
            if self.is_waited_for:
                self.parent.send(progress=vars(progress))


if __name__ == "__main__":
    main()
