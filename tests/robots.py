# SPDX-License-Identifier: Apache-2.0
"""List Gymnasium-Robotics environments that work with the installed mujoco."""

import contextlib
import importlib.util
import types
import warnings
from unittest import mock

import gymnasium
import mujoco

has_robotics = importlib.util.find_spec("gymnasium_robotics") is not None


def robotics_ids():
    """Return the ids that do not need mujoco_py, or none without the package."""
    if not has_robotics:
        return []
    _register()
    return sorted(
        env_id
        for env_id, spec in gymnasium.registry.items()
        if str(spec.entry_point).startswith("gymnasium_robotics")
        and "MujocoPy" not in str(spec.entry_point)
        and ".envs.mujoco." not in str(spec.entry_point)
        # These environments differ only in their rewards.
        and "Dense" not in env_id
    )


@contextlib.contextmanager
def robots_that_reset():
    """Patch Gymnasium-Robotics so that Fetch, the hand and the kitchen can reset.

    Since mujoco 3.12 the comparison `mjtJoint.mjJNT_FREE == np.int32(0)` is False.
    """
    if not has_robotics:
        yield
        return
    _register()
    joints = {f"mjJNT_{n}": i for i, n in enumerate(("FREE", "BALL", "SLIDE", "HINGE"))}
    patched = {**vars(mujoco), "mjtJoint": types.SimpleNamespace(**joints)}
    where = "gymnasium_robotics.utils.mujoco_utils.mujoco"
    with (
        mock.patch(where, types.SimpleNamespace(**patched)),
        warnings.catch_warnings(),
    ):
        # The environments warn about other versions and their own observations.
        warnings.simplefilter("ignore")
        yield


def _register():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
