# SPDX-License-Identifier: Apache-2.0
"""Test which Gymnasium environments can be rendered from states."""

import functools
import json
import operator

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

from mjrec.environments.gymnasium_scenes import gymnasium_scenes
from mjrec.environments.viewer_scene import ViewerScene
from mjrec.errors import InvalidArgument, UnknownName

WIREFRAME = int(mujoco.mjtRndFlag.mjRND_WIREFRAME)


def make(env_id="InvertedPendulum-v5", **kwargs):
    kwargs = {"render_mode": "rgb_array", "width": 64, "height": 48, **kwargs}
    env = gymnasium.make(env_id, **kwargs)
    env.reset(seed=1)
    return env


def scene_of(env, **asked):
    view = {"camera": None, "height": None, "width": None, **asked}
    return ViewerScene(env.unwrapped, **view)


class Overlay(gymnasium.Wrapper):
    def render(self):
        return super().render() // 2


class Below(Overlay):
    pass


class DrawsMore(HalfCheetahEnv):
    def render(self):
        return super().render() // 2


class Renderer(MujocoRenderer):
    pass


def changed(env, part, **values):
    """Set attributes of the environment or a part of it, and return the environment."""
    for name, value in values.items():
        setattr(operator.attrgetter(part)(env) if part else env, name, value)
    return env


def test_most_wrappers_of_gymnasium_are_no_obstacle():
    """If a view is requested, no wrapper is an obstacle."""
    env = wrappers.RecordEpisodeStatistics(wrappers.ClipAction(make()))
    env = wrappers.NormalizeReward(wrappers.Autoreset(env))
    assert gymnasium_scenes(env).obstacle is None
    assert gymnasium_scenes(make(render_mode=None)).obstacle is None
    for asked in ({"camera": -1}, {"height": 32}, {"width": 32}):
        assert gymnasium_scenes(Overlay(make()), **asked).obstacle is None


OBSTACLES = [
    # The message names the overriding class, wherever it is in the chain.
    (
        lambda: gymnasium.Wrapper(Below(make())),
        f"wrapper {__name__}.Overlay overrides",
    ),
    (lambda: wrappers.RenderCollection(make()), "rendering.RenderCollection overrides"),
    (lambda: changed(make(), "", render=print), "TimeLimit overrides"),
    # This method renders another environment.
    (lambda: changed(make(), "", render=make().render), "TimeLimit overrides"),
    (
        lambda: changed(make(), "unwrapped", render=make().unwrapped.render),
        "InvertedPendulumEnv overrides",
    ),
    (lambda: DrawsMore(render_mode="rgb_array"), f"environment {__name__}.DrawsMore"),
    (lambda: HalfCheetahEnv(render_mode="depth_array"), "'depth_array'"),
    (
        lambda: changed(make(), "unwrapped.mujoco_renderer", render=print),
        "MujocoRenderer is not Gymnasium's own",
    ),
    (
        lambda: changed(make(), "unwrapped.mujoco_renderer", __class__=Renderer),
        f"{__name__}.Renderer is not Gymnasium's own",
    ),
]


@pytest.mark.parametrize(("made", "words"), OBSTACLES)
def test_overridden_rendering_is_a_named_obstacle(made, words):
    assert words in gymnasium_scenes(made()).obstacle


def test_patched_render_method_is_an_obstacle(monkeypatch):
    """The patch is an obstacle even if it has the name of Gymnasium's method."""
    original = MujocoEnv.render

    @functools.wraps(original)
    def patched(self):
        return 255 - original(self)

    monkeypatch.setattr(MujocoEnv, "render", patched)
    assert "overrides render()" in str(gymnasium_scenes(make()).obstacle)


VIEWER = "unwrapped.mujoco_renderer.viewer"
viewer_of = operator.attrgetter(VIEWER)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda env: viewer_of(env).add_marker(pos=np.zeros(3)), "markers"),
        (lambda env: viewer_of(env).add_overlay(0, "a", "b"), "text"),
        (lambda env: viewer_of(env).scn.flags.__setitem__(WIREFRAME, 1), "flags"),
        (lambda env: changed(env, f"{VIEWER}.pert", select=1), "selected"),
        (lambda env: changed(env, VIEWER, render=print), "not Gymnasium's own"),
        (
            lambda env: changed(env, "unwrapped", model=make().unwrapped.model),
            "does not draw the model",
        ),
    ],
)
def test_additions_to_the_viewer_are_momentary_obstacles(change, words):
    """`env.render()` shows such additions, but the scene does not have them."""
    env = make()
    scene = scene_of(env)
    assert scene.obstacle() is None
    env.render()
    assert scene.obstacle() is None
    change(env)
    assert words in str(scene.obstacle())
    env.close()


def test_replaced_renderer_replaces_camera_and_options():
    env = make("HalfCheetah-v5")
    scene = scene_of(env)
    view = scene()
    scene.at_frame(lambda: None)
    base = env.unwrapped
    base.mujoco_renderer = MujocoRenderer(
        base.model, base.data, {"azimuth": 11.0}, 64, 48, visual_options={0: True}
    )
    scene.at_frame(lambda: None)
    assert view.camera.azimuth == 11
    assert view.option.flags[0] == 1


def test_requested_camera_is_a_name_a_number_or_an_object():
    """The free camera uses the defaults of the model."""
    env = make("HalfCheetah-v5")
    view = scene_of(env, camera="track", height=32)()
    assert (view.camera.fixedcamid, view.label) == (0, "track")
    assert (view.height, view.width) == (32, 64)
    scene = scene_of(env, camera=-1)
    view = scene()
    before = view.camera.azimuth
    env.unwrapped.model.vis.global_.azimuth += 45
    scene.at_frame(lambda: None)
    assert view.camera.azimuth == before + 45
    camera = mujoco.MjvCamera()
    assert scene_of(env, camera=camera)().camera is camera
    with pytest.raises(UnknownName, match="track"):
        gymnasium_scenes(env, camera="tracking")
    with pytest.raises(InvalidArgument, match="height"):
        gymnasium_scenes(env, height=0)


def test_environment_facts_suffice_to_recreate_it():
    """The facts are JSON, with the smallest step limit and only relevant wrappers."""
    env = make("Hopper-v5", healthy_z_range=(0.5, np.float32(2.5)))
    environment = gymnasium_scenes(env).environment
    assert environment["kwargs"]["healthy_z_range"] == [0.5, 2.5]
    assert json.loads(json.dumps(environment)) == environment
    env = make(default_camera_config={"lookat": np.zeros(3)}, max_episode_steps=7)
    for steps in (9, 5, 8):
        env = wrappers.TimeLimit(env, steps)
    env = wrappers.RecordEpisodeStatistics(wrappers.ClipAction(env))
    assert gymnasium_scenes(wrappers.TransformReward(env, abs)).environment == {
        "framework": "gymnasium",
        "id": "InvertedPendulum-v5",
        "kwargs": None,
        "wrappers": [
            "gymnasium.wrappers.transform_reward.TransformReward",
            "gymnasium.wrappers.transform_action.ClipAction",
        ],
        "wrapper_arguments": [None, {}],
        "max_episode_steps": 5,
    }
    assert gymnasium_scenes(HalfCheetahEnv()).environment is None
