# SPDX-License-Identifier: Apache-2.0
"""A process that draws pictures: `python -m mjrec.rendering.worker DESCRIPTOR`.

DESCRIPTOR is the file descriptor of a `FrameRing`. Both sides say one JSON object a
line. On its standard input it is told::

    {"job": 3, "drawing": {...}, "pictures": [[position, index, slot], ...]}
    {"cancel": 3}

`drawing` is what `open_drawing` takes. A job is what one caller wants from all
workers; its number grows. On its standard output it says::

    {"backend": "egl"}                                      once, before anything else
    {"job": 3, "size": [48, 64], "gl": {...}}               before its first picture
    {"job": 3, "position": 0}                               the picture is in its slot
    {"job": 3, "position": 1, "error": {...}}               there will be none
    {"error": {...}}                                        instead of a backend
    {"log": [30, "..."]}                                    for the parent's log

Whatever drivers print goes to the standard error. It ends when its standard input
does, in mid-drawing too: nothing that it does is of use to anybody but its parent.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import sys
import threading
from collections.abc import Mapping
from typing import IO, Any

from ..carried_errors import carried
from ..child_python import say_stacks_when_asked, take_standard_output
from ..gl import use_gl
from .frame_ring import FrameRing

_NICE = 10


def main() -> None:
    """Draw until the standard input ends."""
    say_stacks_when_asked()
    answers = _Answers(os.fdopen(take_standard_output(), "wb"))
    logging.getLogger().addHandler(_ToParent(answers))
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    orders = _Orders()
    try:
        answers.say(backend=os.environ.get("MUJOCO_GL") or use_gl())
    except Exception as error:
        answers.say(error=carried(error))
        # The answer is what the parent waits for; it ends this process.
        orders.wait_for_end()
    _Desk(FrameRing(int(sys.argv[1])), answers).serve(orders)


class _Answers:
    """What is said to the parent, in whole lines from any thread."""

    def __init__(self, pipe: IO[bytes]) -> None:
        self._pipe = pipe
        self._one_at_a_time = threading.Lock()

    def say(self, **answer: Any) -> None:
        line = json.dumps(answer).encode() + b"\n"
        try:
            with self._one_at_a_time:
                self._pipe.write(line)
                self._pipe.flush()
        except OSError:
            # Nobody listens any more.
            os._exit(0)


class _Orders:
    """What the parent says; read on a thread, to be noticed in mid-drawing."""

    def __init__(self) -> None:
        self._waiting: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._cancelled = 0
        threading.Thread(target=self._read, name="mjrec-orders", daemon=True).start()

    def next(self) -> dict[str, Any]:
        """Return the next order for pictures, waiting for it."""
        return self._waiting.get()

    def is_cancelled(self, job: int) -> bool:
        """Return whether the pictures of this job are not wanted any more."""
        return job <= self._cancelled

    def wait_for_end(self) -> None:
        """Wait for the end of this process."""
        while True:
            self._waiting.get()

    def _read(self) -> None:
        for line in sys.stdin.buffer:
            order = json.loads(line)
            if "cancel" in order:
                self._cancelled = order["cancel"]
            else:
                self._waiting.put(order)
        # Not `sys.exit`, which would wait for the driver.
        os._exit(0)


class _Desk:
    """Draws what is ordered, keeping the drawing of a job from order to order."""

    def __init__(self, ring: FrameRing, answers: _Answers) -> None:
        self._ring = ring
        self._answers = answers
        self._job = 0
        self._drawing: Any = None

    def serve(self, orders: _Orders) -> None:
        """Draw what is ordered, for ever."""
        while True:
            order = orders.next()
            for position, index, slot in order["pictures"]:
                if not orders.is_cancelled(order["job"]):
                    self._draw(order, position, index, slot)

    def _draw(
        self, order: Mapping[str, Any], position: int, index: int, slot: int
    ) -> None:
        answer: dict[str, Any] = {"job": order["job"], "position": position}
        try:
            self._open(order)
            self._drawing.draw(index, out=self._ring.slot(slot))
        except Exception as error:
            answer["error"] = carried(error)
        self._answers.say(**answer)

    def _open(self, order: Mapping[str, Any]) -> None:
        if self._job == order["job"]:
            return
        # Here, because mujoco reads the backend when it is imported, and that was
        # chosen only just now.
        from .drawing import open_drawing

        self._close()
        self._drawing = open_drawing(order["drawing"])
        self._ring.shape(*self._drawing.size)
        self._job = order["job"]
        self._answers.say(
            job=self._job, size=self._drawing.size, gl=self._drawing.gl_facts
        )

    def _close(self) -> None:
        drawing, self._drawing, self._job = self._drawing, None, 0
        if drawing is not None:
            drawing.close()


class _ToParent(logging.Handler):
    """Lets the parent log what is worth a warning here."""

    def __init__(self, answers: _Answers) -> None:
        super().__init__(logging.WARNING)
        self._answers = answers

    def emit(self, record: logging.LogRecord) -> None:
        self._answers.say(log=[record.levelno, record.getMessage()])


if __name__ == "__main__":
    main()
