# SPDX-License-Identifier: Apache-2.0
"""Builders of small recordings for reports."""

from pathlib import Path

import numpy as np

import mjrec
from mjrec.formats.journal import JournalEntry, JournalWriter

GYM = Path(__file__).parent / "data" / "gym"


def entry(episode_id, **values):
    known = {
        "episode_id": episode_id,
        "length": 10,
        "reward": float(episode_id),
        "type": "t",
        "start_time": 1.79e9 + episode_id,
        "end_time": 1.79e9 + episode_id + 0.5,
        "seed": None,
        "options": None,
        "terminated": False,
        "truncated": True,
        "success": None,
    }
    return JournalEntry(**{**known, **values})


def write_journal(directory, infix, env_id, entries):
    """Write the journal of a killed monitor."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"openaigym.episodes.{infix}.jsonl"
    info = {"gym_version": "mjrec-1", "env_id": env_id}
    writer = JournalWriter(path, run={"env_info": info})
    for each in entries:
        writer.append(each)
    writer.close()
    return path


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
