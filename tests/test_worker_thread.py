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


def fail(item: object) -> None:
    raise Boom(item)


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
    """Everything put before close is consumed, once, in order, by one thread."""
    seen: list[tuple[int, int]] = []
    worker = WorkerThread[int](
        lambda item: seen.append((item, threading.get_ident())), capacity=3, name="w"
    )
    for number in range(100):
        worker.put(number)
    worker.close()
    assert [number for number, _ in seen] == list(range(100))
    assert len({thread for _, thread in seen} | {threading.get_ident()}) == 2


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


def test_the_consumers_own_error_is_raised_by_put() -> None:
    """A put after the failure raises the very exception, and so does the next."""
    worker = WorkerThread[int](fail, capacity=2, name="w")
    with pytest.raises(Boom) as first:
        until_error(worker)
    with pytest.raises(Boom) as second:
        worker.put(1)
    assert first.value is second.value
    worker.close()


def test_the_consumers_error_is_raised_by_close_once() -> None:
    """An error that no put has raised is raised by close, and only by the first."""
    worker = WorkerThread[int](fail, capacity=8, name="w")
    worker.put(1)
    with pytest.raises(Boom):
        worker.close()
    worker.close()


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


def test_even_system_exit_comes_home() -> None:
    """What is not an Exception does not end the thread unseen."""

    def leave(item: int) -> None:
        sys.exit(3)

    worker = WorkerThread[int](leave, capacity=1, name="w")
    worker.put(1)
    with pytest.raises(SystemExit):
        worker.close()


def test_put_after_close_is_an_error() -> None:
    """A closed worker takes nothing; closing again is harmless."""
    worker = WorkerThread[int](lambda item: None, capacity=1, name="video writer")
    worker.close()
    worker.close()
    with pytest.raises(ClosedError, match="video writer"):
        worker.put(1)


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


def test_an_interrupted_close_can_be_called_again() -> None:
    """The second waits for the thread as the first would have."""
    gate, in_hand = threading.Event(), threading.Event()
    seen: list[int] = []

    def consume(item: int) -> None:
        in_hand.set()
        assert gate.wait(30)
        seen.append(item)

    worker = WorkerThread[int](
        consume, capacity=9, name="w", finish=lambda: seen.append(-1)
    )
    for number in range(5):
        worker.put(number)
    assert in_hand.wait(30)
    for _ in range(2):
        with ctrl_c_soon(), pytest.raises(KeyboardInterrupt):
            worker.close()
    gate.set()
    worker.close()
    assert seen == [0, 1, 2, 3, 4, -1]


def test_close_on_the_thread_itself_waits_for_nothing() -> None:
    """As when the consumer's garbage collection ends the worker's owner."""
    done = threading.Event()
    seen: list[int] = []

    def consume(item: int) -> None:
        seen.append(item)
        assert owner.wait(30)
        worker.close()

    owner = threading.Event()
    worker = WorkerThread[int](consume, capacity=5, name="w", finish=done.set)
    worker.put(1)
    worker.put(2)
    owner.set()
    assert done.wait(30)
    worker.close()
    assert seen == [1, 2]


def test_abort_on_the_thread_itself_waits_for_nothing() -> None:
    """What waits is dropped, and the thread ends."""
    go = threading.Event()
    seen: list[int] = []

    def consume(item: int) -> None:
        seen.append(item)
        assert go.wait(30)
        worker.abort()

    worker = WorkerThread[int](consume, capacity=5, name="w")
    worker.put(1)
    worker.put(2)
    go.set()
    worker.close()
    assert seen == [1]


def test_the_threads_name_tells_whose_it_is() -> None:
    """Others recognise our threads by the beginning of their names."""
    names: list[str] = []
    worker = WorkerThread[int](
        lambda _: names.append(threading.current_thread().name), capacity=1, name="w"
    )
    worker.put(1)
    worker.close()
    assert names == ["mjrec-w"]


@pytest.fixture
def no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """No thread can be started, as at interpreter exit from Python 3.12 on."""

    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't create new thread at interpreter shutdown")

    monkeypatch.setattr(threading.Thread, "start", refuse)


@pytest.mark.usefixtures("no_threads")
def test_without_a_thread_put_consumes() -> None:
    """Each item before the next, the finish at the end and once."""
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
    with pytest.raises(ClosedError, match="w is closed"):
        worker.put(3)


@pytest.mark.usefixtures("no_threads")
def test_without_a_thread_an_error_is_raised_by_put() -> None:
    """At once, and again; the finish is left out."""
    seen: list[int] = []
    worker = WorkerThread[int](
        fail, capacity=1, name="w", finish=lambda: seen.append(-1)
    )
    for _ in range(2):
        with pytest.raises(Boom):
            worker.put(1)
    assert worker.failed
    worker.close()
    worker.abort()
    assert seen == []


@pytest.mark.usefixtures("no_threads")
def test_without_a_thread_close_within_an_item_comes_after_it() -> None:
    """A signal's handler may close in the midst of an item."""
    seen: list[int] = []

    def consume(item: int) -> None:
        worker.close()
        seen.append(item)

    worker = WorkerThread[int](
        consume, capacity=1, name="w", finish=lambda: seen.append(-1)
    )
    worker.put(1)
    assert seen == [1, -1]


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


def test_leave_lets_the_thread_end_by_itself() -> None:
    """Without anybody waiting, the rest is consumed and the finish is called."""
    done = threading.Event()
    seen: list[int] = []
    worker = WorkerThread[int](seen.append, capacity=5, name="w", finish=done.set)
    for number in range(5):
        worker.put(number)
    worker.leave()
    assert done.wait(30)
    assert seen == list(range(5))


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


def test_capacity_is_checked() -> None:
    """A queue of nothing could never take an item."""
    with pytest.raises(ValueError, match="capacity"):
        WorkerThread[int](print, capacity=0, name="w")
