# SPDX-License-Identifier: Apache-2.0
"""Of the local engine, what `test_engines` does not try on every one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from engine_runs import (
    lines,
    odd_work,
    outcomes,
    run_python,
    submit,
    values,
    wait_for,
    wait_for_end,
)
from interruption import ctrl_c_soon
from processes import children
from waiting import wait_until

from mjrec.engines import local, worker
from mjrec.engines.jobs import Run, Work
from mjrec.engines.local import LocalEngine
from mjrec.errors import ClosedError, Error, GLError, InvalidArgument
from mjrec.machine import usable_cpus

pytestmark = pytest.mark.usefixtures("no_process_is_left")


def begun(workers: int = 1, make: str = "make", **settings: Any) -> Run:
    return Run(LocalEngine(workers), odd_work(make, **settings))


def test_a_thousand_small_jobs() -> None:
    """Nobody waits for anything but work."""
    keys = [str(number) for number in range(1000)]
    with begun(2) as run:
        submit(run, *keys, do="echo")
        began = time.monotonic()
        assert sorted(outcomes(run), key=int) == keys
    assert time.monotonic() - began < 10


def test_no_more_children_than_jobs() -> None:
    """Nor any before there is one; they stay for later jobs."""
    before = children()
    with begun(4) as run:
        assert children() == before
        submit(run, "a", do="where")
        [first] = values(run)
        submit(run, "b", do="where")
        [second] = values(run)
        assert children() - before == {first["pid"]} == {second["pid"]}


def test_workers_are_one_for_each_cpu() -> None:
    """Unless their number is given, which is refused before anything starts."""
    assert LocalEngine().workers == usable_cpus()
    assert repr(LocalEngine(3, gpus=0.5)) == "LocalEngine(workers=3, gpus=0.5)"
    for workers in (0, -1, 1.5, True, "2"):
        with pytest.raises(InvalidArgument, match="workers must be a whole number"):
            LocalEngine(workers)  # type: ignore[arg-type]  # that is the test


def test_an_engine_that_was_shut_down() -> None:
    """It takes no more jobs; those before are done."""
    engine = LocalEngine(1)
    assert engine.submit(len, "abc").result() == 3
    engine.shutdown()
    with pytest.raises(ClosedError):
        engine.submit(len, "abc")


def test_children_have_more_environment() -> None:
    """And nothing of the caller's input, for which a job would wait."""
    work = Work(entry="odd_jobs:make", environ={"OMP_NUM_THREADS": "3"})
    with Run(LocalEngine(1), work) as run:
        submit(run, "a", do="where")
        submit(run, "b", do="talk")
        first, second = values(run)
    assert first["threads"] == "3"
    assert second == {"read": ""}


@pytest.mark.thorough
def test_children_share_the_gpus_that_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Two share the first; one warning says that both draw in software."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    os.mkfifo(tmp_path / "pipe")
    with Run(LocalEngine(2, gpus=0.5), odd_work()) as run:
        # Both at once, so that each is done by a child of its own.
        for key, mode in (("a", "rb"), ("b", "wb")):
            submit(run, key, do="meet", pipe=str(tmp_path / "pipe"), mode=mode)
        met = {value["pid"]: value["gpus"] for value in values(run)}
    assert [*met.values()] == ["3", "3"]
    assert len([text for text in caplog.messages if "GPU 3" in text]) == 1


@pytest.mark.thorough
def test_a_gpu_that_is_required_and_is_not_there_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before any job is done."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    with Run(LocalEngine(1, gpus=1, require_gpu=True), odd_work()) as run:
        submit(run, "a", do="echo")
        with pytest.raises(GLError, match="GPU 3"):
            outcomes(run)


def test_a_child_killed_from_outside(tmp_path: Path) -> None:
    """Its job is done by another, also where it was told to end."""
    with begun() as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
        for signum in (signal.SIGKILL, signal.SIGTERM):
            pid = wait_for(tmp_path / "begun", run)
            (tmp_path / "begun").unlink()
            os.kill(pid, signum)
        assert wait_for(tmp_path / "begun", run) != pid


def test_children_that_cannot_begin_do_not_end_those_at_work(tmp_path: Path) -> None:
    """Of four two may die at their start: no job fails, and the run goes on."""
    with begun(4, make="make_and_die_at_first", deaths=str(tmp_path)) as run:
        submit(run, *"abcdef", do="echo")
        found = outcomes(run)
    assert [outcome.failure for outcome in found.values()] == [None] * 6
    assert len(list(tmp_path.iterdir())) == 2


def test_last_words_are_those_of_the_job(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """What earlier jobs of the same child have printed is not among them."""
    with begun() as run:
        submit(run, "a", do="talk")
        submit(run, "b", do="die", how="exit", once=str(tmp_path / "once"))
        outcomes(run)
    assert caplog.messages[-1].endswith("what it said: exit is near")


def test_processes_that_a_child_leaves_are_not_waited_for(tmp_path: Path) -> None:
    """Its end is its end, whatever holds copies of what it had open."""
    with begun() as run:
        submit(run, "a", do="fork", children=str(tmp_path / "children"))
        found = outcomes(run)
    assert "was killed by SIGKILL" in (found["a"].failure or "")
    pids = [int(line) for line in lines(tmp_path / "children")]
    assert len(pids) == 3
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
        wait_for_end(pid)


@pytest.mark.parametrize("entry", ["no_such_module:make", "odd_jobs:no_such_name"])
def test_an_entry_that_there_is_not(entry: str) -> None:
    """The error names it."""
    with Run(LocalEngine(1), Work(entry=entry)) as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match="no_such_"):
            outcomes(run)


def test_a_child_that_is_told_to_end_while_it_begins() -> None:
    """It ends as any other does, and reports no fault of the handler."""
    with begun(make="make_and_be_told_to_end") as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match=r"No worker can begin.* ended with status 143"):
            outcomes(run)


def test_a_python_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names it."""
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with begun() as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match="cannot be started: '/no/such/python'"):
            outcomes(run)


def test_what_jobs_print_is_passed_on(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Line by line, more than a pipe holds; where there is a standard error."""
    with begun(2) as run:
        submit(run, "a", do="talk")
        values(run)
    assert capsys.readouterr().err.splitlines() == [
        '{"key": "a", "value": {"forged": true}}',
        "to the error output",
        "of a child",
        "50 %",
        "100 %",
    ]
    with begun(2) as run:
        submit(run, *"bcde", do="shout")
        assert values(run) == [{}] * 4
        assert capsys.readouterr().err.count("x") == 4_000_000
        monkeypatch.setattr(sys, "stderr", None)
        submit(run, "f", do="talk")
        assert values(run) == [{"read": ""}]


def test_handlers_are_closed_at_the_end(tmp_path: Path) -> None:
    """Each in its own process."""
    with begun(closed=str(tmp_path / "closed")) as run:
        submit(run, "a", do="where")
        [value] = values(run)
        assert not lines(tmp_path / "closed")
    assert lines(tmp_path / "closed") == [str(value["pid"])]


def test_ctrl_c_while_results_come(tmp_path: Path) -> None:
    """It is raised at once, and leaving `with` closes what the children are at."""
    run = begun(closed=str(tmp_path / "closed"))
    submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    with pytest.raises(KeyboardInterrupt), run, ctrl_c_soon():
        outcomes(run)
    assert lines(tmp_path / "closed") == [str(pid)]


def test_a_job_that_takes_no_notice_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """After some seconds; the log says so."""
    monkeypatch.setattr(worker, "SECONDS_TO_CLOSE", 0.2)
    with begun() as run:
        submit(run, "a", do="hold_on", begun=str(tmp_path / "begun"))
        pid = wait_for(tmp_path / "begun", run)
    wait_for_end(pid)
    assert "is killed" in caplog.text


def test_a_caller_that_ignores_sigterm(tmp_path: Path) -> None:
    """Its children do not."""
    earlier = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        with begun(closed=str(tmp_path / "closed")) as run:
            submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
            pid = wait_for(tmp_path / "begun", run)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGTERM, earlier)
    assert lines(tmp_path / "closed") == [str(pid)]


@pytest.mark.thorough
def test_fifty_runs_leave_nothing_open() -> None:
    """No descriptor, no process, and no thread."""

    def once() -> None:
        engine = LocalEngine(1)
        with Run(engine, odd_work()) as run:
            submit(run, "a", do="echo")
            outcomes(run)
        engine.shutdown()

    once()
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208  no paths
    for _ in range(50):
        once()
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208  no paths


CALLER = """
from mjrec.engines.jobs import Job, Run, Work
from mjrec.engines.local import LocalEngine
with Run(LocalEngine(2), Work(entry="odd_jobs:make")) as run:
    for number in range(9):
        run.submit(Job(key=str(number), arguments={"do": "echo"}))
    print(sorted(outcome.key for outcome in run.results()))
"""
SAID = f"{[str(number) for number in range(9)]}\n"


def test_from_wherever_the_caller_is(tmp_path: Path) -> None:
    """From standard input, from a script without a guard, in a daemonic process."""
    assert run_python("-", text=CALLER) == SAID
    (tmp_path / "script.py").write_text(CALLER)
    # What lies beside it is not taken for Python's own modules.
    (tmp_path / "random.py").write_text("raise RuntimeError('not this one')")
    assert run_python(str(tmp_path / "script.py")) == SAID
    daemonic = f"""
import multiprocessing
def work():
    exec({CALLER!r}, {{}})
if __name__ == "__main__":
    process = multiprocessing.get_context("fork").Process(target=work, daemon=True)
    process.start()
    process.join()
    raise SystemExit(process.exitcode)
"""
    assert run_python("-c", daemonic) == SAID


LEAVING = """
import sys
import threading
from mjrec.engines.jobs import Job, Run, Work
from mjrec.engines.local import LocalEngine
run = Run(LocalEngine(1), Work(entry="odd_jobs:make"))
run.submit(Job(key="a", arguments={"do": "where"}))
run.submit(Job(key="b", arguments={"do": "hold", "begun": sys.argv[1]}))
print(next(run.results()).value["pid"])
"""


def test_leaving_in_mid_job_is_silent(tmp_path: Path) -> None:
    """At interpreter exit the children end, and nothing waits for them."""
    wait_for_end(int(run_python("-c", LEAVING, str(tmp_path / "begun"))))


KILLED = """
import json, os, signal, sys
from pathlib import Path
from mjrec.engines.jobs import Job, Run, Work
from mjrec.engines.local import LocalEngine
place = Path(sys.argv[1])
settings = {"closed": str(place / "closed")}
run = Run(LocalEngine(2), Work(entry="odd_jobs:make", settings=settings))
for key, do in (("a", "hold"), ("b", "hold_on")):
    run.submit(Job(key=key, arguments={"do": do, "begun": str(place / key)}))
for _ in run.results(patience_s=0.02):
    if all((place / key).exists() and (place / key).read_text() for key in "ab"):
        break
if not os.fork():
    # A forked child has copies of all files, and may not use them.
    try:
        run.results()
    except Exception as error:
        run.cancel()
        os.write(1, f"{type(error).__name__}\\n".encode())
    sys.stdin.read()
    os._exit(0)
os.read(int(sys.argv[2]), 1)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.thorough
def test_a_killed_parent_leaves_no_children(tmp_path: Path) -> None:
    """They close what they are at, although another process has its files too.

    One that takes no notice is ended after some seconds.
    """
    child_may_go_on, keeps_child = os.pipe()
    parent_may_die, kills_parent = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", KILLED, tmp_path, str(parent_may_die)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        stdin=child_may_go_on,
        stdout=subprocess.PIPE,
        pass_fds=[parent_may_die],
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ClosedError\n"
    pids = [int((tmp_path / key).read_text()) for key in "ab"]
    os.kill(pids[0], 0)
    os.write(kills_parent, b"x")
    process.wait()

    wait_for_end(pids[0])
    assert lines(tmp_path / "closed") == [str(pids[0])]
    wait_for_end(pids[1])
    for end in (child_may_go_on, keeps_child, parent_may_die, kills_parent):
        os.close(end)
    process.stdout.close()


def test_import_is_inert() -> None:
    """Neither driver nor child loads a simulator, NumPy, or another engine."""
    heavy = ["mujoco", "numpy", "h5py", "ray", "submitit"]
    script = (
        "import json, sys, mjrec.engines.jobs, mjrec.engines.child; "
        f"print(json.dumps([m for m in {heavy} if m in sys.modules]))"
    )
    assert json.loads(run_python("-c", script)) == []


def test_threads_that_have_nothing_to_do_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """An engine that was used and forgotten leaves none; one that is used has new."""
    monkeypatch.setattr(local, "_SECONDS_IDLE", 0.05)
    engine = LocalEngine(3)
    for _ in range(2):
        calls = [engine.submit(time.sleep, 0.01) for _ in range(6)]
        assert [call.result() for call in calls] == [None] * 6
        wait_until(lambda: "mjrec-worker" not in str(threading.enumerate()))
