# SPDX-License-Identifier: Apache-2.0
"""Functions that find ffmpeg and run it so that no failure goes unnoticed.

`imageio-ffmpeg` provides or finds the binary, and this module runs it. If ffmpeg fails,
an `EncoderError` gives the command, the exit status and the end of the error output. If
ffmpeg cannot be started, a different error gives the reason.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import select
import shutil
import signal
import subprocess
import tempfile
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Self

from ..atomic_files import file_sha256, write_text
from ..errors import (
    EncoderError,
    Error,
    FileNotWritten,
    InvalidArgument,
    MissingDependency,
)
from ..frames import Frame
from ..timeouts import Timeout
from .regular_files import read_regular

_ENVIRONMENT_VARIABLE = "IMAGEIO_FFMPEG_EXE"
_END_OF_STDERR = 2000
_PIPE_SIZE = 1 << 20
_SECONDS_TO_DIE = 10.0
# libavutil in ffmpeg 5.1, which renamed an option. ffmpeg 9 removed the old name.
_LIBAVUTIL_OF_FPS_MODE = (57, 28)
_MOST_BYTES = 1 << 20
_MOST_PROGRAMS = 8

# The answers for each program, keyed by question.
_answers: dict[str, dict[str, str]] = {}


def ffmpeg_executable() -> str:
    """Return the path of ffmpeg.

    This is the binary that `IMAGEIO_FFMPEG_EXE` names, if it is set; otherwise the one
    bundled with `imageio-ffmpeg`, conda's or the system's.

    Raises:
        MissingDependency: no ffmpeg was found.
        InvalidArgument: `IMAGEIO_FFMPEG_EXE` does not name a program.
    """
    # Imported here because importing mjrec must not import imageio-ffmpeg.
    import imageio_ffmpeg

    try:
        name: str = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise _unusable("no ffmpeg was found") from error
    path = shutil.which(name)
    if path is None:
        raise _unusable("no such program exists", name)
    return path


def ffmpeg_version() -> str:
    """Return the first line of `ffmpeg -version`."""
    return _version().partition("\n")[0].strip()


def ffmpeg_sha256() -> str:
    """Return the SHA-256 of the ffmpeg binary, in hexadecimal."""
    return remembered(
        "sha256", lambda: file_sha256(Path(ffmpeg_executable()).resolve())
    )


def remembered(question: str, answer: Callable[[], str]) -> str:
    """Return the answer to a question about ffmpeg, asking only once.

    Asking ffmpeg three questions and hashing its 80 megabytes takes as long as
    rendering a hundred small frames, so the answers are cached in
    `$XDG_CACHE_HOME/mjrec/programs.json` (`~/.cache/mjrec/programs.json` by default),
    which can be deleted at any time. They are valid only for the same file, with the
    same path, device, inode, size, mtime and ctime (which only the kernel can set).

    Args:
        question: a key that identifies the question.
        answer: a function that asks ffmpeg. If it raises an error, nothing is
            cached.
    """
    program = ffmpeg_executable()
    status = Path(program).stat()
    times = (status.st_mtime_ns, status.st_ctime_ns)
    numbers = (status.st_dev, status.st_ino, status.st_size, *times)
    identity = " ".join(map(str, (*numbers, program)))
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111  `Path.home` raises for users without one
    path = Path(home, "mjrec", "programs.json")
    if identity not in _answers:
        _answers[identity] = _read(path).get(identity, {})
    answers = _answers[identity]
    if question not in answers:
        answers[question] = answer()
        with contextlib.suppress(OSError, FileNotWritten):
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            others = {k: v for k, v in _read(path).items() if k != identity}
            newest = dict(list(others.items())[1 - _MOST_PROGRAMS :])
            write_text(path, json.dumps({**newest, identity: answers}))
    return answers[question]


def _read(path: Path) -> dict[str, dict[str, str]]:
    # An unreadable cache is harmless, because its answers can be obtained again.
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):
        stored = json.loads(read_regular(path, limit=_MOST_BYTES))
        return {key: dict(value) for key, value in stored.items()}
    return {}


def video_encoders() -> list[str]:
    """Return the names of the video encoders that this ffmpeg has."""
    listing = run_ffmpeg(["-hide_banner", "-encoders"]).decode()
    _, _, table = listing.partition("------\n")
    return re.findall(r"^ *V\S* +(\S+)", table, re.MULTILINE)


def every_frame_arguments() -> tuple[str, ...]:
    """Return the output arguments that make ffmpeg keep each frame exactly once.

    By default, ffmpeg duplicates and drops frames to keep the rate constant. During
    decoding, this would hide missing and duplicate frames.
    """
    version = re.search(r"^libavutil +(\d+)\. *(\d+)", _version(), re.M)
    is_old = version and tuple(map(int, version.groups())) < _LIBAVUTIL_OF_FPS_MODE
    return "-vsync" if is_old else "-fps_mode", "passthrough"


def as_file(path: Path) -> str:
    """Return the argument that makes ffmpeg treat a path as a file."""
    # Without the prefix, ffmpeg would mistake the part before a colon for a protocol.
    return f"file:{path}"


def run_ffmpeg(
    arguments: Sequence[str],
    *,
    standard_input: bytes = b"",
    what: str = "ffmpeg failed.",
) -> bytes:
    """Run ffmpeg until it ends, and return its standard output.

    Args:
        arguments: the arguments after the program's name.
        standard_input: bytes to feed to ffmpeg.
        what: the first sentence of the error message if ffmpeg fails.

    Raises:
        EncoderError: the exit status is not 0, or ffmpeg made no progress for
            `timeout_s`.
        Error: ffmpeg could not be started. See `ffmpeg_executable` for errors about the
            program itself.
    """
    with FfmpegProcess(arguments, what=what, reads=True, writes=True) as process:
        process.write(standard_input)
        process.end_input()
        output = b"".join(iter(lambda: process.read(_PIPE_SIZE), b""))
        process.wait()
        return output


class FfmpegProcess:
    """An ffmpeg process with a pipe for its input, its output or both.

    The process runs in its own session, so Ctrl-C in the terminal reaches only the
    parent, which decides what to do. When the parent dies, ffmpeg sees the end of its
    input and finishes its file on its own. Leaving the `with` block kills the process.

    Each method that waits for ffmpeg kills it if it hangs for `timeout_s`. It hangs if
    it accepts no input, returns no output, or has received all input but does not
    change its file.

    Args:
        arguments: the arguments after the program's name.
        what: the first sentence of the error message if ffmpeg fails.
        reads: whether ffmpeg gets its input through `write`.
        writes: whether its output is read through `read`.
        keeps: the descriptor of a file that ffmpeg must keep open.

    Attributes:
        command: the program and its arguments.

    Raises:
        Error: ffmpeg could not be started; see `run_ffmpeg`.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        *,
        what: str,
        reads: bool = False,
        writes: bool = False,
        keeps: int | None = None,
    ) -> None:
        self.command = [ffmpeg_executable(), *arguments]
        self._what = what
        self._timeout = Timeout()
        try:
            with contextlib.ExitStack() as on_failure:
                # Use a file, because a pipe would have to be drained while ffmpeg runs.
                stderr = on_failure.enter_context(tempfile.TemporaryFile())
                self._process = subprocess.Popen(
                    self.command,
                    stdin=subprocess.PIPE if reads else subprocess.DEVNULL,
                    stdout=subprocess.PIPE if writes else subprocess.DEVNULL,
                    stderr=stderr,
                    bufsize=0,
                    start_new_session=True,
                    # ffmpeg ignores SIGXFSZ, as Python does, so it reports a file size
                    # limit as an error instead of being killed.
                    restore_signals=False,
                    pass_fds=() if keeps is None else (keeps,),
                )
                on_failure.pop_all()
        except OSError as error:
            raise _not_started(self.command[0], error) from error
        self._stderr: IO[bytes] = stderr
        pipes = (self._process.stdin, self._process.stdout)
        self._pipes = [pipe for pipe in pipes if pipe is not None]
        for pipe in self._pipes:
            # Linux's default of 64 KiB costs eleven context switches per 480x480 frame.
            # The kernel may refuse a larger pipe.
            with contextlib.suppress(OSError):
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)
        if self._process.stdin is not None:
            os.set_blocking(self._process.stdin.fileno(), False)
        _running.add(self)

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def write(self, data: bytes | Frame) -> None:
        """Feed `data` to ffmpeg, waiting until the pipe has accepted all of it.

        Raises:
            EncoderError: ffmpeg has ended, or hangs.
        """
        pipe = self._process.stdin
        assert pipe is not None
        rest = memoryview(data if isinstance(data, bytes) else data.data).cast("B")
        try:
            while rest:
                # The result is None if the pipe is full.
                taken = pipe.write(rest)
                if taken:
                    rest = rest[taken:]
                else:
                    self._wait_for(pipe, select.POLLOUT)
        except (OSError, ValueError) as error:
            # ValueError means that the pipe was already closed. ffmpeg itself ends once
            # its input is closed, but a wrapper script may not.
            self._has_ended(_SECONDS_TO_DIE)
            self.kill()
            raise self._error() from error

    def read(self, size: int) -> bytes:
        """Return at most `size` bytes of output, or no bytes at its end.

        Raises:
            EncoderError: ffmpeg hangs.
        """
        pipe = self._process.stdout
        assert pipe is not None
        self._wait_for(pipe, select.POLLIN)
        return pipe.read(size)

    def end_input(self) -> None:
        """Close ffmpeg's input."""
        if self._process.stdin is not None:
            self._process.stdin.close()

    def wait(self) -> None:
        """Wait for ffmpeg to end. Can be called more than once.

        Raises:
            EncoderError: the exit status is not 0, or ffmpeg hangs.
        """
        self._wait_until(self._has_ended, self._state_of_output)
        if self._process.returncode != 0:
            raise self._error()

    def kill(self) -> None:
        """Kill the process, along with any processes that a wrapper script started.

        The pipes stay open: a thread may be about to write, and a closed descriptor's
        number may already belong to another file.
        """
        if self._process.poll() is None:
            # The process leads its own process group, and may already have ended.
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)
        # A process that is blocked on a broken disk cannot die, so do not wait forever.
        self._has_ended(_SECONDS_TO_DIE)

    def release(self) -> None:
        """Close the pipes of an ended process. No thread may still be using them."""
        self.close_inherited_pipes()
        self._stderr.close()
        _running.discard(self)

    def close_inherited_pipes(self) -> None:
        """Close a forked child's copies of the pipes.

        While any process holds the write end, ffmpeg does not see the end of its input.
        The parent's `wait` would then last until the child ends.
        """
        for pipe in self._pipes:
            pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self.release()

    def _wait_for(self, pipe: IO[bytes], event: int) -> None:
        """Wait until a pipe is ready, or closed at the other end."""
        poll = select.poll()
        poll.register(pipe, event)
        self._wait_until(lambda seconds: bool(poll.poll(1000 * seconds)))

    def _wait_until(
        self,
        is_ready: Callable[[float], bool],
        state: Callable[[], object] = lambda: None,
    ) -> None:
        """Wait, killing the process if it makes no progress for too long.

        Args:
            is_ready: a function that waits for at most the given number of seconds, and
                returns whether the wait is over.
            state: a function whose result changes as long as there is progress.
        """
        last = state()
        self._timeout.renew()
        while not self._timeout.wait(is_ready):
            if (now := state()) != last:
                last = now
                self._timeout.renew()
            elif self._timeout.is_over:
                self.kill()
                raise self._error()

    def _has_ended(self, seconds: float) -> bool:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self._process.returncode is not None

    def _state_of_output(self) -> tuple[int, int]:
        """Return a value that changes while ffmpeg writes its file, if any."""
        protocol, _, path = self.command[-1].partition(":")
        if protocol == "file":
            with contextlib.suppress(OSError):
                status = Path(path).stat()
                return status.st_size, status.st_mtime_ns
        return 0, 0

    def _error(self) -> EncoderError:
        what = self._what
        if self._timeout.is_over:
            what += (
                f" It made no progress for {self._timeout.seconds:g} seconds and was "
                "killed."
            )
        size = self._stderr.seek(0, os.SEEK_END)
        self._stderr.seek(max(0, size - _END_OF_STDERR))
        return EncoderError(
            what,
            command=self.command,
            returncode=self._process.returncode,
            stderr=self._stderr.read().decode(errors="replace"),
        )


_running: weakref.WeakSet[FfmpegProcess] = weakref.WeakSet()


def _close_pipes_after_fork() -> None:
    for process in list(_running):
        process.close_inherited_pipes()


os.register_at_fork(after_in_child=_close_pipes_after_fork)


def _version() -> str:
    return remembered(
        "version", lambda: run_ffmpeg(["-version"]).decode(errors="replace")
    )


def _not_started(executable: str, error: OSError) -> Error:
    # The error has a file name only if the program itself is the problem, not a lack of
    # memory, processes or open files.
    if error.filename != executable:
        return Error(f"ffmpeg ({executable}) could not be started: {error}.")
    return _unusable(str(error.strerror), executable)


def _unusable(reason: str, executable: str | None = None) -> Error:
    named = os.environ.get(_ENVIRONMENT_VARIABLE)
    if named:
        return InvalidArgument(
            f"{_ENVIRONMENT_VARIABLE} is {named!r}, which cannot be started: {reason}. "
            "Unset it, or set it to the path of an ffmpeg binary."
        )
    return MissingDependency(
        "ffmpeg",
        purpose="Writing a video",
        reason=executable and f"{executable} cannot be started: {reason}",
        install="pip install --force-reinstall imageio-ffmpeg, or set "
        f"{_ENVIRONMENT_VARIABLE} to the path of an ffmpeg binary",
    )
