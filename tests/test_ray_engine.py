# SPDX-License-Identifier: Apache-2.0
"""Of the Ray engine, what `test_engines` does not try on every one."""

import os
import signal
from pathlib import Path

import pytest
from engine_runs import (
    MARK,
    driver,
    lines,
    marked,
    odd_work,
    run_python,
    submit,
    wait_for,
)
from ray_clusters import home_for_ray, own_ray
from waiting import wait_until

from mjrec.engines.jobs import Run
from mjrec.engines.ray import RayEngine
from mjrec.errors import Error, InvalidArgument

# Ray's own connections and pipes, of which it says so when they are collected.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """No process of Ray, and nothing in the home, is left by all tests of these."""
    with home_for_ray(tmp_path_factory.mktemp("home")):
        yield


@pytest.mark.thorough
def test_a_killed_worker_of_ray_counts_as_a_death(tmp_path, caplog):
    """Its child ends with it, and the job is begun again.

    A driver that uses Ray for other things goes on doing so.
    """
    with own_ray(cpus=1) as ray:
        remembered = ray.put("of the caller")
        work = odd_work(shared=tmp_path / "shared", left=str(tmp_path / "left"))
        engine = RayEngine(1)
        with Run(engine, work) as run:
            submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
            pid = wait_for(tmp_path / "begun", run)
            (tmp_path / "begun").unlink()
            facts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
            os.kill(int(facts.split()[1]), signal.SIGKILL)
            assert wait_for(tmp_path / "begun", run) != pid
            wait_until(lambda: str(pid) in lines(tmp_path / "left"))
        engine.shutdown()
        assert ray.get(remembered) == "of the caller"
    assert "job a, which will be retried" in caplog.text


@pytest.mark.thorough
def test_cancelling_does_not_wait_for_the_resources_of_others(tmp_path):
    """Whose task holds the only CPU, and goes on; in the queue is nothing left."""
    with own_ray(cpus=1) as ray:
        os.mkfifo(tmp_path / "pipe")
        other = ray.remote(num_cpus=1)(Path.read_text).remote(tmp_path / "pipe")
        with Run(RayEngine(), odd_work(shared=tmp_path / "shared")) as run:
            submit(run, "a", "b", do="echo")
            assert next(run.results(timeout_s=0.5)) is None
        (tmp_path / "pipe").write_text("of the caller")
        assert ray.get(other) == "of the caller"


BEGIN = """
import os, signal, sys
from pathlib import Path
from engine_runs import odd_work, submit, values
from mjrec.engines.jobs import Run
from mjrec.engines.ray import RayEngine
place = Path(sys.argv[1])
"""


@pytest.mark.thorough
def test_a_ray_of_our_own_leaves_nothing_behind(tmp_path):
    """No process, no token, no variable, no handler of a signal; twice in a row."""
    script = f"""{BEGIN}
def state():
    handlers = [signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT)]
    return dict(os.environ), handlers
before = state()
for _ in range(2):
    engine = RayEngine(1)
    with Run(engine, odd_work(shared=place)) as run:
        submit(run, "a", do="echo")
        assert len(values(run)) == 1
        assert state() == before
    engine.shutdown()
import ray
assert not ray.is_initialized() and state() == before
print(sorted(os.listdir(os.environ["HOME"])))
"""
    environ = {MARK: str(tmp_path), "HOME": str(tmp_path), "RAY_AUTH_TOKEN": ""}
    assert run_python("-c", script, str(tmp_path), **environ) == "[]\n"
    wait_until(lambda: not marked(tmp_path), seconds=10)


@pytest.mark.thorough
def test_a_ray_of_our_own_without_a_gpu(tmp_path):
    """One warning, and the jobs are done; nobody waits for what will never be there."""
    script = f"""{BEGIN}
import logging
from mjrec.errors import GLError
logging.basicConfig(stream=sys.stdout, format="%(message)s")
engine = RayEngine(1, gpus=0.5)
with Run(engine, odd_work(shared=place)) as run:
    submit(run, "a", "b", do="echo")
    assert len(values(run)) == 2
engine.shutdown()
try:
    RayEngine(1, gpus=0.5, require_gpu=True).submit(len, "abc")
except GLError as error:
    print("refused:", error)
"""
    said = run_python("-c", script, str(tmp_path), **{MARK: str(tmp_path)})
    warning = "Ray finds none on this machine. Workers render in software."
    assert said.count(warning) == 1
    assert "refused: GPUs were requested" in said
    wait_until(lambda: not marked(tmp_path), seconds=10)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("signum", "status"), [(signal.SIGTERM, 128 + 15), (signal.SIGKILL, -9)]
)
def test_a_driver_that_is_ended(tmp_path, signum, status):
    """Says so by its exit status, and leaves no process."""
    with driver(tmp_path, "RayEngine(1)", **{MARK: str(tmp_path)}) as process:
        process.send_signal(signum)
    assert process.returncode == status
    wait_until(lambda: not marked(tmp_path), seconds=30)
    assert lines(tmp_path / "left") == lines(tmp_path / "begun")


def test_ray_is_optional():
    """It is heavy; without it there is an error that says what to install."""
    script = """
import sys
import mjrec.engines.choice, mjrec.engines.ray
assert "ray" not in sys.modules
sys.modules["ray"] = None
try:
    mjrec.RayEngine()
except ImportError as error:
    print(type(error).__name__, error)
"""
    assert run_python("-c", script) == (
        'MissingDependency engine="ray" needs ray, which is not installed. '
        'Run: pip install "mjrec[ray]"\n'
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("address", "kind", "said"),
    [
        ("127.0.0.1:1", Error, "No Ray cluster answers at 127.0.0.1:1"),
        ("ray://127.0.0.1:10001", InvalidArgument, "--address auto"),
    ],
)
def test_an_address_at_which_nothing_is(address, kind, said):
    """The error says so soon, and what to look at."""
    with pytest.raises(kind, match=said):
        RayEngine(1, address=address).submit(len, "abc")
