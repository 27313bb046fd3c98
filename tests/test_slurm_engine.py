# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from engine_runs import lines, outcomes, submit, values, wait_for
from evaluated_files import recorded_in
from interruption import ctrl_c_soon
from waiting import wait_until

import mjrec
from mjrec.engines.job_folder import HostState, JobFolder, Pace
from mjrec.engines.slurm import DEFAULT_WORKERS, SlurmEngine
from mjrec.engines.work import WORK_FOLDER, Engine, JobOutcome, Run, Work
from mjrec.errors import ClosedError, Error, InvalidArgument, MissingDependency
from mjrec.machine import usable_cpus
from test_evaluating import SLOW, contents, ended
from test_evaluating import begun as begun_in
from test_evaluating import run as run_small

pytest.importorskip("submitit")

MARK = "MJREC_TEST_MARK"
QUICK = Pace(poll_s=0.05, look_s=0.1, beat_s=0.1, silent_s=60, idle_s=60)
# What a driver says on import of these tests' helpers.
DRIVER_PATH = {"PYTHONPATH": str(Path(__file__).parent)}


@pytest.fixture(autouse=True)
def mark(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Every process that a test has started, or they have, is gone at its end."""
    mark = secrets.token_hex(8)
    monkeypatch.setenv(MARK, mark)
    yield mark
    wait_until(lambda: not marked(mark))


def marked(mark: str) -> list[str]:
    """Return the commands of the processes that were started with the mark."""
    wanted = f"{MARK}={mark}".encode()
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            environ = (process / "environ").read_bytes().split(b"\0")
            if wanted in environ:
                found.append((process / "cmdline").read_text().replace("\0", " "))
    return found


def engine(
    workers: int | None = 1, *, pace: Pace = QUICK, **options: Any
) -> SlurmEngine:
    made = SlurmEngine(workers, cluster="local", **options)
    made._pace = pace
    return made


def work(place: Path, make: str = "make", **settings: Any) -> Work:
    return Work(
        entry=f"odd_jobs:{make}", settings=settings, shared_directory=place / "shared"
    )


def begun(place: Path, workers: int = 1, **settings: Any) -> Run:
    return engine(workers).begin(work(place, **settings))


def folder_in(place: Path) -> JobFolder:
    [path] = (place / "shared" / WORK_FOLDER).iterdir()
    return JobFolder(path)


def host_process(place: Path) -> int:
    """Return the number of the process that is the only host of the only run."""
    [job] = folder_in(place).submitted()
    [host] = Path("/proc", job, "task", job, "children").read_text().split()
    return int(host)


# Jobs and their outcomes


def test_it_is_an_engine(tmp_path: Path) -> None:
    """Of the interface, and nothing stays of a run that had no jobs."""
    made: Engine = engine(2)
    with made.begin(work(tmp_path)) as run:
        assert run.workers == 2
        assert run.unfinished == 0
        assert list(run.results()) == []
    assert not (tmp_path / "shared").exists()


def test_jobs_get_settings_and_arguments(tmp_path: Path) -> None:
    """The outcome is what the handler returns."""
    with begun(tmp_path, seeds=[1, 2]) as run:
        submit(run, "a", do="echo", text="ß\n")
        assert run.unfinished == 1
        [value] = values(run)
        assert run.unfinished == 0
    assert value == {
        "arguments": {"do": "echo", "text": "ß\n"},
        "settings": {"seeds": [1, 2]},
    }


def test_jobs_can_be_submitted_while_results_come(tmp_path: Path) -> None:
    """The iterator goes on to their outcomes, and a second one too."""
    with begun(tmp_path, 2) as run:
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


@pytest.mark.thorough
def test_hundreds_of_small_jobs(tmp_path: Path) -> None:
    """Each once, however many workers try for them."""
    keys = [str(number) for number in range(300)]
    with begun(tmp_path, 3) as run:
        submit(run, *keys, do="echo")
        assert sorted(o.key for o in run.results() if o) == sorted(keys)


@pytest.mark.thorough
def test_jobs_run_beside_each_other(tmp_path: Path) -> None:
    """In two Slurm jobs, or in one that holds two workers."""
    for per_job in (1, 2):
        pipe = tmp_path / f"pipe{per_job}"
        os.mkfifo(pipe)
        with engine(2, workers_per_job=per_job).begin(work(tmp_path)) as run:
            submit(run, "a", do="meet", pipe=str(pipe), mode="rb")
            submit(run, "b", do="meet", pipe=str(pipe), mode="wb")
            assert len({value["pid"] for value in values(run)}) == 2
            assert len(folder_in(tmp_path).submitted()) == 2 / per_job


def test_no_more_slurm_jobs_than_jobs(tmp_path: Path) -> None:
    """Nor any before there is one; they stay for later jobs."""
    with begun(tmp_path, 4) as run:
        assert folder_in(tmp_path).submitted() == []
        submit(run, "a", do="where")
        [first] = values(run)
        submit(run, "b", do="where")
        [second] = values(run)
        assert first == second
        assert len(folder_in(tmp_path).submitted()) == 1


def test_patience_is_told_of(tmp_path: Path) -> None:
    """None is no outcome: the caller may look at the clock."""
    with begun(tmp_path) as run:
        submit(run, "a", do="echo")
        assert next(run.results(patience_s=1e-6)) is None
        assert run.unfinished == 1
        assert [o.key for o in run.results(patience_s=1e-6) if o is not None] == ["a"]


def test_workers_are_where_the_driver_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its directory, with its environment and more."""
    monkeypatch.chdir(tmp_path)
    asked = Work(
        entry="odd_jobs:make",
        environ={"OMP_NUM_THREADS": "3"},
        shared_directory=Path("shared"),
    )
    with engine().begin(asked) as run:
        submit(run, "a", do="where")
        [value] = values(run)
    assert value["directory"] == str(tmp_path)
    assert value["threads"] == "3"


@pytest.mark.thorough
def test_a_large_payload_is_read_once_by_each_slurm_job(tmp_path: Path) -> None:
    """It is one file, which is of no use once the workers have begun."""
    payload = os.urandom(1 << 20) * 200
    asked = Work(
        entry="odd_jobs:make", payload=payload, shared_directory=tmp_path / "shared"
    )
    with engine().begin(asked) as run:
        submit(run, "first", do="payload")
        [first] = values(run)
        (folder_in(tmp_path).path / "payload").unlink()
        submit(run, *"abc", do="payload")
        found = values(run)
    assert first["size"] == len(payload)
    assert found == [first] * 3


def test_what_cannot_be_handed_out(tmp_path: Path) -> None:
    """Errors name the job."""
    with pytest.raises(InvalidArgument, match="settings of the work cannot be written"):
        begun(tmp_path, path=Path())
    with begun(tmp_path) as run:
        submit(run, "a", do="echo")
        with pytest.raises(InvalidArgument, match="a job 'a' in this run already"):
            submit(run, "a", do="echo")
        with pytest.raises(InvalidArgument, match="arguments of the job 'b' cannot be"):
            submit(run, "b", do=Path())
        with pytest.raises(InvalidArgument, match="patience_s must be"):
            run.results(patience_s=0)
        assert run.unfinished == 1


def test_a_shared_directory_is_needed() -> None:
    """The error says for what."""
    with pytest.raises(InvalidArgument, match="that all machines see"):
        engine().begin(Work(entry="odd_jobs:make"))


# Jobs that fail, and workers that die


def test_what_a_handler_raises_is_the_outcome(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In one line; the worker goes on, and the driver's log has the traceback."""
    with begun(tmp_path) as run:
        submit(run, "bad", do="fail")
        submit(run, "exit", do="leave")
        submit(run, "after", do="where")
        found = outcomes(run)
    assert found["bad"].failure == "ValueError: not today"
    assert found["exit"].failure == "SystemExit: enough"
    assert found["after"].value is not None
    assert "The job bad failed" in caplog.text


@pytest.mark.thorough
def test_jobs_that_kill_their_workers(tmp_path: Path) -> None:
    """Once is chance, and three times is the job; all others come through."""
    with begun(tmp_path) as run:
        once = str(tmp_path / "once")
        submit(run, "chance", do="die", how="SIGKILL", once=once)
        submit(run, "poison", do="die", how="SIGKILL")
        submit(run, *"abc", do="echo")
        found = outcomes(run)
    assert found["chance"] == JobOutcome(key="chance", value={"alive": True}, tries=2)
    assert found["poison"].tries == 3
    assert "was killed by SIGKILL" in (found["poison"].failure or "")
    assert [found[key].failure for key in "abc"] == [None] * 3


def test_a_handler_that_cannot_be_made(tmp_path: Path) -> None:
    """An error of ours stays what it is."""
    with begun(tmp_path, make="make_no_name") as run:
        submit(run, *"abc", do="echo")
        with pytest.raises(mjrec.UnknownName, match="no camera 'egocentric'") as raised:
            outcomes(run)
    assert raised.value.available == ["back", "side"]


# Slurm jobs that end


@pytest.mark.thorough
def test_a_host_that_is_killed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its job is a try, done again in another Slurm job; the logs are kept."""
    with begun(tmp_path) as run:
        submit(run, "a", do="echo")
        outcomes(run)
        submit(run, "b", do="hold", begun=str(tmp_path / "begun"))
        first = wait_for(tmp_path / "begun", run)
        os.kill(host_process(tmp_path), signal.SIGKILL)
        (tmp_path / "begun").unlink()
        assert wait_for(tmp_path / "begun", run) != first
        assert len(folder_in(tmp_path).submitted()) == 2
    assert "A worker died at the job b, which is begun again" in caplog.text
    assert list(folder_in(tmp_path).logs.glob("*_log.err"))
    assert str(folder_in(tmp_path).logs) in caplog.messages[-1]


@pytest.mark.thorough
def test_a_host_that_is_told_to_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As at preemption: files are closed, and its job, no try, is done elsewhere."""
    with begun(tmp_path, closed=str(tmp_path / "closed")) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
        first = wait_for(tmp_path / "begun", run)
        os.kill(host_process(tmp_path), signal.SIGTERM)
        (tmp_path / "begun").unlink()
        wait_until(lambda: lines(tmp_path / "closed") == [str(first)])
        assert wait_for(tmp_path / "begun", run) != first
    assert not caplog.messages
    assert not (tmp_path / "shared").exists()


@pytest.mark.thorough
def test_a_host_whose_time_will_be_over(tmp_path: Path) -> None:
    """It is at its job to the end, and another Slurm job does the next."""
    with begun(tmp_path) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
        pid = wait_for(tmp_path / "begun", run)
        # As Slurm does: to all processes of the job.
        host = host_process(tmp_path)
        for process in [host, *children_of(host)]:
            os.kill(process, signal.SIGUSR2)
        wait_until(lambda: HostState.LEAVING in folder_in(tmp_path).hosts().values())
        submit(run, "b", do="where")
        for outcome in run.results(patience_s=0.02):
            if outcome is not None:
                break
        assert outcome is not None
        assert outcome.key == "b"
        assert [pid] == children_of(host)
        assert (outcome.value or {})["pid"] != pid


def children_of(pid: int) -> list[int]:
    found = Path("/proc", str(pid), "task").glob("*/children")
    return [int(child) for path in found for child in path.read_text().split()]


def test_slurm_jobs_that_end_as_soon_as_they_begin(tmp_path: Path) -> None:
    """Three are enough; the error has the end of the log and says where it is."""
    made = engine(setup=["echo no such module >&2; exit 1"])
    with made.begin(work(tmp_path)) as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match="No Slurm job can do anything") as raised:
            outcomes(run)
    assert str(folder_in(tmp_path).logs) in str(raised.value)


@pytest.mark.thorough
def test_hosts_that_have_nothing_to_do_end(tmp_path: Path) -> None:
    """And there are others when there is something again."""
    pace = Pace(poll_s=0.05, look_s=0.1, beat_s=0.1, idle_s=0.3)
    with engine(pace=pace).begin(work(tmp_path)) as run:
        submit(run, "a", do="where")
        [first] = values(run)
        wait_until(
            lambda: set(folder_in(tmp_path).hosts().values()) == {HostState.ENDED}
        )
        submit(run, "b", do="where")
        [second] = values(run)
    assert first["pid"] != second["pid"]


# The end


def test_cancelling_lets_a_job_close_its_files(tmp_path: Path) -> None:
    """What is not done stays so; a second time is no more than once."""
    run = begun(tmp_path, closed=str(tmp_path / "closed"))
    submit(run, "a", "b", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    run.cancel()
    run.cancel()
    assert lines(tmp_path / "closed") == [str(pid)]
    assert run.unfinished == 2
    with pytest.raises(ClosedError, match="cancelled"):
        run.results()
    with pytest.raises(ClosedError, match="cancelled"):
        submit(run, "c", do="echo")
    assert not (tmp_path / "shared").exists()


def test_what_others_keep_in_the_shared_directory_stays(tmp_path: Path) -> None:
    """Also where this run has made it."""
    with begun(tmp_path) as run:
        submit(run, "a", do="echo")
        (tmp_path / "shared" / "results.csv").touch()
        outcomes(run)
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["results.csv"]


def test_ctrl_c_while_results_come(tmp_path: Path) -> None:
    """It is raised at once, and leaving `with` closes what the workers are at."""
    run = begun(tmp_path, closed=str(tmp_path / "closed"))
    submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    with pytest.raises(KeyboardInterrupt), run, ctrl_c_soon():
        outcomes(run)
    assert lines(tmp_path / "closed") == [str(pid)]


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_in_a_terminal(tmp_path: Path) -> None:
    """It reaches all processes there, of which only the driver takes it to heart."""
    script = DRIVER.replace("run = engine.begin(work)", "run = start(engine, work)")
    driver = subprocess.Popen(
        [sys.executable, "-c", CANCELLING + script, str(tmp_path), "60"],
        env={**os.environ, **DRIVER_PATH},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    wait_until(lambda: lines(tmp_path / "begun"))
    os.killpg(driver.pid, signal.SIGINT)
    _, said = driver.communicate(timeout=60)
    assert said.count("KeyboardInterrupt") == 1
    [pid] = lines(tmp_path / "begun")
    assert pid in lines(tmp_path / "closed")
    assert not (tmp_path / "shared").exists()


def test_forgotten_runs_end(tmp_path: Path, mark: str) -> None:
    """In mid-job too."""
    run = begun(tmp_path)
    submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
    wait_for(tmp_path / "begun", run)
    del run
    wait_until(lambda: not marked(mark))


# A driver that is killed

CANCELLING = """
import atexit
def start(engine, work):
    run = engine.begin(work)
    atexit.register(run.cancel)
    return run
"""
DRIVER = """
import sys
from pathlib import Path
from mjrec.engines.job_folder import Pace
from mjrec.engines.slurm import SlurmEngine
from mjrec.engines.work import Job, Work
place = Path(sys.argv[1])
engine = SlurmEngine(2, cluster="local")
engine._pace = Pace(poll_s=0.05, look_s=0.1, beat_s=0.1, silent_s=float(sys.argv[2]))
settings = {"closed": str(place / "closed")}
work = Work(
    entry="odd_jobs:make", settings=settings, shared_directory=place / "shared"
)
run = engine.begin(work)
run.submit(Job(key="a", arguments={"do": "hold", "begun": str(place / "begun")}))
for number in range(20):
    run.submit(Job(key=str(number), arguments={"do": "echo"}))
for outcome in run.results(patience_s=0.05):
    print(outcome.key if outcome else None, flush=True)
"""


@contextlib.contextmanager
def killed_driver(place: Path, silent_s: float) -> Iterator[None]:
    """Be where a driver was killed, of whom a host is in mid-job."""
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(place), str(silent_s)],
        env={**os.environ, **DRIVER_PATH},
        stdout=subprocess.PIPE,
    )
    with driver:
        wait_until(lambda: lines(place / "begun"))
        driver.kill()
    yield


@pytest.mark.thorough
def test_hosts_of_a_killed_driver_end(tmp_path: Path, mark: str) -> None:
    """They finish what they are at, and take no more."""
    with killed_driver(tmp_path, silent_s=1):
        hosts = folder_in(tmp_path).hosts
        wait_until(lambda: HostState.LEAVING in hosts().values())
        wait_until(lambda: HostState.WORKING not in hosts().values())
        [pid] = lines(tmp_path / "begun")
        assert pid not in lines(tmp_path / "closed")
        # Nobody is left who would end the one that never comes to its end.
        folder_in(tmp_path).stop()
        wait_until(lambda: not marked(mark))
    assert pid in lines(tmp_path / "closed")


@pytest.mark.thorough
def test_the_next_driver_ends_what_a_killed_one_has_left(
    tmp_path: Path, mark: str
) -> None:
    """At once, and cleans up behind it."""
    with killed_driver(tmp_path, silent_s=600), begun(tmp_path) as run:
        [pid] = lines(tmp_path / "begun")
        wait_until(lambda: pid in lines(tmp_path / "closed"))
        submit(run, "a", do="echo")
        assert len(values(run)) == 1
        # One Slurm job is this driver's: two processes, and their worker.
        wait_until(lambda: len(marked(mark)) <= 3)
    assert list((tmp_path / "shared").iterdir()) == []


@pytest.mark.thorough
def test_another_driver_that_is_alive_is_left_alone(tmp_path: Path) -> None:
    """Two runs in one directory do not know of each other."""
    with begun(tmp_path) as one, begun(tmp_path) as other:
        submit(one, "a", do="echo")
        submit(other, "b", do="echo")
        assert list(outcomes(one)) == ["a"]
        assert list(outcomes(other)) == ["b"]
    assert not (tmp_path / "shared").exists()


# What an engine can be asked for


def test_how_many_workers() -> None:
    """What Slurm grants is not known; what this machine has is."""
    assert SlurmEngine(cluster="local").workers == usable_cpus()
    assert DEFAULT_WORKERS == 4
    assert repr(engine(3)) == "SlurmEngine(workers=3, cluster='local')"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"workers": 0}, "workers must be"),
        ({"cluster": "pbs"}, "cluster is"),
        ({"cpus_per_worker": 0}, "cpus_per_worker must be"),
        ({"workers_per_job": 1.5}, "workers_per_job must be"),
        ({"time_min": 0}, "time_min must be"),
        ({"time_min": 1, "notice_s": 60}, "notice_s is less than"),
        ({"mem_gb": 0}, "mem_gb is more than 0"),
        ({"gpus": -1}, "gpus is how many"),
    ],
)
def test_what_cannot_be(options: dict[str, Any], said: str) -> None:
    """It is refused before anything starts."""
    with pytest.raises(InvalidArgument, match=said):
        SlurmEngine(**{"cluster": "local", **options})


def test_a_machine_without_slurm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error says what is missing, and what to do."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Error, match=r"no sbatch, squeue, .* login node"):
        SlurmEngine()


def test_without_submitit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says how to get it."""
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(MissingDependency, match=r"pip install \"mjrec\[slurm\]\""):
        SlurmEngine(cluster="local")


def test_options_as_texts() -> None:
    """Of the command line."""
    made = SlurmEngine.from_texts(
        {
            "cluster": "local",
            "partition": "gpu",
            "time_min": "30",
            "mem_gb": "2.5",
            "setup": "module load cuda",
            "sbatch.exclusive": "",
            "sbatch.nice": "100",
        },
        workers=8,
        gpus=0.25,
    )
    asked = made._request.for_slurm()
    assert asked["partition"] == "gpu"
    assert asked["time"] == 30
    assert asked["mem"] == "10240M"
    assert asked["gpus_per_node"] == 1
    assert asked["cpus_per_task"] == 4
    assert asked["setup"] == ["module load cuda"]
    assert asked["additional_parameters"] == {
        "exclusive": True,
        "nice": "100",
        "no_requeue": True,
    }


def test_gpus_can_be_asked_for_in_the_clusters_own_words() -> None:
    """Then they are not asked for twice."""
    made = SlurmEngine(8, cluster="local", gpus=1, sbatch={"gres": "gpu:a100:1"})
    asked = made._request.for_slurm()
    assert "gpus_per_node" not in asked
    assert asked["additional_parameters"]["gres"] == "gpu:a100:1"


def test_texts_that_cannot_be() -> None:
    """A slip is told with what there is."""
    with pytest.raises(mjrec.UnknownName, match=r"'partitoin'.*partition.*sbatch.NAME"):
        SlurmEngine.from_texts({"partitoin": "gpu"})
    with pytest.raises(InvalidArgument, match="time_min of Slurm's is a number"):
        SlurmEngine.from_texts({"time_min": "an hour"})


def test_import_is_inert() -> None:
    """An engine needs submitit, which is to leave logging as it is."""
    script = """
import logging, os, sys
import mjrec.engines.slurm
assert "submitit" not in sys.modules
handler = logging.StreamHandler()
mjrec.engines.slurm.SlurmEngine(1, cluster="local")
assert "submitit" in sys.modules
assert not logging.getLogger("submitit").handlers
assert handler in [reference() for reference in logging._handlerList]
assert "SUBMITIT_LOG_LEVEL" not in os.environ
"""
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)


# Evaluations


# Takes more than five seconds: the same evaluation here and through submitit.
def test_an_evaluation_in_slurm_jobs_is_that_of_this_machine(tmp_path: Path) -> None:
    """Results, trajectories and videos, however their jobs were handed out."""
    there = run_small(tmp_path / "there", keep="best", engine=engine(2), workers=None)
    here = run_small(tmp_path / "here", keep="best")
    assert contents(there.directory) == contents(here.directory)
    assert recorded_in(there) == recorded_in(here)
    assert len(recorded_in(there)) == 4 + 1
    assert not (tmp_path / "there" / WORK_FOLDER).exists()


EVALUATION = """
import sys
from pathlib import Path
import mjrec
from mjrec.engines.job_folder import Pace
from mjrec.engines.slurm import SlurmEngine

engine = SlurmEngine(2, cluster="local")
engine._pace = Pace(poll_s=0.05, look_s=0.1, beat_s=0.1)
mjrec.evaluate(
    ["InvertedPendulum-v5"], policy="slow_policy:Slow", directory=sys.argv[1],
    episodes=6, num_seeds=4, max_steps=10, keep="none", resume=True, engine=engine,
)
"""


@pytest.mark.thorough
def test_a_killed_evaluation_goes_on_where_it_was(tmp_path: Path, mark: str) -> None:
    """Of its driver; what is finished, by hosts that live on too, is not repeated."""

    def evaluating(name: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-c", EVALUATION, str(tmp_path / name)],
            cwd=tmp_path,
            env={**os.environ, **DRIVER_PATH},
        )

    (tmp_path / "slow_policy.py").write_text(SLOW)
    killed = tmp_path / "killed"
    with evaluating("killed") as driver:
        wait_until(lambda: ended(killed) >= 5)
        driver.kill()
    for name in ("killed", "whole"):
        with evaluating(name) as driver:
            assert driver.wait() == 0
    assert contents(killed) == contents(tmp_path / "whole")
    assert 24 <= begun_in(killed) <= 26
    wait_until(lambda: not marked(mark))
    assert not (killed / WORK_FOLDER).exists()
