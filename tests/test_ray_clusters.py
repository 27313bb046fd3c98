# SPDX-License-Identifier: Apache-2.0
"""Work on clusters of several nodes."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import ray
from engine_runs import lines, outcomes, submit, values
from ray.cluster_utils import Cluster
from ray_clusters import SMALL_STORE, cluster_of, home_for_ray, is_gone
from waiting import wait_until

import mjrec
from mjrec.engines import ray as ray_engine
from mjrec.engines.ray import RayEngine
from mjrec.errors import Error
from ray_runs import begun, run_python

# Ray's own connections and pipes, of which it says so when they are collected.
pytestmark = [
    pytest.mark.ray_nodes,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No process of Ray, and nothing in the home, is left by all tests of these."""
    with home_for_ray(tmp_path_factory.mktemp("home")):
        yield


@pytest.fixture(scope="module")
def cluster(home: None) -> Iterator[Cluster]:
    """A cluster of which each node has a CPU and two GPUs, as Ray believes."""
    with cluster_of({"num_cpus": 1, "num_gpus": 2}, {"num_cpus": 2}) as cluster:
        yield cluster


@pytest.fixture
def address(cluster: Cluster) -> Iterator[str]:
    """Of the cluster; nobody is connected to it before and after."""
    assert not ray.is_initialized()
    yield str(cluster.address)
    assert not ray.is_initialized()


def test_a_cluster_at_an_address(address: str) -> None:
    """It is found, used with all that it has, and disconnected from."""
    with begun(engine=RayEngine(address=address)) as run:
        assert run.workers == 3
        submit(run, *"abc", do="echo")
        assert len(values(run)) == 3


def test_a_cluster_in_the_environment(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Ray's own tools take it."""
    monkeypatch.setenv("RAY_ADDRESS", address)
    with begun(engine=RayEngine()) as run:
        assert run.workers == 3


def test_workers_are_given_parts_of_gpus(
    cluster: Cluster, address: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Two of a half share one; that they render in software all the same is said.

    Once; and it is an error where a GPU is required.
    """
    node = cluster.add_node(num_cpus=4, num_gpus=1, object_store_memory=SMALL_STORE)
    try:
        engine = RayEngine(address=address, gpus=0.5)
        with begun(engine=engine, entry="ray_jobs:make") as run:
            assert run.workers == 1 + 2
            submit(run, *"abcdef", do="gpus")
            given = [value["gpus"] for value in values(run)]
        assert set(given) <= {"0", "1"}
        assert len(caplog.messages) == 1
        engine = RayEngine(address=address, gpus=1, require_gpu=True)
        with begun(engine=engine) as run:
            submit(run, "a", do="echo")
            with pytest.raises(mjrec.GLError):
                outcomes(run)
    finally:
        cluster.remove_node(node)


def test_a_node_that_dies_takes_no_job_with_it(
    cluster: Cluster,
    address: str,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """What it was at is begun elsewhere, and nothing else is done again."""
    node = cluster.add_node(
        num_cpus=1, resources={"doomed": 1}, object_store_memory=SMALL_STORE
    )
    with begun(engine=RayEngine(address=address), entry="ray_jobs:make") as run:
        assert run.workers == 4
        for key in "abcd":
            submit(run, key, do="hold_till", begun=str(tmp_path / key))
        for _ in run.results(patience_s=0.05):
            if all((tmp_path / key).exists() for key in "abcd"):
                break
        pids = [int(lines(tmp_path / key)[0]) for key in "abcd"]
        cluster.remove_node(node, allow_graceful=False)
        wait_until(lambda: any(is_gone(pid) for pid in pids))
        for key in "efgh":
            submit(run, key, do="echo")
        (tmp_path / "go").touch()
        found = outcomes(run)
    assert len(found) == 8
    assert {outcome.failure for outcome in found.values()} == {None}
    assert sum(len(lines(tmp_path / key)) for key in "abcd") == 5
    assert caplog.text.count("is begun again") == 1


def test_a_cluster_without_room_is_waited_for(
    cluster: Cluster,
    address: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """One warning says so; a node that comes is used."""
    monkeypatch.setattr(ray_engine, "_SECONDS_WITHOUT_WORKERS", 0.5)
    with begun(engine=RayEngine(1, address=address, gpus=3)) as run:
        submit(run, "a", do="echo")
        for _ in run.results(patience_s=1):
            if caplog.messages:
                break
        [told] = caplog.messages
        assert "no room for a worker" in told
        assert "Each needs 1 CPU and 3 GPUs; in all there are" in told
        node = cluster.add_node(num_cpus=1, num_gpus=3, object_store_memory=SMALL_STORE)
        assert len(values(run)) == 1
    cluster.remove_node(node)


def test_workers_without_mjrec(address: str, tmp_path: Path) -> None:
    """The error says what to install, and where."""
    (tmp_path / "mjrec").mkdir()
    (tmp_path / "mjrec" / "__init__.py").write_text(
        "raise ModuleNotFoundError(\"No module named 'mjrec'\", name='mjrec')"
    )
    ray.init(
        address=address,
        logging_level=logging.ERROR,
        runtime_env={"env_vars": {"PYTHONPATH": str(tmp_path)}},
    )
    try:
        with begun(engine=RayEngine(1)) as run:
            submit(run, "a", do="echo")
            with pytest.raises(Error, match="workers have no mjrec: install it on all"):
                outcomes(run)
    finally:
        ray.shutdown()


def test_a_cluster_that_is_gone(tmp_path: Path) -> None:
    """There is an error that says how to go on, before Ray ends the process."""
    script = """
import sys
from mjrec.engines import ray as ray_engine
from mjrec.engines.ray import RayEngine
from mjrec.engines.work import Job, Work
from ray_clusters import cluster_of
ray_engine._SECONDS_OF_SILENCE = 3.0
with cluster_of({"num_cpus": 1}) as cluster:
    run = RayEngine(1, address=cluster.address).begin(Work(entry="odd_jobs:make"))
    run.submit(Job(key="a", arguments={"do": "hold", "begun": sys.argv[1]}))
    next(run.results(patience_s=5))
    cluster.head_node.kill_gcs_server()
    try:
        list(run.results())
    except Exception as error:
        print(type(error).__name__, error, flush=True)
    cluster.head_node.kill_all_processes(check_alive=False, allow_graceful=False)
    import os
    os._exit(0)
"""
    told = run_python(script, str(tmp_path / "begun"))
    assert told.startswith("Error The Ray cluster does not answer any more.")
    assert "--resume" in told
