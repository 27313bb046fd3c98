# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
import gc
import logging
import os
import select
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interruption import ctrl_c_soon
from parts import parametrize
from processes import children
from rides import FRAMES, HEIGHT, WIDTH, Ride, record

from mjrec import child_python
from mjrec.child_python import Child
from mjrec.errors import (
    Error,
    GLError,
    InvalidArgument,
    UnknownName,
    UnreadableFile,
)
from mjrec.gl import Probe, choice
from mjrec.rendering import pool as pool_module
from mjrec.rendering.pool import WorkerPool
from mjrec.rendering.views import View


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory) -> Ride:
    return record(tmp_path_factory.mktemp("ride"))


@pytest.fixture(scope="module")
def three() -> Iterator[WorkerPool]:
    """Three workers, which stay from test to test."""
    with WorkerPool(3) as three:
        yield three


@pytest.fixture
def one() -> Iterator[WorkerPool]:
    with WorkerPool(1) as one:
        yield one


@contextlib.contextmanager
def new_children() -> Iterator[list[int]]:
    """Fill the list with the processes that the block has started and not ended."""
    before = children()
    new: list[int] = []
    yield new
    new += children() - before


def pids(pool: WorkerPool) -> list[int]:
    return [worker.child.pid for worker in pool._workers if worker.child is not None]


def wait_for_end(pid: int) -> None:
    """Wait until a process that need not be a child is gone."""
    with contextlib.suppress(ProcessLookupError):
        descriptor = os.pidfd_open(pid)
        ready, _, _ = select.select([descriptor], [], [], 30)
        os.close(descriptor)
        assert ready, f"process {pid} goes on"


def use_process(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Let another program be the worker."""
    command = [sys.executable, "-c", textwrap.dedent(script)]
    monkeypatch.setattr(child_python, "python_command", lambda _: command)


def draw_otherwise(monkeypatch: pytest.MonkeyPatch, body: str) -> None:
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
    use_process(monkeypatch, code)


# In order, whoever draws


@pytest.mark.parametrize("indices", [range(FRAMES), [8, 0, 0, 3, 7, 2, 2, 8]])
def test_any_workers_give_what_was_seen(
    ride: Ride, one: WorkerPool, three: WorkerPool, indices: Sequence[int]
) -> None:
    """Byte for byte, over an infinite plane, whose place depends on the frame before.

    In any order, also repeated; and who draws is known from the first frame on.
    """
    expected = [ride.frames[index] for index in indices]
    assert np.array_equal(list(one.frames(ride.path, indices)), expected)
    assert np.array_equal(list(three.frames(ride.path, indices, View())), expected)
    assert len(pids(three)) == 3
    strings = {"gl_vendor", "gl_renderer", "gl_version"}
    assert three.gl_facts.keys() - {"gl_device"} == strings
    assert os.getpriority(os.PRIO_PROCESS, pids(one)[0]) == 10


@pytest.mark.parametrize("is_there", [True, False])
def test_prepared_workers_draw_the_same(
    ride: Ride,
    one: WorkerPool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    is_there: bool,
) -> None:
    """They load a model before frames are asked for; that there is none is no harm."""
    noted = tmp_path / "noted"
    note = f"""
        import pathlib
        import mjrec.rendering.worker as worker
        open_drawing = worker.open_drawing
        def note(*arguments):
            pathlib.Path({str(noted)!r}).touch()
            return open_drawing(*arguments)
        worker.open_drawing = note
        worker.main()
    """
    use_process(monkeypatch, note)
    one.start()
    one.prepare(ride.path if is_there else tmp_path / ride.path.name)
    while not noted.exists():
        time.sleep(0.01)
    drawn = list(one.frames(ride.path, range(FRAMES)))
    assert np.array_equal(drawn, ride.frames)


def test_few_frames_are_kept_here(ride: Ride, three: WorkerPool) -> None:
    """However slow the caller is: two of each worker, besides what its pipe holds."""
    indices = [number % FRAMES for number in range(60)]
    kept = []
    for index, frame in zip(indices, three.frames(ride.path, indices), strict=True):
        assert np.array_equal(frame, ride.frames[index])
        # They are the caller's to keep, and to write to.
        frame[:] = 1
        kept.append(frame)
        assert all(len(worker.arrived) <= 2 for worker in three._workers)
    assert all((frame == 1).all() for frame in kept)


def test_workers_stay_and_go_over_to_other_views(ride: Ride, three: WorkerPool) -> None:
    """Larger and smaller frames through the same pipes; also if some are dropped."""
    list(three.frames(ride.path, range(5)))
    before = pids(three)
    for height in (20, 90):
        for frame in three.frames(ride.path, range(5), View(height=height)):
            assert frame.shape == (height, WIDTH, 3)
    assert pids(three) == before
    next(three.frames(ride.path, range(FRAMES)))
    assert np.array_equal(list(three.frames(ride.path, [5])), [ride.frames[5]])


# What goes wrong


def test_errors_come_at_their_place(ride: Ride, three: WorkerPool) -> None:
    """The same class and facts as in the worker; the workers go on."""
    with pytest.raises(UnknownName, match="no camera 'sid'") as caught:
        three.frames(ride.path, range(FRAMES), View(camera="sid"))
    assert caught.value.available == ["side", "rider"]
    with pytest.raises(UnreadableFile) as lost:
        three.frames(ride.path.with_name("lost.h5"), range(4))
    assert lost.value.path == ride.path.with_name("lost.h5")
    frames = three.frames(ride.path, [0, 1, 2, 3, 99])
    assert np.array_equal([next(frames) for _ in range(4)], ride.frames[:4])
    with pytest.raises(InvalidArgument, match="no picture 99"):
        next(frames)
    assert np.array_equal(list(three.frames(ride.path, [3])), [ride.frames[3]])


def test_a_killed_worker_is_replaced(
    ride: Ride, caplog: pytest.LogCaptureFixture
) -> None:
    """What it was drawing is drawn again, and the log says so."""
    indices = [number % FRAMES for number in range(40)]
    with WorkerPool(2) as pool:
        frames = pool.frames(ride.path, indices)
        drawn = [next(frames)]
        for pid in pids(pool):
            os.kill(pid, signal.SIGKILL)
        drawn += frames

    assert np.array_equal(drawn, [ride.frames[index] for index in indices])
    assert "killed by SIGKILL" in caplog.text


@pytest.fixture
def be_impatient(monkeypatch: pytest.MonkeyPatch) -> Callable[[WorkerPool], None]:
    """Let a worker hang after a moment; the next one gets its time."""

    def shorten(pool: WorkerPool) -> None:
        stacks = Child.stacks

        def prolong_and_ask(child: Child) -> str:
            pool._patience.seconds = 120
            return stacks(child)

        monkeypatch.setattr(Child, "stacks", prolong_and_ask)
        pool._patience.seconds = 0.5

    return shorten


def test_a_worker_that_hangs_is_replaced_and_the_log_says_where(
    ride: Ride,
    tmp_path: Path,
    be_impatient: Callable[[WorkerPool], None],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
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
        be_impatient(pool)
        assert np.array_equal(list(frames), ride.frames)
    assert "it has drawn nothing for 0.5 seconds" in caplog.text
    assert "in draw_otherwise" in caplog.text


def test_a_worker_that_dies_twice_is_an_error(
    ride: Ride, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_what_a_worker_says_is_heard(
    ride: Ride, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
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


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "2"])
def test_a_number_of_workers_that_cannot_be(count: Any) -> None:
    """One error before anything is started."""
    with pytest.raises(InvalidArgument, match="workers must be"):
        WorkerPool(count)


# Their life


def test_forgotten_workers_end(ride: Ride) -> None:
    """Garbage collection is enough."""
    with new_children() as new:
        pool = WorkerPool(1)
        frames = pool.frames(ride.path, range(FRAMES))
        next(frames)
        del pool, frames
        gc.collect()
    assert new == []


def test_ctrl_c_while_a_picture_is_drawn(ride: Ride, one: WorkerPool) -> None:
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


# Wherever the caller is

CALLER = """
import os, sys
import numpy as np
from pathlib import Path
from mjrec.rendering.pool import WorkerPool
with WorkerPool(2) as pool:
    frames = list(pool.frames(Path(os.environ["RIDE"]), range(9)))
print(len(frames), sum(int(frame.sum()) for frame in frames))
"""


def run(
    arguments: list[str], ride: Ride, *, text: str | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    inherited = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    return subprocess.run(
        [sys.executable, *arguments],
        env={**inherited, "RIDE": str(ride.path), **environment},
        input=text,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def said(ride: Ride) -> str:
    return f"{FRAMES} {sum(int(frame.sum()) for frame in ride.frames)}\n"


DAEMONIC = f"""
import multiprocessing
def work():
    exec({CALLER!r})
if __name__ == "__main__":
    process = multiprocessing.get_context("fork").Process(target=work, daemon=True)
    process.start()
    process.join()
    raise SystemExit(process.exitcode)
"""
THREAD = f"""
import threading
thread = threading.Thread(target=exec, args=[{CALLER!r}, {{}}])
thread.start()
thread.join()
"""


@parametrize(
    ("way", "code"),
    [
        *(("script", CALLER), ("stdin", CALLER), ("command", DAEMONIC)),
        ("command", THREAD),
    ],
)
def test_any_program_can_have_workers(
    way: str, code: str, ride: Ride, tmp_path: Path
) -> None:
    """A script without a guard runs once, and what lies beside it is not Python's."""
    (tmp_path / "script.py").write_text(code)
    (tmp_path / "mujoco.py").write_text("raise RuntimeError('not this one')")
    argument = {"script": [str(tmp_path / "script.py")], "stdin": ["-"]}
    done = run(
        argument.get(way, ["-c", code]), ride, text=code if way == "stdin" else None
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, said(ride), "")


def test_a_killed_parent_leaves_no_workers(ride: Ride) -> None:
    """Their input ends with it, whatever else it has started."""
    script = """
import os, signal, sys, time
from pathlib import Path
from mjrec.rendering.pool import WorkerPool
pool = WorkerPool(2)
frames = pool.frames(Path(os.environ["RIDE"]), range(9))
if not os.fork():
    # A forked child has copies of the pipes, and may not use them.
    try:
        pool.frames(Path(os.environ["RIDE"]), range(9))
    except Exception as error:
        os.write(1, f"{type(error).__name__}\\n".encode())
    sys.stdin.read()
    os._exit(0)
os.write(1, " ".join(str(w.child.pid) for w in pool._workers).encode() + b"\\n")
os.kill(os.getpid(), signal.SIGKILL)
"""
    # The child reads this end until the test is over.
    reading, writing = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", script],
        env={**os.environ, "RIDE": str(ride.path)},
        stdin=reading,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    lines = [process.stdout.readline(), process.stdout.readline()]
    process.wait()
    # Two processes say a line each, in any order.
    told, numbers = sorted(lines, reverse=True)
    assert told == "ClosedError\n"

    for pid in numbers.split():
        wait_for_end(int(pid))
    os.close(writing)
    os.close(reading)
    process.stdout.close()


# What draws


@pytest.mark.thorough
@pytest.mark.parametrize("setting", ["disable", None])
def test_a_backend_is_chosen_where_none_is_named(
    ride: Ride, setting: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where rendering is turned off, which is for the simulation."""
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    if setting is None:
        monkeypatch.delenv("MUJOCO_GL")
    else:
        monkeypatch.setenv("MUJOCO_GL", setting)
    with WorkerPool(3) as pool:
        drawn = list(pool.frames(ride.path, range(FRAMES)))
        assert len(pids(pool)) == 3
    assert [frame.shape for frame in drawn] == [(HEIGHT, WIDTH, 3)] * FRAMES
    assert os.environ.get("MUJOCO_GL") == setting


def test_a_backend_that_is_named_is_used(
    ride: Ride, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In mjrec's spelling or another."""
    monkeypatch.setenv("MUJOCO_GL", "OSMesa")
    with WorkerPool(1) as pool:
        list(pool.frames(ride.path, [0]))
        [pid] = pids(pool)
        environment = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    assert b"MUJOCO_GL=osmesa" in environment
    assert b"PYOPENGL_PLATFORM=osmesa" in environment


# Takes more than five seconds: both backends are tried by processes of their own.
def test_where_egl_does_not_work_another_backend_draws(
    ride: Ride, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_no_backend_works(ride: Ride, monkeypatch: pytest.MonkeyPatch) -> None:
    """One error with the reasons of all; the workers may be asked again."""
    broken = Probe("", False, cause="it is broken")
    monkeypatch.setattr(choice, "probe", lambda name: broken)
    monkeypatch.setenv("MUJOCO_GL", "off")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    with WorkerPool(2) as pool:
        for _ in range(2):
            with pytest.raises(GLError, match=r"(?s)egl.*broken.*osmesa.*broken"):
                pool.frames(ride.path, range(FRAMES))


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


@pytest.fixture
def two_cpus(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the machine have two CPUs."""
    monkeypatch.setattr(pool_module, "usable_cpus", lambda: 2)


@pytest.mark.usefixtures("two_cpus")
def test_the_cpus_of_another_process_are_waited_for(tmp_path: Path) -> None:
    """Until it rests or dies; the files of a dead one do not count."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"2\n"
        threading.Timer(0.3, holder.kill).start()
        began = time.monotonic()
        shared = WorkerPool(None, directory=tmp_path)
        with pytest.raises(UnreadableFile):
            shared.frames(tmp_path / "lost.h5", [0])
    assert time.monotonic() - began >= 0.3
    assert len(pids(shared)) == 1
    shared.close()
