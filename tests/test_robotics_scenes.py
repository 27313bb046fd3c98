# SPDX-License-Identifier: Apache-2.0
"""Scenes of Gymnasium-Robotics environments at the moment of drawing."""

import gymnasium
import mujoco
import numpy as np
import pytest
from robots import robots_that_reset

from mjrec.environments.gymnasium_scenes import (
    drawn_part,
    frame_moment,
    gymnasium_scenes,
)

pytest.importorskip("gymnasium_robotics")


@pytest.fixture(autouse=True)
def _robots():
    with robots_that_reset():
        yield


def started(env_id, **kwargs):
    env = gymnasium.make(env_id, **kwargs)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    return env


def everything(env):
    """Return the state, and fields that `render` changes."""
    model, data = env.unwrapped.model, env.unwrapped.data
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    state = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, state, spec)
    arrays = (state, data.site_xpos, data.geom_xpos, data.qacc, data.sensordata)
    changed = (model.site_pos, model.site_rgba, model.geom_rgba)
    return [array.copy() for array in arrays + changed]


@pytest.mark.parametrize(
    ("env_id", "inside"),
    [("PointMaze_UMaze-v3", "point_env"), ("FrankaKitchen-v1", "robot_env")],
)
def test_overridden_render_of_the_inner_environment_is_an_obstacle(env_id, inside):
    """Mazes and the kitchen draw an inner environment."""
    env = gymnasium.make(env_id)
    drawn = drawn_part(env.unwrapped)
    assert drawn is getattr(env.unwrapped, inside)
    assert gymnasium_scenes(env).obstacle is None
    env.reset(seed=1)
    assert gymnasium_scenes(env).random_state().keys() == {"env", "inner"}
    drawn.render = lambda: None
    assert "overrides render()" in gymnasium_scenes(env).obstacle


@pytest.mark.parametrize("mode", [None, "rgb_array"])
def test_goal_is_drawn_and_nothing_else_changes(mode):
    """The marker is at the goal during drawing alone, also after errors."""
    env = started("FetchPickAndPlace-v4", render_mode=mode)
    base = env.unwrapped
    moment = frame_moment(base)
    site = mujoco.mj_name2id(base.model, int(mujoco.mjtObj.mjOBJ_SITE), "target0")
    before, positions = everything(env), []

    def check_unchanged():
        assert not np.allclose(base.data.site_xpos[site], base.goal)
        for now, then in zip(everything(env), before, strict=True):
            np.testing.assert_array_equal(now, then)
        assert "render" not in vars(base.mujoco_renderer)
        assert base.mujoco_renderer.viewer is None

    moment(lambda: positions.append(base.data.site_xpos[site].copy()))
    np.testing.assert_allclose(positions[0], base.goal, atol=1e-6)
    check_unchanged()
    with pytest.raises(ZeroDivisionError):
        moment(lambda: 1 / 0)
    check_unchanged()


def test_unknown_render_is_not_called():
    from gymnasium_robotics.envs.fetch.reach import MujocoFetchReachEnv

    class Robot(MujocoFetchReachEnv):
        def render(self):
            raise AssertionError("called")

    env = Robot()
    assert frame_moment(env) is None
    assert "Robot overrides render()" in gymnasium_scenes(env).obstacle
    maze = gymnasium.make("PointMaze_UMaze-v3")
    assert frame_moment(drawn_part(maze.unwrapped)) is None
