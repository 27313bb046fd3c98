# SPDX-License-Identifier: Apache-2.0
"""Environments that are not what their name says, recorded as they are."""

import contextlib
from collections.abc import Callable
from typing import Any

import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.inverted_pendulum_v5 import InvertedPendulumEnv

Change = Callable[[Any, tuple[Any, ...]], tuple[Any, ...]]


@contextlib.contextmanager
def doctored(change):
    """Let each step of a pendulum or a cheetah give what `change` makes of it.

    Args:
        change: is given the environment and what a step returns.
    """
    with pytest.MonkeyPatch.context() as patch:
        for kind in (InvertedPendulumEnv, HalfCheetahEnv):
            patch.setattr(kind, "step", _changed(kind.step, change))
        yield


def _changed(step, change):
    def changed(self, action):
        return change(self, step(self, action))

    return changed


def double_reward(_, result):
    """Give each reward twice."""
    observation, reward, *rest = result
    return observation, 2 * reward, *rest


def hide_the_pole(env, result):
    """Make the pole invisible from the third step on."""
    if env.data.time > 2.5 * env.dt:
        env.model.geom_rgba[-1, 3] = 0
    return result


def never_fall(_, result):
    """Go on where the environment ends an episode."""
    observation, reward, _, *rest = result
    return observation, reward, False, *rest


def push(env, result):
    """Help the pole to stand."""
    env.data.qvel[-1] *= 0.5
    return result


def make_heavy(env, result):
    """Make another robot of it."""
    env.model.body_mass[1:] *= 2
    return result


def raise_gravity(env, result):
    """Play it on the moon."""
    env.model.opt.gravity[2] = -1.62
    return result


def always_succeed(_, result):
    """Call each episode a success."""
    *rest, info = result
    return *rest, {**info, "is_success": True}
