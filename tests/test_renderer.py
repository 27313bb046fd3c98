# SPDX-License-Identifier: Apache-2.0
"""Frames of `SceneRenderer`, also beside other renderers in the process."""

import gc
import os
import re
import textwrap
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
from other_python import run_python

from mjrec.simulation.renderer import SceneRenderer

ASSETS = Path(__file__).parents[1] / "assets"
SIZE = {"height": 50, "width": 70}

# The shadow map is small, as it takes most of the time of a small frame.
TABLE = """
<mujoco>
  <visual><quality shadowsize="256"/><map zfar="50"/></visual>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1"
      width="32" height="32"/>
    <material name="cloth" texture="checks" texrepeat="1.7 1.7"/>
    <hfield name="hills" nrow="8" ncol="8" size=".4 .4 .3 .1"/>
    <mesh name="roof" vertex="-1 -1 0  1 -1 0  0 1 0  0 0 1" scale=".3 .3 .3"/>
  </asset>
  <worldbody>
    <light directional="true" pos="0 -1 3" dir="0 .3 -1"/>
    <camera name="above" pos="0 -1.5 2" xyaxes="1 0 0 0 .8 .6"/>
    <geom type="plane" size="1 1 .1" material="cloth"/>
    <geom type="hfield" hfield="hills" pos="-.5 .3 .05"/>
    <geom type="mesh" mesh="roof" pos=".5 .3 .2"/>
    <body pos="0 0 .5"><freejoint/><geom size=".1"/><site name="dot" size=".12"/>
      <camera name="rider" pos="0 -2 1" xyaxes="1 0 0 0 .4 .9"/></body>
  </worldbody>
</mujoco>
"""


def load(path):
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture
def table(tmp_path):
    (tmp_path / "table.xml").write_text(TABLE)
    return load(tmp_path / "table.xml")


def saved(model):
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def rendered(model, data):
    with SceneRenderer(model, camera="above", **SIZE) as renderer:
        return renderer.render(data)


def run_script(script, **environment):
    """Run a program that has `load` and `SceneRenderer`; return its output."""
    # mujoco sets this variable, which would forbid the child another backend.
    inherited = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    head = f"""
import os, sys, warnings
import mujoco, numpy as np
from mjrec import GLError
from mjrec.simulation.renderer import SceneRenderer
SIZE = {SIZE}
def load(name):
    model = mujoco.MjModel.from_xml_path(f"{ASSETS}/{{name}}.xml")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data
"""
    env = {**inherited, **environment}
    done = run_python(head + textwrap.dedent(script), env=env)
    # Other packages may print deprecation warnings.
    assert not re.search("Exception ignored|Error|mjrec", done.stderr), done.stderr
    return done.stdout


# --- Frames --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "camera"),
    [("showcase", "tracking"), ("walker_on_plane", "chase"), ("pendulum", -1)],
)
def test_frames_equal_those_of_mujoco_renderer(name, camera):
    """Rendering changes neither the model nor the trajectory."""
    path = ASSETS / f"{name}.xml"
    (model, data), (_, alone) = load(path), load(path)
    before = saved(model)
    with (
        mujoco.Renderer(model, 50, 70) as theirs,
        SceneRenderer(model, camera=camera, **SIZE) as ours,
    ):
        for _ in range(3):
            mujoco.mj_step(model, data, 60)
            theirs.update_scene(data, camera)
            frame = ours.render(data)
            assert frame.std() > 5
            assert np.array_equal(frame, theirs.render())
    mujoco.mj_step(model, alone, 180)
    assert np.array_equal(data.geom_xpos, alone.geom_xpos)
    assert saved(model) == before


def test_frames_equal_those_of_mujoco_renderer_on_osmesa():
    script = """
        model, data = load("showcase")
        with (
            mujoco.Renderer(model, 50, 70) as theirs,
            SceneRenderer(model, camera="overview", **SIZE) as ours,
        ):
            assert ours.render(data).std() > 5
            theirs.update_scene(data, "overview")
            assert np.array_equal(theirs.render(), ours.render(data))
            print(ours.gl_facts["gl_renderer"])
    """
    assert run_script(script, MUJOCO_GL="osmesa").strip()


def test_a_frame_may_be_larger_than_the_models_buffer(table):
    """The user's model stays the same."""
    model, data = table
    before = saved(model)
    with SceneRenderer(model, height=700, width=900, camera="above") as renderer:
        frame = renderer.render(data)
        renderer.model_changed()
    assert frame[350:, 450].std() > 5
    assert saved(model) == before


@pytest.mark.parametrize(("shadowsize", "drawn"), [(2048, 1024), (256, 256)])
def test_a_draft_has_no_multisampling_and_a_small_shadow_map(table, shadowsize, drawn):
    """The user's model stays the same."""
    model, data = table
    model.vis.quality.shadowsize = shadowsize
    before = saved(model)
    with SceneRenderer(model, camera="above", quality="draft", **SIZE) as renderer:
        draft = renderer.render(data)
    assert saved(model) == before
    model.vis.quality.shadowsize = drawn
    model.vis.quality.offsamples = 0
    assert np.array_equal(draft, rendered(model, data))


# --- Changes of the model ------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda model: model.hfield_data.__setitem__(slice(20, 40), 1),
        lambda model: model.tex_data.__setitem__(slice(1000), 200),
        lambda model: model.mesh_vert.__imul__((1.5, 1, 1)),
        lambda model: model.geom_size[0].__setitem__(slice(2), (0.4, 2)),
        lambda model: model.mat_texid.fill(-1),
        lambda model: setattr(model.vis.quality, "offsamples", 0),
    ],
    ids=["hills", "paint", "roof", "plane", "texture", "sharpness"],
)
def test_changes_of_the_model_show(table, change):
    """Colors show at once, data uploaded to OpenGL after `model_changed`."""
    model, data = table
    with SceneRenderer(model, camera="above", **SIZE) as renderer:
        before = renderer.render(data)
        model.site_rgba[0] = (1, 0, 1, 1)
        recoloured = renderer.render(data)
        assert not np.array_equal(before, recoloured)
        change(model)
        mujoco.mj_forward(model, data)
        expected = rendered(model, data)
        assert not np.array_equal(recoloured, expected)
        renderer.model_changed()
        assert np.array_equal(renderer.render(data), expected)


# --- Other renderers -----------------------------------------------------------------


def gymnasium_scene():
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    inner = env.unwrapped
    return env.render, (inner.model, inner.data), "track"


def dm_control_scene():
    suite = pytest.importorskip("dm_control.suite")
    physics = suite.load("cartpole", "swingup", task_kwargs={"random": 0}).physics
    simulation = (physics.model.ptr, physics.data.ptr)
    return lambda: physics.render(48, 64, camera_id="fixed"), simulation, "fixed"


@pytest.mark.parametrize(
    "make",
    [gymnasium_scene, pytest.param(dm_control_scene, marks=pytest.mark.dm_control)],
)
def test_an_environment_keeps_its_context(make):
    """Gymnasium's viewer never makes its context current again."""
    # A context from an earlier test must not be freed between two frames.
    gc.collect()
    theirs, (model, data), camera = make()
    before = theirs()
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
    look = {"camera": camera, "scene_option": option, "height": 48, "width": 64}
    with SceneRenderer(model, **look) as renderer:
        frame = renderer.render(data)
        assert np.array_equal(theirs(), before)
        assert np.array_equal(renderer.render(data), frame)
        forgotten = SceneRenderer(model, **look)
        del forgotten
        gc.collect()
        assert np.array_equal(theirs(), before)
    assert before.std() > 5
    assert np.array_equal(frame, before) or camera == "track"
    assert np.array_equal(before, theirs())


# --- Errors and ends -----------------------------------------------------------------


def test_a_frame_beyond_memory_is_an_error():
    """The process can render other frames."""
    script = """
        import resource
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
        model, data = load("pendulum")
        try:
            SceneRenderer(model, height=16384, width=16384)
        except GLError as error:
            print(error)
        with SceneRenderer(model, **SIZE) as renderer:
            renderer.render(data)
    """
    assert "A 16384x16384 frame cannot be drawn" in run_script(script)


@pytest.mark.parametrize(
    "environment", [{"MUJOCO_GL": "off"}, {"MUJOCO_GL": "glfw", "DISPLAY": ""}]
)
def test_the_error_without_gl_names_backend_and_doctor(environment):
    script = """
        warnings.simplefilter("ignore")  # GLFW only warns
        try:
            SceneRenderer(load("pendulum")[0], **SIZE)
        except GLError as error:
            print(error)
    """
    output = run_script(script, **environment)
    assert f"MUJOCO_GL {environment['MUJOCO_GL']!r}: " in output
    assert "`mjrec doctor`" in output


@pytest.mark.parametrize("order", ["ours, theirs", "theirs, ours"])
def test_exit_without_closing_is_silent(order):
    """Both mujoco and dm_control shut EGL down at exit, in any order."""
    script = """
        import gymnasium
        try:
            from dm_control import suite
        except Exception:  # it fails with some mujoco versions
            suite = None

        def theirs():
            kept.append(gymnasium.make("HalfCheetah-v5", render_mode="rgb_array"))
            kept[-1].reset()
            kept[-1].render()
            kept[-1].close()
            if suite is not None:
                kept.append(suite.load("cartpole", "swingup"))
                kept[-1].physics.render(16, 16)

        def ours():
            model, data = load("pendulum")
            for _ in range(2):
                kept.append(SceneRenderer(model, **SIZE))
                kept[-1].render(data)

        kept = []
        for step in [ORDER]:
            step()
        print("end")
    """
    assert run_script(script.replace("ORDER", order)) == "end\n"


@pytest.mark.parametrize(
    ("drawn_by", "errors"), [("SceneRenderer", 2), ("mujoco.Renderer", 1), (None, 0)]
)
def test_rendering_in_a_fork_of_a_process_that_rendered_is_an_error(drawn_by, errors):
    """It would hang, as fork does not copy Mesa's threads."""
    script = f"""
        warnings.simplefilter("ignore")  # Python 3.12 warns of fork with threads
        model, data = load("pendulum")
        uses = [lambda: SceneRenderer(model, **SIZE).render(data)]
        if {drawn_by!r} == "SceneRenderer":
            renderer = SceneRenderer(model, **SIZE)
            uses.append(lambda: renderer.render(data))
            renderer.render(data)
        elif {drawn_by!r} == "mujoco.Renderer":
            with mujoco.Renderer(model, 16, 16) as renderer:
                renderer.update_scene(data)
                renderer.render()
        if not (child := os.fork()):
            for use in uses:
                try:
                    assert use().shape == (50, 70, 3)
                except GLError as error:
                    assert "fork" in str(error) and "spawn" in str(error)
                    print("error", flush=True)
            renderer = None
            # Children of multiprocessing end like this. mujoco's exit handler
            # hangs in a forked child on a display without contexts.
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        assert uses[-1]().shape == (50, 70, 3)
    """
    assert run_script(script) == "error\n" * errors
