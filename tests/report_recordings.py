# SPDX-License-Identifier: Apache-2.0
"""Build small recordings for reports."""

from pathlib import Path

import numpy as np
import result_files

import mjrec

GYM = Path(__file__).parent / "data" / "gym"


def entry(episode_id, **values):
    usual = {
        "length": 10,
        "start_time": 1.79e9 + episode_id,
        "end_time": 1.79e9 + episode_id + 0.5,
        "seed": None,
        "terminated": False,
        "truncated": True,
    }
    return result_files.entry(episode_id, **{**usual, **values})


def write_journal(directory, infix, env_id, entries):
    """Write the journal of a killed monitor."""
    directory.mkdir(parents=True, exist_ok=True)
    run = {"env_info": {"gym_version": "mjrec-1", "env_id": env_id}}
    return result_files.write_journal(directory, infix, *entries, run=run)


def record(env, directory, episodes, **options):
    monitor = mjrec.Monitor(env, directory, **options)
    for seed in range(episodes):
        monitor.reset(seed=seed)
        done = False
        while not done:
            action = np.zeros_like(monitor.action_space.sample())
            _, _, terminated, truncated, _ = monitor.step(action)
            done = terminated or truncated
    monitor.close()
