# SPDX-License-Identifier: Apache-2.0
"""What is known of Gymnasium environments: whose frames follow from states."""

import functools
import json

import gymnasium
import mujoco
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

import mjrec
from mjrec.environments.gymnasium_scenes import gymnasium_scenes
from mjrec.environments.viewer_scene import ViewerScene
from mjrec.environments.wrapping import around_gymnasium
from mjrec.errors import InvalidArgument, UnknownName

WIREFRAME = int(mujoco.mjtRndFlag.mjRND_WIREFRAME)
CAMERA_MEMBERS = (
    *("type", "fixedcamid", "trackbodyid", "lookat", "distance"),
    *("azimuth", "elevation", "orthographic"),
)


def make(env_id="InvertedPendulum-v5", **kwargs):
    kwargs = {"render_mode": "rgb_array", "width": 64, "height": 48, **kwargs}
    env = gymnasium.make(env_id, **kwargs)
    quality = env.get_wrapper_attr("model").vis.quality
    quality.shadowsize, quality.offsamples = 64, 0
    return env


def scene_of(env, **asked):
    view = {"camera": None, "height": None, "width": None, **asked}
    return ViewerScene(env.unwrapped, **view)


def pose(camera):
    return [np.array(getattr(camera, name)).tolist() for name in CAMERA_MEMBERS]


class Overlay(gymnasium.Wrapper):
    def render(self):
        frame = super().render()
        frame[:8] = 255
        return frame


class OverlayBelow(Overlay):
    """Inherits what overrides."""


class DrawsMore(HalfCheetahEnv):
    def render(self):
        return super().render() // 2


class PassesOn(gymnasium.Wrapper):
    def step(self, action):
        return super().step(action * 0.5)


def test_wrappers_that_show_what_is_inside_are_no_obstacle():
    """gymnasium.make's own, a user's, and most of Gymnasium's."""
    env = wrappers.RecordEpisodeStatistics(PassesOn(make()))
    env = wrappers.NormalizeReward(wrappers.Autoreset(env))
    assert gymnasium_scenes(env).obstacle is None
    assert gymnasium_scenes(make(render_mode=None)).obstacle is None


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (Overlay, "Overlay"),
        (lambda env: PassesOn(Overlay(env)), "Overlay"),
        (OverlayBelow, "Overlay"),
        (wrappers.RenderCollection, "gymnasium.wrappers.rendering.RenderCollection"),
        (lambda env: wrappers.HumanRendering(env), "HumanRendering"),
    ],
)
def test_wrappers_that_draw_are_named(wrap, name):
    """Wherever they are in the chain; the class that overrides is what is named."""
    obstacle = gymnasium_scenes(wrap(make())).obstacle
    assert obstacle.startswith("the wrapper ")
    assert obstacle.endswith(f"{name} overrides render()")


def test_a_patched_class_is_an_obstacle(monkeypatch):
    """A function in the place of Gymnasium's, even if it copies all names."""
    original = MujocoEnv.render

    @functools.wraps(original)
    def patched(self):
        return 255 - original(self)

    monkeypatch.setattr(MujocoEnv, "render", patched)
    assert "overrides render()" in str(gymnasium_scenes(make()).obstacle)


@pytest.mark.parametrize("mode", ["depth_array", "rgbd_tuple", "human"])
def test_other_frames_are_an_obstacle(mode):
    """Depths are not drawn from states, and a window is nothing to record."""
    env = HalfCheetahEnv(render_mode=mode)
    assert repr(mode) in str(gymnasium_scenes(env).obstacle)


def test_what_replaces_a_part_is_an_obstacle():
    """A render of one object, a class that extends, a renderer, be it Gymnasium's."""

    class Renderer(MujocoRenderer):
        pass

    wrapped = PassesOn(make())
    wrapped.render = lambda: None
    assert "PassesOn overrides" in str(gymnasium_scenes(wrapped).obstacle)
    obstacle = gymnasium_scenes(DrawsMore(render_mode="rgb_array")).obstacle
    assert obstacle == f"the environment {__name__}.DrawsMore overrides render()"
    env = make()
    env.unwrapped.mujoco_renderer.render = lambda _: None
    assert "is not Gymnasium's own" in str(gymnasium_scenes(env).obstacle)
    env = make()
    old = env.unwrapped.mujoco_renderer
    env.unwrapped.mujoco_renderer = Renderer(old.model, old.data, None, 64, 48)
    assert "Renderer is not Gymnasium's own" in str(gymnasium_scenes(env).obstacle)


@pytest.mark.parametrize("asked", [{"camera": -1}, {"height": 32}, {"width": 32}])
def test_a_view_that_was_asked_for_is_of_the_scene(asked):
    """What wrappers draw is not in it, live or later."""
    assert gymnasium_scenes(Overlay(make()), **asked).obstacle is None


def test_what_makes_the_environment_again():
    """Its id and arguments, as far as JSON can hold them."""
    env = make("Hopper-v5", healthy_z_range=(0.5, np.float32(2.5)))
    environment = gymnasium_scenes(env).environment
    assert (environment["framework"], environment["id"]) == ("gymnasium", "Hopper-v5")
    assert environment["kwargs"]["healthy_z_range"] == [0.5, 2.5]
    assert json.loads(json.dumps(environment)) == environment
    odd = make(default_camera_config={"lookat": np.zeros(3)})
    assert gymnasium_scenes(odd).environment == {
        "framework": "gymnasium",
        "id": "InvertedPendulum-v5",
        "kwargs": None,
        "wrappers": [],
        "max_episode_steps": 1000,
    }
    assert gymnasium_scenes(HalfCheetahEnv()).environment is None


def test_another_renderer_has_another_camera():
    """An environment that makes both anew is shown as if it were new, at once."""
    env = make("HalfCheetah-v5")
    env.reset(seed=1)
    scene = scene_of(env)
    view = scene()
    scene.at_frame(lambda: None)
    first = pose(view.camera)
    for _ in range(20):
        env.step(env.action_space.sample())
    base = env.unwrapped
    base.mujoco_renderer = MujocoRenderer(
        base.model, base.data, {"azimuth": 11.0}, 64, 48, visual_options={0: True}
    )
    scene.at_frame(lambda: None)
    assert view.camera.azimuth == 11
    assert view.camera.lookat.tolist() != first[3]
    assert view.option.flags[0] == 1


@pytest.mark.parametrize(
    ("add", "text"),
    [
        (lambda viewer: viewer.add_marker(pos=np.zeros(3)), "markers"),
        (lambda viewer: viewer.add_overlay(0, "a", "b"), "text"),
        (lambda viewer: viewer.scn.flags.__setitem__(WIREFRAME, 1), "flags"),
        (lambda viewer: setattr(viewer.pert, "select", 1), "selected"),
        (lambda viewer: setattr(viewer, "render", print), "not Gymnasium's own"),
    ],
)
def test_what_is_added_in_the_viewer_is_a_momentary_obstacle(add, text):
    """It is in env.render() and not in the scene."""
    env = make()
    env.reset(seed=1)
    scene = scene_of(env)
    assert scene.obstacle() is None
    env.render()
    assert scene.obstacle() is None
    add(env.unwrapped.mujoco_renderer.viewer)
    assert text in str(scene.obstacle())
    env.close()


def test_a_renderer_of_another_model_is_a_momentary_obstacle():
    """It would show the old one."""
    env = make()
    scene = scene_of(env)
    env.unwrapped.model = mujoco.MjModel.from_xml_path(env.unwrapped.fullpath)
    assert "does not draw the model" in str(scene.obstacle())


def test_camera_that_was_asked_for():
    """A name, a number, the free camera where the model has it, or an MjvCamera."""
    env = make("HalfCheetah-v5")
    env.reset(seed=1)
    view = scene_of(env, camera="track", height=32)()
    assert (view.camera.fixedcamid, view.label) == (0, "track")
    assert (view.height, view.width) == (32, 64)
    scene = scene_of(env, camera=-1)
    view = scene()
    before = pose(view.camera)
    env.unwrapped.model.vis.global_.azimuth += 45
    scene.at_frame(lambda: None)
    assert pose(view.camera) != before
    camera = mujoco.MjvCamera()
    assert scene_of(env, camera=camera)().camera is camera


def test_camera_and_size_are_checked_at_once():
    """Not at the first frame."""
    with pytest.raises(UnknownName, match="track"):
        gymnasium_scenes(make("HalfCheetah-v5"), camera="tracking")
    with pytest.raises(InvalidArgument, match="height"):
        gymnasium_scenes(make(), height=0)


@pytest.mark.parametrize("part", ["wrapper", "environment"])
def test_an_environment_that_shows_another_is_drawn_live(part, tmp_path):
    """Its frames do not follow from its own states."""
    options = {"render_mode": "rgb_array", "width": 48, "height": 32}
    env, other = (gymnasium.make("HalfCheetah-v5", **options) for _ in range(2))
    other.reset()
    changed = env if part == "wrapper" else env.unwrapped
    changed.render = (other if part == "wrapper" else other.unwrapped).render
    monitor = mjrec.Monitor(env, tmp_path, lambda _: True, workers=0)
    with monitor:
        monitor.reset(seed=0)
        monitor.step(np.zeros(6))
        assert isinstance(monitor.video_recorder, mjrec.VideoRecorder)
    other.close()


def test_wrappers_that_change_something_are_named():
    """Outermost first; what only looks on is not among them; the least limit counts."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=7)
    for steps in (9, 5, 8):
        env = wrappers.TimeLimit(env, steps)
    assert around_gymnasium(env) == {"wrappers": [], "max_episode_steps": 5}
    env = wrappers.RecordEpisodeStatistics(wrappers.ClipAction(env))
    env = wrappers.TransformReward(env, abs)
    assert around_gymnasium(env)["wrappers"] == [
        "gymnasium.wrappers.transform_reward.TransformReward",
        "gymnasium.wrappers.transform_action.ClipAction",
    ]
