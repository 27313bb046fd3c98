# SPDX-License-Identifier: Apache-2.0
"""Evaluations on Ray: the same files, whoever dies."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evaluated_files import recorded_in
from ray_clusters import home_for_ray
from waiting import wait_until

from mjrec.engines.ray import RayEngine
from mjrec.evaluation.evaluating import evaluate

# Ray's own connections and pipes, of which it says so when they are collected.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")

PENDULUM = "InvertedPendulum-v5"
MOST_BYTES = 200 << 20
BEGUN, ENDED = b'{"begun"', b'"evaluation": {'


@pytest.fixture(scope="module", autouse=True)
def home(tmp_path_factory):
    """No process of Ray, and nothing in the home, is left by all tests of these."""
    with home_for_ray(tmp_path_factory.mktemp("home")):
        yield


def run(directory, **options):
    """Evaluate something small."""
    small = {
        "tasks": [PENDULUM],
        "policy": "random",
        "episodes": 3,
        "num_seeds": 2,
        "keep": "best",
        "max_steps": 5,
        "height": 32,
        "width": 32,
    }
    return evaluate(**{**small, **options}, directory=directory)


def results_in(directory):
    return [(directory / name).read_bytes() for name in ("results.csv", "results.json")]


class Huge:
    """A policy whose weights are as large as those of a large network."""

    def __init__(self):
        self.weights = np.ones(MOST_BYTES, np.uint8)

    def __call__(self, observation):
        return np.sin(100 * observation[:1]) * self.weights[-1]


# Takes more than five seconds: a real Ray, whose workers import MuJoCo.
def test_the_files_are_those_of_this_machine(tmp_path):
    """Results byte for byte, and all states and videos; with a policy of 200 MiB."""
    policy = Huge()
    here = run(tmp_path / "here", policy=policy, workers=2)
    there = run(tmp_path / "there", policy=policy, engine=RayEngine(2))
    assert results_in(there.directory) == results_in(here.directory)
    assert recorded_in(there) == recorded_in(here)
    assert len(recorded_in(there)) == 6 + 1
    assert there.pending == {}


SCRIPT = """
import sys
from pathlib import Path
import test_ray_evaluating
from mjrec.engines.ray import RayEngine
test_ray_evaluating.run(
    Path(sys.argv[1]), policy="slow_policy:Slow", episodes=8,
    resume="resume" in sys.argv, engine=RayEngine(2),
)
"""
SLOW = """
import time
import numpy as np

class Slow:
    def __init__(self, env):
        pass
    def __call__(self, observation):
        time.sleep(0.05)
        return np.sin(100 * observation[:1])
"""


def slow_run(place, *arguments):
    (place / "slow_policy.py").write_text(SLOW)
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT, str(place / "e"), *arguments],
        cwd=place,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
    )


def noted(directory, what):
    """Return how often journals say that an episode has begun, or ended."""
    journals = directory.glob("*/*/openaigym.episodes.*.jsonl")
    return sum(path.read_bytes().count(what) for path in journals)


@pytest.mark.thorough
def test_a_killed_driver_is_gone_on_with(tmp_path):
    """With `resume`: what was finished is not repeated."""
    process = slow_run(tmp_path)
    wait_until(lambda: noted(tmp_path / "e", ENDED) >= 4)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "e" / "results.json").exists()
    assert slow_run(tmp_path, "resume").wait() == 0
    assert noted(tmp_path / "e", ENDED) == 16
    # Each once; those that the two workers were at, once more.
    assert 16 <= noted(tmp_path / "e", BEGUN) <= 18
