# SPDX-License-Identifier: Apache-2.0
"""Recordings of random bytes, including NaNs of every kind, to compare exactly."""

import numpy as np
from trajectories_by_hand import add_row

from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.trajectory import packed, row_dtype

INFIX = "0.1"
NAME = trajectory_prefix(INFIX, 27)
FACTS = {"env_id": "E-v0", "seed": 7, "limit": float("inf")}
STATE = packed([("qpos", ("<f8", (2,))), ("time", ("<f8", (1,)))])
# This layout puts padding between the arrays of a row.
SNAPSHOT = packed(
    [
        ("geom_xpos", ("<f8", (2, 3))),
        ("wrap_obj", ("<i4", (3,))),
        ("eq_active", ("|u1", (1,))),
    ]
)
ACTION, OBSERVATION = np.dtype(("<f4", (3,))), np.dtype(("|u1", (2, 2)))
DTYPE = row_dtype(
    state=STATE, snapshot=SNAPSHOT, action=ACTION, observation=OBSERVATION
)


def rows(count, dtype=DTYPE):
    """Return random rows; the first rows are the same for every `count`."""
    data = np.random.default_rng(1).bytes(count * dtype.itemsize)
    return np.frombuffer(data, dtype)


def write(
    logs, steps, *, episode=27, every=1, facts=FACTS, dtype=DTYPE, first=0, span=None
):
    """Record an unfinished episode, or continue one from step `first`."""
    span = span or logs.begin(trajectory_prefix(INFIX, episode), facts, dtype)
    for step, row in enumerate(rows(steps + 1, dtype)):
        parts = {name: row[name] for name in dtype.names[4:]}
        for name, kind in (("state", np.float64), ("snapshot", np.uint64)):
            if name in parts:
                parts[name] = np.frombuffer(row[name].tobytes(), kind)
        if step % every:
            parts.pop("snapshot", None)
        if step >= first:
            add_row(span, step, reward=step / 3, truncated=step == 9, **parts)
    return span


def check(content, steps, *, every=1, dtype=DTYPE):
    """Check that a recording equals what `write` recorded."""
    expected = rows(steps + 1, dtype)
    assert content.dtype == dtype
    assert content.rewards.tolist() == [k / 3 for k in range(1, steps + 1)]
    assert content.truncated.tolist() == [k == 9 for k in range(1, steps + 1)]
    assert not content.terminated.any()
    if "state" in dtype.names:
        assert content.states.tobytes() == expected["state"].tobytes()
    if "action" in dtype.names:
        assert content.actions.shape == (steps, *dtype["action"].shape)
        assert content.actions.tobytes() == expected["action"][1:].tobytes()
    if "observation" in dtype.names:
        assert content.observations.tobytes() == expected["observation"].tobytes()
    if "snapshot" in dtype.names:
        assert content.frame_steps.tolist() == list(range(0, steps + 1, every))
        # The padding must be zero.
        frames = np.zeros(len(content.frame_steps), dtype["snapshot"])
        for name in frames.dtype.names:
            frames[name] = expected["snapshot"][name][::every]
        assert content.snapshots.tobytes() == frames.tobytes()
