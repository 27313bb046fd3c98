# SPDX-License-Identifier: Apache-2.0
import gc
import logging
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from interruption import ctrl_c_soon
from processes import children
from rides import FRAMES, HEIGHT, WIDTH, record

from mjrec import child_python
from mjrec.child_python import Child
from mjrec.errors import Error, UnreadableFile
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.rendering import pool as pool_module
from mjrec.rendering.jobs import View
from mjrec.rendering.pool import WorkerPool


@pytest.fixture(scope="module")
def ride(tmp_path_factory):
    return record(tmp_path_factory.mktemp("ride"))


@pytest.fixture(scope="module")
def three():
    """Three workers, which stay from test to test."""
    with WorkerPool(3) as three:
        yield three


@pytest.fixture
def one():
    with WorkerPool(1) as one:
        yield one


def pids(pool):
    return [worker.child.pid for worker in pool._workers if worker.child is not None]


def draw_otherwise(monkeypatch, body):
    """Let workers draw with other code, which may call `draw(self, index, **rest)`."""
    code = f"""
import logging, os, pathlib, signal, sys, threading, time
import mjrec.rendering.worker as worker
draw = worker.Drawing.draw
def draw_otherwise(self, index, **rest):
{textwrap.indent(textwrap.dedent(body), "    ")}
worker.Drawing.draw = draw_otherwise
worker.main()
"""
    command = [sys.executable, "-c", code]
    monkeypatch.setattr(child_python, "python_command", lambda _: command)


# In order, whoever draws


@pytest.mark.parametrize("indices", [range(FRAMES), [0, 2, 3, 7, 8]])
def test_any_workers_give_what_was_seen(ride, one, three, indices):
    """Byte for byte, over an infinite plane, whose place depends on the frame before.

    Of some frames too; and who draws is known from the first frame on.
    """
    expected = [ride.frames[index] for index in indices]
    assert np.array_equal(list(one.frames(ride.path, indices)), expected)
    assert np.array_equal(list(three.frames(ride.path, indices, View())), expected)
    assert len(pids(three)) == 3
    strings = {"gl_vendor", "gl_renderer", "gl_version"}
    assert three.gl_facts.keys() - {"gl_device"} == strings
    assert os.getpriority(os.PRIO_PROCESS, pids(one)[0]) == 10


def test_few_frames_are_kept_here(tmp_path, three):
    """However slow the caller is: two of each worker, besides what its pipe holds."""
    ride = record(tmp_path, count=40)
    kept = []
    for frame in three.frames(ride.path, range(40)):
        # They are the caller's to keep, and to write to.
        kept.append(frame.copy())
        frame[:] = 1
        assert all(len(worker.arrived) <= 2 for worker in three._workers)
    assert np.array_equal(kept, ride.frames)


def test_workers_stay_and_go_over_to_other_views(ride, three):
    """Larger and smaller frames, and none that shows what the last have changed."""
    list(three.frames(ride.path, range(5)))
    before = pids(three)
    for height in (20, 90):
        for frame in three.frames(ride.path, range(5), View(height=height)):
            assert frame.shape == (height, WIDTH, 3)
    assert pids(three) == before
    # Some are dropped.
    next(three.frames(ride.path, range(FRAMES)))
    assert np.array_equal(list(three.frames(ride.path, range(FRAMES))), ride.frames)


def test_a_grid_is_what_each_camera_shows(ride, three, tmp_path):
    """Byte for byte; and so it is where the log has become HDF5."""
    side = record(tmp_path, camera="side")
    path, numbers = finish_trajectory(side.path), range(FRAMES)
    frames = three.frames(path, numbers, cameras=[None, "rider", "side"])
    for number, frame in zip(numbers, frames, strict=True):
        upper, lower = frame[:HEIGHT], frame[HEIGHT:]
        np.testing.assert_array_equal(upper[:, :WIDTH], side.frames[number])
        np.testing.assert_array_equal(upper[:, WIDTH:], ride.frames[number])
        np.testing.assert_array_equal(lower[:, :WIDTH], side.frames[number])
        assert not lower[:, WIDTH:].any()


# What goes wrong


def test_a_killed_worker_is_replaced(tmp_path, caplog):
    """What it was drawing is drawn again, and the log says so."""
    ride = record(tmp_path, count=40)
    with WorkerPool(2) as pool:
        frames = pool.frames(ride.path, range(40))
        drawn = [next(frames)]
        for pid in pids(pool):
            os.kill(pid, signal.SIGKILL)
        drawn += frames
    assert np.array_equal(drawn, ride.frames)
    assert "killed by SIGKILL" in caplog.text


def test_a_worker_that_hangs_is_replaced_and_the_log_says_where(
    ride, tmp_path, monkeypatch, caplog
):
    """Nothing of it is missing or comes twice."""
    hung = tmp_path / "hung"
    draw_otherwise(
        monkeypatch,
        f"""
        hung = pathlib.Path({str(hung)!r})
        if index == 3 and not hung.exists():
            hung.touch()
            threading.Event().wait()
        return draw(self, index, **rest)
        """,
    )
    with WorkerPool(1) as pool:
        frames = pool.frames(ride.path, range(FRAMES))
        pool._timeout.seconds = 0.5
        stacks = Child.stacks

        def give_the_next_one_time(child):
            pool._timeout.seconds = 120
            return stacks(child)

        monkeypatch.setattr(Child, "stacks", give_the_next_one_time)
        assert np.array_equal(list(frames), ride.frames)
    assert "it has drawn nothing for 0.5 seconds" in caplog.text
    assert "in draw_otherwise" in caplog.text


def test_a_worker_that_dies_twice_is_an_error(ride, monkeypatch):
    """It names the signal, the file, and what the worker said, with Python's stack."""
    draw_otherwise(
        monkeypatch,
        """
        print("llvm: out of registers", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGSEGV)
        """,
    )
    words = r"(?s)SIGSEGV.*out of registers.*in draw_otherwise"
    with WorkerPool(2) as pool, pytest.raises(Error, match=words) as caught:
        pool.frames(ride.path, range(FRAMES))
    assert str(ride.path) in str(caught.value)


def test_what_a_worker_says_is_heard(ride, monkeypatch, caplog):
    """Warnings are logged here; what a driver prints is not, however much."""
    draw_otherwise(
        monkeypatch,
        """
        os.write(1, b"x" * 100_000)
        print("a driver speaks")
        logging.getLogger("x").error("no %s", "GPU")
        return draw(self, index, **rest)
        """,
    )
    with WorkerPool(1) as pool:
        assert np.array_equal(list(pool.frames(ride.path, range(4))), ride.frames[:4])
    levels = {r.getMessage(): r.levelno for r in caplog.records}
    assert levels == {"no GPU": logging.ERROR}


# Their life


def test_forgotten_workers_end(ride):
    """Garbage collection is enough."""
    before = children()
    pool = WorkerPool(1)
    frames = pool.frames(ride.path, range(FRAMES))
    next(frames)
    assert len(children() - before) == 1
    del pool, frames
    gc.collect()
    assert children() == before


def test_ctrl_c_while_a_frame_is_drawn(ride, one):
    """It reaches only the parent; another worker draws for the next call."""
    list(one.frames(ride.path, [0]))
    [pid] = pids(one)
    large = View(height=1000, width=1400)
    with ctrl_c_soon(), pytest.raises(KeyboardInterrupt):
        list(one.frames(ride.path, range(FRAMES), large))

    assert np.array_equal(list(one.frames(ride.path, [4])), [ride.frames[4]])
    [another] = pids(one)
    assert another != pid
    assert os.getsid(another) == another


# What draws


# Takes more than five seconds: both backends are tried by processes of their own.
def test_where_egl_does_not_work_another_backend_draws(ride, monkeypatch):
    """No frame is lost or drawn by EGL, and nothing is tried twice."""
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    with WorkerPool(2) as pool:
        assert len(list(pool.frames(ride.path, range(FRAMES)))) == FRAMES
        before = pids(pool)
        assert len(list(pool.frames(ride.path, range(FRAMES)))) == FRAMES
        assert pids(pool) == before
        environment = Path(f"/proc/{before[0]}/environ").read_bytes().split(b"\0")
    assert b"MUJOCO_GL=osmesa" in environment


# CPUs, shared by all that render into a directory

# Takes what is free of the two CPUs of argv[1], says how many, and waits.
HOLDER = """
import pathlib, sys
from mjrec.rendering import pool
pool.usable_cpus = lambda: 2
shared = pool.WorkerPool(None, directory=pathlib.Path(sys.argv[1]))
print(shared._free(), flush=True)
sys.stdin.read()
"""


def test_the_cpus_of_another_process_are_waited_for(tmp_path, monkeypatch):
    """Until it rests or dies; the files of a dead one do not count."""
    monkeypatch.setattr(pool_module, "usable_cpus", lambda: 2)
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as holder:
        assert holder.stdout.readline() == b"2\n"
        threading.Timer(0.3, holder.kill).start()
        began = time.monotonic()
        shared = WorkerPool(None, directory=tmp_path)
        with pytest.raises(UnreadableFile):
            shared.frames(tmp_path / "lost.h5", [0])
    assert time.monotonic() - began >= 0.3
    assert len(pids(shared)) == 1
    shared.close()
