# SPDX-License-Identifier: Apache-2.0
"""Test dm_control scenes, obstacles to rendering them, and resets without OpenGL."""

import json

import mujoco
import numpy as np
import pytest

pytest.importorskip("dm_control")

from dm_control import _render, composer, manipulation, suite
from dm_control.locomotion.arenas import bowl
from dm_control.locomotion.tasks import escape
from dm_control.locomotion.walkers import rodent
from dm_control.mujoco import Physics
from dm_control.suite.wrappers import action_noise, pixels

from mjrec.environments.dm_control_scenes import ContextsOnDemand, dm_control_scenes
from mjrec.environments.wrapping import around_dm_env

pytestmark = pytest.mark.dm_control


def load(domain="cheetah", task="run", **kwargs):
    env = suite.load(domain, task, task_kwargs={"random": 0, **kwargs})
    quality = env.physics.model.vis.quality
    quality.shadowsize, quality.offsamples = 64, 0
    return env


def begun(env, directory, **asked):
    """Return the facts about the scene at the start of an episode."""
    states = dm_control_scenes(env, **asked).states
    states.open(directory)
    with states.resetting():
        env.reset()
    start = states.begin_episode()
    assert start.refusal is None
    states.finish()
    states.close()
    return dict(start.scene)


def test_scene_equals_that_of_physics_render(tmp_path):
    """For large frames or a camera object, dm_control uses another scene."""
    scene = begun(load(), tmp_path)
    assert (scene["height"], scene["width"], scene["label"]) == (240, 320, -1)
    assert (scene["fresh"], scene["max_geom"]) == (True, 1000)
    assert scene["option"]["flags"][int(mujoco.mjtVisFlag.mjVIS_RANGEFINDER)] == 0
    named = begun(load(), tmp_path, camera="side", height=32)
    assert (named["camera"]["fixedcamid"], named["label"]) == (0, "side")
    for asked in ({"width": 4000}, {"camera": mujoco.MjvCamera()}):
        scene = begun(load(), tmp_path, **asked)
        assert (scene["fresh"], scene["max_geom"]) == (False, 10000)


def test_overridden_render_of_physics_is_an_obstacle():
    class Drawing(Physics):
        def render(self, *args, **kwargs):
            return 255 - super().render(*args, **kwargs)

    env = load()
    assert dm_control_scenes(env).obstacle is None
    env._physics = Drawing.from_model(env.physics.model)
    assert "Drawing overrides render()" in dm_control_scenes(env).obstacle
    assert dm_control_scenes(env, camera=mujoco.MjvCamera()).obstacle is None
    env = load()
    env.physics.render = lambda: None
    assert "Physics overrides render()" in dm_control_scenes(env).obstacle


def test_environment_facts_suffice_to_recreate_it():
    """The facts include the state of the random generator."""

    class Opaque:
        __slots__ = ()

    env = load(time_limit=0.5)
    name = "dm_control/cheetah-run"
    scenes = dm_control_scenes(action_noise.Wrapper(env), env_id=name)
    assert scenes.environment == {
        "framework": "dm_control",
        "id": name,
        "kwargs": None,
        "wrappers": ["dm_control.suite.wrappers.action_noise.Wrapper"],
        "max_episode_steps": 50,
    }
    assert dm_control_scenes(env, env_id=name).environment["wrappers"] == []
    assert dm_control_scenes(env, env_id="mine").environment is None
    [hidden] = around_dm_env(Opaque())["wrappers"]
    assert hidden.endswith("Opaque")
    again = np.random.RandomState()
    again.set_state(json.loads(json.dumps(scenes.random_state())))
    assert again.rand() == env.task.random.rand()


def test_composers_model_is_stored_with_its_sources(tmp_path):
    env = manipulation.load("reach_site_features", seed=1)
    scenes = dm_control_scenes(env)
    assert scenes.obstacle is None
    assert scenes.random_state()["bit_generator"] == "MT19937"
    begun(env, tmp_path)
    assert len(list(tmp_path.glob("*.mjb.gz"))) == 1
    assert len(list(tmp_path.glob("*.zip"))) == 1


def rat_in_a_bowl():
    walker = rodent.Rat()
    task = escape.Escape(walker=walker, arena=bowl.Bowl(size=(4.0, 4.0)))
    walker.observables.egocentric_camera.enabled = False
    return composer.Environment(task, random_state=np.random.RandomState(0))


@pytest.mark.parametrize("make", [lambda: load("quadruped", "escape"), rat_in_a_bowl])
def test_terrain_is_made_without_opengl(make, monkeypatch):
    """A reset requires an OpenGL context, which `ContextsOnDemand` replaces."""
    # This has the same effect as MUJOCO_GL=disable.
    monkeypatch.setattr(_render, "Renderer", _render._no_renderer())
    env = make()
    contexts = ContextsOnDemand(env)
    for _ in range(2):
        with contexts.resetting():
            env.reset()
        assert env.physics._contexts is None
        assert env.physics.model.hfield_data.std() > 0.1
    with pytest.raises(RuntimeError, match="No OpenGL rendering backend"):
        env.reset()


def test_reset_that_draws_pixels_gets_equal_frames():
    kwargs = {"height": 24, "width": 32, "camera_id": 0}
    plain, recorded = (
        pixels.Wrapper(load("quadruped", "escape"), render_kwargs=kwargs)
        for _ in range(2)
    )
    expected = plain.reset().observation["pixels"].copy()
    with ContextsOnDemand(recorded).resetting():
        seen = recorded.reset().observation["pixels"].copy()
    assert type(recorded.physics._contexts).__name__ == "Contexts"
    np.testing.assert_array_equal(seen, expected)
    assert seen.std() > 5
    for env in (plain, recorded):
        env.physics.free()


def test_reset_restores_the_contexts():
    env = load()
    with pytest.raises(ZeroDivisionError), ContextsOnDemand(env).resetting():
        env.physics.render(1 / 0)
    assert env.physics._contexts is None
    env.physics.render(8, 8)
    own = env.physics._contexts
    with ContextsOnDemand(env).resetting():
        assert env.physics._contexts is own
    assert env.physics._contexts is own
    env.physics.free()
