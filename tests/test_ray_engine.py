# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import hashlib
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import ray
from engine_runs import lines, outcomes, submit, values, wait_for
from ray_clusters import (
    MARK,
    SMALL_STORE,
    home_for_ray,
    is_gone,
    ray_processes,
)
from waiting import wait_until

import mjrec
from mjrec.engines.ray import RayEngine
from mjrec.engines.work import Engine, JobOutcome, Run, Work
from mjrec.errors import ClosedError, Error, InvalidArgument, MissingDependency
from ray_runs import begun, run_python

# Ray's own connections and pipes, of which it says so when they are collected.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No process of Ray, and nothing in the home, is left by all tests of these."""
    with home_for_ray(tmp_path_factory.mktemp("home")):
        yield


@pytest.fixture(scope="module")
def own_ray(home: None) -> Iterator[None]:
    """A Ray that this process has started for itself, with room for two workers."""
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        object_store_memory=SMALL_STORE,
        logging_level=logging.ERROR,
    )
    yield
    ray.shutdown()


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


# Jobs and their outcomes


@pytest.mark.thorough
def test_it_is_an_engine(own_ray: None) -> None:
    """Of the interface, as a type checker sees it too."""
    engine: Engine = RayEngine(1)
    run: Run = engine.begin(Work(entry="odd_jobs:make"))
    with run:
        assert (run.unfinished, run.workers) == (0, 1)
        assert list(run.results()) == []


@pytest.mark.thorough
def test_jobs_get_settings_and_arguments(own_ray: None) -> None:
    """The outcome is what the handler returns."""
    with begun(seeds=[1, 2]) as run:
        submit(run, "a", do="echo", text="ß\n")
        [value] = values(run)
    assert value == {
        "arguments": {"do": "echo", "text": "ß\n"},
        "settings": {"seeds": [1, 2]},
    }


@pytest.mark.thorough
def test_jobs_can_be_submitted_while_results_come(own_ray: None) -> None:
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


@pytest.mark.thorough
def test_jobs_run_beside_each_other(own_ray: None, tmp_path: Path) -> None:
    """Two that wait for each other both come to their end."""
    os.mkfifo(tmp_path / "pipe")
    with begun(2) as run:
        submit(run, "a", do="meet", pipe=str(tmp_path / "pipe"), mode="rb")
        submit(run, "b", do="meet", pipe=str(tmp_path / "pipe"), mode="wb")
        assert len({value["pid"] for value in values(run)}) == 2


@pytest.mark.thorough
def test_workers_stay_for_later_jobs(own_ray: None, tmp_path: Path) -> None:
    """In the driver's directory."""
    with begun(2) as run:
        submit(run, "a", do="where")
        [first] = values(run)
        submit(run, "b", do="where")
        [second] = values(run)
    assert first == second
    assert first["directory"] == str(Path.cwd())


@pytest.mark.thorough
def test_patience_is_told_of(own_ray: None) -> None:
    """None is no outcome: the caller may look at the clock."""
    with begun(1) as run:
        submit(run, "a", do="echo")
        assert next(run.results(patience_s=1e-6)) is None
        assert run.unfinished == 1
        assert [o.key for o in run.results(patience_s=1e-6) if o is not None] == ["a"]


@pytest.mark.thorough
def test_workers_are_as_many_as_the_cluster_has_cpus(own_ray: None) -> None:
    """Unless their number is given."""
    with begun(None) as run:
        assert run.workers == 2
    assert repr(RayEngine(3, gpus=0.5)) == "RayEngine(workers=3, gpus=0.5)"


@pytest.mark.thorough
def test_what_cannot_be_handed_out(own_ray: None) -> None:
    """Errors name the job, and come before Ray is needed."""
    with pytest.raises(InvalidArgument, match="settings of the work cannot be written"):
        begun(path=Path())
    with begun() as run:
        submit(run, "a", do="echo")
        with pytest.raises(InvalidArgument, match="a job 'a' in this run already"):
            submit(run, "a", do="echo")
        with pytest.raises(InvalidArgument, match="patience_s must be"):
            run.results(patience_s=0)


@pytest.mark.thorough
def test_a_large_payload_is_fetched_once_per_worker(own_ray: None) -> None:
    """However many jobs there are, the object store has it once, and no job has it."""
    payload = os.urandom(1 << 20) * 20
    store = ray.cluster_resources()["object_store_memory"]
    work = Work(entry="odd_jobs:make", payload=payload)
    with RayEngine(2).begin(work) as run:
        submit(run, *map(str, range(30)), do="payload")
        seen = {(value["pid"], value["sha256"]) for value in values(run)}
        used = store - ray.available_resources()["object_store_memory"]
    assert {sha256 for _, sha256 in seen} == {hashlib.sha256(payload).hexdigest()}
    assert len(seen) <= 2
    assert used < 2 * len(payload)


# Jobs that fail, and workers that die


@pytest.mark.thorough
def test_what_a_handler_raises_is_the_outcome(
    own_ray: None, caplog: pytest.LogCaptureFixture
) -> None:
    """In one line; the worker goes on, and the log has the traceback."""
    with begun() as run:
        submit(run, "before", do="where")
        submit(run, "bad", do="fail")
        submit(run, "exit", do="leave")
        submit(run, "after", do="where")
        found = outcomes(run)
    assert found["bad"].failure == "ValueError: not today"
    assert found["exit"].failure == "SystemExit: enough"
    assert found["before"].value == found["after"].value
    assert "The job bad failed" in caplog.text


@pytest.mark.thorough
def test_a_job_whose_process_dies_is_begun_again(
    own_ray: None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """By the same worker, as the local engine does it; so are tries counted."""
    with begun(2) as run:
        submit(run, "once", do="die", how="SIGKILL", once=str(tmp_path / "once"))
        submit(run, "poison", do="die", how="SIGSEGV")
        submit(run, *"abc", do="echo")
        found = outcomes(run)
    assert found["once"] == JobOutcome(key="once", value={"alive": True}, tries=2)
    assert found["poison"].tries == 3
    assert "was killed by SIGSEGV" in (found["poison"].failure or "")
    assert [found[key].failure for key in "abc"] == [None] * 3
    assert "job once, which is begun again. It was killed by SIGKILL" in caplog.text


@pytest.mark.thorough
def test_a_killed_worker_of_ray_counts_as_a_death(
    own_ray: None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its process of jobs closes what it is at, and the job is begun again."""
    with begun(closed=str(tmp_path / "closed")) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
        for deaths in (1, 2, 3):
            pid = wait_for(tmp_path / "begun", run)
            os.kill(parent_of(pid), signal.SIGKILL)
            wait_until(lambda n=deaths: len(lines(tmp_path / "closed")) == n)
            (tmp_path / "begun").unlink()
        [outcome] = outcomes(run).values()
    assert outcome.tries == 3
    assert "try 3 of 3: it ended, and Ray says: The actor is dead" in (
        outcome.failure or ""
    )
    assert "job a, which is begun again" in caplog.text


@pytest.mark.thorough
def test_a_terminated_worker_of_ray_is_nobodys_fault(
    own_ray: None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As nodes are taken away: the job closes its files, and is begun elsewhere."""
    with begun(closed=str(tmp_path / "closed")) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
        for _ in range(4):
            pid = wait_for(tmp_path / "begun", run)
            (tmp_path / "begun").unlink()
            os.kill(parent_of(pid), signal.SIGTERM)
        wait_for(tmp_path / "begun", run)
        assert len(lines(tmp_path / "closed")) == 4
        assert run.unfinished == 1
    assert "is told to end: the job a is begun again" in caplog.text


@pytest.mark.thorough
def test_a_handler_that_cannot_be_made(own_ray: None) -> None:
    """It is an error at once; one of ours keeps its class and facts."""
    with begun(entry="odd_jobs:make_no_name") as run:
        submit(run, *"abc", do="echo")
        with pytest.raises(mjrec.UnknownName, match="no camera 'egocentric'") as raised:
            outcomes(run)
    assert raised.value.available == ["back", "side"]


@pytest.mark.thorough
def test_what_jobs_print_is_passed_on(
    own_ray: None,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """By Ray, which says whose it is; and warnings are logged, each once."""
    said: list[str] = []

    def all_is_said() -> bool:
        said.append(capsys.readouterr().err)
        return "to the error output" in "".join(said)

    with begun(2) as run:
        submit(run, *"ab", do="talk")
        assert values(run) == [{"read": ""}] * 2
        wait_until(all_is_said)
    assert "(mjrec worker pid=" in "".join(said)
    assert [r for r in caplog.record_tuples if r[0] == "odd"] == [
        ("odd", logging.WARNING, "a warning of 7")
    ]


# The end


@pytest.mark.thorough
def test_cancelling_lets_jobs_close_their_files(own_ray: None, tmp_path: Path) -> None:
    """What is not done stays so; and nothing of the run is left on the cluster."""
    run = begun(2, closed=str(tmp_path / "closed"))
    submit(run, "a", do="echo")
    submit(run, "b", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    worker = parent_of(pid)
    run.cancel()
    run.cancel()
    assert str(pid) in lines(tmp_path / "closed")
    assert is_gone(pid)
    wait_until(lambda: is_gone(worker))
    with pytest.raises(ClosedError, match="cancelled"):
        submit(run, "c", do="echo")
    with pytest.raises(ClosedError, match="cancelled"):
        run.results()


@pytest.mark.thorough
def test_idle_workers_end_too(own_ray: None, tmp_path: Path) -> None:
    """Also where Ray goes on, because it is the caller's."""
    with begun(closed=str(tmp_path / "closed")) as run:
        submit(run, "a", do="where")
        [value] = values(run)
        worker = parent_of(value["pid"])
    assert lines(tmp_path / "closed") == [str(value["pid"])]
    wait_until(lambda: is_gone(worker))
    assert ray.is_initialized()


@pytest.mark.thorough
def test_forgotten_runs_end(own_ray: None, tmp_path: Path) -> None:
    """In mid-job too."""
    run = begun()
    submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
    pid = wait_for(tmp_path / "begun", run)
    del run
    wait_until(lambda: is_gone(pid))


# Ray itself


@pytest.mark.thorough
def test_ray_is_left_as_the_caller_had_it(own_ray: None) -> None:
    """A driver that uses Ray for other things goes on doing so."""
    remembered = ray.put("of the caller")
    with begun() as run:
        submit(run, "a", do="echo")
        values(run)
    assert ray.get(remembered) == "of the caller"


@pytest.mark.thorough
def test_a_ray_of_our_own_leaves_nothing_behind(tmp_path: Path) -> None:
    """No process, no token, no variable, no handler of a signal; twice in a row."""
    script = """
import os, signal
from mjrec.engines.ray import RayEngine
from mjrec.engines.work import Job, Work
def state():
    handlers = [signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT)]
    return dict(os.environ), handlers
before = state()
for _ in range(2):
    with RayEngine(1).begin(Work(entry="odd_jobs:make")) as run:
        with RayEngine(1).begin(Work(entry="odd_jobs:make")) as other:
            assert state() == before
        run.submit(Job(key="a", arguments={"do": "echo"}))
        assert [o.failure for o in run.results()] == [None]
import ray
assert not ray.is_initialized() and state() == before
print(sorted(os.listdir(os.environ["HOME"])))
"""
    mark = f"{MARK}={tmp_path}"
    environ = {MARK: str(tmp_path), "HOME": str(tmp_path), "RAY_AUTH_TOKEN": ""}
    assert run_python(script, **environ) == "[]\n"
    wait_until(lambda: not ray_processes(mark), seconds=10)


@pytest.mark.thorough
def test_a_ray_of_our_own_without_a_gpu(tmp_path: Path) -> None:
    """One warning, and the jobs are done; nobody waits for what will never be there."""
    script = """
import logging, sys
from mjrec.engines.ray import RayEngine
from mjrec.errors import GLError
from engine_runs import submit, values
from ray_runs import begun
logging.basicConfig(stream=sys.stdout, format="%(message)s")
with begun(engine=RayEngine(1, gpus=0.5)) as run:
    submit(run, "a", "b", do="echo")
    assert len(values(run)) == 2
try:
    begun(engine=RayEngine(1, gpus=0.5, require_gpu=True))
except GLError as error:
    print("refused:", error)
"""
    said = run_python(script, **{MARK: str(tmp_path)})
    assert said.count("Ray finds none on this machine. They draw in software.") == 1
    assert "refused: Workers are to get GPUs" in said
    wait_until(lambda: not ray_processes(f"{MARK}={tmp_path}"), seconds=10)


@pytest.mark.thorough
def test_a_terminated_driver_says_so(tmp_path: Path) -> None:
    """By the exit status of SIGTERM, whatever Ray makes of signals."""
    script = """
import os, signal, sys
from pathlib import Path
from mjrec.signals import exiting_on_signals
from engine_runs import submit
from ray_runs import begun
place = Path(sys.argv[1]) / "begun"
with exiting_on_signals(), begun() as run:
    submit(run, "a", do="hold", begun=str(place))
    for _ in run.results(patience_s=0.05):
        if place.exists() and place.read_text():
            break
    signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    signal.setitimer(signal.ITIMER_REAL, 0.5)
    list(run.results())
"""
    environ = {"PYTHONPATH": str(Path(__file__).parent), MARK: str(tmp_path)}
    command = [sys.executable, "-c", script, str(tmp_path)]
    done = subprocess.run(command, env={**os.environ, **environ}, check=False)
    assert done.returncode == 128 + signal.SIGTERM
    wait_until(lambda: not ray_processes(f"{MARK}={tmp_path}"), seconds=10)


@pytest.mark.thorough
def test_a_killed_driver_leaves_no_process(tmp_path: Path) -> None:
    """Neither of Ray nor of ours; the job that was running has closed its files."""
    script = """
import os, signal, sys
from pathlib import Path
from mjrec.engines.ray import RayEngine
from mjrec.engines.work import Job, Work
place = Path(sys.argv[1])
work = Work(entry="odd_jobs:make", settings={"closed": str(place / "closed")})
run = RayEngine(1).begin(work)
begun = place / "begun"
run.submit(Job(key="a", arguments={"do": "hold", "begun": str(begun)}))
for _ in run.results(patience_s=0.05):
    if begun.exists() and begun.read_text():
        os.kill(os.getpid(), signal.SIGKILL)
"""
    with pytest.raises(AssertionError):
        run_python(script, str(tmp_path), **{MARK: str(tmp_path)})
    wait_until(lambda: not ray_processes(f"{MARK}={tmp_path}"), seconds=30)
    assert lines(tmp_path / "closed") == [(tmp_path / "begun").read_text()]


def test_ray_is_optional() -> None:
    """Without it there is an error that says what to install."""
    script = """
import sys
sys.modules["ray"] = None
from mjrec.engines.ray import RayEngine
try:
    RayEngine()
except Exception as error:
    print(type(error).__name__, error)
"""
    assert run_python(script) == (
        'MissingDependency engine="ray" needs ray, which is not installed. '
        'Run: pip install "mjrec[ray]"\n'
    )
    assert issubclass(MissingDependency, ImportError)


def test_an_engine_is_made_without_loading_ray_before() -> None:
    """It is heavy, and most people need none."""
    script = (
        "import sys, mjrec.engines.choice, mjrec.engines.ray_worker; "
        "print('ray' in sys.modules)"
    )
    assert run_python(script) == "False\n"


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("address", "kind", "said"),
    [
        ("127.0.0.1:1", Error, "no Ray cluster to be had at 127.0.0.1:1"),
        ("ray://127.0.0.1:10001", InvalidArgument, "--address auto"),
    ],
)
def test_an_address_at_which_nothing_is(
    address: str, kind: type[Error], said: str
) -> None:
    """The error says so soon, and what to look at."""
    script = """
import sys
from mjrec.engines.ray import RayEngine
from mjrec.engines.work import Work
try:
    RayEngine(1, address=sys.argv[1]).begin(Work(entry="odd_jobs:make"))
except Exception as error:
    print(type(error).__name__, error)
"""
    told = run_python(script, address)
    assert told.startswith(kind.__name__)
    assert said in told
