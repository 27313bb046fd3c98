# SPDX-License-Identifier: Apache-2.0
"""Test the bounded worker thread."""

import pytest
from other_python import run_python

from mjrec.worker_thread import WorkerThread


@pytest.mark.parametrize("end", [WorkerThread.close, WorkerThread.abort])
def test_ending_a_worker_on_its_own_thread_does_not_block(end):
    """Garbage collection on the worker's own thread may finalize its owner."""
    ended = []
    worker = WorkerThread(lambda _: ended.append(end(worker)), capacity=5, name="w")
    worker.put(1)
    worker.close()
    assert ended == [None]


def test_forks_and_interpreter_exit_do_not_wait_for_the_thread():
    """In a fork, `put` raises an error; a hanging consumer does not block the exit."""
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
    run_python(code, timeout=60)
