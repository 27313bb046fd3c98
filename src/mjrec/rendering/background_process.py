# SPDX-License-Identifier: Apache-2.0
"""A process that finishes recordings beside a simulation.

`python -m mjrec.rendering.background_process DIRECTORY --workers N|auto [--strict]`. On
its standard input it is told the base name of one ended trajectory a line, or of the
first part of a clip; `that was all` where it is waited for, and `a video is expected`.
On its standard output it says one JSON object a line::

    {"progress": {"videos_done": 0, "videos": 2, "frames_done": 40, "frames": 2002}}
    {"done": "<recording>", "failures": {"<video or trajectory>": "..."}}
    {"log": [30, "..."]}                                for the simulation's log

What libraries print goes to the standard error.

It ends at once, leaving the rest as it is, when its standard input ends: then it is of
no use to anybody any more.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..child_python import LineWriter, say_stacks_when_asked, take_standard_output
from .background import ALL_SAID, EXPECTED
from .finish import Finisher
from .jobs import Progress, VideoJob, key_of

_NICE = 10
_SECONDS_BETWEEN_REPORTS = 0.2
_SECONDS_BETWEEN_LOOKS = 0.05
_SECONDS_TO_LEAVE = 2.0
_READ_SIZE = 1 << 16

_Say = Callable[..., None]


class _Stopped(BaseException):
    """Raised in the main thread, wherever it is: clean up and leave."""


def main(argv: Sequence[str] | None = None) -> int:
    """Finish what the standard input names; return the exit status."""
    parser = argparse.ArgumentParser()
    parser.add_argument("directory", type=Path)
    parser.add_argument("--workers", required=True)
    parser.add_argument("--strict", action="store_true")
    arguments = parser.parse_args(argv)
    workers = None if arguments.workers == "auto" else int(arguments.workers)
    signal.signal(signal.SIGTERM, _stop)
    say_stacks_when_asked()
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    # Beside a simulation a single worker, too, has one CPU to itself and no more: the
    # threads of Mesa's rasteriser would get in the way of the steps.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    answers = LineWriter(take_standard_output())

    def say(**answer: Any) -> None:
        answers.write(json.dumps(answer).encode() + b"\n")

    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: say(  # type: ignore[method-assign] # one of its own
        log=[record.levelno, handler.format(record)]
    )
    logging.getLogger().addHandler(handler)
    told: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_read, args=[told], daemon=True).start()
    try:
        with contextlib.closing(
            Finisher(arguments.directory, workers=workers)
        ) as finisher:
            _work(finisher, arguments.directory, told, say, strict=arguments.strict)
    except _Stopped:
        return 0


def _stop(signum: int, frame: object) -> None:
    del frame
    # One is enough, and cleaning up must not be disturbed.
    signal.signal(signum, signal.SIG_IGN)
    raise _Stopped


def _read(names: queue.SimpleQueue[str]) -> None:
    """Read what the simulation says, and notice at once when it ends."""
    # Not through `sys.stdin`, whose lock this thread would hold at exit.
    unread = b""
    while block := os.read(sys.stdin.fileno(), _READ_SIZE):
        *lines, unread = (unread + block).split(b"\n")
        for line in lines:
            names.put(line.decode())
    # To the main thread, wherever it waits. Should it not come out of that, it is of no
    # use any more.
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_SECONDS_TO_LEAVE)
    os._exit(1)


def _work(
    finisher: Finisher,
    directory: Path,
    told: queue.SimpleQueue[str],
    say: _Say,
    *,
    strict: bool,
) -> NoReturn:
    """Do what is told, and tell what came of it, until the end of this process."""
    all_said, last_report = False, 0.0

    def take_in(*, wait: bool = False) -> None:
        nonlocal all_said
        while wait or not told.empty():
            name, wait = told.get(), False
            all_said = name == ALL_SAID
            if name == EXPECTED:
                finisher.start_workers()
            elif not all_said:
                job = VideoJob(directory=directory, recording=name, strict=strict)
                if key_of(name) is None or not finisher.add(job):
                    say(done=name, failures={})

    def look_up(progress: Progress) -> None:
        """Listen and report, in the midst of work."""
        nonlocal last_report
        now = time.monotonic()
        if now - last_report >= _SECONDS_BETWEEN_REPORTS:
            last_report = now
            take_in()
            say(progress=vars(progress))

    finisher.on_progress = look_up
    while True:
        take_in()
        if not finisher:
            finisher.rest()
            take_in(wait=True)
        elif finisher.is_ready() or all_said:
            job, result = finisher.do_next()
            say(progress=vars(finisher.progress))
            say(done=job.recording, failures={**result.failures, **result.blank})
        else:
            # The simulation is still writing the model.
            time.sleep(_SECONDS_BETWEEN_LOOKS)


if __name__ == "__main__":
    sys.exit(main())
