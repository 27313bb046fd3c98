# SPDX-License-Identifier: Apache-2.0
"""A process that draws frames: `python -m mjrec.rendering.worker`.

On its standard input it is told one JSON object a line::

    {"drawing": {...}, "runs": [[1, 2, 250]]}

`drawing` is what `open_drawing` takes; `runs` are the frames, as first number, step and
count. What it says begins with a `pool.HEADER`. It is the bytes of a frame,
`(height, width, 3) uint8`, or a JSON object::

    {"size": [48, 64], "gl": {...}}         before the frames of a job
    {"error": {...}}                        instead of a frame and all that would follow
    {"log": [30, "..."]}                    for the parent's log
    {"untried": "..."}                      with `--try`, where a frame of its own is
                                            not what it should be: then it ends

Whatever drivers print goes to the standard error. It ends when its standard input
does, in mid-drawing too: nothing that it does is of use to anybody but its parent.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import sys
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..child_python import carried, say_stacks_when_asked, take_standard_output
from ..simulation.gl_probe import draw_test_scene
from ..simulation.renderer import Canvas
from .drawing import open_drawing
from .pool import FRAME, HEADER, TEXT, TRY

_NICE = 10


def main() -> None:
    """Draw until the standard input ends."""
    say_stacks_when_asked()
    answers = _Answers(take_standard_output())
    logging.getLogger().addHandler(_ToParent(answers))
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    orders: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=[orders], daemon=True).start()
    if TRY in sys.argv[1:]:
        try:
            draw_test_scene()
        except Exception as error:
            answers.say(untried=str(error))
            # Not `sys.exit`, which would wait for the driver.
            os._exit(1)
    canvas = Canvas()
    while True:
        order = orders.get()
        try:
            _draw(order, canvas, answers)
        except Exception as error:
            answers.say(error=carried(error))


def _read(orders: queue.SimpleQueue[dict[str, Any]]) -> None:
    """Read what the parent says, and notice its end in mid-drawing."""
    for line in sys.stdin.buffer:
        orders.put(json.loads(line))
    # Not `sys.exit`, which would wait for the driver.
    os._exit(0)


def _draw(order: Mapping[str, Any], canvas: Canvas, answers: _Answers) -> None:
    with contextlib.closing(open_drawing(order["drawing"], canvas)) as drawing:
        answers.say(size=drawing.size, gl=drawing.gl_facts)
        frame = np.empty((*drawing.size, 3), np.uint8)
        for first, step, count in order["runs"]:
            for place in range(count):
                drawing.draw(first + step * place, out=frame)
                answers.send(FRAME, frame.data.cast("B"))


class _Answers:
    """What is sent to the parent, in whole messages from any thread."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._one_at_a_time = threading.Lock()

    def say(self, **said: Any) -> None:
        self.send(TEXT, memoryview(json.dumps(said).encode()))

    def send(self, kind: bytes, content: memoryview) -> None:
        header = memoryview(HEADER.pack(kind, len(content)))
        try:
            with self._one_at_a_time:
                for rest in (header, content):
                    while rest:
                        rest = rest[os.write(self._pipe, rest) :]
        except OSError:
            # Nobody listens any more.
            os._exit(0)


class _ToParent(logging.Handler):
    """Lets the parent log what is worth a warning here."""

    def __init__(self, answers: _Answers) -> None:
        super().__init__(logging.WARNING)
        self._answers = answers

    def emit(self, record: logging.LogRecord) -> None:
        self._answers.say(log=[record.levelno, record.getMessage()])


if __name__ == "__main__":
    main()
