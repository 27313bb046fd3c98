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
import time
from pathlib import Path
from typing import Any

import pytest
from engine_runs import lines, outcomes, submit, values, wait_for
from interruption import ctrl_c_soon
from processes import children

import mjrec
from mjrec.engines import local
from mjrec.engines.local import LocalEngine, LocalRun
from mjrec.engines.work import Engine, Job, JobOutcome, Run, Work
from mjrec.errors import ClosedError, Error, GLError, InvalidArgument
from mjrec.machine import usable_cpus

pytestmark = pytest.mark.usefixtures("no_process_is_left")


def begun(
    workers: int = 1,
    *,
    make: str = "make",
    payload: bytes | None = None,
    environ: dict[str, str] | None = None,
    **settings: Any,
) -> LocalRun:
    return LocalEngine(workers).begin(
        Work(
            entry=f"odd_jobs:{make}",
            settings=settings,
            payload=payload,
            environ=environ or {},
        )
    )


def wait_for_end(pid: int) -> None:
    """Wait until a process that need not be a child is gone."""
    with contextlib.suppress(ProcessLookupError):
        descriptor = os.pidfd_open(pid)
        ready, _, _ = select.select([descriptor], [], [], 30)
        os.close(descriptor)
        assert ready, f"process {pid} goes on"


# Jobs and their outcomes


def test_it_is_an_engine() -> None:
    """Of the interface, as a type checker sees it too."""
    engine: Engine = LocalEngine(1)
    run: Run = engine.begin(Work(entry="odd_jobs:make"))
    with run:
        assert run.unfinished == 0
        assert list(run.results()) == []


def test_jobs_get_settings_and_arguments() -> None:
    """The outcome is what the handler returns."""
    with begun(seeds=[1, 2]) as run:
        submit(run, "a", do="echo", text="ß\n")
        assert run.unfinished == 1
        [value] = values(run)
        assert run.unfinished == 0
    assert value == {
        "arguments": {"do": "echo", "text": "ß\n"},
        "settings": {"seeds": [1, 2]},
    }


def test_jobs_can_be_submitted_while_results_come() -> None:
    """The iterator goes on to their outcomes, and a second one too."""
    with begun(2) as run:
        submit(run, "0", do="echo")
        seen = []
        for outcome in run.results():
            assert outcome is not None
            seen.append(outcome.key)
            if len(seen) < 5:
                submit(run, str(len(seen)), do="echo")
        submit(run, "later", do="echo")
        assert seen == ["0", "1", "2", "3", "4"]
        assert list(outcomes(run)) == ["later"]


def test_a_thousand_small_jobs() -> None:
    """Nobody waits for anything but work."""
    keys = [str(number) for number in range(1000)]
    with begun(2) as run:
        submit(run, *keys, do="echo")
        began = time.monotonic()
        assert sorted(outcomes(run), key=int) == keys
    assert time.monotonic() - began < 5


def test_jobs_run_beside_each_other(tmp_path: Path) -> None:
    """Two that wait for each other both come to their end."""
    os.mkfifo(tmp_path / "pipe")
    with begun(2) as run:
        submit(run, "a", do="meet", pipe=str(tmp_path / "pipe"), mode="rb")
        submit(run, "b", do="meet", pipe=str(tmp_path / "pipe"), mode="wb")
        assert len({value["pid"] for value in values(run)}) == 2


def test_no_more_workers_than_jobs() -> None:
    """Nor any before there is one; they stay for later jobs."""
    before = children()
    with begun(4) as run:
        assert children() == before
        submit(run, "a", do="where")
        [first] = values(run)
        submit(run, "b", do="where")
        [second] = values(run)
        assert children() - before == {first["pid"]} == {second["pid"]}


def test_patience_is_told_of() -> None:
    """None is no outcome: the caller may look at the clock."""
    with begun(2) as run:
        submit(run, "a", do="echo")
        first = next(run.results(patience_s=1e-6))
        assert first is None
        assert run.unfinished == 1
        assert [o.key for o in run.results(patience_s=1e-6) if o is not None] == ["a"]


def test_workers_are_where_the_caller_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its directory, with its environment and more, and out of Ctrl-C's reach."""
    monkeypatch.chdir(tmp_path)
    with begun(environ={"OMP_NUM_THREADS": "3"}) as run:
        submit(run, "a", do="where")
        [value] = values(run)
    assert value == {
        "pid": value["pid"],
        "directory": str(tmp_path),
        "main": "local_worker.py",
        "session": value["pid"],
        "threads": "3",
    }


def test_workers_are_one_for_each_cpu() -> None:
    """Unless their number is given."""
    assert LocalEngine().workers == usable_cpus()
    assert repr(LocalEngine(3)) == "LocalEngine(workers=3)"


# GPUs


@pytest.mark.thorough
def test_workers_share_the_gpus_that_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each sees the one that it was given, and no other; two share the first."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    wait = {"do": "meet", "pipe": str(tmp_path / "pipe")}
    os.mkfifo(tmp_path / "pipe")
    engine = LocalEngine(2, gpus=0.5)
    with engine.begin(Work(entry="odd_jobs:make")) as run:
        # Both at once, so that each is done by a worker of its own.
        run.submit(Job(key="a", arguments={**wait, "mode": "rb"}))
        run.submit(Job(key="b", arguments={**wait, "mode": "wb"}))
        met = {value["pid"]: value["gpus"] for value in values(run)}
    assert [*met.values()] == ["3", "3"]
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "3,5"
    assert repr(engine) == "LocalEngine(workers=2, gpus=0.5)"


@pytest.mark.thorough
def test_rendering_in_software_on_a_given_gpu_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Once, however many workers: they do their jobs all the same."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    with LocalEngine(2, gpus=0.5).begin(Work(entry="odd_jobs:make")) as run:
        os.mkfifo(tmp_path / "pipe")
        submit(run, "a", do="meet", pipe=str(tmp_path / "pipe"), mode="rb")
        submit(run, "b", do="meet", pipe=str(tmp_path / "pipe"), mode="wb")
        assert len(values(run)) == 2
    assert len([text for text in caplog.messages if "GPU 3" in text]) == 1


@pytest.mark.thorough
def test_a_gpu_that_is_required_and_is_not_there_is_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before any job is done."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    engine = LocalEngine(1, gpus=1, require_gpu=True)
    with engine.begin(Work(entry="odd_jobs:make")) as run:
        submit(run, "a", do="echo")
        with pytest.raises(GLError, match="GPU 3"):
            outcomes(run)


@pytest.mark.parametrize("workers", [0, -1, 1.5, True, "2"])
def test_a_number_of_workers_that_cannot_be(workers: Any) -> None:
    """It is refused before anything starts."""
    with pytest.raises(InvalidArgument, match="workers must be a whole number"):
        LocalEngine(workers)


def test_what_cannot_be_handed_out() -> None:
    """Errors name the job."""
    with pytest.raises(InvalidArgument, match="settings of the work cannot be written"):
        begun(path=Path())
    with begun() as run:
        submit(run, "a", do="echo")
        with pytest.raises(InvalidArgument, match="a job 'a' in this run already"):
            submit(run, "a", do="echo")
        with pytest.raises(InvalidArgument, match="arguments of the job 'b' cannot be"):
            submit(run, "b", do=Path())
        with pytest.raises(InvalidArgument, match="patience_s must be"):
            run.results(patience_s=0)
        assert run.unfinished == 1


# The payload


def test_no_payload() -> None:
    """None is None, and not empty."""
    with begun() as run:
        submit(run, "a", do="payload")
        assert values(run) == [{"payload": None}]
    with begun(payload=b"") as run:
        submit(run, "a", do="payload")
        assert values(run)[0]["size"] == 0


def test_a_large_payload_travels_once_per_worker(tmp_path: Path) -> None:
    """Each worker has it, and this process no copies of it, however many jobs."""
    script = """
import hashlib, os, resource, sys
from mjrec.engines.local import LocalEngine
from mjrec.engines.work import Job, Work
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
payload = os.urandom(1 << 20) * 50
before = peak()
with LocalEngine(2).begin(Work(entry="odd_jobs:make", payload=payload)) as run:
    os.mkfifo(sys.argv[1])
    for key, mode in (("a", "rb"), ("b", "wb")):
        meeting = {"do": "meet", "pipe": sys.argv[1], "mode": mode}
        run.submit(Job(key=key, arguments=meeting))
    assert len({o.value["pid"] for o in run.results()}) == 2
    for number in range(30):
        run.submit(Job(key=str(number), arguments={"do": "payload"}))
    seen = {(o.value["pid"], o.value["sha256"]) for o in run.results()}
digest = hashlib.sha256(payload).hexdigest()
print(len(seen), {sha256 for _, sha256 in seen} == {digest}, (peak() - before) // 1024)
"""
    done = run_python(["-c", script, str(tmp_path / "pipe")])
    workers, equal, megabytes = done.stdout.split()
    assert (workers, equal) == ("2", "True")
    assert int(megabytes) < 10


# Jobs that fail, and workers that die


def test_what_a_handler_raises_is_the_outcome(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """In one line; the worker goes on, and the log has the traceback."""
    with begun() as run:
        submit(run, "before", do="where")
        submit(run, "bad", do="fail")
        submit(run, "exit", do="leave")
        submit(run, "path", do="no_json")
        submit(run, "after", do="where")
        found = outcomes(run)
    assert found["bad"] == JobOutcome(
        key="bad", value=None, failure="ValueError: not today", tries=1
    )
    assert found["exit"].failure == "SystemExit: enough"
    assert (found["path"].failure or "").startswith("TypeError: Object of type")
    assert found["before"].value == found["after"].value
    assert "The job bad failed" in caplog.text
    assert 'raise ValueError("not\\n  today")' in caplog.text


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("SIGKILL", "was killed by SIGKILL"),
        ("SIGSEGV", "was killed by SIGSEGV"),
        ("exit", "ended with status 7"),
    ],
)
def test_a_job_whose_worker_dies_is_begun_again(
    how: str, said: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In a new worker; the log says of what the first one died."""
    with begun() as run:
        submit(run, "a", do="die", how=how, once=str(tmp_path / "once"))
        submit(run, "b", do="echo")
        found = outcomes(run)
    assert found["a"] == JobOutcome(key="a", value={"alive": True}, tries=2)
    assert found["b"].tries == 1
    [record] = caplog.records
    assert record.levelno == logging.WARNING
    assert "job a, which is begun again" in record.message
    assert said in record.message
    assert f"{how} is near" in record.message


def test_a_worker_killed_from_outside(tmp_path: Path) -> None:
    """Its job is done by another."""
    with begun(2) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
        os.kill(wait_for(tmp_path / "begun", run), signal.SIGKILL)
        (tmp_path / "begun").unlink()
        first = wait_for(tmp_path / "begun", run)
        assert run.unfinished == 1
        # As a scheduler takes a machine away: it closes, and is no failure.
        (tmp_path / "begun").unlink()
        os.kill(first, signal.SIGTERM)
        assert wait_for(tmp_path / "begun", run) != first


def test_a_job_that_kills_its_workers_is_given_up() -> None:
    """After three of them; all others come through."""
    with begun(2) as run:
        submit(run, "poison", do="die", how="SIGKILL")
        submit(run, *"abcdef", do="echo")
        found = outcomes(run)
    assert found["poison"] == JobOutcome(
        key="poison",
        value=None,
        failure=(
            "Its worker died, which was try 3 of 3: it was killed by SIGKILL. "
            "The end of what it said: SIGKILL is near"
        ),
        tries=3,
    )
    assert [found[key].failure for key in "abcdef"] == [None] * 6
    # It is last, because it had to wait behind the others.
    assert list(found)[-1] == "poison"


def test_last_words_are_those_of_the_job(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    """What earlier jobs of the same worker have printed is not among them."""
    with begun() as run:
        submit(run, "a", do="talk")
        submit(run, "b", do="die", how="exit", once=str(tmp_path / "once"))
        outcomes(run)
    assert caplog.messages[-1].endswith("what it said: exit is near")


def test_children_that_a_worker_leaves_are_not_waited_for(tmp_path: Path) -> None:
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


def test_a_handler_that_cannot_be_made(capsys: pytest.CaptureFixture[str]) -> None:
    """It is an error at once, with what was raised and where."""
    with begun(make="make_nothing") as run:
        submit(run, *"abc", do="echo")
        with pytest.raises(Error, match="ValueError: there is no handler"):
            outcomes(run)
    assert "about to raise" in capsys.readouterr().err


def test_an_error_of_ours_stays_what_it_is() -> None:
    """With its class and its facts."""
    with begun(make="make_no_name") as run:
        submit(run, "a", do="echo")
        with pytest.raises(mjrec.UnknownName, match="no camera 'egocentric'") as raised:
            outcomes(run)
    assert raised.value.available == ["back", "side"]


@pytest.mark.parametrize("entry", ["no_such_module:make", "odd_jobs:no_such_name"])
def test_an_entry_that_there_is_not(entry: str) -> None:
    """The error names it."""
    with LocalEngine(1).begin(Work(entry=entry)) as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match="no_such_"):
            outcomes(run)


def test_a_worker_that_is_told_to_end_while_it_begins() -> None:
    """It ends as any other does, and reports no fault."""
    with begun(make="make_and_be_told_to_end") as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match=r"No worker can begin.* ended with status 143"):
            outcomes(run)


def test_workers_that_end_as_soon_as_they_begin(tmp_path: Path) -> None:
    """Two of them are enough."""
    with begun(make="make_and_die", begun=str(tmp_path / "begun")) as run:
        submit(run, *"abc", do="echo")
        with pytest.raises(
            Error,
            match=r"No worker can begin. The last one ended with status 3. "
            r"The end of what it said: a library is missing",
        ):
            outcomes(run)
    assert len(lines(tmp_path / "begun")) == 2


def test_a_python_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error names it."""
    monkeypatch.setattr(sys, "executable", "/no/such/python")
    with begun() as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match="No worker could be started: '/no/such/py"):
            outcomes(run)


# What workers print


def test_what_jobs_print_disturbs_nothing(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """It is passed on, and warnings are logged under their own name."""
    with begun() as run:
        submit(run, "a", do="talk")
        assert values(run) == [{"read": ""}]
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.splitlines() == [
        '{"key": "a", "value": {"forged": true}}',
        "to the error output",
        "of a child",
        "50 %",
        "100 %",
    ]
    assert caplog.record_tuples == [("odd", logging.WARNING, "a warning of 7")]


def test_much_that_is_printed_is_not_in_the_way(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """More than a pipe holds, from several at once, line by line."""
    with begun(2) as run:
        submit(run, *"abcd", do="shout")
        assert values(run) == [{}] * 4
    assert capsys.readouterr().err.count("x") == 4_000_000


def test_no_standard_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A caller without one gets its results all the same."""
    monkeypatch.setattr(sys, "stderr", None)
    with begun() as run:
        submit(run, "a", do="talk")
        assert values(run) == [{"read": ""}]


# The end


def test_handlers_are_closed_at_the_end(tmp_path: Path) -> None:
    """Each of them, in its own process."""
    with begun(closed=str(tmp_path / "closed")) as run:
        submit(run, "a", do="where")
        [value] = values(run)
        assert not lines(tmp_path / "closed")
    assert lines(tmp_path / "closed") == [str(value["pid"])]


def test_a_handler_that_cannot_be_closed(caplog: pytest.LogCaptureFixture) -> None:
    """The log says why; the results are there."""
    with begun(closes="badly") as run:
        submit(run, "a", do="where")
        assert len(values(run)) == 1
    assert "could not close what it held" in caplog.text
    assert "OSError: the disk is gone" in caplog.text


def test_cancelling_lets_a_job_close_its_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is not done stays so; a second time is no more than once."""
    run = begun(closed=str(tmp_path / "closed"))
    submit(run, "a", "b", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    run.cancel()
    run.cancel()
    assert lines(tmp_path / "closed") == [str(pid)]
    assert "let go" in capsys.readouterr().err
    assert run.unfinished == 2
    with pytest.raises(ClosedError, match="cancelled"):
        run.results()
    with pytest.raises(ClosedError, match="cancelled"):
        submit(run, "c", do="echo")


def test_cancelling_while_results_come(tmp_path: Path) -> None:
    """There are no more of them."""
    run = begun()
    submit(run, *"abcdefgh", do="echo")
    for number, _ in enumerate(run.results()):
        assert number < 3
        if number == 2:
            run.cancel()


def test_ctrl_c_while_results_come(tmp_path: Path) -> None:
    """It is raised at once, and leaving `with` closes what the workers are at."""
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
    monkeypatch.setattr(local, "SECONDS_TO_CLOSE", 0.2)
    with begun() as run:
        submit(run, "a", do="hold_on", begun=str(tmp_path / "begun"))
        pid = wait_for(tmp_path / "begun", run)
    wait_for_end(pid)
    assert "are killed" in caplog.text


def test_a_caller_that_ignores_sigterm(tmp_path: Path) -> None:
    """Its workers do not."""
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


def test_forgotten_runs_end(tmp_path: Path) -> None:
    """Without a warning, in mid-job too."""
    run = begun()
    submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    del run
    gc.collect()
    wait_for_end(pid)


@pytest.mark.thorough
def test_fifty_runs_leave_nothing_open() -> None:
    """No descriptor, and no process."""

    def once() -> None:
        with begun() as run:
            submit(run, "a", do="echo")
            outcomes(run)

    once()
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208  no paths
    for _ in range(50):
        once()
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208  no paths


# Wherever the caller is

CALLER = """
from mjrec.engines.local import LocalEngine
from mjrec.engines.work import Job, Work
with LocalEngine(2).begin(Work(entry="odd_jobs:make")) as run:
    for number in range(9):
        run.submit(Job(key=str(number), arguments={"do": "echo"}))
    print(sorted(outcome.key for outcome in run.results()))
"""
SAID = f"{[str(number) for number in range(9)]}\n"


def run_python(
    arguments: list[str], *, text: str | None = None
) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(
        [sys.executable, "-W", "error", *arguments],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        input=text,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done


def test_from_standard_input() -> None:
    """`python -` has no main module that could be imported."""
    assert run_python(["-"], text=CALLER).stdout == SAID


def test_jobs_read_nothing_of_the_callers_input() -> None:
    """It is the caller's, and jobs would wait for it."""
    script = CALLER.replace('"echo"', '"talk"').replace(
        "outcome.key for", "outcome.value['read'] for"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        input="for the caller",
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"{[''] * 9}\n"


def test_from_a_script_without_a_guard(tmp_path: Path) -> None:
    """It runs once, and what lies beside it is not taken for Python's own modules."""
    (tmp_path / "script.py").write_text(CALLER)
    (tmp_path / "random.py").write_text("raise RuntimeError('not this one')")
    assert run_python([str(tmp_path / "script.py")]).stdout == SAID


def test_from_a_daemonic_process() -> None:
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
    assert run_python(["-c", script]).stdout == SAID


def test_leaving_in_mid_job_is_silent(tmp_path: Path) -> None:
    """At interpreter exit the workers end, and nothing waits for them."""
    script = """
import sys
from mjrec.engines.local import LocalEngine
from mjrec.engines.work import Job, Work
run = LocalEngine(1).begin(Work(entry="odd_jobs:make"))
run.submit(Job(key="a", arguments={"do": "where"}))
run.submit(Job(key="b", arguments={"do": "hold", "begun": sys.argv[1]}))
print(next(run.results()).value["pid"])
"""
    done = run_python(["-c", script, str(tmp_path / "begun")])
    wait_for_end(int(done.stdout))


@pytest.mark.thorough
def test_a_killed_parent_leaves_no_workers(tmp_path: Path) -> None:
    """They close what they are at, although the parent's child has its files too.

    One that takes no notice is ended after some seconds.
    """
    script = f"""
import os, signal, sys
from pathlib import Path
from mjrec.engines.local import LocalEngine
from mjrec.engines.work import Job, Work
place = Path({str(tmp_path)!r})
settings = {{"closed": str(place / "closed")}}
run = LocalEngine(2).begin(Work(entry="odd_jobs:make", settings=settings))
for key, do in (("a", "hold"), ("b", "hold_on")):
    begun = {{"do": do, "begun": str(place / key)}}
    run.submit(Job(key=key, arguments=begun))
for _ in run.results(patience_s=0.02):
    if all((place / key).exists() and (place / key).read_text() for key in "ab"):
        break
if not os.fork():
    # A forked child has copies of all files, and may not use them.
    try:
        run.results()
    except Exception as error:
        run.cancel()
        os.write(1, f"{{type(error).__name__}}\\n".encode())
    sys.stdin.read()
    os._exit(0)
os.read(int(sys.argv[1]), 1)
os.kill(os.getpid(), signal.SIGKILL)
"""
    child_may_go_on, keeps_child = os.pipe()
    parent_may_die, kills_parent = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", script, str(parent_may_die)],
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
    """Neither the engine nor its worker loads a simulator or numpy."""
    script = (
        "import sys, mjrec.engines.local, mjrec.engines.local_worker; "
        "print([m for m in ('mujoco', 'numpy', 'h5py') if m in sys.modules])"
    )
    assert run_python(["-c", script]).stdout == "[]\n"
