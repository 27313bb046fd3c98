# SPDX-License-Identifier: Apache-2.0
"""Test scenes of Gymnasium-Robotics environments."""

import gymnasium
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


@pytest.mark.parametrize(
    ("env_id", "inside"),
    [("PointMaze_UMaze-v3", "point_env"), ("FrankaKitchen-v1", "robot_env")],
)
def test_overridden_render_of_the_inner_environment_is_an_obstacle(env_id, inside):
    """Mazes and the kitchen render an inner environment."""
    env = gymnasium.make(env_id)
    drawn = drawn_part(env.unwrapped)
    assert drawn is getattr(env.unwrapped, inside)
    assert gymnasium_scenes(env).obstacle is None
    env.reset(seed=1)
    assert gymnasium_scenes(env).random_state().keys() == {"env", "inner"}
    drawn.render = lambda: None
    assert "overrides render()" in gymnasium_scenes(env).obstacle


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
