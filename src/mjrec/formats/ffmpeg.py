# SPDX-License-Identifier: Apache-2.0
"""ffmpeg: which one, and running it so that a failure is never missed.

`imageio-ffmpeg` brings the binary (or finds one); driving it is done here. Every
failure of an ffmpeg that ran is one `EncoderError` with the command, the exit status
and the end of what it said. One that cannot be started is another error, with the
reason.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import re
import select
import shutil
import signal
import subprocess
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Protocol

from ..errors import EncoderError, Error, InvalidArgument, MissingDependency
from ..file_digests import file_sha256
from ..frames import Frame
from ..patience import Patience

_ENVIRONMENT_VARIABLE = "IMAGEIO_FFMPEG_EXE"
_END_OF_STDERR = 2000
_PIPE_SIZE = 1 << 20
# An encoder that closed its input ends by itself; a wrapper script may not.
_SECONDS_TO_DIE = 10.0


def ffmpeg_executable() -> str:
    """Return the path of ffmpeg.

    It is the one that `IMAGEIO_FFMPEG_EXE` names, else the one that comes with
    `imageio-ffmpeg`, else conda's or the system's.

    Raises:
        MissingDependency: there is none.
        InvalidArgument: `IMAGEIO_FFMPEG_EXE` names none.
    """
    # Not at the top: importing mjrec imports no ffmpeg.
    import imageio_ffmpeg

    try:
        name: str = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise _no_program("ffmpeg") from error
    path = shutil.which(name)
    if path is None:
        raise _unusable(name, "there is no program of that name")
    return path


def ffmpeg_version() -> str:
    """Return the first line of `ffmpeg -version`."""
    return _version(*_identity(ffmpeg_executable()))


def ffmpeg_sha256() -> str:
    """Return the sha256 of the ffmpeg binary, in hexadecimal; read once a process."""
    return _sha256(*_identity(ffmpeg_executable()))


def video_encoders() -> list[str]:
    """Return the names of the video encoders that this ffmpeg has."""
    return list(_video_encoders(*_identity(ffmpeg_executable())))


def every_frame_arguments() -> tuple[str, ...]:
    """Return the output arguments for each frame once, none dropped or repeated.

    Left alone, ffmpeg fills gaps with copies and drops what comes too early, to make
    the rate even; in decoding, that hides what a file lacks or doubles.
    """
    return _every_frame_arguments(*_identity(ffmpeg_executable()))


def run_ffmpeg(
    arguments: Sequence[str],
    *,
    standard_input: bytes = b"",
    what: str = "ffmpeg failed.",
) -> subprocess.CompletedProcess[bytes]:
    """Run ffmpeg to its end and return what it wrote.

    Args:
        arguments: those after the program's name.
        standard_input: what it reads.
        what: what fails when it fails: the first sentence of the error.

    Raises:
        EncoderError: its exit status is not 0, or it took longer than `patience_s`.
        Error: it could not be started, as `ffmpeg_executable` where that is its fault.
    """
    command = [ffmpeg_executable(), *arguments]
    patience = Patience()
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            restore_signals=False,
        )
    except OSError as error:
        raise _not_started(command[0], error) from error
    with process:
        try:
            output, said = _communicate(process, standard_input, patience)
        except BaseException:
            _kill(process)
            raise
    if process.returncode != 0:
        raise EncoderError(
            _with_hanging(what, patience),
            command=command,
            returncode=process.returncode,
            stderr=_text(said[-_END_OF_STDERR:]),
        )
    return subprocess.CompletedProcess(command, process.returncode, output, said)


class HasFileno(Protocol):
    """What is an open file."""

    def fileno(self) -> int:
        """Return its descriptor."""


class FfmpegProcess:
    """An ffmpeg that is fed through, or read from, a pipe.

    It runs in a session of its own: Ctrl-C in the terminal reaches only the parent,
    which decides. When the parent dies, ffmpeg sees the end of its input and finishes
    its file by itself.

    Args:
        arguments: those after the program's name.
        what: what fails when it fails: the first sentence of the error.
        reads: whether it is fed through `write`.
        writes: whether it is read through `read`.

    Each method that waits for it ends it when it has hung for `patience_s`: when it
    takes no byte, gives none, or has all and does not write on in its file.

    Raises:
        Error: as `run_ffmpeg`, if it could not be started.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        *,
        what: str,
        reads: bool = False,
        writes: bool = False,
        keeps: HasFileno | None = None,
    ) -> None:
        self._what = what
        self._command = [ffmpeg_executable(), *arguments]
        self._patience = Patience()
        # A file, not a pipe: nobody has to empty it while the process runs.
        self._stderr: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  see release
        try:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE if reads else subprocess.DEVNULL,
                stdout=subprocess.PIPE if writes else subprocess.DEVNULL,
                stderr=self._stderr,
                bufsize=0,
                start_new_session=True,
                # A file that would grow beyond a limit is an error that ffmpeg tells,
                # not the end of it: Python ignores SIGXFSZ, and so does ffmpeg then.
                restore_signals=False,
                pass_fds=() if keeps is None else (keeps.fileno(),),
            )
        except BaseException as error:
            self._stderr.close()
            if isinstance(error, OSError):
                raise _not_started(self._command[0], error) from error
            raise
        try:
            self._enlarge_pipes()
            if self._process.stdin is not None:
                os.set_blocking(self._process.stdin.fileno(), False)
            _running.add(self)
        except BaseException:
            self.kill()
            self.release()
            raise

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._process.pid

    @property
    def command(self) -> list[str]:
        """The program and its arguments."""
        return list(self._command)

    def write(self, data: bytes | Frame) -> None:
        """Feed `data`, waiting until the pipe has taken all of it.

        Raises:
            EncoderError: ffmpeg has ended, or hangs.
        """
        pipe = self._process.stdin
        assert pipe is not None
        rest = memoryview(data if isinstance(data, bytes) else data.data).cast("B")
        try:
            while rest:
                # None: it is full.
                taken = pipe.write(rest)
                if taken:
                    rest = rest[taken:]
                else:
                    self._wait_for(pipe, select.POLLOUT)
        except (OSError, ValueError) as error:
            # ValueError: the pipe was closed before.
            raise self._died() from error

    def read(self, size: int) -> bytes:
        """Return at most `size` bytes of output; none at its end.

        Raises:
            EncoderError: ffmpeg hangs.
        """
        pipe = self._process.stdout
        assert pipe is not None
        self._wait_for(pipe, select.POLLIN)
        return pipe.read(size)

    def end_input(self) -> None:
        """Say that nothing follows."""
        if self._process.stdin is not None:
            self._process.stdin.close()

    def wait(self) -> None:
        """Wait for the end. May be called again.

        Raises:
            EncoderError: the exit status is not 0, or it hangs.
        """
        written = self._state_of_output()
        self._patience.renew()
        while not self._has_ended(self._patience.begin_slice()):
            self._patience.end_slice()
            if self._state_of_output() != written:
                written = self._state_of_output()
                self._patience.renew()
            elif self._patience.is_over:
                raise self._hung()
        if self._process.returncode != 0:
            raise self._error()

    def kill(self) -> None:
        """End the process at once, if it runs.

        The pipes stay open: a thread may be about to write, and the number of a closed
        one may be another file's by then.
        """
        _kill(self._process)

    def release(self) -> None:
        """Close the pipes of a process that has ended, once no thread uses them."""
        self.close_inherited_pipes()
        self._stderr.close()
        _running.discard(self)

    def close_inherited_pipes(self) -> None:
        """Close a forked child's copies of the pipes.

        While any process holds the writing end, ffmpeg does not see the end of its
        input, and the parent's `wait` would last as long as the child lives.
        """
        for pipe in self._pipes():
            pipe.close()

    def _pipes(self) -> list[IO[bytes]]:
        return [pipe for pipe in (self._process.stdin, self._process.stdout) if pipe]

    def _enlarge_pipes(self) -> None:
        for pipe in self._pipes():
            # Linux's default is 64 KiB, eleven switches for a 480x480 frame. More is
            # a favour that the kernel may refuse.
            with contextlib.suppress(OSError):
                fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE_SIZE)

    def _wait_for(self, pipe: IO[bytes], event: int) -> None:
        """Wait until a pipe is ready, or closed at the other end."""
        poll = select.poll()
        poll.register(pipe, event)
        self._patience.renew()
        while not poll.poll(1000 * self._patience.begin_slice()):
            self._patience.end_slice()
            if self._patience.is_over:
                raise self._hung()

    def _has_ended(self, seconds: float) -> bool:
        """Wait for the end, so long at most, and return whether it has come."""
        try:
            # `Popen.wait` would look again and again, with pauses that add up.
            descriptor = os.pidfd_open(self.pid)
        except OSError:
            # It was waited for before, or the system knows no such thing.
            descriptor = None
        if descriptor is not None:
            try:
                select.select([descriptor], [], [], seconds)
            finally:
                os.close(descriptor)
            seconds = 0
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self._process.returncode is not None

    def _state_of_output(self) -> tuple[int, int]:
        """Return what changes while it writes its file; as one, where it has none."""
        protocol, _, path = self._command[-1].partition(":")
        if protocol != "file":
            return 0, 0
        try:
            status = Path(path).stat()
        except OSError:
            return 0, 0
        return status.st_size, status.st_mtime_ns

    def _hung(self) -> EncoderError:
        _kill(self._process)
        return self._error()

    def _died(self) -> EncoderError:
        try:
            self._process.wait(_SECONDS_TO_DIE)
        except subprocess.TimeoutExpired:
            _kill(self._process)
        return self._error()

    def _error(self) -> EncoderError:
        return EncoderError(
            _with_hanging(self._what, self._patience),
            command=self._command,
            returncode=self._process.returncode,
            stderr=self._end_of_stderr(),
        )

    def _end_of_stderr(self) -> str:
        size = self._stderr.seek(0, os.SEEK_END)
        self._stderr.seek(max(0, size - _END_OF_STDERR))
        return _text(self._stderr.read())


_running: weakref.WeakSet[FfmpegProcess] = weakref.WeakSet()


def _close_pipes_after_fork() -> None:
    for process in list(_running):
        process.close_inherited_pipes()


os.register_at_fork(after_in_child=_close_pipes_after_fork)


def _communicate(
    process: subprocess.Popen[bytes], standard_input: bytes, patience: Patience
) -> tuple[bytes, bytes]:
    """Return what a process writes and says, once it has ended or was ended."""
    unsaid: bytes | None = standard_input
    while not patience.is_over:
        try:
            return process.communicate(unsaid, timeout=patience.begin_slice())
        except subprocess.TimeoutExpired:
            unsaid = None
            patience.end_slice()
    _kill(process)
    # What it has said before.
    return process.communicate()


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a process at once, with those that a wrapper script has started."""
    if process.poll() is None:
        # It leads a group of its own. Not more than the process may have ended.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
    # One whose disk does not answer cannot die.
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_SECONDS_TO_DIE)


def _with_hanging(what: str, patience: Patience) -> str:
    if not patience.is_over:
        return what
    return (
        f"{what} It made no progress for {patience.seconds:g} seconds, and was ended."
    )


def _identity(executable: str) -> tuple[str, int, int]:
    """Return what changes when the binary changes, as a key for the caches below."""
    status = Path(executable).stat()
    return executable, status.st_size, status.st_mtime_ns


@functools.lru_cache
def _version(executable: str, size: int, modified: int) -> str:
    return _text(run_ffmpeg(["-version"]).stdout).partition("\n")[0].strip()


@functools.lru_cache
def _sha256(executable: str, size: int, modified: int) -> str:
    return file_sha256(Path(executable))


@functools.lru_cache
def _video_encoders(executable: str, size: int, modified: int) -> tuple[str, ...]:
    listing = _text(run_ffmpeg(["-hide_banner", "-encoders"]).stdout)
    _, _, table = listing.partition("------\n")
    return tuple(re.findall(r"^ *V\S* +(\S+)", table, re.MULTILINE))


@functools.lru_cache
def _every_frame_arguments(
    executable: str, size: int, modified: int
) -> tuple[str, ...]:
    # 5.1 brought the first, 9 took the second away.
    options = _text(run_ffmpeg(["-hide_banner", "-h", "long"]).stdout)
    name = "-fps_mode" if "-fps_mode" in options else "-vsync"
    return name, "passthrough"


def _not_started(executable: str, error: OSError) -> Error:
    # The name is there only where the program itself is to blame, and not a lack of
    # memory, processes or open files.
    if error.filename is None:
        return Error(f"ffmpeg ({executable}) could not be started: {error}.")
    return _unusable(executable, error.strerror)


def _unusable(executable: str, reason: object) -> Error:
    named = os.environ.get(_ENVIRONMENT_VARIABLE)
    if named:
        return InvalidArgument(
            f"{_ENVIRONMENT_VARIABLE} is {named!r}, which cannot be started: {reason}. "
            "Unset it, or set it to the path of an ffmpeg."
        )
    return _no_program(f"an ffmpeg other than {executable} ({reason})")


def _no_program(what: str) -> MissingDependency:
    return MissingDependency(
        what,
        purpose="Writing a video",
        install="pip install --force-reinstall imageio-ffmpeg, or set "
        f"{_ENVIRONMENT_VARIABLE} to the path of an ffmpeg",
    )


def _text(data: bytes) -> str:
    return data.decode("utf-8", errors="replace")
