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
def pool_of_3():
    """Three workers, shared by the tests of this module."""
    with WorkerPool(3) as pool:
        yield pool


@pytest.fixture
def pool_of_1():
    with WorkerPool(1) as pool:
        yield pool


def pids(pool):
    return [worker.child.pid for worker in pool._workers if worker.child is not None]


def patch_drawing(monkeypatch, body):
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


# Frames in order


@pytest.mark.parametrize("indices", [range(FRAMES), [0, 2, 3, 7, 8]])
def test_any_number_of_workers_renders_the_recorded_frames(
    ride, pool_of_1, pool_of_3, indices
):
    """They are equal byte for byte, even if an infinite plane follows the camera."""
    expected = [ride.frames[index] for index in indices]
    assert np.array_equal(list(pool_of_1.frames(ride.path, indices)), expected)
    assert np.array_equal(list(pool_of_3.frames(ride.path, indices, View())), expected)
    assert len(pids(pool_of_3)) == 3
    strings = {"gl_vendor", "gl_renderer", "gl_version"}
    assert pool_of_3.gl_facts.keys() - {"gl_device"} == strings
    assert os.getpriority(os.PRIO_PROCESS, pids(pool_of_1)[0]) == 10


def test_at_most_two_frames_of_each_worker_are_waiting(tmp_path, pool_of_3):
    ride = record(tmp_path, count=40)
    kept = []
    for frame in pool_of_3.frames(ride.path, range(40)):
        # The caller may overwrite a frame.
        kept.append(frame.copy())
        frame[:] = 1
        assert all(len(worker.arrived) <= 2 for worker in pool_of_3._workers)
    assert np.array_equal(kept, ride.frames)


def test_workers_stay_for_other_sizes_and_after_unfinished_calls(ride, pool_of_3):
    """Changes of the model by earlier calls do not show."""
    list(pool_of_3.frames(ride.path, range(5)))
    before = pids(pool_of_3)
    for height in (20, 90):
        for frame in pool_of_3.frames(ride.path, range(5), View(height=height)):
            assert frame.shape == (height, WIDTH, 3)
    assert pids(pool_of_3) == before
    # The caller abandons this call after a frame.
    next(pool_of_3.frames(ride.path, range(FRAMES)))
    assert np.array_equal(list(pool_of_3.frames(ride.path, range(FRAMES))), ride.frames)


def test_a_grid_has_each_cameras_frame_byte_for_byte(ride, pool_of_3, tmp_path):
    side = record(tmp_path, camera="side")
    path, numbers = finish_trajectory(side.path), range(FRAMES)
    frames = pool_of_3.frames(path, numbers, cameras=[None, "rider", "side"])
    for number, frame in zip(numbers, frames, strict=True):
        upper, lower = frame[:HEIGHT], frame[HEIGHT:]
        np.testing.assert_array_equal(upper[:, :WIDTH], side.frames[number])
        np.testing.assert_array_equal(upper[:, WIDTH:], ride.frames[number])
        np.testing.assert_array_equal(lower[:, :WIDTH], side.frames[number])
        assert not lower[:, WIDTH:].any()


# Failures


def test_killed_workers_are_replaced_without_losing_frames(tmp_path, caplog):
    ride = record(tmp_path, count=40)
    with WorkerPool(2) as pool:
        frames = pool.frames(ride.path, range(40))
        drawn = [next(frames)]
        for pid in pids(pool):
            os.kill(pid, signal.SIGKILL)
        drawn += frames
    assert np.array_equal(drawn, ride.frames)
    assert "killed by SIGKILL" in caplog.text


def test_a_hanging_worker_is_replaced_and_its_stack_logged(
    ride, tmp_path, monkeypatch, caplog
):
    """Every frame comes once."""
    hung = tmp_path / "hung"
    patch_drawing(
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

        def give_the_next_worker_time(child):
            pool._timeout.seconds = 120
            return stacks(child)

        monkeypatch.setattr(Child, "stacks", give_the_next_worker_time)
        assert np.array_equal(list(frames), ride.frames)
    assert "it has drawn nothing for 0.5 seconds" in caplog.text
    assert "in draw_otherwise" in caplog.text


def test_a_worker_that_dies_twice_is_an_error(ride, monkeypatch):
    """The error has the signal, the file, the worker's stderr and Python's stack."""
    patch_drawing(
        monkeypatch,
        """
        print("llvm: out of registers", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGSEGV)
        """,
    )
    message = r"(?s)SIGSEGV.*out of registers.*in draw_otherwise"
    with WorkerPool(2) as pool, pytest.raises(Error, match=message) as caught:
        pool.frames(ride.path, range(FRAMES))
    assert str(ride.path) in str(caught.value)


def test_a_workers_warnings_are_logged_and_prints_ignored(ride, monkeypatch, caplog):
    patch_drawing(
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


# Ends


def test_garbage_collection_ends_workers(ride):
    before = children()
    pool = WorkerPool(1)
    frames = pool.frames(ride.path, range(FRAMES))
    next(frames)
    assert len(children() - before) == 1
    del pool, frames
    gc.collect()
    assert children() == before


def test_after_ctrl_c_another_worker_renders_the_next_call(ride, pool_of_1):
    """Ctrl-C reaches only the parent."""
    list(pool_of_1.frames(ride.path, [0]))
    [pid] = pids(pool_of_1)
    large = View(height=1000, width=1400)
    with ctrl_c_soon(), pytest.raises(KeyboardInterrupt):
        list(pool_of_1.frames(ride.path, range(FRAMES), large))

    assert np.array_equal(list(pool_of_1.frames(ride.path, [4])), [ride.frames[4]])
    [another] = pids(pool_of_1)
    assert another != pid
    assert os.getsid(another) == another


# OpenGL


# Takes more than five seconds: a process tries each backend.
def test_without_egl_osmesa_renders_all_frames(ride, monkeypatch):
    """Each backend is tried once."""
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


# CPUs, shared by all processes that render into a directory

# Takes the free CPUs of the directory in argv[1], prints their number, and waits.
HOLDER = """
import pathlib, sys
from mjrec.rendering import pool
pool.usable_cpus = lambda: 2
shared = pool.WorkerPool(None, directory=pathlib.Path(sys.argv[1]))
print(shared._free(), flush=True)
sys.stdin.read()
"""


def test_a_pool_waits_until_another_process_with_all_cpus_dies(tmp_path, monkeypatch):
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
