# SPDX-License-Identifier: Apache-2.0
"""Rendering beside a simulation: the half that lives in the simulation's process.

The other half is a process of its own, `background_process`, and this one does next to
nothing: it starts that process, writes it names of recordings, and listens when it is
told to wait. No thread, no simulator and no OpenGL comes into this process.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ..child_python import Child, LineWriter, said_in
from ..errors import Error
from ..formats.monitor_directory import infix_of
from ..patience import Patience, patience_s
from .jobs import Progress
from .pool import check_workers

logger = logging.getLogger(__name__)

# Lines that are no names of recordings: nothing comes for now, or a video will.
ALL_SAID = "that was all"
EXPECTED = "a video is expected"

_MODULE = "mjrec.rendering.background_process"
_READ_SIZE = 1 << 16
# What the process waits for itself, it gives up after one patience.
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
        self._process: _Process | None = None
        self._progress = Progress()
        self._is_stopped = self._waits_later = False
        # How processes have died, the second of which was the last.
        self._deaths: list[str] = []
        self.failures: dict[str, str] = {}
        # A dictionary for its order.
        self.waiting: dict[str, None] = {}

    def share(self) -> Share:
        """Return what one of several monitors has of it."""
        return Share(self)

    def expect(self) -> None:
        """Start all processes: a video will have to be rendered. Idempotent."""
        if self._process is None and not self._was_forked():
            self._say(EXPECTED)

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
        self._say(name)

    def wait(self, on_progress: Callable[[Progress], object] = lambda _: None) -> None:
        """Return when all that was taken over is done, or the process has died.

        What could not be done is in `failures`. May be interrupted (Ctrl-C); then
        `stop` ends it, and another `wait` waits on.

        Args:
            on_progress: called now and then with a `Progress`.
        """
        if self._was_forked() or self._is_stopped or self._waits_later:
            return
        patience = Patience(_PATIENCES * patience_s())
        while self.waiting and (process := self._process) is not None:
            if not process.knows_all:
                self._say(ALL_SAID)
            on_progress(self._progress)
            process.wait_for_news(patience.begin_slice())
            patience.end_slice()
            if self._listen() or process.has_worked():
                patience.renew()
            elif patience.is_over:
                logger.error(
                    "The process that renders the videos of %s has given no sign of "
                    "life for %g seconds, and is ended. What its threads were at:\n%s",
                    self._directory,
                    patience.seconds,
                    process.child.stacks(),
                )
                process.child.kill()
                self._replace(f"it hung for {patience.seconds:g} seconds and was ended")
                patience.renew()
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
        process, self._process = self._process, None
        if process is not None and not self._was_forked():
            # What it has told of failures belongs into the manifest.
            for message in process.messages():
                self._take(message)
            process.child.end()

    def _was_forked(self) -> bool:
        return os.getpid() != self._process_id

    def _say(self, line: str) -> None:
        """Say a line to the process, which is started if need be."""
        if self._is_stopped or len(self._deaths) > 1:
            return
        try:
            self._process = self._process or _Process(self._arguments)
        except OSError as error:
            self._replace(f"it could not be started: {error}")
            return
        self._process.say(line)
        self._listen()

    def _listen(self) -> bool:
        """Take what was said; return whether it was anything."""
        process = self._process
        if process is None:
            return False
        messages = process.messages()
        for message in messages:
            self._take(message)
        if process.has_ended:
            self._replace(f"it {process.child.last_words()}")
        return bool(messages)

    def _take(self, message: Mapping[str, Any]) -> None:
        if "progress" in message:
            self._progress = Progress(**message["progress"])
        elif "log" in message:
            logger.log(*message["log"])
        elif "done" in message:
            self.waiting.pop(message["done"], None)
            self.failures.update(message["failures"])

    def _replace(self, how: str) -> None:
        """Let another process do what one that has died left; it is the last."""
        if self._process is not None:
            self._process.child.end()
            self._process = None
        self._deaths.append(how)
        is_last = len(self._deaths) > 1
        logger.warning(
            "The process that renders the videos of %s is gone%s: %s",
            self._directory,
            ", and they stay pending" if is_last else ", and another one goes on",
            how,
        )
        for name in list(self.waiting):
            self._say(name)


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


class _Process:
    """The process, from outside.

    Attributes:
        child: the process.
        knows_all: it knows that nothing more comes for now.
        has_ended: nothing more comes from it.
    """

    def __init__(self, arguments: list[str]) -> None:
        self.child = Child(_MODULE, *arguments, environ=os.environ)
        self.knows_all = self.has_ended = False
        self._cpu_seconds = 0.0
        self._lines = LineWriter(self.child.orders.fileno())
        self._unread = b""
        os.set_blocking(self.child.answers.fileno(), False)

    def say(self, line: str) -> None:
        """Send a line, now or, where the pipe is full, with a later one."""
        self.knows_all = line == ALL_SAID
        self._lines.write(f"{line}\n".encode())

    def messages(self) -> list[dict[str, Any]]:
        """Return what it has said since; never waits."""
        while (block := self.child.answers.read(_READ_SIZE)) is not None:
            self._unread += block
            if not block:
                self.has_ended = True
                break
        *lines, self._unread = self._unread.split(b"\n")
        return [said_in(line) for line in lines]

    def has_worked(self) -> bool:
        """Tell whether it has used its CPU since the last call.

        What it waits for itself, it looks at every second. Blocked for good, by a disk
        that does not answer for example, it uses none.
        """
        before = self._cpu_seconds
        with contextlib.suppress(OSError):
            # The kernel's number for the CPU clock of another process.
            self._cpu_seconds = time.clock_gettime((~self.child.pid << 3) | 2)
        return self._cpu_seconds > before

    def wait_for_news(self, seconds: float) -> None:
        """Wait until it says something or ends, or so many seconds have passed."""
        poll = select.poll()
        poll.register(self.child.answers, select.POLLIN)
        if self._lines.is_behind:
            poll.register(self.child.orders, select.POLLOUT)
        poll.poll(seconds * 1000)
