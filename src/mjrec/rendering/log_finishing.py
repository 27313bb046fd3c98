# SPDX-License-Identifier: Apache-2.0
"""Giving an ended recording its final form, without memory of the caller's process.

A long one is turned into HDF5 by a process of its own:
`python -m mjrec.rendering.log_finishing PATH`. It says one JSON object,
`{"finished": "<path>"}` or `{"error": {...}}`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from ..carried_errors import carried, unpacked
from ..child_python import (
    environment_of_child,
    python_command,
    said_in,
    say_stacks_when_asked,
    stacks_said_in,
    take_standard_output,
)
from ..errors import Error
from ..formats.in_flight import find_recording
from ..formats.span_reader import rows_size
from ..formats.trajectory_file import finish_trajectory
from ..patience import Patience

logger = logging.getLogger(__name__)

_MODULE = "mjrec.rendering.log_finishing"

# Up to here it takes no longer than starting a process, and a few MB.
_LARGEST_HERE = 8 << 20
_SECONDS_TO_LEAVE = 3.0
_END_OF_STDERR = 1500
_READ_SIZE = 1 << 16


def finish_log(log: Path) -> Path:
    """Make the HDF5 file of an ended recording.

    What `finish_trajectory` does, for a long one in a process of its own. It may be
    interrupted (Ctrl-C): then no process and no half file is left, and the log stays.
    In the very moment in which the process is started it may be left alone instead; it
    then finishes the log and ends. A process that hangs, using no CPU for
    `patience_s`, is ended, and what it was at is in the log.

    Returns:
        The path of the HDF5 file.

    Raises:
        Error: as `finish_trajectory`; or the process was killed or hung, and the log
            stays.
    """
    recording = find_recording(log)
    if recording is None or rows_size(recording) <= _LARGEST_HERE:
        return finish_trajectory(log)
    try:
        # Not a pipe, which could fill up while the other one is read.
        with tempfile.TemporaryFile() as words, _start(log, words) as process:
            return _result(log, process, words)
    except OSError as error:
        if isinstance(error, Error):
            raise
        # No process can be started, or no file made: it costs memory then.
        return finish_trajectory(log)


def main(argv: Sequence[str] | None = None) -> int:
    """Finish the recording that is named; return the exit status."""
    [path] = sys.argv[1:] if argv is None else argv
    answers = take_standard_output()
    say_stacks_when_asked()
    # So that the unfinished file is removed.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    said: dict[str, Any]
    try:
        said = {"finished": str(finish_trajectory(Path(path)))}
    except Exception as error:
        said = {"error": carried(error)}
    with contextlib.suppress(BrokenPipeError):
        os.write(answers, json.dumps(said).encode())
    return 0


class _Finisher(subprocess.Popen[bytes]):
    """The process; it has ended when the block that it is used in is left."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        try:
            super().__init__(*arguments, **options)
        except BaseException:
            # Ctrl-C, when there is a process already.
            if getattr(self, "pid", None) is not None:
                self._end()
            raise

    def __exit__(self, kind: Any, value: Any, traceback: Any) -> None:
        try:
            self._end()
        finally:
            super().__exit__(kind, value, traceback)

    def _end(self) -> None:
        try:
            if self.poll() is None:
                self.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.wait(_SECONDS_TO_LEAVE)
        finally:
            # Also when a second Ctrl-C comes.
            if self.poll() is None:
                self.kill()
                self.wait()


def _start(log: Path, words: IO[bytes]) -> _Finisher:
    return _Finisher(
        [*python_command(_MODULE), str(log)],
        env=environment_of_child(os.environ),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=words,
        # Ctrl-C in a terminal is the caller's to handle.
        start_new_session=True,
    )


def _result(log: Path, process: _Finisher, words: IO[bytes]) -> Path:
    said: Mapping[str, Any] = {}
    # One that is killed says nothing, and libraries may have said something before.
    for line in _output(log, process, words).splitlines():
        said = said_in(line)
    status = process.wait()
    if "finished" in said:
        return Path(said["finished"])
    if "error" in said:
        raise unpacked(said["error"])
    how = f"was killed by signal {-status}" if status < 0 else f"ended with {status}"
    size = words.seek(0, os.SEEK_END)
    words.seek(max(0, size - _END_OF_STDERR))
    last_words = words.read().decode(errors="replace").strip() or "(nothing)"
    raise Error(
        f"The process that was to finish {log} {how}. The log stays, and `mjrec "
        f"render` of its directory tries again. The end of what it said: {last_words}"
    )


def _output(log: Path, process: _Finisher, words: IO[bytes]) -> bytes:
    """Return all that the process says, unless it hangs."""
    assert process.stdout is not None
    output, patience, used = b"", Patience(), 0.0
    while True:
        ready, _, _ = select.select([process.stdout], [], [], patience.begin_slice())
        patience.end_slice()
        if ready:
            block = os.read(process.stdout.fileno(), _READ_SIZE)
            if not block:
                return output
            output += block
        elif (now := _cpu_seconds(process.pid)) > used:
            used = now
            patience.renew()
        elif patience.is_over:
            logger.error(
                "The process that was to finish %s hangs. What it was at:\n%s",
                log,
                stacks_said_in(words, process.pid),
            )
            raise Error(
                f"The process that was to finish {log} did nothing for "
                f"{patience.seconds:g} seconds and was ended. The log stays, and "
                "`mjrec render` of its directory tries again."
            )


def _cpu_seconds(pid: int) -> float:
    """Return how long a process has computed; 0 where nobody knows."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0.0
    # Behind the name, which may hold anything, user's and system's time.
    fields = stat.rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    sys.exit(main())
