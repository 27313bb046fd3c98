# SPDX-License-Identifier: Apache-2.0
"""The Slurm engine without Slurm: submitit starts local processes as Slurm jobs.

`test_engines` tests what holds on every engine, `test_slurm_cluster` a real cluster.
"""

import os
import secrets
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
    outcomes,
    run_python,
    submit,
    values,
    wait_for,
    wait_for_end,
)
from waiting import wait_until

import mjrec
from mjrec.engines.jobs import WORK_FOLDER, Run
from mjrec.engines.slurm import DEFAULT_WORKERS, SlurmEngine, slurm_options
from mjrec.errors import Error, InvalidArgument, MissingDependency
from mjrec.machine import usable_cpus

pytest.importorskip("submitit")


@pytest.fixture(autouse=True)
def mark(monkeypatch):
    """Check that no descendant process is left at the end of a test."""
    mark = secrets.token_hex(8)
    monkeypatch.setenv(MARK, mark)
    yield mark
    # submitit waits for a minute for its pickled function, even if that is deleted.
    wait_until(lambda: not marked(mark), seconds=90, told=lambda: marked(mark))


def engine(workers=1, **options):
    return SlurmEngine(workers, cluster="local", **options)


def begin(place, **settings):
    return Run(engine(), odd_work(shared=place / "shared", **settings))


def submitted(place):
    """Return the numbers of the Slurm jobs of the only run."""
    logs = (place / "shared" / WORK_FOLDER).glob("*/slurm/logs/*_0_log.err")
    return [path.name.removesuffix("_0_log.err") for path in logs]


@pytest.mark.thorough
def test_workers_of_one_slurm_job_run_in_parallel(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    slurm = engine(2, workers_per_job=2)
    with Run(slurm, odd_work(shared=tmp_path / "shared")) as run:
        for mode in ("rb", "wb"):
            submit(run, mode, do="meet", pipe=str(tmp_path / "pipe"), mode=mode)
        assert len({value["pid"] for value in values(run)}) == 2
    slurm.shutdown()


def test_an_array_has_at_most_four_slurm_jobs_per_worker(tmp_path):
    with begin(tmp_path) as run:
        submit(run, *map(str, range(30)), do="echo")
        assert len(values(run)) == 30
        assert len(submitted(tmp_path)) == 4


@pytest.mark.thorough
@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGKILL, signal.SIGUSR2])
def test_work_of_an_ended_slurm_job_is_done_in_a_new_process(signum, tmp_path):
    """SIGUSR2, sent before the time limit, requeues the same Slurm job."""
    with begin(tmp_path, left=str(tmp_path / "left")) as run:
        submit(run, "a", do="hold", begun=str(tmp_path / "begun"))
        first = wait_for(tmp_path / "begun", run)
        (tmp_path / "begun").unlink()
        [job] = submitted(tmp_path)
        [process] = Path("/proc", job, "task", job, "children").read_text().split()
        os.kill(int(process), signum)
        assert wait_for(tmp_path / "begun", run) != first
        wait_until(lambda: str(first) in lines(tmp_path / "left"))


def test_failing_setup_is_an_error(tmp_path):
    slurm = engine(setup=["echo no such module >&2; exit 1"])
    with Run(slurm, odd_work(shared=tmp_path / "shared")) as run:
        submit(run, "a", do="echo")
        with pytest.raises(Error, match=r"No worker can start.* was in the Slurm job"):
            outcomes(run)


def test_warning_names_the_reason_of_waiting_slurm_jobs(tmp_path, monkeypatch, caplog):
    cancelled = tmp_path / "cancelled"
    for name, does in {
        "sbatch": "echo Submitted batch job 7",
        "squeue": f"test -e {cancelled} || echo '7|PENDING|Resources'",
        "scancel": f"touch {cancelled}",
        "srun": "false",
    }.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{does}\n")
        (tmp_path / name).chmod(0o700)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setattr("mjrec.engines.slurm._SECONDS_WITHOUT_START", -1)
    with Run(SlurmEngine(1), odd_work(shared=tmp_path / "shared")) as run:
        submit(run, "a", do="echo")
        wait_until(lambda: caplog.text)
    assert "not started 1 Slurm job for a minute. Its reason: Resources." in caplog.text


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_ends_slurm_jobs(tmp_path):
    with driver(tmp_path, 'SlurmEngine(2, cluster="local")') as process:
        os.killpg(process.pid, signal.SIGINT)
        process.wait(60)
    wait_for_end(int(*lines(tmp_path / "begun")))
    wait_until(lambda: not list((tmp_path / "shared").iterdir()))


@pytest.mark.thorough
def test_next_driver_ends_slurm_jobs_of_killed_drivers_only(tmp_path):
    with driver(tmp_path, 'SlurmEngine(2, cluster="local")') as process:
        process.kill()
    [pid] = lines(tmp_path / "begun")
    with begin(tmp_path) as living:
        submit(living, "a", do="echo")
        assert len(values(living)) == 1
        wait_for_end(int(pid))
        with begin(tmp_path) as run:
            submit(run, "b", do="echo")
            assert len(values(run)) == 1
        submit(living, "c", do="echo")
        assert len(values(living)) == 1
    assert not list((tmp_path / "shared").iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "workers must be"),
        ({"cluster": "pbs"}, "cluster must be"),
        ({"cpus_per_worker": 0}, "cpus_per_worker must be"),
        ({"workers_per_job": 1.5}, "workers_per_job must be"),
        ({"time_min": 0}, "time_min must be"),
        ({"time_min": 1, "notice_s": 60}, "notice_s, in seconds, must be less than"),
        ({"mem_gb": 0}, "mem_gb must be more than 0"),
        ({"gpus": -1}, "gpus must be the number"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(InvalidArgument, match=message):
        SlurmEngine(**{"cluster": "local", **options})


def test_local_cluster_has_a_worker_per_cpu_and_takes_no_functions():
    assert engine(None).workers == usable_cpus()
    assert DEFAULT_WORKERS == 4
    assert repr(engine(3)) == "SlurmEngine(workers=3, cluster='local')"
    with pytest.raises(InvalidArgument, match="submitit executor"):
        engine().submit(len, "abc")


def test_missing_slurm_or_submitit_is_an_error(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setenv("PATH", str(tmp_path))
        with pytest.raises(Error, match=r"no sbatch, squeue, .* login node"):
            SlurmEngine()
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(MissingDependency, match=r"pip install \"mjrec\[slurm\]\""):
        engine()


def test_options_of_the_command_line_reach_sbatch():
    texts = {
        "partition": "gpu",
        "time_min": "30",
        "mem_gb": "2.5",
        "setup": "module load cuda",
        "sbatch.exclusive": "",
        "sbatch.nice": "100",
    }
    script = sbatch_script(texts, workers=8, gpus=0.25)
    for line in (
        "--partition=gpu",
        "--time=30",
        "--mem=10GB",
        "--gpus-per-node=1",
        "--cpus-per-task=4",
        "--array=0-2%2",
        "--exclusive",
        "--nice=100",
    ):
        assert f"#SBATCH {line}\n" in script
    assert "\nmodule load cuda\n" in script
    script = sbatch_script({"sbatch.gres": "gpu:a100:1"}, workers=8, gpus=1)
    assert "#SBATCH --gres=gpu:a100:1\n" in script
    assert "gpus-per-node" not in script
    with pytest.raises(mjrec.UnknownName, match=r"'partitoin'.*partition.*sbatch.NAME"):
        slurm_options({"partitoin": "gpu"})
    with pytest.raises(InvalidArgument, match="time_min must be a number"):
        slurm_options({"time_min": "an hour"})


def sbatch_script(texts, **options):
    """Return submitit's batch script for an array of three."""
    import submitit

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
        slurm = SlurmEngine(**options, **slurm_options(texts))
        executor = submitit.AutoExecutor("logs", cluster="slurm")
    executor.update_parameters(**slurm._parameters)
    executor._executor.parameters["map_count"] = 3
    return str(executor._executor._make_submission_file_text("command", "uid"))


def test_submitit_leaves_logging_unchanged():
    script = """
import logging, os
import mjrec.engines.slurm
handler = logging.StreamHandler()
mjrec.engines.slurm.SlurmEngine(1, cluster="local")
assert not logging.getLogger("submitit").handlers
assert handler in [reference() for reference in logging._handlerList]
print("SUBMITIT_LOG_LEVEL" in os.environ)
"""
    assert run_python("-c", script) == "False\n"
