# SPDX-License-Identifier: Apache-2.0
"""Running a module of ours in a Python process of its own.

Not with multiprocessing, whose children import the caller's main module (a script
without a guard would run again), cannot be started from daemonic processes, and with
"fork" inherit OpenGL's locks without its threads.

Errors come home from there as JSON (`carried`, `unpacked`): pickle would let a process
that writes into the pipe run code here.
"""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from .errors import KINDS, Error, rebuilt

logger = logging.getLogger(__name__)

_STACKS = signal.SIGUSR1
_MOST_WORDS_READ = 20_000
_LOOKS_FOR_STACKS = 20
_SECONDS_BETWEEN_LOOKS = 0.1
_MOST_WORDS = 1 << 20
_END_OF_WORDS = 2000
_SECONDS_TO_END = 3.0


class Child:
    """A Python process that runs a module of ours, connected by two pipes.

    It has a session of its own, so that Ctrl-C in the terminal reaches only the parent.
    It is ended by `end`, by garbage collection and at interpreter exit. Its standard
    input ends whenever and however the parent dies, so a module that heeds that leaves
    no process behind. Its standard error goes into memory, for the log.

    Args:
        module: what to run.
        arguments: its command line.
        environ: its environment variables, besides the module search path.
        cwd: its working directory; the parent's, if None.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(
        self,
        module: str,
        *arguments: str,
        environ: Mapping[str, str],
        cwd: str | None = None,
    ) -> None:
        words = os.memfd_create("mjrec-words")
        try:
            # So that the file can be emptied while the child writes into it.
            fcntl.fcntl(words, fcntl.F_SETFL, os.O_APPEND)
            self._process = subprocess.Popen(
                [*python_command(module), *arguments],
                env=environment_of_child(environ),
                cwd=cwd,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=words,
                bufsize=0,
                start_new_session=True,
            )
        except BaseException:
            os.close(words)
            raise
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.orders: IO[bytes] = self._process.stdin
        self.answers: IO[bytes] = self._process.stdout
        self._words: IO[bytes] = os.fdopen(words, "r+b", buffering=0)
        self._files = (self.orders, self.answers, self._words)
        self._end = weakref.finalize(
            self, _end_child, self._process, self._files, os.getpid()
        )
        _children.add(self)

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    def stacks(self) -> str:
        """Return what the threads of one that hangs are at, for the log."""
        before = after = self._size_of_words()
        with contextlib.suppress(ProcessLookupError):
            # One that has not begun yet dies of it. It may only have been stopped.
            os.kill(self.pid, _STACKS)
            os.kill(self.pid, signal.SIGCONT)
        for _ in range(_LOOKS_FOR_STACKS):
            time.sleep(_SECONDS_BETWEEN_LOOKS)
            size = self._size_of_words()
            if size == after > before:
                break
            after = size
        return self._words_from(before) or "(it does not say)"

    def last_words(self) -> str:
        """Return what became of it, and the end of what it printed."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_SECONDS_TO_END)
        status = self._process.returncode
        how = "lives, and is silent" if status is None else how_it_ended(status)
        said = self._words_from(max(0, self._size_of_words() - _MOST_WORDS_READ))
        # What Python says of a crash ends with the names of dozens of modules.
        words = said.partition("\nExtension modules:")[0].strip()
        return (
            f"{how}. The end of what it said: {words[-_END_OF_WORDS:] or '(nothing)'}"
        )

    def forget_words(self) -> None:
        """Drop what it has printed, if that is much."""
        if self._size_of_words() > _MOST_WORDS:
            os.ftruncate(self._words.fileno(), 0)

    def kill(self) -> None:
        """Kill it and its children, which may hang as well; `end` does the rest."""
        if self._process.poll() is None:
            for pid in [*_pids_of_children(self.pid), self.pid]:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)

    def end(self) -> None:
        """End it, by force where it does not end by itself. Idempotent."""
        _children.discard(self)
        self._end()

    def _size_of_words(self) -> int:
        return os.fstat(self._words.fileno()).st_size

    def _words_from(self, begin: int) -> str:
        # Not by seeking: the position is the child's too.
        said = os.pread(self._words.fileno(), _MOST_WORDS_READ, begin)
        return said.decode(errors="replace").strip()


class LineWriter:
    """Writes lines into a pipe, from any thread, and never waits for the reader.

    Args:
        pipe: its descriptor.
    """

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._unwritten = b""
        self._one_at_a_time = threading.RLock()
        os.set_blocking(pipe, False)

    @property
    def is_behind(self) -> bool:
        """Whether the reader has not taken all yet, after one more try."""
        self.write(b"")
        return bool(self._unwritten)

    def write(self, lines: bytes) -> None:
        """Write whole lines, now or, where the pipe is full, with later ones."""
        with self._one_at_a_time:
            self._unwritten += lines
            try:
                while self._unwritten:
                    written = os.write(self._pipe, self._unwritten)
                    self._unwritten = self._unwritten[written:]
            except BlockingIOError:
                return
            except BrokenPipeError:
                # That it has no reader is noticed elsewhere.
                self._unwritten = b""


def _end_child(
    process: subprocess.Popen[bytes], files: tuple[IO[bytes], ...], owner: int
) -> None:
    # A forked child has copies; the process is its parent's.
    if os.getpid() == owner:
        process.terminate()
        try:
            process.wait(_SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            process.kill()
            # One whose disk or driver does not answer cannot die.
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_SECONDS_TO_END)
    for file in files:
        with contextlib.suppress(OSError):
            file.close()
    # Python waits for no process that it takes for ended.
    process.returncode = process.returncode or 0


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


def take_standard_output() -> int:
    """Return a descriptor of the standard output, for what is said to the parent.

    From here on the standard output is the standard error: libraries and drivers print
    whenever they like. Children do not get the descriptor.
    """
    sys.stdout.flush()
    descriptor = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return descriptor


def say_stacks_when_asked() -> None:
    """Let this process write what its threads are at to the standard error.

    At `Child.stacks`, whatever it hangs in, and when it dies of a signal such as
    SIGSEGV.
    """
    faulthandler.enable()
    faulthandler.register(_STACKS)


def how_it_ended(status: int) -> str:
    """Return in words the exit status of a process, as `subprocess` gives it."""
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"was killed by {signal.Signals(-status).name}"
    except ValueError:
        return f"was killed by signal {-status}"


def said_in(line: bytes) -> dict[str, Any]:
    """Return what a child has said in a line; nothing if that is no JSON object."""
    try:
        said = json.loads(line)
    except (ValueError, RecursionError):
        said = None
    if isinstance(said, dict):
        return said
    logger.warning("A process of mjrec's said what is not understood: %.200r", line)
    return {}


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
