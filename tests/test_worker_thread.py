# SPDX-License-Identifier: Apache-2.0
"""The bounded worker thread."""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import pytest

from mjrec.errors import ClosedError
from mjrec.worker_thread import WorkerThread


def held() -> tuple[WorkerThread[Any], threading.Event, threading.Event, list[Any]]:
    """Return a worker, whether it has an item, what lets it go on, and what it took."""
    in_hand, gate = threading.Event(), threading.Event()
    seen: list[Any] = []

    def consume(item: Any) -> None:
        in_hand.set()
        assert gate.wait(30)
        seen.append(item)
        if isinstance(item, BaseException):
            raise item

    worker = WorkerThread[Any](
        consume, capacity=1, name="w", finish=lambda: seen.append("end")
    )
    return worker, in_hand, gate, seen


def test_items_are_consumed_in_order_on_one_other_thread() -> None:
    """Every item, then the finish, while `put` waits; after `abort` that in hand."""
    worker, in_hand, gate, seen = held()
    worker.put(1)
    assert in_hand.wait(30)
    worker.put(2)
    putter = threading.Thread(target=lambda: worker.put(3))
    putter.start()
    putter.join(0.05)
    assert putter.is_alive()
    gate.set()
    putter.join(30)
    worker.close()
    worker.close()
    assert seen == [1, 2, 3, "end"]
    with pytest.raises(ClosedError, match="w is closed"):
        worker.put(1)
    worker, in_hand, gate, seen = held()
    worker.put(1)
    assert in_hand.wait(30)
    worker.put(2)
    threading.Timer(0.05, gate.set).start()
    worker.abort()
    assert seen == [1]


def test_the_consumers_own_error_comes_home() -> None:
    """Whatever it is: a put that waits raises it, and so does each later one."""
    worker, in_hand, gate, _ = held()
    error = SystemExit()
    worker.put(error)
    assert in_hand.wait(30)
    worker.put(1)
    threading.Timer(0.05, gate.set).start()
    for item in (2, 3):
        with pytest.raises(SystemExit) as caught:
            worker.put(item)
        assert caught.value is error
    worker.close()


@pytest.mark.parametrize("call", ["close", "abort"])
def test_an_end_on_the_thread_itself_waits_for_nothing(call: str) -> None:
    """As when the consumer's garbage collection ends the worker's owner."""
    seen: list[int] = []

    def consume(item: int) -> None:
        seen.append(item)
        getattr(worker, call)()

    worker = WorkerThread[int](consume, capacity=5, name="w")
    worker.put(1)
    worker.close()
    assert seen == [1]


def test_neither_forks_nor_the_interpreter_wait_for_the_thread() -> None:
    """A fork is told that it has none; a script whose consumer hangs still ends."""
    code = (
        "import os, threading\n"
        "from mjrec.errors import ClosedError\n"
        "from mjrec.worker_thread import WorkerThread\n"
        "hang = threading.Event().wait\n"
        "worker = WorkerThread(lambda item: hang(), capacity=1, name='w')\n"
        "worker.put(1)\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    try:\n"
        "        worker.put(1)\n"
        "    except ClosedError:\n"
        "        worker.close()\n"
        "        os._exit(7)\n"
        "assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
