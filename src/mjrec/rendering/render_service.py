# SPDX-License-Identifier: Apache-2.0
"""Rendering beside a simulation: the half that lives in the simulation's process.

The other half is a process of its own, `render_server`, and this one does next to
nothing: it starts that process, writes it names of trajectories, and listens when it
is told to wait. No thread, no simulator and no OpenGL comes into this process.
"""

from __future__ import annotations

import logging
import os
import select
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..child_python import Child, LineWriter, said_in
from ..errors import Error
from ..patience import Patience, patience_s
from .progress import Progress
from .shared_pool import check_workers

logger = logging.getLogger(__name__)

# Lines that are no names of trajectories: nothing comes for now, or a video will.
ALL_SAID = "that was all"
EXPECTED = "a video is expected"

_MODULE = "mjrec.rendering.render_server"
_READ_SIZE = 1 << 16
# What the server waits for itself, it gives up after one patience.
_PATIENCES = 3


class RenderService:
    """Turns ended trajectories into finished ones and into videos, beside the caller.

    `expect`, or the first trajectory, starts the process that does it, which stays with
    its workers until `stop`. Where it dies, another one goes on with what is left; what
    that one does not do either is left pending. One that hangs while it is waited for
    is ended and has died. The service belongs to the process that made it.

    Args:
        directory: the monitor directory.
        workers: how many processes draw; None is one for each CPU that can be used,
            shared by all who render into the directory.
        strict: whether a video that shows nothing counts as one that could not be
            rendered, though it is there.

    Raises:
        InvalidArgument: `workers` is no number of processes.

    Attributes:
        failures: why videos could not be rendered, by their base names; for an episode
            without a video, that of the trajectory.
    """

    def __init__(
        self, directory: Path, *, workers: int | None, strict: bool = False
    ) -> None:
        self._directory = Path(directory).absolute()
        count = str(check_workers(workers) or "auto")
        self._arguments = [str(self._directory), "--workers", count]
        if strict:
            self._arguments.append("--strict")
        self._process_id = os.getpid()
        self._server: _Server | None = None
        # A dictionary for its order.
        self._waiting: dict[str, None] = {}
        self._progress = Progress()
        self._stopped = False
        # How servers have died, the second of which was the last.
        self._deaths: list[str] = []
        self.failures: dict[str, str] = {}

    @property
    def waiting(self) -> list[str]:
        """The trajectories that were taken over and are not done, in their order."""
        return list(self._waiting)

    def expect(self) -> None:
        """Start all processes: a video will have to be rendered. Idempotent."""
        if self._server is None and not self._was_forked():
            self._say(EXPECTED)

    def submit(self, trajectory: Path) -> None:
        """Take over an ended trajectory. Never waits, and raises no failure.

        After `stop` nothing is done: the trajectory stays as it is.

        Raises:
            Error: in a process forked from the one that made the service.
        """
        if self._was_forked():
            raise Error(
                f"Process {self._process_id} renders into {self._directory}, and this "
                f"is {os.getpid()}, forked from it. Make a monitor of its own here."
            )
        name = Path(trajectory).name
        self._waiting[name] = None
        self._say(name)

    def wait(self, on_progress: Callable[[Progress], object] = lambda _: None) -> None:
        """Return when all that was taken over is done, or the server has died.

        What could not be done is in `failures`. May be interrupted (Ctrl-C); then
        `stop` ends it, and another `wait` waits on.

        Args:
            on_progress: called now and then with a `Progress`.
        """
        if self._was_forked() or self._stopped:
            return
        patience = Patience(_PATIENCES * patience_s())
        while self._waiting and (server := self._server) is not None:
            if not server.all_said:
                self._say(ALL_SAID)
            on_progress(self._progress)
            server.wait_for_news(patience.begin_slice())
            patience.end_slice()
            if self._listen():
                patience.renew()
            elif patience.is_over:
                self._end_hanging(server, patience.seconds)
                patience.renew()
        on_progress(self._progress)
        if self._waiting:
            reason = f"the process that renders is gone: {self._deaths[-1]}"
            self.failures.update(dict.fromkeys(self._waiting, reason))
            self._waiting.clear()

    def stop(self) -> None:
        """Stop at once; what is not done stays pending. Idempotent."""
        self._stopped = True
        server, self._server = self._server, None
        if server is not None and not self._was_forked():
            # What it has told of failures belongs into the manifest.
            for message in server.messages():
                self._take(message)
            server.child.end()

    def _was_forked(self) -> bool:
        return os.getpid() != self._process_id

    def _say(self, line: str) -> None:
        """Say a line to the server, which is started if need be."""
        if self._stopped or len(self._deaths) > 1:
            return
        try:
            self._server = self._server or _Server(self._arguments)
        except OSError as error:
            self._note_death(f"it could not be started: {error}")
            return
        self._server.say(line)
        self._listen()

    def _listen(self) -> bool:
        """Take what was said; return whether it was anything."""
        server = self._server
        if server is None:
            return False
        messages = server.messages()
        for message in messages:
            self._take(message)
        if server.has_ended:
            words = server.child.last_words()
            server.child.end()
            self._server = None
            self._note_death(words)
        return bool(messages)

    def _take(self, message: Mapping[str, Any]) -> None:
        if "progress" in message:
            self._progress = Progress(**message["progress"])
        elif "log" in message:
            logger.log(*message["log"])
        elif "done" in message:
            self._waiting.pop(message["done"], None)
            if message.get("failure"):
                self.failures[message["name"]] = message["failure"]

    def _end_hanging(self, server: _Server, seconds: float) -> None:
        logger.error(
            "The process that renders the videos of %s has given no sign of life for "
            "%g seconds, and is ended. What its threads were at:\n%s",
            self._directory,
            seconds,
            server.child.stacks(),
        )
        server.child.kill()
        server.child.end()
        self._server = None
        self._note_death(f"it hung for {seconds:g} seconds and was ended.")

    def _note_death(self, how: str) -> None:
        """Let another one do what is left, once."""
        self._deaths.append(how)
        is_last = len(self._deaths) > 1
        logger.warning(
            "The process that renders the videos of %s is gone%s: %s",
            self._directory,
            ", and they stay pending" if is_last else ", and another one goes on",
            how,
        )
        for name in self.waiting:
            self._say(name)


class _Server:
    """The render server, from outside.

    Attributes:
        child: its process.
        all_said: it knows that nothing more comes for now.
        has_ended: nothing more comes from it.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self, arguments: list[str]) -> None:
        self.child = Child(_MODULE, *arguments, environ=os.environ)
        self.all_said = False
        self.has_ended = False
        self._lines = LineWriter(self.child.orders.fileno())
        self._unread = b""
        os.set_blocking(self.child.answers.fileno(), False)

    def say(self, line: str) -> None:
        """Send a line, now or, where the pipe is full, with a later one."""
        self.all_said = line == ALL_SAID
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

    def wait_for_news(self, seconds: float) -> None:
        """Wait until it says something or ends, or so many seconds have passed."""
        poll = select.poll()
        poll.register(self.child.answers, select.POLLIN)
        if self._lines.is_behind:
            poll.register(self.child.orders, select.POLLOUT)
        poll.poll(seconds * 1000)
