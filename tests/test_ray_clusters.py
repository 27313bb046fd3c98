# SPDX-License-Identifier: Apache-2.0
"""Work on Ray clusters of several nodes."""

from pathlib import Path

import pytest
import ray
from engine_runs import lines, outcomes, submit, values
from ray.cluster_utils import Cluster
from ray_clusters import SMALL_STORE, home_for_ray
from waiting import wait_until

import mjrec
from mjrec.engines.jobs import Run, Work
from mjrec.engines.ray import RayEngine

# Ray's own connections and pipes, of which it says so when they are collected.
pytestmark = [
    pytest.mark.ray_nodes,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """No process of Ray, and nothing in the home, is left by all tests of these."""
    with home_for_ray(tmp_path_factory.mktemp("home")):
        yield


@pytest.fixture(scope="module")
def cluster(home):
    """A cluster of which one node has two GPUs, as Ray believes."""
    small = {"object_store_memory": SMALL_STORE}
    # Nothing runs on its head.
    head = {"num_cpus": 0, "include_dashboard": False, **small}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        cluster.add_node(num_cpus=1, num_gpus=2, **small)
        cluster.add_node(num_cpus=2, **small)
        yield cluster
    finally:
        cluster.shutdown()


@pytest.fixture
def work(tmp_path):
    return Work(entry="odd_jobs:make", shared_directory=tmp_path / "shared")


@pytest.mark.parametrize("how", ["argument", "environment"])
def test_a_cluster_that_there_is(how, cluster, work, monkeypatch):
    """It is found, used with all that it has, and disconnected from."""
    assert not ray.is_initialized()
    address = str(cluster.address)
    if how == "environment":
        monkeypatch.setenv("RAY_ADDRESS", address)
    engine = RayEngine(address=address if how == "argument" else None)
    with Run(engine, work) as run:
        submit(run, *"abc", do="where")
        assert len(values(run)) == 3
    engine.shutdown()
    assert not ray.is_initialized()


def test_workers_are_given_parts_of_gpus(cluster, work, caplog):
    """That they draw in software all the same is said once, or is an error."""
    engine = RayEngine(address=str(cluster.address), gpus=0.5)
    with Run(engine, work) as run:
        submit(run, *"abcd", do="where")
        assert {value["gpus"] for value in values(run)} <= {"0", "1"}
    engine.shutdown()
    assert len(caplog.messages) == 1
    engine = RayEngine(address=str(cluster.address), gpus=1, require_gpu=True)
    with Run(engine, work) as run:
        submit(run, "a", do="echo")
        with pytest.raises(mjrec.GLError):
            outcomes(run)
    engine.shutdown()


def test_a_node_that_dies_takes_no_job_with_it(cluster, work, tmp_path, caplog):
    """What it was at is begun elsewhere, and nothing else is done again."""
    node = cluster.add_node(num_cpus=1, object_store_memory=SMALL_STORE)
    engine = RayEngine(address=str(cluster.address))
    with Run(engine, work) as run:
        for key in "abcd":
            said = {"begun": str(tmp_path / key), "go": str(tmp_path / "go")}
            submit(run, key, do="hold", **said)
        for _ in run.results(timeout_s=0.05):
            if all(lines(tmp_path / key) for key in "abcd"):
                break
        pids = [int(lines(tmp_path / key)[0]) for key in "abcd"]
        cluster.remove_node(node, allow_graceful=False)
        wait_until(lambda: any(not Path(f"/proc/{pid}").exists() for pid in pids))
        for key in "efgh":
            submit(run, key, do="echo")
        (tmp_path / "go").touch()
        found = outcomes(run)
    engine.shutdown()
    assert len(found) == 8
    assert {outcome.failure for outcome in found.values()} == {None}
    assert sum(len(lines(tmp_path / key)) for key in "abcd") == 5
    assert caplog.text.count("will be retried") == 1
