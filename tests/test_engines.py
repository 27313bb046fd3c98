# SPDX-License-Identifier: Apache-2.0
"""What holds of jobs on every engine: ours, and any executor of one's own.

`docs/howto/clusters.md` lists these guarantees.
"""

import os
import signal

import pytest
from engine_runs import (
    each_engine,
    lines,
    odd_work,
    outcomes,
    submit,
    values,
    wait_for,
    wait_for_end,
)
from parts import parametrize

import mjrec
from mjrec.engines.choice import engine_from
from mjrec.engines.jobs import JobOutcome, Run
from mjrec.errors import Error, InvalidArgument

pytestmark = [
    # Ray's own connections and pipes, of which it says so when they are collected.
    pytest.mark.filterwarnings("ignore::ResourceWarning")
]
# Real Ray, and Slurm jobs through submitit, take seconds each.
on_each = parametrize("engine", ["local", "own", "slurm", "ray", "dask"], default=2)


@pytest.fixture(scope="module")
def engines(tmp_path_factory):
    with each_engine(tmp_path_factory.mktemp("home")) as made:
        yield made


@pytest.fixture
def begin(engine, engines, tmp_path):
    """Return what begins a run of `odd_jobs` on an engine."""
    made = []
    (tmp_path / "shared").mkdir()

    def begun(workers=1, make="make", **settings):
        made.append(engines(engine, workers))
        return Run(made[-1], odd_work(make, shared=tmp_path / "shared", **settings))

    yield begun
    for executor in made:
        executor.shutdown()
    assert not list((tmp_path / "shared").iterdir())


@on_each
def test_jobs_get_settings_and_arguments(begin, engine, tmp_path, monkeypatch):
    """Also those that are submitted while results come, and after.

    Children work where the driver is, out of Ctrl-C's reach; each stays for later
    jobs, in Slurm of the same array.
    """
    monkeypatch.chdir(tmp_path)
    with begin() as run:
        submit(run, *"ab", do="where")
        first, second = values(run)
    assert first == second or engine == "slurm"
    assert first["directory"] == str(tmp_path)
    assert first["session"] == first["pid"]
    with begin(2, seeds=[1, 2]) as run:
        submit(run, "0", do="echo", text="ß\n")
        seen = []
        for outcome in run.results():
            seen.append(outcome.key)
            if len(seen) < 4:
                submit(run, str(len(seen)), do="echo")
        submit(run, "later", do="echo", text="ß\n")
        [value] = values(run)
    assert seen == ["0", "1", "2", "3"]
    arguments = {"do": "echo", "text": "ß\n"}
    assert value == {"arguments": arguments, "settings": {"seeds": [1, 2]}}


def test_a_dask_scheduler_that_does_not_answer(monkeypatch):
    """The error says so soon, and what to do."""
    pytest.importorskip("distributed")
    monkeypatch.setattr("mjrec.engines.choice._SECONDS_TO_REACH", 0.1)
    with pytest.raises(Error, match=r"answers at tcp://127.0.0.1:1. `dask scheduler`"):
        engine_from("dask:tcp://127.0.0.1:1")


@on_each
def test_jobs_run_beside_each_other(begin, tmp_path):
    """Two that wait for each other both come to their end; the caller may look on."""
    os.mkfifo(tmp_path / "pipe")
    with begin(2) as run:
        submit(run, "a", do="meet", pipe=str(tmp_path / "pipe"), mode="rb")
        assert next(run.results(timeout_s=1e-6)) is None
        submit(run, "b", do="meet", pipe=str(tmp_path / "pipe"), mode="wb")
        assert len({value["pid"] for value in values(run)}) == 2


@on_each
def test_what_a_handler_raises_is_the_outcome(begin, caplog):
    """In one line; the child goes on, and the log has the traceback.

    So it has warnings, under their own name, each once. Nothing that a job prints is
    an answer.
    """
    with begin() as run:
        submit(run, *"ab", do="talk")
        assert values(run) == [{"read": ""}] * 2
        submit(run, "bad", do="fail")
        submit(run, "exit", do="leave_python")
        submit(run, "path", do="no_json")
        submit(run, "after", do="echo")
        found = outcomes(run)
    failure = "ValueError: not today"
    assert found["bad"] == JobOutcome(key="bad", value=None, failure=failure)
    assert found["exit"].failure == "SystemExit: enough"
    assert (found["path"].failure or "").startswith("TypeError: Object of type")
    assert found["after"].value is not None
    assert 'raise ValueError("not\\n  today")' in caplog.text
    told = [record.getMessage() for record in caplog.records if record.name == "odd"]
    assert told == ["a warning of 7"]


@on_each
def test_a_job_whose_child_dies_is_done_again(begin, tmp_path, caplog):
    """Three times in all; no other job fails."""
    with begin(2) as run:
        once = str(tmp_path / "once")
        submit(run, "once", do="die", how="SIGSEGV", once=once)
        submit(run, "poison", do="die", how="SIGKILL")
        submit(run, *"abcdef", do="echo")
        found = outcomes(run)
    assert found["once"] == JobOutcome(key="once", value={"alive": True})
    assert found["poison"].failure == (
        "Its worker died on try 3 of 3: it was killed by SIGKILL. "
        "Its last output: SIGKILL is near"
    )
    assert [found[key].failure for key in "abcdef"] == [None] * 6
    assert "job once, which will be retried. It was killed by SIGSEGV" in caplog.text


@on_each
def test_a_job_that_takes_too_long_is_ended(begin, tmp_path):
    """Though it holds the interpreter; the next try finds what is said of it."""
    with begin() as run:
        submit(run, "a", do="hang", mark=str(tmp_path / "mark"))
        assert outcomes(run)["a"].value == {"mark": "too slow"}


@on_each
def test_a_handler_that_cannot_be_made(begin):
    """An error of ours keeps its class and its facts; of others it is told.

    So it is of children that die as they begin.
    """
    with begin(make="make_no_name") as run:
        submit(run, *"abc", do="echo")
        with pytest.raises(mjrec.UnknownName, match="no camera 'egocentric'") as raised:
            outcomes(run)
    assert raised.value.available == ["back", "side"]
    for make, said in (
        ("make_nothing", "ValueError: there is no handler"),
        ("make_and_die", "No worker can start.* status 3.*: a library is missing"),
    ):
        with begin(make=make) as run:
            submit(run, "a", do="echo")
            with pytest.raises(Error, match=said):
                outcomes(run)


@pytest.mark.parametrize("engine", ["local", "own"])
def test_children_that_cannot_begin_do_not_end_one_at_work(begin, tmp_path):
    """It does the jobs of all; how often others have died is no fault of theirs."""
    with begin(2, make="make_one", place=str(tmp_path)) as run:
        begun, go = str(tmp_path / "begun"), str(tmp_path / "go")
        submit(run, "a", do="hold", begun=begun, go=go)
        wait_for(tmp_path / "begun", run)
        submit(run, *"bcdefg", do="echo")
        for _ in run.results(timeout_s=0.02):
            if len(list(tmp_path.glob("died-*"))) >= 6:
                break
        (tmp_path / "go").touch()
        found = outcomes(run)
    assert [found[key].failure for key in "abcdefg"] == [None] * 7


@on_each
def test_cancelling_ends_what_is_at_work(begin, tmp_path):
    """Each may leave a word; a second time is no more than once.

    The job of one that was killed from outside is done by another.
    """
    run = begin(left=str(tmp_path / "left"))
    submit(run, "a", "b", do="hold", begun=str(tmp_path / "begun"))
    killed = wait_for(tmp_path / "begun", run)
    (tmp_path / "begun").unlink()
    os.kill(killed, signal.SIGKILL)
    pid = wait_for(tmp_path / "begun", run)
    assert pid != killed
    run.cancel()
    run.cancel()
    wait_for_end(pid)
    assert lines(tmp_path / "left").count(str(pid)) == 1


@parametrize("engine", ["own", "slurm", "ray"], default=1)
def test_a_shared_directory_is_needed_elsewhere(begin, tmp_path):
    """And what others keep in it stays; two runs there do not know of each other."""
    with begin() as run:
        (tmp_path / "shared" / "results.csv").touch()
        with pytest.raises(InvalidArgument, match="that all workers see"):
            Run(run._engine, odd_work())
        with Run(run._engine, odd_work(shared=tmp_path / "shared")) as other:
            submit(other, "a", do="echo")
            submit(run, "a", do="echo")
            assert [*outcomes(other)] == [*outcomes(run)] == ["a"]
    (tmp_path / "shared" / "results.csv").unlink()
