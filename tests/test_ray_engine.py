# SPDX-License-Identifier: Apache-2.0
"""The Ray engine; `test_engines` tests what holds on every engine."""

import os
import signal
import sys
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
from mjrec.errors import Error, InvalidArgument, MissingDependency

# Ray leaves connections and pipes to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """Check that the tests leave no process of Ray and no file in the home."""
    with home_for_ray(tmp_path_factory.mktemp("home")):
        yield


@pytest.mark.thorough
def test_job_of_a_killed_ray_worker_is_retried(tmp_path, caplog):
    """The worker's child ends. The driver's own use of Ray continues."""
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
def test_cancelling_does_not_wait_for_other_tasks(tmp_path):
    """Another task holds the only CPU, and continues."""
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
directory = Path(sys.argv[1])
"""


@pytest.mark.thorough
def test_own_ray_leaves_no_process_variable_or_handler(tmp_path):
    script = f"""{BEGIN}
def state():
    handlers = [signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT)]
    return dict(os.environ), handlers
before = state()
for _ in range(2):
    engine = RayEngine(1)
    with Run(engine, odd_work(shared=directory)) as run:
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
def test_own_ray_without_a_gpu_runs_jobs_with_one_warning(tmp_path):
    script = f"""{BEGIN}
import logging
from mjrec.errors import GLError
logging.basicConfig(stream=sys.stdout, format="%(message)s")
engine = RayEngine(1, gpus=0.5)
with Run(engine, odd_work(shared=directory)) as run:
    submit(run, "a", "b", do="echo")
    assert len(values(run)) == 2
engine.shutdown()
try:
    RayEngine(1, gpus=0.5, require_gpu=True).submit(len, "abc")
except GLError as error:
    print("refused:", error)
"""
    output = run_python("-c", script, str(tmp_path), **{MARK: str(tmp_path)})
    warning = "Ray finds none on this machine. Workers render in software."
    assert output.count(warning) == 1
    assert "refused: GPUs were requested" in output
    wait_until(lambda: not marked(tmp_path), seconds=10)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("signum", "status"), [(signal.SIGTERM, 128 + 15), (signal.SIGKILL, -9)]
)
def test_ended_driver_leaves_no_process(tmp_path, signum, status):
    with driver(tmp_path, "RayEngine(1)", **{MARK: str(tmp_path)}) as process:
        process.send_signal(signum)
    assert process.returncode == status
    wait_until(lambda: not marked(tmp_path), seconds=30)
    assert lines(tmp_path / "left") == lines(tmp_path / "begun")


def test_error_without_ray_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    message = 'engine="ray" needs ray, which is not installed. Run: '
    with pytest.raises(MissingDependency) as raised:
        RayEngine()
    assert str(raised.value) == f'{message}pip install "mjrec[ray]"'


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("address", "kind", "message"),
    [
        ("127.0.0.1:1", Error, "No Ray cluster answers at 127.0.0.1:1"),
        ("ray://127.0.0.1:10001", InvalidArgument, "--address auto"),
    ],
)
def test_unreachable_or_unsupported_addresses_are_refused(address, kind, message):
    with pytest.raises(kind, match=message):
        RayEngine(1, address=address).submit(len, "abc")
