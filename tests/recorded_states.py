# SPDX-License-Identifier: Apache-2.0
"""What was recorded of the states of episodes, to compare it."""

import numpy as np

import mjrec


def is_fast(monitor):
    """Return whether the coming step may be recorded the fast way."""
    return monitor._recorder.fast is not None


def trajectories(directory):
    """Return those of all episodes that are over, in their order."""
    return [mjrec.load_trajectory(path) for path in sorted(directory.glob("*.h5"))]


def assert_same(found, expected):
    """All that was recorded of two episodes is the same, bit for bit."""
    for name in ("states", "actions", "rewards", "terminated", "truncated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    np.testing.assert_array_equal(found.frame_steps, expected.frame_steps)
    assert found.snapshots.keys() == expected.snapshots.keys()
    for name, values in expected.snapshots.items():
        np.testing.assert_array_equal(found.snapshots[name], values)
