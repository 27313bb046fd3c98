# SPDX-License-Identifier: Apache-2.0
"""Child processes that each run an mjrec module, which creates a `Parent`.

multiprocessing is not used. Its children import the caller's main module (so a script
without a `__main__` guard runs twice) and cannot be started from daemonic processes.
Its forked children inherit OpenGL's locks but not OpenGL's threads.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import select
import signal
import subprocess
import sys
import time
import traceback
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Self

from .messages import (
    MOST_BYTES,
    PIPES_VARIABLE,
    STACKS_SIGNAL,
    Message,
    packed,
    received,
)
from .timeouts import Timeout

# The maximum pipe size for unprivileged users. It holds more than one 480x480 frame.
_PIPE_BYTES = 1 << 20
_MOST_WORDS_READ = 20_000
_LOOKS_FOR_STACKS = 20
_SECONDS_BETWEEN_LOOKS = 0.1
_MOST_WORDS = 1 << 20
_END_OF_WORDS = 2000
_SECONDS_TO_END = 3.0
_LONGEST_PAUSE = 0.02


class Child:
    """A Python process that runs an mjrec module, which creates a `Parent`.

    The process has its own session, so Ctrl-C in the terminal reaches only the parent.
    `end`, leaving the `with` block, garbage collection and interpreter exit end the
    process. It also notices when the parent dies, whatever the cause.

    Args:
        module: the module to run.
        arguments: its command-line arguments.
        environ: its environment variables, except the module search path.
        cwd: its working directory, unless it is forked; None for the parent's.
        is_heard: whether the caller reads the output from the pipe `words`. If False,
            the output is kept in memory, and `last_words` includes its end.
        fork: a function to call in a fork of this process, instead of running the
            module in a new Python process. Only valid if this process has a single
            thread and has not used OpenGL.

    Raises:
        OSError: the process cannot be started.

    Attributes:
        pid: the process id.
        most_bytes: maximum size of a message, larger than any frame. After a message
            that exceeds it, no more messages are received.
    """

    most_bytes = MOST_BYTES

    def __init__(
        self,
        module: str,
        *arguments: str,
        environ: Mapping[str, str],
        cwd: str | None = None,
        is_heard: bool = False,
        fork: Callable[[], object] | None = None,
    ) -> None:
        words, printed = _pipe() if is_heard else _memory()
        their_orders, orders = _pipe()
        answers, their_answers = _pipe()
        pipes = (their_orders, their_answers)
        environ = {**environ, PIPES_VARIABLE: f"{their_orders} {their_answers}"}
        try:
            if fork is not None:
                self.pid = _forked(fork, pipes, printed, environ)
            else:
                process = subprocess.Popen(
                    [*python_command(module), *arguments],
                    env=environment_of_child(environ),
                    cwd=cwd,
                    stdin=subprocess.DEVNULL,
                    stdout=printed,
                    stderr=printed,
                    pass_fds=pipes,
                    start_new_session=True,
                )
                # `_Process` waits for the child, so `subprocess` must not.
                process.returncode = 0
                self.pid = process.pid
        except BaseException:
            for descriptor in (words, orders, answers):
                os.close(descriptor)
            raise
        finally:
            for descriptor in (*pipes, printed):
                os.close(descriptor)
        for pipe in (orders, answers):
            os.set_blocking(pipe, False)
            # The system may refuse to enlarge the pipe.
            with contextlib.suppress(OSError):
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._process = _Process(self.pid)
        self._orders = os.fdopen(orders, "wb", buffering=0)
        self._answers = os.fdopen(answers, "rb", buffering=0)
        self.words: IO[bytes] = os.fdopen(words, "rb", buffering=0)
        self._unsent = b""
        self._messages = received(answers, self.most_bytes)
        files = (self._orders, self._answers, self.words)
        self._end = weakref.finalize(
            self, _end_child, self._process, files, os.getpid()
        )
        _children.add(self)

    def fileno(self) -> int:
        """Return a descriptor that is readable once the child sends data or ends."""
        return self._answers.fileno()

    def send(self, **message: Any) -> None:
        """Send a message without blocking; any part that does not fit is sent later.

        If the child has died, the caller finds out only when it waits for messages.
        """
        self._unsent += b"".join(packed(message))
        self._send_on()

    def receive(self) -> Message | None:
        """Return the child's next message, or None if it has not arrived yet.

        Raises:
            EOFError: the child has ended.
        """
        for message in self._messages:
            return message
        raise EOFError

    def messages(self, seconds: float) -> Iterator[dict[str, Any] | None]:
        """Yield the child's messages until it ends.

        Args:
            seconds: maximum time in seconds without a message. After that, None is
                yielded and the iterator ends.
        """
        timeout = Timeout(seconds)
        while not timeout.is_over:
            if not timeout.wait(lambda slice_: wait_for_news([self], slice_)):
                continue
            try:
                while (message := self.receive()) is not None:
                    if isinstance(message, dict):
                        yield message
            except EOFError:
                return
        yield None

    def stacks(self) -> str:
        """Return the stacks of a hanging child's threads, for the log."""
        before = after = self._size_of_words()
        # The signal kills a child that has not set its handler yet. SIGCONT resumes a
        # child that was only stopped.
        self._process.send_signal(STACKS_SIGNAL)
        self._process.send_signal(signal.SIGCONT)
        for _ in range(_LOOKS_FOR_STACKS):
            time.sleep(_SECONDS_BETWEEN_LOOKS)
            size = self._size_of_words()
            if size == after > before:
                break
            after = size
        return self._words_from(before) or "(no output)"

    def last_words(self) -> str:
        """Return a description of how the child ended, with the end of its output."""
        how = self.how_it_ended()
        # Python's crash report ends with the names of dozens of modules.
        words = self.printed().partition("\nExtension modules:")[0].strip()
        end = words[-_END_OF_WORDS:] or "(nothing)"
        return f"{how}. Its last output: {end}"

    def printed(self) -> str:
        """Return the end of the child's output."""
        return self._words_from(max(0, self._size_of_words() - _MOST_WORDS_READ))

    def how_it_ended(self) -> str:
        """Wait a few seconds for the exit status, and describe it in words."""
        status = self._process.wait(_SECONDS_TO_END)
        if status is None:
            return "is alive but silent"
        if status >= 0:
            return f"ended with status {status}"
        try:
            return f"was killed by {signal.Signals(-status).name}"
        except ValueError:
            return f"was killed by signal {-status}"

    def forget_words(self) -> None:
        """Discard the output so far if it is large."""
        if self._size_of_words() > _MOST_WORDS:
            os.ftruncate(self.words.fileno(), 0)

    def cpu_seconds(self) -> float:
        """Return the child's CPU time in seconds; 0 once it has ended."""
        with contextlib.suppress(OSError):
            # The kernel's clock id for another process's CPU time.
            return time.clock_gettime((~self.pid << 3) | 2)
        return 0.0

    def kill(self) -> None:
        """Kill the child and its own children, which may hang too; `end` cleans up."""
        children = _pids_of_children(self.pid)
        self._process.send_signal(signal.SIGKILL)
        for pid in children:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)

    def end(self) -> None:
        """End the child, by force if it does not end on its own. Idempotent."""
        _children.discard(self)
        self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    def _send_on(self) -> None:
        try:
            while self._unsent:
                written = os.write(self._orders.fileno(), self._unsent)
                self._unsent = self._unsent[written:]
        except BlockingIOError:
            return
        except (OSError, ValueError):
            self._unsent = b""

    def _size_of_words(self) -> int:
        return os.fstat(self.words.fileno()).st_size

    def _words_from(self, begin: int) -> str:
        # Read without seeking, because the file position is shared with the child.
        output = os.pread(self.words.fileno(), _MOST_WORDS_READ, begin)
        return output.decode(errors="replace").strip()


def wait_for_news(children: Iterable[Child], seconds: float) -> list[Child]:
    """Wait until at least one child sends something or ends, and return such children.

    Args:
        children: the children to wait for.
        seconds: maximum time to wait.
    """
    poll, by_descriptor = select.poll(), {}
    for child in children:
        by_descriptor[child.fileno()] = child
        poll.register(child, select.POLLIN)
        if child._unsent:
            poll.register(child._orders, select.POLLOUT)
            by_descriptor[child._orders.fileno()] = child
    found = []
    for descriptor, _ in poll.poll(1000 * seconds):
        child = by_descriptor[descriptor]
        if descriptor == child.fileno():
            found.append(child)
        else:
            child._send_on()
    return found


class _Process:
    """A child process, with its exit status and a way to send it signals."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._status: int | None = None

    def send_signal(self, signum: int) -> None:
        # Once a process has been waited for, its pid may belong to another process.
        if self.wait(0) is None:
            os.kill(self._pid, signum)

    def wait(self, seconds: float) -> int | None:
        """Return the exit status in `subprocess`'s form, or None if still running."""
        deadline, pause = time.monotonic() + seconds, 0.0005
        while (status := self._poll()) is None:
            rest = deadline - time.monotonic()
            if rest <= 0:
                break
            pause = min(2 * pause, rest, _LONGEST_PAUSE)
            time.sleep(pause)
        return status

    def _poll(self) -> int | None:
        if self._status is None:
            try:
                pid, status = os.waitpid(self._pid, os.WNOHANG)
            except ChildProcessError:
                # If SIGCHLD is ignored, the system keeps no status.
                self._status = 0
            else:
                self._status = os.waitstatus_to_exitcode(status) if pid else None
        return self._status


def _pipe() -> tuple[int, int]:
    """Return both ends of a pipe, as descriptors above those of the standard streams.

    If a standard stream is closed, a new pipe may get its number. The child's own
    standard stream would then replace the pipe.
    """
    ends = os.pipe()
    reading, writing = (fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 3) for end in ends)
    for end in ends:
        os.close(end)
    return reading, writing


def _memory() -> tuple[int, int]:
    """Return two descriptors of an in-memory file."""
    words = os.memfd_create("mjrec-words")
    # In append mode, the file can be emptied while the child writes to it.
    fcntl.fcntl(words, fcntl.F_SETFL, os.O_APPEND)
    return words, os.dup(words)


def _forked(
    run: Callable[[], object],
    pipes: tuple[int, int],
    printed: int,
    environ: Mapping[str, str],
) -> int:
    pid = os.fork()
    if pid:
        return pid
    try:
        os.setsid()
        os.environ.update(environ)
        # Undo the settings that were copied from the parent.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        logging.getLogger().handlers.clear()
        for descriptor in (1, 2):
            os.dup2(printed, descriptor)
        for descriptor in map(int, os.listdir("/proc/self/fd")):  # noqa: PTH208  no paths
            if descriptor > 2 and descriptor not in pipes:
                with contextlib.suppress(OSError):
                    os.close(descriptor)
        run()
        os._exit(0)
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(1)


def _end_child(process: _Process, files: tuple[IO[bytes], ...], owner: int) -> None:
    for file in files:
        with contextlib.suppress(OSError):
            file.close()
    # A forked child has copies of the files, but the process belongs to its parent.
    if os.getpid() == owner:
        process.send_signal(signal.SIGTERM)
        if process.wait(_SECONDS_TO_END) is None:
            process.send_signal(signal.SIGKILL)
            # A process that is blocked by a disk or a driver does not die.
            process.wait(_SECONDS_TO_END)


def _pids_of_children(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += map(int, task.read_text().split())
    return found


_children: weakref.WeakSet[Child] = weakref.WeakSet()


def _leave_all_to_parent() -> None:
    """Close a forked child's copies of the pipes, which would otherwise stay open."""
    for child in list(_children):
        child.end()


os.register_at_fork(after_in_child=_leave_all_to_parent)


def python_command(module: str) -> list[str]:
    """Return the command that runs `module` as a child process.

    Run it with `environment_of_child`, so that it finds the same modules as this
    process. `-P` keeps Python from searching the working directory first, which might
    contain a file called `random.py`.
    """
    return [sys.executable, "-P", "-m", module]


def environment_of_child(environ: Mapping[str, str]) -> dict[str, str]:
    """Return `environ` with this process's module search path in `PYTHONPATH`.

    The path is complete and in order, so the child imports the same mujoco and mjrec,
    no matter how this process found them. The exception is the directory of the main
    script (or the working directory): Python puts it first, but the child searches it
    last.
    """
    first, rest = sys.path[:1], sys.path[1:]
    path = [*rest, *first] if first and _is_of_main(first[0]) else sys.path
    entries = (str(Path(entry).absolute()) for entry in path if isinstance(entry, str))
    # A path that contains the separator cannot be listed in PYTHONPATH.
    entries_said = [entry for entry in entries if os.pathsep not in entry]
    return {**environ, "PYTHONPATH": os.pathsep.join(entries_said)}


def places_of_main() -> list[str]:
    """Return a list with the main script's folder, if modules are imported from it."""
    first = sys.path[:1]
    return [str(Path(each).absolute()) for each in first if _is_of_main(each)]


def _is_of_main(entry: str) -> bool:
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    return entry == "" or (
        file is not None and Path(entry).resolve() == Path(file).resolve().parent
    )


@contextlib.contextmanager
def changed_environ(changes: Mapping[str, str | None]) -> Iterator[None]:
    """Set environment variables inside the block, or remove those that are None.

    After the block, all variables are restored, including those that the block set.
    """
    before = dict(os.environ)
    for name in changes:
        os.environ.pop(name, None)
    os.environ.update({name: v for name, v in changes.items() if v is not None})
    try:
        yield
    finally:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        os.environ.update(before)
