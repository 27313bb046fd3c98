# SPDX-License-Identifier: Apache-2.0
"""What was recorded of the states of episodes, to compare it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import mjrec
from mjrec.formats.trajectory_file import open_trajectory


def is_fast(monitor: Any) -> bool:
    """Tell whether the coming step may be recorded the fast way."""
    return monitor._recorder.fast is not None


def trajectories(directory: Path) -> list[mjrec.Trajectory]:
    """Return those of all episodes that are over, in their order."""
    return [mjrec.load_trajectory(path) for path in sorted(directory.glob("*.h5"))]


def changes_in(directory: Path) -> dict[int, set[str]]:
    """Return which fields of model and view changed in an episode, by the step."""
    [path] = directory.glob("*.h5")
    with open_trajectory(path) as reader:
        return {change.step: set(change.fields) for change in reader.model_changes}


def assert_same(found: mjrec.Trajectory, expected: mjrec.Trajectory) -> None:
    """All that was recorded of two episodes is the same, bit for bit."""
    for name in ("states", "actions", "rewards", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_array_equal(found.frame_steps, expected.frame_steps)
    assert found.snapshots.keys() == expected.snapshots.keys()
    for name, values in expected.snapshots.items():
        np.testing.assert_array_equal(found.snapshots[name], values)
