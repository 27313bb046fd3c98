# SPDX-License-Identifier: Apache-2.0
"""Processes of ours that run a module of ours: `Child`, and in there `Parent`.

Not with multiprocessing, whose children import the caller's main module (a script
without a guard would run again), cannot be started from daemonic processes, and with
"fork" inherit OpenGL's locks without its threads.

Both sides send messages: a JSON object, or the bytes of a frame. Errors come home as
JSON (`carried`, `unpacked`): pickle would let a process that writes into the pipe run
code here.
"""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import json
import logging
import os
import queue
import select
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Self, TypeAlias

from .errors import KINDS, Error, rebuilt
from .patience import Patience

logger = logging.getLogger(__name__)

Message: TypeAlias = "dict[str, Any] | bytearray"

# Each message begins with whether it is the bytes of a frame, and its length.
_HEADER = struct.Struct("=?Q")
# What users may have without privileges: one frame of 480x480, and more.
_PIPE_BYTES = 1 << 20

# In the environment of a child: the descriptors that it receives from and sends to.
_PIPES = "MJREC_PARENT"

_STACKS = signal.SIGUSR1
_MOST_WORDS_READ = 20_000
_LOOKS_FOR_STACKS = 20
_SECONDS_BETWEEN_LOOKS = 0.1
_MOST_WORDS = 1 << 20
_END_OF_WORDS = 2000
_SECONDS_TO_END = 3.0
_LONGEST_PAUSE = 0.02


class Child:
    """A Python process that runs a module of ours, and makes a `Parent` there.

    It has a session of its own, so that Ctrl-C in the terminal reaches only the parent.
    It is ended by `end`, by leaving `with`, by garbage collection and at interpreter
    exit; and it notices the parent's end, however that dies.

    Args:
        module: what to run.
        arguments: its command line.
        environ: its environment variables, besides the module search path.
        cwd: its working directory; the parent's, if None.
        is_heard: whether what it prints is to be read from `words`, a pipe, by the
            caller. Else it goes into memory, and its end is one of `last_words`.
        fork: what a fork of this process does in place of a new Python with the module.
            Only where there is a single thread, and OpenGL was not used.

    Raises:
        OSError: it cannot be started.

    Attributes:
        pid: the process's number.
        most_bytes: of a message; what is longer ends them. No frame is.
    """

    most_bytes = 1 << 32

    def __init__(
        self,
        module: str,
        *arguments: str,
        environ: Mapping[str, str],
        cwd: str | None = None,
        is_heard: bool = False,
        fork: Callable[[], object] | None = None,
    ) -> None:
        words, printed = os.pipe() if is_heard else _memory()
        their_orders, orders = os.pipe()
        answers, their_answers = os.pipe()
        pipes = (their_orders, their_answers)
        environ = {**environ, _PIPES: f"{their_orders} {their_answers}"}
        try:
            if fork is None:
                command = [*python_command(module), *arguments]
                self.pid = _started(command, pipes, printed, environ, cwd)
            else:
                self.pid = _forked(fork, pipes, printed, environ, cwd)
        except BaseException:
            for descriptor in (words, orders, answers):
                os.close(descriptor)
            raise
        finally:
            for descriptor in (*pipes, printed):
                os.close(descriptor)
        for pipe in (orders, answers):
            os.set_blocking(pipe, False)
            # The system may grant no more than it has.
            with contextlib.suppress(OSError):
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._process = _Process(self.pid)
        self._orders = os.fdopen(orders, "wb", buffering=0)
        self._answers = os.fdopen(answers, "rb", buffering=0)
        self.words: IO[bytes] = os.fdopen(words, "rb", buffering=0)
        self._unsent = b""
        self._messages = _messages(answers, self.most_bytes)
        files = (self._orders, self._answers, self.words)
        self._end = weakref.finalize(
            self, _end_child, self._process, files, os.getpid()
        )
        _children.add(self)

    def fileno(self) -> int:
        """Return the descriptor that is readable where there is news of it."""
        return self._answers.fileno()

    def send(self, **message: Any) -> None:
        """Send a message. Never waits: what its pipe does not take goes with the next.

        That it has died is noticed where its messages are waited for.
        """
        self._unsent += b"".join(_packed(message))
        self._send_on()

    def receive(self) -> Message | None:
        """Return its next message; None where none is there yet.

        Raises:
            EOFError: it has ended.
        """
        for message in self._messages:
            return message
        raise EOFError

    def messages(self, seconds: float) -> Iterator[dict[str, Any] | None]:
        """Yield its messages until it ends; None once it was silent for so long."""
        patience = Patience(seconds)
        while not patience.is_over:
            if not patience.wait(lambda slice_: wait_for_news([self], slice_)):
                continue
            try:
                while (message := self.receive()) is not None:
                    if isinstance(message, dict):
                        yield message
            except EOFError:
                return
        yield None

    def stacks(self) -> str:
        """Return what the threads of one that hangs are at, for the log."""
        before = after = self._size_of_words()
        # One that has not begun yet dies of it. It may only have been stopped.
        self._process.send_signal(_STACKS)
        self._process.send_signal(signal.SIGCONT)
        for _ in range(_LOOKS_FOR_STACKS):
            time.sleep(_SECONDS_BETWEEN_LOOKS)
            size = self._size_of_words()
            if size == after > before:
                break
            after = size
        return self._words_from(before) or "(it does not say)"

    def last_words(self) -> str:
        """Return what became of it, and the end of what it printed."""
        how = self.how_it_ended()
        # What Python says of a crash ends with the names of dozens of modules.
        words = self.printed().partition("\nExtension modules:")[0].strip()
        end = words[-_END_OF_WORDS:] or "(nothing)"
        return f"{how}. The end of what it said: {end}"

    def printed(self) -> str:
        """Return the end of what it has printed."""
        return self._words_from(max(0, self._size_of_words() - _MOST_WORDS_READ))

    def how_it_ended(self) -> str:
        """Return in words its exit status, for which it is waited some seconds."""
        status = self._process.wait(_SECONDS_TO_END)
        if status is None:
            return "lives, and is silent"
        if status >= 0:
            return f"ended with status {status}"
        try:
            return f"was killed by {signal.Signals(-status).name}"
        except ValueError:
            return f"was killed by signal {-status}"

    def forget_words(self) -> None:
        """Drop what it has printed, if that is much."""
        if self._size_of_words() > _MOST_WORDS:
            os.ftruncate(self.words.fileno(), 0)

    def cpu_seconds(self) -> float:
        """Return how many seconds it has used a CPU; 0 once it has ended."""
        with contextlib.suppress(OSError):
            # The kernel's number for the CPU clock of another process.
            return time.clock_gettime((~self.pid << 3) | 2)
        return 0.0

    def terminate(self) -> None:
        """Ask it to end. It is not waited for."""
        self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Kill it and its children, which may hang as well; `end` does the rest."""
        children = _pids_of_children(self.pid)
        self._process.send_signal(signal.SIGKILL)
        for pid in children:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)

    def end(self) -> None:
        """End it, by force where it does not end by itself. Idempotent."""
        _children.discard(self)
        self._end()

    @property
    def has_ended(self) -> bool:
        """Whether `end` was called."""
        return not self._end.alive

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
        # Not by seeking: the position is the child's too.
        said = os.pread(self.words.fileno(), _MOST_WORDS_READ, begin)
        return said.decode(errors="replace").strip()


def wait_for_news(children: Iterable[Child], seconds: float) -> list[Child]:
    """Wait until one of them sends something or ends; return those that did."""
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


class Parent:
    """The process that started this one, as its `Child`.

    Not through the standard input, which is empty, and the standard output, which is
    the standard error: libraries and drivers print whenever they like. What this
    process starts or forks cannot speak to it.

    Asked by `Child.stacks`, and when it dies of a signal such as SIGSEGV, this process
    writes what its threads are at to the standard error.
    """

    def __init__(self) -> None:
        faulthandler.enable()
        faulthandler.register(_STACKS)
        self._pipes = [int(number) for number in os.environ.pop(_PIPES).split()]
        for pipe in self._pipes:
            os.set_inheritable(pipe, False)
        self._orders, self._answers = self._pipes
        self._messages = _messages(self._orders, Child.most_bytes)
        self._said: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._listens = False
        self._one_at_a_time = threading.Lock()
        os.register_at_fork(after_in_child=self._close)

    def receive(self, seconds: float | None = None) -> dict[str, Any]:
        """Return its next message, waiting for it.

        Args:
            seconds: to wait at most, where `listen` was called; None is for ever.

        Raises:
            queue.Empty: nothing has come in that time.
            EOFError: it has ended, and `listen` was not called.
        """
        if self._listens:
            return self._said.get(timeout=seconds)
        for message in self._messages:
            assert isinstance(message, dict)
            return message
        raise EOFError

    @property
    def has_said_something(self) -> bool:
        """Whether `receive` would not wait, where `listen` was called."""
        return not self._said.empty()

    def listen(self, at_end: Callable[[], object] | None = None) -> None:
        """Receive on a thread from now on, to notice its end whatever is done here.

        Args:
            at_end: called there when it has ended; ends this process. At once, if None:
                what is done here is of use to nobody else.
        """
        self._listens = True
        threading.Thread(
            target=self._listen, args=[at_end], name="mjrec-parent", daemon=True
        ).start()

    def send(self, content: memoryview | None = None, **message: Any) -> None:
        """Send a message, or the bytes of a frame; from any thread."""
        parts = _packed(message if content is None else content)
        # Where it has ended, `listen` sees to it.
        with contextlib.suppress(OSError), self._one_at_a_time:
            for part in parts:
                rest = memoryview(part)
                while rest:
                    rest = rest[os.write(self._answers, rest) :]

    def send_warnings(self) -> None:
        """Send it what is logged here as a warning or worse, as `log`, from now on."""
        logging.getLogger().addHandler(_ToParent(self))

    def _listen(self, at_end: Callable[[], object] | None) -> None:
        # Reset, where it died before it had read everything.
        with contextlib.suppress(OSError):
            for message in self._messages:
                assert isinstance(message, dict)
                self._said.put(message)
        if at_end is not None:
            at_end()
        # Not `sys.exit`, which would wait for a driver.
        os._exit(0)

    def _close(self) -> None:
        while self._pipes:
            os.close(self._pipes.pop())


def log_message(message: Mapping[str, Any]) -> bool:
    """Log here what a child has sent as `log`; return whether it is that."""
    if "log" in message:
        name, level, text = message["log"]
        logging.getLogger(name).log(level, "%s", text)
    return "log" in message


class _ToParent(logging.Handler):
    def __init__(self, parent: Parent) -> None:
        super().__init__(logging.WARNING)
        self._parent = parent

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._parent.send(log=[record.name, record.levelno, self.format(record)])
        except Exception:
            # As all handlers: who logs is not disturbed by it.
            self.handleError(record)


def _packed(
    message: Mapping[str, Any] | memoryview,
) -> tuple[bytes, bytes | memoryview]:
    if isinstance(message, memoryview):
        return _HEADER.pack(True, message.nbytes), message.cast("B")
    content = json.dumps(message).encode()
    return _HEADER.pack(False, len(content)), content


def _messages(pipe: int, most_bytes: int) -> Generator[Message | None, None, None]:
    """Yield what comes through a pipe until its end; None where it has to wait."""
    with contextlib.suppress(EOFError):
        while True:
            is_frame, size = _HEADER.unpack((yield from _received(pipe, _HEADER.size)))
            if size > most_bytes:
                logger.warning("A process of mjrec's sends what is not understood.")
                return
            content = yield from _received(pipe, size)
            if is_frame:
                yield content
                continue
            try:
                message = json.loads(content)
            except (ValueError, RecursionError):
                message = None
            if isinstance(message, dict):
                yield message
            else:
                logger.warning(
                    "A process of mjrec's said what is not understood: %.200r", content
                )


def _received(pipe: int, size: int) -> Generator[None, None, bytearray]:
    content = bytearray(size)
    missing = memoryview(content)
    while missing:
        try:
            count = os.readv(pipe, [missing])
        except BlockingIOError:
            yield None
            continue
        if not count:
            raise EOFError
        missing = missing[count:]
    return content


class _Process:
    """A process that this one has started, as far as it has to be waited for."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._status: int | None = None

    def send_signal(self, signum: int) -> None:
        # One that was waited for may have given its number to another.
        if self.wait(0) is None:
            os.kill(self._pid, signum)

    def wait(self, seconds: float) -> int | None:
        """Return the exit status, as `subprocess` gives it; None where it goes on."""
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
                # Whoever ignores SIGCHLD never knows.
                self._status = 0
            else:
                self._status = os.waitstatus_to_exitcode(status) if pid else None
        return self._status


def _memory() -> tuple[int, int]:
    """Return two descriptors of one file in memory."""
    words = os.memfd_create("mjrec-words")
    # So that the file can be emptied while the child writes into it.
    fcntl.fcntl(words, fcntl.F_SETFL, os.O_APPEND)
    return words, os.dup(words)


def _started(
    command: list[str],
    pipes: tuple[int, int],
    printed: int,
    environ: Mapping[str, str],
    cwd: str | None,
) -> int:
    process = subprocess.Popen(
        command,
        env=environment_of_child(environ),
        cwd=cwd,
        stdin=subprocess.DEVNULL,
        stdout=printed,
        stderr=printed,
        pass_fds=pipes,
        start_new_session=True,
    )
    # It is waited for here.
    process.returncode = 0
    return process.pid


def _forked(
    run: Callable[[], object],
    pipes: tuple[int, int],
    printed: int,
    environ: Mapping[str, str],
    cwd: str | None,
) -> int:
    pid = os.fork()
    if pid:
        return pid
    try:
        os.setsid()
        os.chdir(cwd or ".")
        os.environ.update(environ)
        # Of the process that this is a copy of.
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
    # A forked child has copies; the process is its parent's.
    if os.getpid() == owner:
        process.send_signal(signal.SIGTERM)
        if process.wait(_SECONDS_TO_END) is None:
            process.send_signal(signal.SIGKILL)
            # One whose disk or driver does not answer cannot die.
            process.wait(_SECONDS_TO_END)
    for file in files:
        with contextlib.suppress(OSError):
            file.close()


def _pids_of_children(pid: int) -> list[int]:
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += map(int, task.read_text().split())
    return found


_children: weakref.WeakSet[Child] = weakref.WeakSet()


def _leave_all_to_parent() -> None:
    """Close a forked child's copies of the pipes, which would not end otherwise."""
    for child in list(_children):
        child.end()


os.register_at_fork(after_in_child=_leave_all_to_parent)


def python_command(module: str) -> list[str]:
    """Return the command that runs `module`, which finds what this process finds.

    To be run with `environment_of_child`. `-P` keeps the working directory, which may
    hold a file called `random.py`, from being searched first.
    """
    return [sys.executable, "-P", "-m", module]


def environment_of_child(environ: Mapping[str, str]) -> dict[str, str]:
    """Return `environ` with this process's module search path in `PYTHONPATH`.

    The whole of it, in its order, so that the child has the same mujoco and the same
    mjrec, by whatever means this process came to them. The directory of the main
    script, or the working directory, which Python puts first, is searched last.
    """
    first, rest = sys.path[:1], sys.path[1:]
    path = [*rest, *first] if first and _is_of_main(first[0]) else sys.path
    entries = (str(Path(entry).absolute()) for entry in path if isinstance(entry, str))
    # What has the separator in its name cannot be said there.
    entries_said = [entry for entry in entries if os.pathsep not in entry]
    return {**environ, "PYTHONPATH": os.pathsep.join(entries_said)}


def _is_of_main(entry: str) -> bool:
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    return entry == "" or (
        file is not None and Path(entry).resolve() == Path(file).resolve().parent
    )


def carried(error: BaseException) -> dict[str, Any]:
    """Return what `unpacked` makes an error like `error` of, in plain JSON."""
    if not isinstance(error, Error):
        told = "".join(traceback.format_exception(error)).strip()
        return {
            "type": "Error",
            "message": f"A worker failed in a way that nobody foresaw.\n{told}",
        }
    # One that a module made of its own is known by the nearest that everybody knows.
    kinds = (kind.__name__ for kind in type(error).__mro__)
    return {
        "type": next(name for name in kinds if name in KINDS),
        "message": str(error),
        "facts": {k: _plain(v) for k, v in vars(error).items() if _is_plain(v)},
    }


def unpacked(plain: Mapping[str, Any]) -> Error:
    """Return the error that was carried.

    It has the class, the message and, of the attributes, numbers, texts, lists of them
    and paths.
    """
    facts = {
        key: Path(value["path"]) if isinstance(value, dict) else value
        for key, value in plain.get("facts", {}).items()
    }
    return rebuilt(KINDS.get(plain["type"], Error), plain["message"], facts)


def _is_plain(value: object) -> bool:
    if isinstance(value, list):
        return all(isinstance(item, str | int | float) for item in value)
    return value is None or isinstance(value, str | int | float | Path)


def _plain(value: Any) -> Any:
    return {"path": str(value)} if isinstance(value, Path) else value
