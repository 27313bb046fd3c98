# SPDX-License-Identifier: Apache-2.0
"""The moment in which Gymnasium-Robotics' environments draw themselves."""

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


def begun(env_id, **kwargs):
    env = gymnasium.make(env_id, **kwargs)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    return env


def everything(env):
    """Return the state, and what a callback moves."""
    model, data = env.unwrapped.model, env.unwrapped.data
    spec = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    state = np.empty(mujoco.mj_stateSize(model, spec))
    mujoco.mj_getState(model, data, state, spec)
    arrays = (state, data.site_xpos, data.geom_xpos, data.qacc, data.sensordata)
    moved = (model.site_pos, model.site_rgba, model.geom_rgba)
    return [array.copy() for array in arrays + moved]


@pytest.mark.parametrize(
    ("env_id", "inside"),
    [("PointMaze_UMaze-v3", "point_env"), ("FrankaKitchen-v1", "robot_env")],
)
def test_overriding_inside_is_an_obstacle(env_id, inside):
    """A maze and a kitchen show what is inside them, which is what is drawn."""
    env = gymnasium.make(env_id)
    shown = drawn_part(env.unwrapped)
    assert shown is getattr(env.unwrapped, inside)
    assert gymnasium_scenes(env).obstacle is None
    env.reset(seed=1)
    assert gymnasium_scenes(env).random_state().keys() == {"env", "inner"}
    shown.render = lambda: None
    assert "overrides render()" in gymnasium_scenes(env).obstacle


@pytest.mark.parametrize("mode", [None, "rgb_array"])
def test_goal_is_shown_and_nothing_is_changed(mode):
    """In the moment the marker is at the goal; then all is as was, after errors too."""
    env = begun("FetchPickAndPlace-v4", render_mode=mode)
    base = env.unwrapped
    moment = frame_moment(base)
    site = mujoco.mj_name2id(base.model, int(mujoco.mjtObj.mjOBJ_SITE), "target0")
    before, seen = everything(env), []

    def check_unchanged():
        assert not np.allclose(base.data.site_xpos[site], base.goal)
        for now, then in zip(everything(env), before, strict=True):
            np.testing.assert_array_equal(now, then)
        assert "render" not in vars(base.mujoco_renderer)
        assert base.mujoco_renderer.viewer is None

    moment(lambda: seen.append(base.data.site_xpos[site].copy()))
    np.testing.assert_allclose(seen[0], base.goal, atol=1e-6)
    check_unchanged()
    with pytest.raises(ZeroDivisionError):
        moment(lambda: 1 / 0)
    check_unchanged()


def test_a_render_that_is_not_known_is_not_called():
    """Nor one that changes nothing: nothing has to be put back."""
    from gymnasium_robotics.envs.fetch.reach import MujocoFetchReachEnv

    class Robot(MujocoFetchReachEnv):
        def render(self):
            raise AssertionError("called")

    env = Robot()
    assert frame_moment(env) is None
    assert "Robot overrides render()" in gymnasium_scenes(env).obstacle
    maze = gymnasium.make("PointMaze_UMaze-v3")
    assert frame_moment(drawn_part(maze.unwrapped)) is None
