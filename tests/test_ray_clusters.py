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

pytestmark = [
    pytest.mark.ray_nodes,
    # Ray leaves connections and pipes to the garbage collector.
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """Check that the tests leave no process of Ray and no file in the home."""
    with home_for_ray(tmp_path_factory.mktemp("home")):
        yield


@pytest.fixture(scope="module")
def cluster(home):
    """A cluster whose first worker node claims two GPUs. Its head runs no jobs."""
    small = {"object_store_memory": SMALL_STORE}
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
def test_existing_cluster_is_used_and_left(how, cluster, work, monkeypatch):
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


def test_workers_share_gpus(cluster, work, caplog):
    """Rendering in software anyway is one warning, or an error."""
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


def test_only_the_job_of_a_dead_node_is_retried(cluster, work, tmp_path, caplog):
    node = cluster.add_node(num_cpus=1, object_store_memory=SMALL_STORE)
    engine = RayEngine(address=str(cluster.address))
    with Run(engine, work) as run:
        for key in "abcd":
            files = {"begun": str(tmp_path / key), "go": str(tmp_path / "go")}
            submit(run, key, do="hold", **files)
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
