# SPDX-License-Identifier: Apache-2.0
"""A process that draws frames: `python -m mjrec.rendering.worker`.

On its standard input it is told one JSON object a line::

    {"job": 3, "drawing": {...}, "runs": [[0, 1, 500]], "first": 1, "stride": 2}
    {"job": 4}

`drawing` is what `open_drawing` takes. `runs` are the frames of the whole job, as first
number, step and count; of their sequence this worker draws number `first` and every
`stride`-th after that. The number of a job grows, and a later one ends the one before.

What it says begins with a `pool.HEADER`. It is the bytes of a frame, `(height, width,
3) uint8`, or a JSON object::

    {"backend": "egl"}                      once, before any job
    {"size": [48, 64], "gl": {...}}         before the frames of a job
    {"error": {...}}                        instead of a frame and all that would follow
    {"log": [30, "..."]}                    for the parent's log

Whatever drivers print goes to the standard error. It ends when its standard input
does, in mid-drawing too: nothing that it does is of use to anybody but its parent.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import os
import queue
import sys
import threading
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..carried_errors import carried
from ..child_python import say_stacks_when_asked, take_standard_output
from ..gl import use_gl
from .pool import FRAME, HEADER, TEXT

if TYPE_CHECKING:
    from .drawing import Drawing

_NICE = 10


def main() -> None:
    """Draw until the standard input ends."""
    say_stacks_when_asked()
    answers = _Answers(take_standard_output())
    logging.getLogger().addHandler(_ToParent(answers))
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    orders = _Orders()
    try:
        answers.say(0, backend=os.environ.get("MUJOCO_GL") or use_gl())
        # Not at the top: mujoco reads the backend when it is imported, and that may
        # have been chosen only just now. Not later: no job waits for it.
        from .drawing import open_drawing
    except Exception as error:
        while True:
            answers.say(orders.next()["job"], error=carried(error))
    while True:
        order = orders.next()
        try:
            with contextlib.closing(open_drawing(order["drawing"])) as drawing:
                _draw(drawing, order, orders, answers)
        except Exception as error:
            answers.say(order["job"], error=carried(error))


def _draw(
    drawing: Drawing, order: Mapping[str, Any], orders: _Orders, answers: _Answers
) -> None:
    job = order["job"]
    answers.say(job, size=drawing.size, gl=drawing.gl_facts)
    frame = np.empty((*drawing.size, 3), np.uint8)
    for index in _own_part(order):
        drawing.draw(index, out=frame)
        if orders.latest != job:
            return
        answers.send(FRAME, job, frame.data.cast("B"))


def _own_part(order: Mapping[str, Any]) -> Iterator[int]:
    every = (
        first + step * place
        for first, step, count in order["runs"]
        for place in range(count)
    )
    return itertools.islice(every, order["first"], None, order["stride"])


class _Answers:
    """What is sent to the parent, in whole messages from any thread."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._one_at_a_time = threading.Lock()

    def say(self, job: int, **said: Any) -> None:
        self.send(TEXT, job, memoryview(json.dumps(said).encode()))

    def send(self, kind: bytes, job: int, content: memoryview) -> None:
        header = memoryview(HEADER.pack(kind, job, len(content)))
        try:
            with self._one_at_a_time:
                for rest in (header, content):
                    while rest:
                        rest = rest[os.write(self._pipe, rest) :]
        except OSError:
            # Nobody listens any more.
            os._exit(0)


class _Orders:
    """What the parent says; read on a thread, to be noticed in mid-drawing.

    Attributes:
        latest: the number of the job that was told last.
    """

    def __init__(self) -> None:
        self.latest = 0
        self._waiting: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=self._read, name="mjrec-orders", daemon=True).start()

    def next(self) -> dict[str, Any]:
        """Return the next order to draw, waiting for it."""
        while (order := self._waiting.get())["job"] != self.latest:
            pass
        return order

    def _read(self) -> None:
        for line in sys.stdin.buffer:
            order = json.loads(line)
            self.latest = order["job"]
            if "drawing" in order:
                self._waiting.put(order)
        # Not `sys.exit`, which would wait for the driver.
        os._exit(0)


class _ToParent(logging.Handler):
    """Lets the parent log what is worth a warning here."""

    def __init__(self, answers: _Answers) -> None:
        super().__init__(logging.WARNING)
        self._answers = answers

    def emit(self, record: logging.LogRecord) -> None:
        self._answers.say(0, log=[record.levelno, record.getMessage()])


if __name__ == "__main__":
    main()
