# SPDX-License-Identifier: Apache-2.0
"""Guarantees of jobs on every engine and executor, as in `docs/howto/clusters.md`."""

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

# Ray leaves connections and pipes to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")
# Real Ray, and Slurm jobs through submitit, take seconds each.
on_each = parametrize("engine", ["local", "own", "slurm", "ray", "dask"], default=2)


@pytest.fixture(scope="module")
def engines(tmp_path_factory):
    with each_engine(tmp_path_factory.mktemp("home")) as engines:
        yield engines


@pytest.fixture
def begin(engine, engines, tmp_path):
    """Return a function that starts a run of `odd_jobs` on an engine."""
    executors = []
    (tmp_path / "shared").mkdir()

    def begin(workers=1, make="make", **settings):
        executors.append(engines(engine, workers))
        work = odd_work(make, shared=tmp_path / "shared", **settings)
        return Run(executors[-1], work)

    yield begin
    for executor in executors:
        executor.shutdown()
    assert not list((tmp_path / "shared").iterdir())


@on_each
def test_jobs_get_settings_and_arguments(begin, engine, tmp_path, monkeypatch):
    """Jobs may be submitted between results.

    A child runs in the driver's directory, in a session of its own, and is kept for
    later jobs, by Slurm for jobs of the same array.
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
        keys = []
        for outcome in run.results():
            keys.append(outcome.key)
            if len(keys) < 4:
                submit(run, str(len(keys)), do="echo")
        submit(run, "later", do="echo", text="ß\n")
        [value] = values(run)
    assert keys == ["0", "1", "2", "3"]
    arguments = {"do": "echo", "text": "ß\n"}
    assert value == {"arguments": arguments, "settings": {"seeds": [1, 2]}}


def test_unreachable_dask_scheduler_is_an_error(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("mjrec.engines.choice._SECONDS_TO_REACH", 0.1)
    with pytest.raises(Error, match=r"answers at tcp://127.0.0.1:1. `dask scheduler`"):
        engine_from("dask:tcp://127.0.0.1:1")


@on_each
def test_jobs_run_in_parallel_and_results_have_a_timeout(begin, tmp_path):
    """Each of two jobs waits for the other."""
    os.mkfifo(tmp_path / "pipe")
    with begin(2) as run:
        submit(run, "a", do="meet", pipe=str(tmp_path / "pipe"), mode="rb")
        assert next(run.results(timeout_s=1e-6)) is None
        submit(run, "b", do="meet", pipe=str(tmp_path / "pipe"), mode="wb")
        assert len({value["pid"] for value in values(run)}) == 2


@on_each
def test_exception_of_a_handler_is_the_outcome(begin, caplog):
    """Tracebacks and warnings are logged once. Printed text is ignored."""
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
    odd = [record.getMessage() for record in caplog.records if record.name == "odd"]
    assert odd == ["a warning of 7"]


@on_each
def test_job_is_tried_three_times_if_its_child_dies(begin, tmp_path, caplog):
    """No other job fails."""
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
def test_time_limit_ends_a_job_that_holds_the_interpreter(begin, tmp_path):
    """The next try finds the reason in a file."""
    with begin() as run:
        submit(run, "a", do="hang", mark=str(tmp_path / "mark"))
        assert outcomes(run)["a"].value == {"mark": "too slow"}


@on_each
def test_failure_to_make_a_handler_is_raised(begin):
    """Errors of mjrec keep their class and attributes."""
    with begin(make="make_no_name") as run:
        submit(run, *"abc", do="echo")
        with pytest.raises(mjrec.UnknownName, match="no camera 'egocentric'") as raised:
            outcomes(run)
    assert raised.value.available == ["back", "side"]
    for make, message in (
        ("make_nothing", "ValueError: there is no handler"),
        ("make_and_die", "No worker can start.* status 3.*: a library is missing"),
    ):
        with begin(make=make) as run:
            submit(run, "a", do="echo")
            with pytest.raises(Error, match=message):
                outcomes(run)


@pytest.mark.parametrize("engine", ["local", "own"])
def test_one_child_does_all_jobs_if_others_cannot_start(begin, tmp_path):
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
def test_cancelling_ends_running_jobs_once(begin, tmp_path):
    """The job of a killed child is taken by another before."""
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
def test_engines_of_other_machines_need_a_shared_directory(begin, tmp_path):
    """Other files in it stay, and runs in it are independent."""
    with begin() as run:
        (tmp_path / "shared" / "results.csv").touch()
        with pytest.raises(InvalidArgument, match="that all workers see"):
            Run(run._engine, odd_work())
        with Run(run._engine, odd_work(shared=tmp_path / "shared")) as other:
            submit(other, "a", do="echo")
            submit(run, "a", do="echo")
            assert [*outcomes(other)] == [*outcomes(run)] == ["a"]
    (tmp_path / "shared" / "results.csv").unlink()
