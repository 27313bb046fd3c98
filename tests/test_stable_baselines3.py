# SPDX-License-Identifier: Apache-2.0
"""Test training, evaluation and result readers of Stable-Baselines3."""

import importlib.util
import json
import math
import os

import gymnasium
import numpy as np
import pytest
from finished_files import episode
from recordings import journal_of, manifest_of, metadata_of, videos_in

import mjrec
from mjrec.trackers import MonitorCsvTracker, Run

if importlib.util.find_spec("stable_baselines3") is None:
    # If this file is named, pytest ignores `collect_ignore` in conftest.py.
    pytest.skip("scripts/test --all installs it", allow_module_level=True)

# Set this before pyplot looks for a display.
os.environ.setdefault("MPLBACKEND", "Agg")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor, get_monitor_files, load_results
from stable_baselines3.common.results_plotter import ts2xy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

pytestmark = [pytest.mark.stable_baselines3, pytest.mark.timeout(120)]

STEPS = 256

# A single thread is far faster for small networks on busy cores.
torch.set_num_threads(1)


def make_env(directory, *, steps=20, **options):
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=steps)
    view = {"width": 48, "height": 32, "render": "deferred"}
    return mjrec.Monitor(env, directory, **view, **options)


def make_ppo(env):
    small = {"n_steps": 64, "batch_size": 64, "n_epochs": 1}
    fixed = {"seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}
    return PPO("MlpPolicy", env, **small, **fixed)


def rewards_in(directory):
    return [entry["reward"] for entry in journal_of(directory)]


def test_training_is_recorded(tmp_path):
    """The algorithm's returns equal those in the journal and in monitor.csv."""
    options = {"video_callable": lambda n: n in (0, 3), "trackers": MonitorCsvTracker()}
    with make_env(tmp_path, **options) as env:
        model = make_ppo(env).learn(STEPS)
    returns = [info["r"] for info in model.ep_info_buffer]
    assert len(returns) > 5
    assert rewards_in(tmp_path) == pytest.approx(returns)
    assert videos_in(tmp_path) == [0, 3]
    assert metadata_of(tmp_path, 3)["recording"] == "deferred"
    assert manifest_of(tmp_path)["mjrec"]["pending"] == []
    read = load_results(str(tmp_path))
    assert list(read["r"]) == rewards_in(tmp_path)
    # The last episode did not end, so its steps are not counted.
    steps, returns = ts2xy(read, "timesteps")
    assert steps[-1] == sum(entry["length"] for entry in journal_of(tmp_path)) <= STEPS
    assert list(returns) == rewards_in(tmp_path)


def test_stable_baselines3_logs_episode_info(tmp_path):
    options = {"episode_info": True, "video_callable": False}
    venv = DummyVecEnv([lambda: make_env(tmp_path, **options)])
    model = make_ppo(venv).learn(STEPS)
    venv.close()
    returns = [info["r"] for info in model.ep_info_buffer]
    assert len(returns) > 5
    assert rewards_in(tmp_path) == pytest.approx(returns)


# From Python 3.12 on, `fork` warns because torch has threads.
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
@pytest.mark.parametrize("kind", ["dummy", "spawn", "forkserver", "fork"])
def test_monitors_in_a_vector_environment_share_a_directory(kind, tmp_path):
    """Scheduled videos exist after `close`."""

    def make(index):
        # This is pickled for a process that cannot import this module.
        def make_monitored():
            import gymnasium

            import mjrec

            env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=20)
            options = {"resume": True, "uid": f"env{index}", "workers": 1}
            options |= {"allow_early_reset": True, "render": "deferred"}
            options |= {"width": 48, "height": 32}
            return mjrec.Monitor(env, directory, lambda n: n in (0, 2), **options)

        return make_monitored

    directory = str(tmp_path / "recordings")
    functions = [make(index) for index in range(2)]
    if kind == "dummy":
        venv = DummyVecEnv(functions)
    else:
        venv = SubprocVecEnv(functions, start_method=kind)
    venv = VecMonitor(venv)
    model = make_ppo(venv).learn(STEPS)
    venv.close()
    manifests = list((tmp_path / "recordings").glob("*.manifest.json"))
    assert len(manifests) == 2
    for path in manifests:
        manifest = json.loads(path.read_text())
        assert len(manifest["videos"]) == 2
        assert manifest["mjrec"]["pending"] == []
    results = mjrec.load_results(directory)
    assert sorted(results["episode_rewards"]) == pytest.approx(
        sorted(one["r"] for one in model.ep_info_buffer)
    )


def test_monitor_csv_equals_that_of_stable_baselines3(tmp_path):
    options = {"video_callable": False, "trackers": MonitorCsvTracker()}
    env = make_env(tmp_path / "ours", **options)
    with Monitor(env, str(tmp_path / "theirs" / "0")) as outer:
        make_ppo(outer).learn(STEPS)
    (ours, theirs) = (load_results(str(tmp_path / name)) for name in ("ours", "theirs"))
    assert list(ours["r"]) == pytest.approx(list(theirs["r"]), abs=1e-6)
    assert list(ours["l"]) == list(theirs["l"])
    assert len(get_monitor_files(str(tmp_path / "ours"))) == 1
    assert np.allclose(ours["t"], theirs["t"], atol=0.5)


def test_evaluation_is_recorded(tmp_path):
    """The returns of `evaluate_policy` equal those in the journal."""
    model = make_ppo(gymnasium.make("InvertedPendulum-v5"))
    options = {"mode": "evaluation", "video_callable": lambda number: number == 1}
    with make_env(tmp_path, **options) as env:
        both = {"return_episode_rewards": True, "warn": False}
        returns, lengths = evaluate_policy(model, env, 3, **both)
    assert rewards_in(tmp_path) == pytest.approx(returns)
    assert [entry["length"] for entry in journal_of(tmp_path)] == lengths
    assert {entry["type"] for entry in journal_of(tmp_path)} == {"e"}
    assert videos_in(tmp_path) == [1]


def test_files_of_several_runs_are_read_together(tmp_path):
    """The episodes are sorted by the time at which they ended."""
    tracker = MonitorCsvTracker()
    runs = [
        Run(directory=tmp_path, infix=f"{i}.1", env_id="x", env_index=i)
        for i in range(3)
    ]
    for run in runs:
        tracker.begin(run)
    start = episode().end_time
    ends = [(1, 1.0), (0, math.nan), (1, math.inf), (0, -2.5)]
    for second, (index, reward) in enumerate(ends):
        tracker.episode(runs[index], episode(reward=reward, end_time=start + second))
    for run in runs:
        tracker.end(run)
    read = load_results(str(tmp_path))
    assert np.array_equal(read["r"], [1.0, math.nan, math.inf, -2.5], equal_nan=True)
    assert list(np.diff(read["t"])) == pytest.approx([1, 1, 1], abs=1e-3)
    assert list(read["l"]) == [10] * 4
    steps, _ = ts2xy(read, "timesteps")
    assert list(steps) == [10, 20, 30, 40]
