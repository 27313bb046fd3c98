# SPDX-License-Identifier: Apache-2.0
"""The bounded worker thread."""

from __future__ import annotations

import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from typing import Any

import pytest
from interruption import ctrl_c_soon

from mjrec.errors import ClosedError
from mjrec.worker_thread import WorkerThread


class Boom(Exception):
    pass


def before_waiting(worker: WorkerThread[Any], act: Callable[[], object]) -> None:
    """Call `act` when a `put` is about to wait for room."""
    condition, consumer = worker._changed, worker._thread
    wait = condition.wait

    def act_and_wait(timeout: float | None = None) -> bool:
        if threading.current_thread() is not consumer:
            act()
        return wait(timeout)

    condition.wait = act_and_wait  # type: ignore[method-assign]  # only this one's


def until_error(worker: WorkerThread[int]) -> None:
    """Put until the consumer's error comes home."""
    while True:
        worker.put(0)


def test_items_are_consumed_in_order_on_one_other_thread() -> None:
    """Everything put before close, once, then the finish; after it nothing is taken."""
    seen: list[tuple[int, str]] = []

    def consume(item: int) -> None:
        seen.append((item, threading.current_thread().name))

    worker = WorkerThread[int](
        consume, capacity=3, name="w", finish=lambda: consume(100)
    )
    for number in range(100):
        worker.put(number)
    worker.close()
    worker.close()
    assert seen == [(number, "mjrec-w") for number in range(101)]
    with pytest.raises(ClosedError, match="w is closed"):
        worker.put(1)


@pytest.mark.parametrize("error", [Boom, SystemExit])
def test_the_consumers_own_error_comes_home(error: type[BaseException]) -> None:
    """Each put raises the very exception, else close does, once."""

    def fail(item: int) -> None:
        raise error(item)

    worker = WorkerThread[int](fail, capacity=2, name="w")
    with pytest.raises(error) as first:
        until_error(worker)
    with pytest.raises(error) as second:
        worker.put(1)
    assert first.value is second.value
    worker.close()
    worker = WorkerThread[int](fail, capacity=2, name="w")
    worker.put(1)
    with pytest.raises(error):
        worker.close()
    worker.close()


def test_put_waits_while_the_queue_is_full() -> None:
    """With the consumer held, the third put of a queue of one does not return."""
    gate, in_hand, waits, third = (threading.Event() for _ in range(4))
    seen: list[int] = []

    def consume(item: int) -> None:
        in_hand.set()
        assert gate.wait(30)
        seen.append(item)

    worker = WorkerThread[int](consume, capacity=1, name="w")
    before_waiting(worker, waits.set)
    worker.put(1)
    assert in_hand.wait(30)
    worker.put(2)
    putter = threading.Thread(target=lambda: (worker.put(3), third.set()))
    putter.start()
    assert waits.wait(30)
    assert not third.is_set()
    gate.set()
    assert third.wait(30)
    putter.join()
    worker.close()
    assert seen == [1, 2, 3]


def test_a_put_that_waits_is_woken_by_the_consumers_death() -> None:
    """A caller blocked on a full queue gets the error instead of waiting forever."""
    gate, in_hand = threading.Event(), threading.Event()

    def consume(item: int) -> None:
        in_hand.set()
        assert gate.wait(30)
        raise Boom

    worker = WorkerThread[int](consume, capacity=1, name="w")
    worker.put(1)
    assert in_hand.wait(30)
    worker.put(2)
    before_waiting(worker, gate.set)
    with pytest.raises(Boom):
        worker.put(3)


class Item:
    """Something whose end can be seen."""


def test_abort_drops_what_waits() -> None:
    """Only the item in hand is consumed, and the finish is left out."""
    in_hand, dropped = threading.Event(), threading.Event()
    seen: list[Item | None] = []

    def consume(item: Item) -> None:
        in_hand.set()
        assert dropped.wait(30)
        seen.append(item)

    worker = WorkerThread[Item](
        consume, capacity=5, name="w", finish=lambda: seen.append(None)
    )
    items = [Item() for _ in range(4)]
    weakref.finalize(items[-1], dropped.set)
    for item in items:
        worker.put(item)
    assert in_hand.wait(30)
    first = items[0]
    del items, item
    worker.abort()
    worker.abort()
    assert seen == [first]


@pytest.mark.parametrize("call", ["close", "abort"])
def test_an_end_on_the_thread_itself_waits_for_nothing(call: str) -> None:
    """As when the consumer's garbage collection ends the worker's owner."""
    go, done = threading.Event(), threading.Event()
    seen: list[int] = []

    def consume(item: int) -> None:
        seen.append(item)
        assert go.wait(30)
        getattr(worker, call)()

    worker = WorkerThread[int](consume, capacity=5, name="w", finish=done.set)
    worker.put(1)
    worker.put(2)
    go.set()
    worker.close()
    assert (seen, done.is_set()) == {
        "close": ([1, 2], True),
        "abort": ([1], False),
    }[call]


def test_an_interrupted_close_can_be_called_again() -> None:
    """The second waits for the thread as the first would have."""
    gate = threading.Event()
    seen: list[int] = []

    def consume(item: int) -> None:
        assert gate.wait(30)
        seen.append(item)

    worker = WorkerThread[int](consume, capacity=9, name="w")
    for number in range(5):
        worker.put(number)
    for _ in range(2):
        with ctrl_c_soon(), pytest.raises(KeyboardInterrupt):
            worker.close()
    gate.set()
    worker.close()
    assert seen == [0, 1, 2, 3, 4]


def test_without_a_thread_put_consumes(monkeypatch: pytest.MonkeyPatch) -> None:
    """As at interpreter exit from Python 3.12 on; an error is raised at once."""

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't create new thread at interpreter shutdown")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    seen: list[int] = []
    worker = WorkerThread[int](
        seen.append, capacity=1, name="w", finish=lambda: seen.append(-1)
    )
    for number in range(3):
        worker.put(number)
        assert seen == list(range(number + 1))
    worker.close()
    worker.close()
    assert seen == [0, 1, 2, -1]
    worker = WorkerThread[int](lambda item: seen[item], capacity=1, name="w")
    for _ in range(2):
        with pytest.raises(IndexError):
            worker.put(9)
    assert worker.failed


def test_items_are_consumed_in_an_exit_hook() -> None:
    """Whether or not this Python can start a thread there."""
    code = (
        "import atexit\n"
        "from mjrec.worker_thread import WorkerThread\n"
        "def hook():\n"
        "    worker = WorkerThread(print, capacity=2, name='w', "
        "finish=lambda: print('end'))\n"
        "    for number in range(5):\n"
        "        worker.put(number)\n"
        "    worker.close()\n"
        "atexit.register(hook)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, timeout=60, stdout=subprocess.PIPE
    )
    assert done.stdout.split() == [b"0", b"1", b"2", b"3", b"4", b"end"]


def test_a_blocked_consumer_does_not_hold_the_interpreter() -> None:
    """A script whose consumer hangs still ends."""
    code = (
        "import threading\n"
        "from mjrec.worker_thread import WorkerThread\n"
        "worker = WorkerThread(lambda item: threading.Event().wait(), "
        "capacity=1, name='w')\n"
        "worker.put(1)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_a_forked_child_is_told_that_it_has_no_thread() -> None:
    """Put and close in a fork do not wait for a thread that is not there."""
    code = (
        "import os\n"
        "from mjrec.errors import ClosedError\n"
        "from mjrec.worker_thread import WorkerThread\n"
        "worker = WorkerThread(print, capacity=1, name='w')\n"
        "child = os.fork()\n"
        "if child == 0:\n"
        "    try:\n"
        "        worker.put(1)\n"
        "    except ClosedError:\n"
        "        worker.close()\n"
        "        os._exit(7)\n"
        "worker.close()\n"
        "assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
