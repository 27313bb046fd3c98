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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from interruption import ctrl_c_soon
from processes import children
from rides import FRAMES, HEIGHT, WIDTH, Ride, record

import mjrec
from mjrec import child_python
from mjrec.carried_errors import carried, unpacked
from mjrec.child_python import Child, environment_of_child
from mjrec.errors import (
    ClosedError,
    Error,
    GLError,
    InvalidArgument,
    UnknownName,
    UnreadableFile,
)
from mjrec.gl import Probe, choice
from mjrec.rendering.pool import WorkerPool, _environment
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


# In order, whoever draws


def test_one_worker_gives_what_was_seen(ride: Ride, one: WorkerPool) -> None:
    """Byte for byte."""
    assert np.array_equal(list(one.frames(ride.path, range(FRAMES))), ride.frames)


def test_three_workers_give_the_same(ride: Ride, three: WorkerPool) -> None:
    """Over an infinite plane, whose place depends on the picture before."""
    drawn = list(three.frames(ride.path, range(FRAMES), View()))

    assert len(pids(three)) == 3
    assert np.array_equal(drawn, ride.frames)


@pytest.mark.thorough
def test_more_frames_than_are_buffered(ride: Ride, three: WorkerPool) -> None:
    """Each worker waits until its frames are taken; none takes another's turn."""
    indices = [number % FRAMES for number in range(70)]

    for frame, index in zip(three.frames(ride.path, indices), indices, strict=True):
        assert np.array_equal(frame, ride.frames[index])


def test_any_order_and_repetition(ride: Ride, three: WorkerPool) -> None:
    """As asked for."""
    indices = [8, 0, 0, 3, 7, 2, 2, 8]
    drawn = list(three.frames(ride.path, indices))
    assert np.array_equal(drawn, [ride.frames[index] for index in indices])


def test_pictures_are_the_callers_to_keep(ride: Ride, one: WorkerPool) -> None:
    """Nothing is drawn over them, and they may be written to."""
    frames = one.frames(ride.path, [0] * 12)
    first = next(frames)
    first[:] = 1
    assert all(np.array_equal(frame, ride.frames[0]) for frame in frames)
    assert (first == 1).all()


def test_few_frames_are_kept_here(ride: Ride, three: WorkerPool) -> None:
    """However slow the caller is: two of each worker, besides what its pipe holds."""
    frames = three.frames(ride.path, [number % FRAMES for number in range(60)])
    for _ in frames:
        assert all(len(worker.arrived) <= 2 for worker in three._workers)


def test_no_pictures_are_no_work() -> None:
    """No process is started."""
    with new_children() as new, WorkerPool(2) as pool:
        assert list(pool.frames(Path("nothing.h5"), [])) == []
        assert pids(pool) == []
    assert new == []


@pytest.mark.thorough
def test_workers_stay_and_go_over_to_other_views(ride: Ride, three: WorkerPool) -> None:
    """Larger and smaller frames through the same pipes."""
    before = pids(three)
    for height in (20, 90, 48):
        for frame in three.frames(ride.path, range(5), View(height=height)):
            assert frame.shape == (height, WIDTH, 3)
    assert np.array_equal(list(three.frames(ride.path, [5])), [ride.frames[5]])
    assert pids(three) == before


def test_the_driver_is_told(ride: Ride, three: WorkerPool) -> None:
    """Who draws is known from the first picture on."""
    frames = three.frames(ride.path, [0])
    strings = {"gl_vendor", "gl_renderer", "gl_version"}
    assert three.gl_facts.keys() - {"gl_device"} == strings
    assert three.gl_facts["gl_renderer"]
    list(frames)


# What goes wrong


def test_errors_are_raised_by_the_call(ride: Ride, three: WorkerPool) -> None:
    """The same class and facts as in the worker; the workers go on."""
    with pytest.raises(UnknownName, match="no camera 'sid'") as caught:
        three.frames(ride.path, range(FRAMES), View(camera="sid"))
    assert caught.value.available == ["side", "rider"]
    with pytest.raises(UnreadableFile) as lost:
        three.frames(ride.path.with_name("lost.h5"), range(4))
    assert lost.value.path == ride.path.with_name("lost.h5")
    assert np.array_equal(list(three.frames(ride.path, [3])), [ride.frames[3]])


def test_an_error_comes_at_its_place(ride: Ride, three: WorkerPool) -> None:
    """The pictures before it are given."""
    frames = three.frames(ride.path, [0, 1, 2, 3, 99])
    assert [np.array_equal(next(frames), ride.frames[n]) for n in range(4)] == [
        True
    ] * 4
    with pytest.raises(InvalidArgument, match="no picture 99"):
        next(frames)


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


def test_a_worker_that_dies_twice_is_an_error(
    ride: Ride, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It names the signal, the file and what the worker said."""
    use_process(
        monkeypatch,
        """
        import os, signal, sys
        sys.stdin.readline()
        print("llvm: out of registers", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGSEGV)
        """,
    )
    with (
        WorkerPool(2) as pool,
        pytest.raises(Error, match=r"(?s)SIGSEGV.*out of registers") as caught,
    ):
        pool.frames(ride.path, range(FRAMES))

    assert str(ride.path) in str(caught.value)


@pytest.fixture
def be_impatient(monkeypatch: pytest.MonkeyPatch) -> Callable[[WorkerPool], None]:
    """Let the first worker hang after a moment; the next one gets its time."""

    def shorten(pool: WorkerPool) -> None:
        stacks = Child.stacks

        def prolong_and_ask(child: Child) -> str:
            for worker in pool._workers:
                worker.patience.seconds = 120
            return stacks(child)

        monkeypatch.setattr(Child, "stacks", prolong_and_ask)
        # It has drawn, the others may only be about to begin.
        pool._workers[0].patience.seconds = 0.5

    return shorten


def test_a_worker_that_always_hangs_is_not_waited_for(
    ride: Ride, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Two are ended. Where nothing was ever drawn, OpenGL is to blame."""
    monkeypatch.setenv("MJREC_PATIENCE", "0.2")
    use_process(monkeypatch, "import time; time.sleep(100)")
    with (
        new_children() as new,
        WorkerPool(1) as pool,
        pytest.raises(GLError, match=r"frame 0 of .* nothing for 0.2 seconds"),
    ):
        pool.frames(ride.path, range(FRAMES))
    assert new == []
    assert caplog.text.count("A drawing worker hangs") == 2


def test_a_worker_that_hangs_is_replaced_and_the_log_says_where(
    ride: Ride,
    tmp_path: Path,
    be_impatient: Callable[[WorkerPool], None],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Nothing of it is missing or comes twice."""
    use_process(
        monkeypatch,
        f"""
        import pathlib, threading
        import mjrec.rendering.worker as worker
        from mjrec.rendering import drawing
        draw = drawing.Drawing.draw
        hung = pathlib.Path({str(tmp_path / "hung")!r})
        def wait_for_a_driver_that_hangs():
            hung.touch()
            lock = threading.Lock()
            lock.acquire()
            lock.acquire()
        def hang_once(self, index, **options):
            if index == 3 and not hung.exists():
                wait_for_a_driver_that_hangs()
            return draw(self, index, **options)
        drawing.Drawing.draw = hang_once
        worker.main()
        """,
    )
    with WorkerPool(1) as pool:
        frames = pool.frames(ride.path, range(FRAMES))
        be_impatient(pool)
        assert np.array_equal(list(frames), ride.frames)
    assert "it has drawn nothing for 0.5 seconds" in caplog.text
    assert "in wait_for_a_driver_that_hangs" in caplog.text


@pytest.mark.thorough
def test_a_worker_that_was_stopped_hangs(
    ride: Ride,
    be_impatient: Callable[[WorkerPool], None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Of two, the other one draws on; the stopped one can still say where it was."""
    indices = [number % FRAMES for number in range(40)]
    with WorkerPool(2) as pool:
        frames = pool.frames(ride.path, indices)
        drawn = [next(frames)]
        os.kill(pids(pool)[0], signal.SIGSTOP)
        be_impatient(pool)
        drawn += frames
    assert np.array_equal(drawn, [ride.frames[index] for index in indices])
    assert caplog.text.count("A drawing worker hangs") == 1
    assert "in main" in caplog.text


@pytest.mark.thorough
def test_a_slow_worker_does_not_hang(
    ride: Ride, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """However long all takes: the time counts from picture to picture."""
    use_process(
        monkeypatch,
        """
        import time
        import mjrec.rendering.worker as worker
        from mjrec.rendering import drawing
        draw = drawing.Drawing.draw
        def slowly(self, index, **options):
            time.sleep(0.3)
            return draw(self, index, **options)
        drawing.Drawing.draw = slowly
        worker.main()
        """,
    )
    with WorkerPool(1) as pool:
        frames = pool.frames(ride.path, range(FRAMES))
        pool._workers[0].patience.seconds = 2
        assert np.array_equal(list(frames), ride.frames)
    assert not caplog.records


def test_a_crash_says_where(ride: Ride, monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of what a worker says has Python's stack."""
    use_process(
        monkeypatch,
        """
        import os, signal
        import mjrec.rendering.worker as worker
        from mjrec.rendering import drawing
        def crash_in_the_driver(*arguments, **options):
            os.kill(os.getpid(), signal.SIGSEGV)
        drawing.Drawing.draw = crash_in_the_driver
        worker.main()
        """,
    )
    with (
        WorkerPool(1) as pool,
        pytest.raises(Error, match=r"(?s)SIGSEGV.*in crash_in_the_driver"),
    ):
        pool.frames(ride.path, range(FRAMES))


def test_a_worker_that_cannot_be_started(
    ride: Ride, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names the program."""
    monkeypatch.setattr(sys, "executable", "/nonexistent/python")
    with WorkerPool(1) as pool, pytest.raises(Error, match="/nonexistent/python"):
        pool.frames(ride.path, range(FRAMES))


def test_what_a_driver_prints_does_not_disturb(
    ride: Ride, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither on the standard output nor as much of it as no pipe holds."""
    use_process(
        monkeypatch,
        """
        import os, sys
        import mjrec.rendering.worker as worker
        from mjrec.rendering import drawing
        draw = drawing.Drawing.draw
        def loud(*arguments, **options):
            os.write(1, b"x" * 100_000)
            print("a driver speaks")
            return draw(*arguments, **options)
        drawing.Drawing.draw = loud
        worker.main()
        """,
    )
    with WorkerPool(1) as pool:
        assert np.array_equal(list(pool.frames(ride.path, range(4))), ride.frames[:4])


def test_errors_that_nobody_foresaw_keep_their_traceback() -> None:
    """They are ours to mend."""
    try:
        raise KeyError("qpos")
    except KeyError as error:
        told = unpacked(carried(error))

    assert type(told) is Error
    assert "test_rendering_pool.py" in str(told)
    assert "KeyError: 'qpos'" in str(told)


def test_errors_are_carried_without_pickle() -> None:
    """A class that there is not is just an error."""
    told = unpacked({"type": "Path", "message": "no"})
    assert (type(told), str(told)) == (Error, "no")


@pytest.mark.parametrize("count", [0, -1, 1.5, True, "2"])
def test_a_number_of_workers_that_cannot_be(count: Any) -> None:
    """One error before anything is started."""
    with pytest.raises(InvalidArgument, match="workers must be"):
        WorkerPool(count)


# Their life


@pytest.mark.thorough
def test_dropping_the_iterator_leaves_the_workers_usable(
    ride: Ride, three: WorkerPool
) -> None:
    """What was ordered and is not wanted any more does not come."""
    for _ in range(3):
        for number, frame in enumerate(three.frames(ride.path, range(FRAMES))):
            assert np.array_equal(frame, ride.frames[number])
            if number == 1:
                break
    backwards = list(three.frames(ride.path, range(FRAMES - 1, -1, -1)))
    assert np.array_equal(backwards, ride.frames[::-1])


def test_a_later_call_takes_the_workers_over(ride: Ride, three: WorkerPool) -> None:
    """The iterator before says so."""
    first = three.frames(ride.path, range(FRAMES))
    next(first)
    second = three.frames(ride.path, range(FRAMES))
    with pytest.raises(ClosedError, match="taken"):
        list(first)
    assert np.array_equal(list(second), ride.frames)


@pytest.mark.thorough
def test_closed_workers_say_so(ride: Ride) -> None:
    """Closing twice is allowed, and leaves no process."""
    with new_children() as new:
        pool = WorkerPool(2)
        frames = pool.frames(ride.path, range(FRAMES))
        assert len(pids(pool)) == 2
        pool.close()
        pool.close()
        with pytest.raises(ClosedError):
            list(frames)
        with pytest.raises(ClosedError):
            pool.frames(ride.path, [0])
    assert new == []


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


def test_a_worker_ends_with_its_input_in_mid_drawing(
    ride: Ride, one: WorkerPool
) -> None:
    """Nobody is left to want what it draws."""
    frames = one.frames(ride.path, [0] * 1000, View(height=1000, width=1000))
    child = one._workers[0].child
    assert child is not None
    child.orders.close()
    wait_for_end(child.pid)
    del frames


def test_workers_are_nice(ride: Ride, one: WorkerPool) -> None:
    """They give way to the simulation."""
    list(one.frames(ride.path, [0]))
    [pid] = pids(one)
    assert os.getpriority(os.PRIO_PROCESS, pid) == 10


# Wherever the caller is

CALLER = """
import os, sys
import numpy as np
from pathlib import Path
from mjrec.gl import Probe, choice
from mjrec.rendering.pool import WorkerPool, _environment
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


@pytest.mark.thorough
def test_from_standard_input(ride: Ride) -> None:
    """`python -` has no main module that could be imported."""
    done = run(["-"], ride, text=CALLER)
    assert (done.returncode, done.stdout, done.stderr) == (0, said(ride), "")


def test_from_a_script_without_a_guard(ride: Ride, tmp_path: Path) -> None:
    """It runs once, and what lies beside it is not taken for Python's own modules."""
    (tmp_path / "script.py").write_text(CALLER)
    (tmp_path / "mujoco.py").write_text("raise RuntimeError('not this one')")
    done = run([str(tmp_path / "script.py")], ride)
    assert "not this one" not in done.stderr
    assert (done.returncode, done.stdout) == (0, said(ride))


@pytest.mark.thorough
def test_from_a_daemonic_process(ride: Ride) -> None:
    """Which may have no children of multiprocessing's."""
    script = f"""
import multiprocessing
def work():
    exec({CALLER!r})
if __name__ == "__main__":
    process = multiprocessing.get_context("fork").Process(target=work, daemon=True)
    process.start()
    process.join()
    raise SystemExit(process.exitcode)
"""
    done = run(["-c", script], ride)
    assert (done.returncode, done.stdout, done.stderr) == (0, said(ride), "")


@pytest.mark.thorough
def test_from_a_thread(ride: Ride, one: WorkerPool) -> None:
    """Any thread, one at a time."""
    drawn: list[Any] = []
    thread = threading.Thread(
        target=lambda: drawn.extend(one.frames(ride.path, range(FRAMES)))
    )
    thread.start()
    thread.join()
    assert np.array_equal(drawn, ride.frames)


def test_a_killed_parent_leaves_no_workers(ride: Ride) -> None:
    """Their input ends with it, whatever else it has started."""
    script = """
import os, signal, sys, time
from pathlib import Path
from mjrec.gl import Probe, choice
from mjrec.rendering.pool import WorkerPool, _environment
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


@pytest.mark.thorough
def test_leaving_in_mid_drawing_is_silent(ride: Ride) -> None:
    """At interpreter exit the workers end, and nothing waits for them."""
    script = """
import os
from pathlib import Path
from mjrec.gl import Probe, choice
from mjrec.rendering.pool import WorkerPool, _environment
pool = WorkerPool(2)
frames = pool.frames(Path(os.environ["RIDE"]), [0] * 1000)
next(frames)
print("end")
"""
    done = run(["-W", "error", "-c", script], ride)
    assert (done.returncode, done.stdout, done.stderr) == (0, "end\n", "")


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


def test_a_backend_that_there_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error before anything is started."""
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(UnknownName, match="MUJOCO_GL"):
        WorkerPool(1)


def test_a_backend_that_does_not_work(
    ride: Ride, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error has the way out."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")
    with WorkerPool(2) as pool, pytest.raises(GLError, match="mjrec doctor"):
        pool.frames(ride.path, range(FRAMES))


def test_no_backend_works(ride: Ride, monkeypatch: pytest.MonkeyPatch) -> None:
    """One error with the reasons of all; the workers may be asked again."""
    broken = Probe("", False, cause="it is broken")
    monkeypatch.setattr(choice, "probe", lambda name: broken)
    monkeypatch.setenv("MUJOCO_GL", "off")
    with WorkerPool(2) as pool:
        for _ in range(2):
            with pytest.raises(GLError, match=r"(?s)egl.*broken.*osmesa.*broken"):
                pool.frames(ride.path, range(FRAMES))


def test_workers_beside_each_other_use_one_cpu_each(
    ride: Ride, three: WorkerPool
) -> None:
    """And one alone uses all; the caller's own setting is left alone."""
    list(three.frames(ride.path, range(6)))
    for pid in pids(three):
        assert b"LP_NUM_THREADS=1\0" in Path(f"/proc/{pid}/environ").read_bytes()
    assert "LP_NUM_THREADS" not in _environment({}, alone=True)
    asked = _environment({"LP_NUM_THREADS": "2"}, alone=False)
    assert asked["LP_NUM_THREADS"] == "2"


def test_a_setting_that_crashes_mesa_is_left_out(
    ride: Ride, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """And the log says so."""
    monkeypatch.setenv("LP_NATIVE_VECTOR_WIDTH", "512")
    with WorkerPool(1) as pool:
        assert np.array_equal(list(pool.frames(ride.path, [2])), [ride.frames[2]])
    assert "LP_NATIVE_VECTOR_WIDTH" in caplog.text


def test_warnings_of_workers_are_logged_here(
    ride: Ride, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """With their level."""
    use_process(
        monkeypatch,
        """
        import logging
        from mjrec.rendering import worker
        open_drawing = worker.open_drawing
        def open_and_warn(*arguments):
            logging.getLogger("x").error("no %s", "GPU")
            return open_drawing(*arguments)
        worker.open_drawing = open_and_warn
        worker.main()
        """,
    )
    with WorkerPool(1) as pool:
        list(pool.frames(ride.path, [0]))
    levels = {r.getMessage(): r.levelno for r in caplog.records}
    assert levels["no GPU"] == logging.ERROR


def test_workers_find_what_their_parent_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The main script's directory last, everything else in its order."""
    main = sys.modules["__main__"]
    monkeypatch.setattr(main, "__file__", "/scripts/train.py", raising=False)
    monkeypatch.setattr(sys, "path", ["/scripts", "/b", "relative", "/with:colon"])
    found = environment_of_child({"A": "1"})
    relative = Path("relative").absolute()
    assert found == {"A": "1", "PYTHONPATH": f"/b:{relative}:/scripts"}


@pytest.mark.thorough
def test_a_parent_that_found_mjrec_by_itself(ride: Ride, tmp_path: Path) -> None:
    """By a change of `sys.path`, in a Python that looks nowhere else."""
    package = Path(mjrec.__file__).parent
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "mjrec").symlink_to(package)
    script = f"""
import sys
sys.path.insert(0, {str(tmp_path / "elsewhere")!r})
{CALLER}
import mjrec
assert "elsewhere" in mjrec.__file__
"""
    done = run(["-c", script], ride)
    assert (done.returncode, done.stdout, done.stderr) == (0, said(ride), "")
