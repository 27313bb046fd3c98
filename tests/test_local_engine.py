# SPDX-License-Identifier: Apache-2.0
"""Test what only the local engine promises, beyond `test_engines`."""

import os
import signal
import sys
import threading

import pytest
from engine_runs import (
    driver,
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
from waiting import wait_until

from mjrec.engines.jobs import Run
from mjrec.engines.local import GpuShare, LocalEngine
from mjrec.errors import ClosedError, Error, GLError, InvalidArgument
from mjrec.machine import usable_cpus

pytestmark = pytest.mark.usefixtures("no_process_is_left")


WRONG = [
    *(({"workers": number}, "workers must be a whole number") for number in (0, True)),
    *(({"gpus": each}, r"such as 1, or 0\.25") for each in (-1, float("nan"), "1")),
    ({"gpus": 1.5}, r"cannot be 1\.5"),
    ({"require_gpu": True}, "Give each worker a share"),
]


@pytest.mark.parametrize(("options", "said"), WRONG)
def test_what_cannot_be_is_refused_before_anything_starts(options, said):
    """The default number of workers is the number of CPUs."""
    with pytest.raises(InvalidArgument, match=said):
        LocalEngine(**options)
    assert LocalEngine().workers == usable_cpus()
    assert repr(LocalEngine(3, gpus=0.5)) == "LocalEngine(workers=3, gpus=0.5)"


def test_an_engine_that_was_shut_down_or_forgotten():
    """Accepted jobs are done, new ones are refused, and no thread remains."""
    engine = LocalEngine(2)
    calls = [engine.submit(len, "abc") for _ in range(5)]
    assert [call.result() for call in calls] == [3] * 5
    engine.shutdown()
    with pytest.raises(ClosedError):
        engine.submit(len, "abc")
    assert LocalEngine(3).submit(len, "abc").result() == 3
    wait_until(lambda: "mjrec-worker" not in str(threading.enumerate()))


@pytest.mark.thorough
def test_children_share_the_gpus_that_there_are(tmp_path, monkeypatch, caplog):
    """Two children share the first GPU, and a warning or error says it is not used."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    os.mkfifo(tmp_path / "pipe")
    with Run(LocalEngine(2, gpus=0.5), odd_work()) as run:
        # The jobs meet at a pipe, so each needs its own child.
        for key, mode in (("a", "rb"), ("b", "wb")):
            submit(run, key, do="meet", pipe=str(tmp_path / "pipe"), mode=mode)
        met = {value["pid"]: value["gpus"] for value in values(run)}
    assert [*met.values()] == ["3", "3"]
    assert len([text for text in caplog.messages if "GPU 3" in text]) == 1
    with Run(LocalEngine(1, gpus=1, require_gpu=True), odd_work()) as run:
        submit(run, "a", do="echo")
        with pytest.raises(GLError, match="GPU 3"):
            outcomes(run)


@pytest.mark.parametrize(
    ("each", "gpus", "given"),
    [
        (0.5, ["3", "5"], ["3", "3", "5", "5", "3", "3", "5", "5"]),
        (1, ["0", "1"], ["0", "1", "0", "1", "0", "1", "0", "1"]),
        (2, ["0", "1", "2", "3"], ["0,1", "2,3"] * 4),
        (1 / 3, ["a", "b"], ["a", "a", "a", "b", "b", "b", "a", "a"]),
        (0.25, [], [None] * 8),
        (0, ["0"], [None] * 8),
    ],
)
def test_gpus_are_filled_one_after_the_other(each, gpus, given):
    """Consecutive workers share a GPU, and further workers start over at the first."""
    share = GpuShare(each=each)
    assert [share.of(seat, gpus) for seat in range(8)] == given


def test_processes_that_a_child_leaves_are_not_waited_for(tmp_path):
    """A dead child counts as ended even if its children hold its open files."""
    with Run(LocalEngine(1), odd_work()) as run:
        submit(run, "a", do="fork", children=str(tmp_path / "children"))
        assert "was killed by SIGKILL" in (outcomes(run)["a"].failure or "")
    for line in lines(tmp_path / "children"):
        os.kill(int(line), signal.SIGKILL)
        wait_for_end(int(line))


def test_what_cannot_be_started(monkeypatch):
    """The error names the executable."""
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with Run(LocalEngine(1), odd_work()) as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match="cannot be started: '/no/such/python'"):
            outcomes(run)


def test_what_jobs_print_is_passed_on(capsys, monkeypatch):
    """Long lines arrive whole, and without a standard error nothing is passed on."""
    with Run(LocalEngine(2), odd_work()) as run:
        submit(run, "a", do="talk", more=1_000_000)
        values(run)
    *said, long = capsys.readouterr().err.splitlines()
    assert said == [
        '{"key": "a", "value": {"forged": true}}',
        "to the error output",
        "of a child",
        "50 %",
        "100 %",
    ]
    assert long == "x" * 1_000_000
    with Run(LocalEngine(2), odd_work()) as run:
        monkeypatch.setattr(sys, "stderr", None)
        submit(run, "f", do="talk")
        assert values(run) == [{"read": ""}]


def test_ctrl_c_while_results_come(tmp_path):
    """The interrupt is raised at once, and leaving `with` ends the running jobs."""
    run = Run(LocalEngine(1), odd_work())
    submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    with pytest.raises(KeyboardInterrupt), run, ctrl_c_soon():
        outcomes(run)
    wait_for_end(pid)


CALLER = """
from mjrec.engines.jobs import Run, Work
from mjrec.engines.local import LocalEngine
with Run(LocalEngine(2), Work(entry="odd_jobs:make")) as run:
    for number in range(9):
        run.submit(str(number), do="echo")
    print(sorted(outcome.key for outcome in run.results()))
"""
SAID = f"{[str(number) for number in range(9)]}\n"


def test_from_wherever_the_caller_is(tmp_path):
    """The caller may be standard input, an unguarded script, or a daemonic process."""
    assert run_python("-", text=CALLER) == SAID
    (tmp_path / "script.py").write_text(CALLER)
    # A module next to the script must not replace one of Python's own.
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
from pathlib import Path
from engine_runs import odd_work, submit, wait_for
from mjrec.engines.jobs import Run
from mjrec.engines.local import LocalEngine
run = Run(LocalEngine(1), odd_work())
submit(run, "a", do="hold", begun=sys.argv[1])
wait_for(Path(sys.argv[1]), run)
"""


def test_children_end_with_their_driver(tmp_path):
    """Children end in the middle of a job, and interpreter exit does not wait."""
    with driver(tmp_path, "LocalEngine(1)") as process:
        process.kill()
    wait_for_end(*map(int, lines(tmp_path / "begun")))
    run_python("-c", LEAVING, str(tmp_path / "again"))
    wait_for_end(*map(int, lines(tmp_path / "again")))
