# SPDX-License-Identifier: Apache-2.0
"""Environments that differ from the one that their name states.

Each function changes a step's observation, reward, terminated, truncated and info.
"""

import contextlib

import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv


@contextlib.contextmanager
def doctored(change):
    """Apply `change` to each step of pendulums and cheetahs."""

    def changed(step):
        return lambda env, action: change(env, *step(env, action))

    with pytest.MonkeyPatch.context() as patch:
        for kind in (InvertedPendulumEnv, HalfCheetahEnv):
            patch.setattr(kind, "step", changed(kind.step))
        yield


def double_reward(_, observation, reward, *rest):
    return observation, 2 * reward, *rest


def hide_the_pole(env, *result):
    """From the third step on."""
    if env.data.time > 2.5 * env.dt:
        env.model.geom_rgba[-1, 3] = 0
    return result


def never_fall(_, observation, reward, terminated, *rest):
    """Go on where the environment ends an episode."""
    return observation, reward, False, *rest


def push(env, *result):
    """Help the pole to stand."""
    env.data.qvel[-1] *= 0.5
    return result


def make_heavy(env, *result):
    env.model.body_mass[1:] *= 2
    return result


def raise_gravity(env, *result):
    """Raise it to that of the moon."""
    env.model.opt.gravity[2] = -1.62
    return result


def always_succeed(_, *result):
    *rest, info = result
    return *rest, {**info, "is_success": True}
