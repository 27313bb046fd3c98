# SPDX-License-Identifier: Apache-2.0
"""Rendering beside a simulation: the half that lives in the simulation's process.

The other half is a process of its own, `render_server`, and this one does next to
nothing: it starts that process, writes it names of trajectories, and listens when it
is told to wait. No thread, no simulator and no OpenGL comes into this process.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import subprocess
import tempfile
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from ..child_python import (
    environment_of_child,
    python_command,
    said_in,
    stacks_said_in,
)
from ..errors import Error
from ..patience import Patience, patience_s
from .progress import Progress
from .shared_pool import check_workers

logger = logging.getLogger(__name__)

# The line that ends the names. It is none of a trajectory.
ALL_SAID = "that was all"

_MODULE = "mjrec.rendering.render_server"
_READ_SIZE = 1 << 16
_SECONDS_TO_STOP = 3.0
_END_OF_STDERR = 1500
# What the server waits for itself, it gives up after one patience.
_PATIENCES = 3

# A forked child shares the pipes, which would then never end for the server.
_services: weakref.WeakSet[RenderService] = weakref.WeakSet()


class RenderService:
    """Turns ended trajectories into finished ones and into videos, beside the caller.

    The first trajectory starts the process that does it. Where that dies, another one
    goes on with what is left; what that one does not do either is left pending. One
    that hangs while it is waited for is ended and has died. The service belongs to the
    process that made it.

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
        self._arguments = _arguments(self._directory, check_workers(workers), strict)
        self._process_id = os.getpid()
        self._server: _Server | None = None
        # A dictionary for its order.
        self._waiting: dict[str, None] = {}
        # What came after an interrupted wait had said that there was no more.
        self._late: list[str] = []
        self._progress = Progress()
        self._stopped = False
        # How the first one went, and how the last.
        self._first_death: str | None = None
        self._death: str | None = None
        self.failures: dict[str, str] = {}
        _services.add(self)

    @property
    def waiting(self) -> list[str]:
        """The trajectories that were taken over and are not done, in their order."""
        return list(self._waiting)

    def submit(self, trajectory: Path) -> None:
        """Take over an ended trajectory. Never waits, and raises no failure.

        After `stop` nothing is done: the trajectory stays as it is.

        Raises:
            Error: in a process forked from the one that made the service.
        """
        self._check_process()
        name = Path(trajectory).name
        self._waiting[name] = None
        if self._stopped or self._death is not None:
            return
        if self._server is not None and self._server.all_said:
            self._late.append(name)
        else:
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
        while (server := self._server) is not None:
            server.say_all_said()
            self._wait_for_end(server, on_progress)
            on_progress(self._progress)
            server.stop()
            if self._server is server:
                self._server = None
            while self._late and self._death is None:
                self._say(self._late.pop(0))
        if self._waiting:
            self._fail_rest()

    def stop(self) -> None:
        """Stop at once; what is not done stays pending. Idempotent."""
        self._stopped = True
        if self._server is not None and not self._was_forked():
            # What it has told of failures belongs into the manifest.
            for message in self._server.messages():
                self._take(message)
            self._server.stop()
            self._server = None

    def _say(self, name: str) -> None:
        try:
            if self._server is None:
                self._server = _Server(self._arguments)
            self._server.say(name)
        except OSError as error:
            self._note_death(f"it could not be started: {error}")
            return
        self._listen(self._server)

    def _check_process(self) -> None:
        if self._was_forked():
            raise Error(
                f"Process {self._process_id} renders into {self._directory}, and this "
                f"is {os.getpid()}, forked from it. Make a monitor of its own here."
            )

    def _was_forked(self) -> bool:
        return os.getpid() != self._process_id

    def _wait_for_end(
        self, server: _Server, on_progress: Callable[[Progress], object]
    ) -> None:
        patience = Patience(_PATIENCES * patience_s())
        while not server.has_ended():
            on_progress(self._progress)
            server.wait_for_news(patience.begin_slice())
            patience.end_slice()
            if self._listen(server):
                patience.renew()
            elif patience.is_over:
                logger.error(
                    "The process that renders the videos of %s has given no sign of "
                    "life for %g seconds, and is ended. What its threads were at:\n%s",
                    self._directory,
                    patience.seconds,
                    server.stacks(),
                )
                server.end_hanging(patience.seconds)

    def _listen(self, server: _Server) -> bool:
        """Take what was said; return whether it was anything."""
        messages = list(server.messages())
        for message in messages:
            self._take(message)
        if server.has_ended() and len(self._waiting) > len(self._late):
            self._go_on_without(server)
        return bool(messages)

    def _go_on_without(self, server: _Server) -> None:
        """Let another one do what is left, once."""
        how = server.obituary()
        if self._first_death is not None:
            self._note_death(how)
            return
        self._first_death = how
        logger.warning(
            "The process that renders the videos of %s is gone, and another one goes "
            "on: %s",
            self._directory,
            how,
        )
        server.forget()
        self._server = None
        for name in [name for name in self._waiting if name not in self._late]:
            self._say(name)

    def _take(self, message: Mapping[str, Any]) -> None:
        if "progress" in message:
            self._progress = Progress(**message["progress"])
        elif "log" in message:
            logger.log(*message["log"])
        elif "done" in message:
            self._waiting.pop(message["done"], None)
            if message.get("failure"):
                self.failures[message["name"]] = message["failure"]

    def _note_death(self, how: str) -> None:
        if self._death is None:
            self._death = how
            logger.warning(
                "The process that renders the videos of %s is gone: %s The videos "
                "stay pending.",
                self._directory,
                how,
            )

    def _fail_rest(self) -> None:
        reason = f"the process that renders is gone: {self._death}"
        self.failures.update(dict.fromkeys(self._waiting, reason))
        self._waiting.clear()

    def _forget_server(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.forget()


class _Server:
    """The render server, from outside.

    Attributes:
        all_said: nothing more is said to it.

    Raises:
        OSError: it could not be started.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        self._stderr = _scratch_file()
        self._unsaid = b""
        self._unread = b""
        self._ended = False
        self._hung_for: float | None = None
        self.all_said = False
        try:
            self._process = _start(arguments, self._stderr)
        except BaseException:
            if self._stderr is not None:
                self._stderr.close()
            raise
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._to: IO[bytes] = self._process.stdin
        self._from: IO[bytes] = self._process.stdout
        os.set_blocking(self._to.fileno(), False)
        os.set_blocking(self._from.fileno(), False)

    def say(self, line: str) -> None:
        """Send a line, now or, where the pipe is full, with a later one."""
        self._unsaid += f"{line}\n".encode()
        self._send()

    def say_all_said(self) -> None:
        """Say, once, that nothing more is said."""
        if not self.all_said:
            self.all_said = True
            self.say(ALL_SAID)

    def messages(self) -> Iterator[Mapping[str, Any]]:
        """Yield what it has said since; never waits."""
        with contextlib.suppress(BlockingIOError):
            while not self._ended:
                block = os.read(self._from.fileno(), _READ_SIZE)
                self._ended = not block
                self._unread += block
                # Before anything else is read: an interruption loses no line.
                while b"\n" in self._unread:
                    line, _, self._unread = self._unread.partition(b"\n")
                    yield said_in(line)

    def wait_for_news(self, seconds: float) -> None:
        """Wait until it says something or ends, or so many seconds have passed."""
        poll = select.poll()
        poll.register(self._from, select.POLLIN)
        if self._unsaid:
            poll.register(self._to, select.POLLOUT)
        poll.poll(seconds * 1000)
        self._send()

    def stacks(self) -> str:
        """Return what the threads of one that hangs are at, for the log."""
        if self._stderr is None:
            return "(nobody could hear it)"
        return stacks_said_in(self._stderr, self._process.pid)

    def end_hanging(self, seconds: float) -> None:
        """End it, and say in the obituary that it hung for so long."""
        self._hung_for = seconds
        self.kill()

    def kill(self) -> None:
        """End it at once, with its children, who may hang as well."""
        if self._process.poll() is None:
            # Stopped, it starts no other and waits for none: their numbers stay theirs.
            self._process.send_signal(signal.SIGSTOP)
            for pid in [*_children(self._process.pid), self._process.pid]:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)

    def has_ended(self) -> bool:
        """Whether nothing more will come from it."""
        return self._ended

    def obituary(self) -> str:
        """Return how it ended, and its last words."""
        self._end()
        status = self._process.returncode
        if self._hung_for is not None:
            how = f"it hung for {self._hung_for:g} seconds and was ended."
        elif status is None:
            how = "it cannot be ended."
        elif status < 0:
            how = f"it was killed ({signal.Signals(-status).name})."
        else:
            how = f"its exit status is {status}."
        words = self._last_words()
        return f"{how} The end of what it said: {words}" if words else how

    def stop(self) -> None:
        """End it, by force where need be, and let go. May be called again."""
        if not self._ended:
            with contextlib.suppress(OSError):
                self._to.close()
            self._process.terminate()
        self._end()
        self.forget()

    def forget(self) -> None:
        """Close this process's ends of the pipes."""
        with contextlib.suppress(OSError):
            self._to.close()
        self._from.close()
        if self._stderr is not None:
            self._stderr.close()
        # In a forked child it is somebody else's process, which nobody here waits for.
        if self._process.returncode is None:
            self._process.returncode = 0

    def _send(self) -> None:
        # One that is gone is noticed when its end of the other pipe is read.
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            while self._unsaid:
                sent = os.write(self._to.fileno(), self._unsaid)
                self._unsaid = self._unsaid[sent:]

    def _end(self) -> None:
        try:
            self._process.wait(_SECONDS_TO_STOP)
        except subprocess.TimeoutExpired:
            self.kill()
            # One whose disk does not answer cannot die.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_SECONDS_TO_STOP)

    def _last_words(self) -> str:
        if self._stderr is None:
            return ""
        descriptor = self._stderr.fileno()
        begin = max(0, os.fstat(descriptor).st_size - _END_OF_STDERR)
        # Not by seeking: the position is the server's too.
        said = os.pread(descriptor, _END_OF_STDERR, begin)
        return said.decode(errors="replace").strip()


def _arguments(directory: Path, workers: int | None, strict: bool) -> list[str]:
    arguments = [str(directory), "--workers", str(workers or "auto")]
    return [*arguments, "--strict"] if strict else arguments


def _start(
    arguments: Sequence[str], stderr: IO[bytes] | None
) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [*python_command(_MODULE), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=stderr or subprocess.DEVNULL,
        bufsize=0,
        env=environment_of_child(os.environ),
        # Ctrl-C in a terminal is the simulation's to handle.
        start_new_session=True,
    )


def _children(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += map(int, task.read_text().split())
    return found


def _scratch_file() -> IO[bytes] | None:
    """Return a file for what the server says; None where there is no room for one."""
    try:
        return tempfile.TemporaryFile()
    except OSError:
        return None


def _forget_servers_of_the_parent() -> None:
    for service in list(_services):
        service._forget_server()


os.register_at_fork(after_in_child=_forget_servers_of_the_parent)
