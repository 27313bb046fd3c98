# SPDX-License-Identifier: Apache-2.0
"""Gymnasium-Robotics' environments, as far as they run with the mujoco installed."""

import contextlib
import importlib.util
import types
import warnings
from unittest import mock

import gymnasium
import mujoco

has_robotics = importlib.util.find_spec("gymnasium_robotics") is not None


def robotics_ids():
    """Return the ids of all that need no mujoco_py; none without the package."""
    if not has_robotics:
        return []
    _register()
    return sorted(
        env_id
        for env_id, spec in gymnasium.registry.items()
        if str(spec.entry_point).startswith("gymnasium_robotics")
        and "MujocoPy" not in str(spec.entry_point)
        and ".envs.mujoco." not in str(spec.entry_point)
        # Only their rewards differ.
        and "Dense" not in env_id
    )


@contextlib.contextmanager
def robots_that_reset():
    """Let Gymnasium-Robotics compare MuJoCo's enumerations with NumPy's integers.

    From mujoco 3.12 on `mjtJoint.mjJNT_FREE == np.int32(0)` is False, and resets of
    Fetch, the hand and the kitchen end at an assertion. Does nothing without the
    package.
    """
    if not has_robotics:
        yield
        return
    _register()
    joints = {f"mjJNT_{n}": i for i, n in enumerate(("FREE", "BALL", "SLIDE", "HINGE"))}
    ints = {**vars(mujoco), "mjtJoint": types.SimpleNamespace(**joints)}
    with (
        mock.patch(
            "gymnasium_robotics.utils.mujoco_utils.mujoco",
            types.SimpleNamespace(**ints),
        ),
        warnings.catch_warnings(),
    ):
        # They warn of other versions of themselves, and of their own observations.
        warnings.simplefilter("ignore")
        yield


def _register():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
