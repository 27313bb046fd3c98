# SPDX-License-Identifier: Apache-2.0
"""A process that finishes episodes beside a simulation.

`python -m mjrec.rendering.render_server DIRECTORY --workers N|auto [--strict]`. On its
standard input it is told the base name of one ended trajectory a line, or of the first
log of a clip, and at last `that was all`. On its standard output it says one JSON
object a line::

    {"progress": {"videos_done": 0, "videos": 2, "frames_done": 40, "frames": 2002}}
    {"done": "<trajectory>", "name": "<video or trajectory>", "failure": null}
    {"log": [30, "..."]}                                for the simulation's log
    {"pulse": 12.5}                                     it is at work, once all was said

What libraries print goes to the standard error.

It ends when all is done, and at once, leaving the rest as it is, when its standard
input ends before: then nobody waits for it any more.
"""

from __future__ import annotations

import argparse
import collections
import json
import logging
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..child_python import say_stacks_when_asked, take_standard_output
from ..patience import patience_s
from .finishing import EpisodeFinisher
from .pending import RecordingKey, key_of
from .progress import Progress
from .render_service import ALL_SAID

_NICE = 10
_SECONDS_BETWEEN_REPORTS = 0.2
_SECONDS_BETWEEN_LOOKS = 0.05
_SECONDS_TO_LEAVE = 2.0
_READ_SIZE = 1 << 16
_LONGEST_BETWEEN_PULSES = 5.0


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
    answers = _Answers(take_standard_output())
    logging.getLogger().addHandler(_ToSimulation(answers))
    try:
        finisher = EpisodeFinisher(
            arguments.directory, workers=workers, strict=arguments.strict
        )
        _Service(finisher, _Inbox(_Pulse(answers)), answers).run()
    except _Stopped:
        return 0
    answers.flush()
    return 0


def _stop(signum: int, frame: object) -> None:
    del frame
    # One is enough, and cleaning up must not be disturbed.
    signal.signal(signum, signal.SIG_IGN)
    raise _Stopped


class _Service:
    """Does what the inbox says, and tells what came of it."""

    def __init__(
        self, finisher: EpisodeFinisher, inbox: _Inbox, answers: _Answers
    ) -> None:
        self._inbox = inbox
        self._answers = answers
        self._last_report = 0.0
        # By which names they were given.
        self._names: dict[RecordingKey, str] = {}
        self._finisher = finisher
        finisher.on_progress = self._look_up

    def run(self) -> None:
        """Return when everything is done."""
        with self._finisher as finisher:
            while self._take_in() or not self._inbox.is_complete:
                if not finisher:
                    self._wait_for_work()
                elif finisher.is_ready() or self._inbox.is_complete:
                    self._finish_next()
                else:
                    # The simulation is still writing the model.
                    time.sleep(_SECONDS_BETWEEN_LOOKS)
        self._report()

    def _finish_next(self) -> None:
        key, outcome = self._finisher.finish_next()
        self._answers.say(
            done=self._names.pop(key),
            name=outcome.name,
            failure=outcome.failure,
        )

    def _wait_for_work(self) -> None:
        self._finisher.rest()
        self._inbox.wait()

    def _take_in(self) -> bool:
        """Take what was said, and return whether there is something to do."""
        for name in self._inbox.names():
            key = key_of(name)
            if key is not None and self._finisher.add(key):
                self._names[key] = name
            else:
                self._answers.say(done=name, name=name, failure=None)
        return bool(self._finisher)

    def _look_up(self, progress: Progress) -> None:
        """Listen and report, in the midst of work."""
        del progress
        now = time.monotonic()
        if now - self._last_report >= _SECONDS_BETWEEN_REPORTS:
            self._last_report = now
            self._take_in()
            self._report()

    def _report(self) -> None:
        self._answers.say(progress=vars(self._finisher.progress))


class _Inbox:
    """What the simulation says; read on a thread, to notice at once when it ends."""

    def __init__(self, pulse: _Pulse) -> None:
        self._pulse = pulse
        self._names: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._next: collections.deque[str] = collections.deque()
        self._all_said = False
        threading.Thread(target=self._read, name="mjrec-inbox", daemon=True).start()

    @property
    def is_complete(self) -> bool:
        """Whether all names were said and taken out."""
        return self._all_said and not self._next and self._names.empty()

    def names(self) -> list[str]:
        """Return the names that came since."""
        while not self._names.empty():
            self._take(self._names.get())
        names = list(self._next)
        self._next.clear()
        return names

    def wait(self) -> None:
        """Wait until something is said."""
        self._take(self._names.get())

    def _take(self, name: str | None) -> None:
        if name is None:
            self._all_said = True
        else:
            self._next.append(name)

    def _read(self) -> None:
        # Not through `sys.stdin`, whose lock this thread would hold at exit.
        unread = b""
        while block := os.read(sys.stdin.fileno(), _READ_SIZE):
            *lines, unread = (unread + block).split(b"\n")
            for said in map(bytes.decode, lines):
                self._names.put(None if said == ALL_SAID else said)
                if said == ALL_SAID:
                    self._pulse.start()
        # To the main thread, wherever it waits. Should it not come out of that, it is
        # of no use any more.
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_SECONDS_TO_LEAVE)
        os._exit(1)


class _Pulse:
    """Says that the main thread is at work, to a simulation that waits for it.

    Whatever that thread waits for itself, it looks at again every second. Blocked for
    good, by a disk that does not answer for example, it uses no CPU.
    """

    def __init__(self, answers: _Answers) -> None:
        self._answers = answers
        self._clock = time.pthread_getcpuclockid(threading.main_thread().ident or 0)
        self._seconds = min(_LONGEST_BETWEEN_PULSES, patience_s() / 4)

    def start(self) -> None:
        threading.Thread(target=self._beat, name="mjrec-pulse", daemon=True).start()

    def _beat(self) -> None:
        before = 0.0
        while True:
            now = time.clock_gettime(self._clock)
            if now > before:
                self._answers.say_if_heard(pulse=now)
            before = now
            time.sleep(self._seconds)


class _Answers:
    """Says whole lines, and never waits for anybody to read them."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._unsaid = b""
        self._one_at_a_time = threading.RLock()
        os.set_blocking(descriptor, False)

    def say(self, **answer: Any) -> None:
        with self._one_at_a_time:
            self._unsaid += json.dumps(answer).encode() + b"\n"
            self._send()

    def say_if_heard(self, **answer: Any) -> None:
        """Say it, unless there is more to say than was taken."""
        with self._one_at_a_time:
            self._send()
            if not self._unsaid:
                self.say(**answer)

    def flush(self) -> None:
        """Wait until all is said."""
        with self._one_at_a_time:
            os.set_blocking(self._descriptor, True)
            self._send()

    def _send(self) -> None:
        try:
            while self._unsaid:
                sent = os.write(self._descriptor, self._unsaid)
                self._unsaid = self._unsaid[sent:]
        except BlockingIOError:
            # With the next line.
            return
        except BrokenPipeError:
            # The input will end as well.
            self._unsaid = b""


class _ToSimulation(logging.Handler):
    """Lets the simulation's process log what is worth a warning here."""

    def __init__(self, answers: _Answers) -> None:
        super().__init__(logging.WARNING)
        self._answers = answers

    def emit(self, record: logging.LogRecord) -> None:
        self._answers.say(log=[record.levelno, self.format(record)])


if __name__ == "__main__":
    sys.exit(main())
