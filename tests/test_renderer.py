# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from interruption import ctrl_c_soon
from parts import parametrize

from mjrec.errors import (
    ClosedError,
    GLError,
    InvalidArgument,
    InvalidFrame,
)
from mjrec.gl import probe
from mjrec.simulation import gl_info, gl_thread
from mjrec.simulation.gl_thread import GLThread
from mjrec.simulation.renderer import SceneRenderer

ASSETS = Path(__file__).parents[1] / "assets"


def is_gpu() -> bool:
    return not probe("egl").software


needs_time = pytest.mark.skipif(
    "is_gpu()", reason="a GPU is done before the signal comes"
)
Simulation = tuple[mujoco.MjModel, mujoco.MjData]
SIZE: dict[str, Any] = {"height": 50, "width": 70}

# Small shadow map: most of the time of a small picture goes there.
TABLE = """
<mujoco>
  <visual><quality shadowsize="256"/></visual>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1"
      width="32" height="32"/>
    <texture name="plain" type="2d" builtin="flat" rgb1="0 1 0" width="32" height="32"/>
    <material name="cloth" texture="checks"/>
    <hfield name="hills" nrow="8" ncol="8" size=".4 .4 .3 .1"/>
    <mesh name="roof" vertex="-1 -1 0  1 -1 0  0 1 0  0 0 1" scale=".3 .3 .3"/>
  </asset>
  <worldbody>
    <light pos="0 -1 3" dir="0 .3 -1"/>
    <camera name="above" pos="0 -1.5 2" xyaxes="1 0 0 0 .8 .6"/>
    <geom type="plane" size="1 1 .1" material="cloth"/>
    <geom type="hfield" hfield="hills" pos="-.5 .3 .05"/>
    <geom type="mesh" mesh="roof" pos=".5 .3 .2"/>
    <body pos="0 0 .5"><freejoint/><geom size=".1"/><site name="dot" size=".12"/></body>
  </worldbody>
</mujoco>
"""


def load(name: str) -> Simulation:
    return started(mujoco.MjModel.from_xml_path(str(ASSETS / f"{name}.xml")))


def started(model: mujoco.MjModel) -> Simulation:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.fixture
def table() -> Simulation:
    return started(mujoco.MjModel.from_xml_string(TABLE))


@pytest.fixture
def renderer(
    table: Simulation,
) -> Iterator[SceneRenderer]:
    with SceneRenderer(table[0], camera="above", **SIZE) as renderer:
        yield renderer


def content(model: mujoco.MjModel) -> bytes:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def drawn_anew(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    with SceneRenderer(model, camera="above", **SIZE) as renderer:
        return renderer.render(data)


def run_script(script: str, **environment: str) -> subprocess.CompletedProcess[str]:
    # mujoco sets it for its backend, and it would forbid the child another one.
    inherited = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(script)],
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def gl_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "mjrec-gl"]


# The pictures


@parametrize(
    ("name", "camera"),
    [
        ("showcase", "overview"),
        ("showcase", "tracking"),
        ("showcase", -1),
        ("walker_on_plane", "track"),
        ("walker_on_plane", "chase"),
        ("pendulum", -1),
    ],
    default=2,
)
def test_pictures_are_those_of_mujocos_own_renderer(
    name: str, camera: str | int
) -> None:
    """Byte for byte, along a trajectory."""
    model, data = load(name)
    with (
        mujoco.Renderer(model, 50, 70) as theirs,
        SceneRenderer(model, camera=camera, **SIZE) as ours,
    ):
        for _ in range(3):
            mujoco.mj_step(model, data, 60)
            theirs.update_scene(data, camera)
            expected = theirs.render()
            picture = ours.render(data)
            assert picture.std() > 5
            assert np.array_equal(picture, expected)


def test_pictures_are_the_same_with_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Same visual options, same limit of geoms, a camera of the caller's own."""
    # MuJoCo writes a log file when the scene is full.
    monkeypatch.chdir(tmp_path)
    model, data = load("showcase")
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_JOINT] = True
    option.geomgroup[3] = True
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (0, 0, 0.6)
    camera.distance = 3
    with (
        mujoco.Renderer(model, 50, 70, max_geom=30) as theirs,
        SceneRenderer(
            model, camera=camera, scene_option=option, max_geom=30, **SIZE
        ) as ours,
    ):
        theirs.update_scene(data, camera, option)
        expected = theirs.render()
        assert np.array_equal(ours.render(data), expected)
        option.flags[mujoco.mjtVisFlag.mjVIS_JOINT] = False
        camera.azimuth += 40
        assert not np.array_equal(ours.render(data), expected)


def test_pictures_are_the_same_on_osmesa() -> None:
    """Byte for byte, on the backend that draws without EGL."""
    script = """
        import mujoco, numpy as np
        from mjrec.simulation.renderer import SceneRenderer
        model = mujoco.MjModel.from_xml_path(MODEL)
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, 50)
        with mujoco.Renderer(model, 50, 70) as theirs, \\
             SceneRenderer(model, height=50, width=70, camera="overview") as ours:
            assert ours.render(data).std() > 5
            theirs.update_scene(data, "overview")
            assert np.array_equal(theirs.render(), ours.render(data))
            print(ours.gl_facts["gl_renderer"])
    """
    model = str(ASSETS / "showcase.xml")

    done = run_script(script.replace("MODEL", repr(model)), MUJOCO_GL="osmesa")

    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.strip()


def test_a_picture_is_a_new_array_with_the_top_row_first(
    renderer: SceneRenderer, table: Simulation
) -> None:
    """A frame is the caller's to keep; the sky is above."""
    data = table[1]
    first = renderer.render(data)
    kept = first.copy()
    data.geom_xpos[-1] += (0.3, 0, 0.2)

    second = renderer.render(data)

    assert second.shape == (50, 70, 3)
    assert second.dtype == np.uint8
    assert second.flags.c_contiguous
    assert second.flags.writeable
    assert np.array_equal(first, kept)
    assert not np.array_equal(first, second)
    assert first[0].max() == 0 < first[-1].max()


def test_a_picture_may_be_larger_than_the_models_buffer(table: Simulation) -> None:
    """The buffer grows on a copy: not one byte of the user's model changes."""
    model, data = table
    before = content(model)
    with SceneRenderer(model, height=700, width=900, camera="above") as renderer:
        picture = renderer.render(data)
        renderer.model_changed()

    assert picture.shape == (700, 900, 3)
    assert picture[350:, 450].std() > 5
    assert content(model) == before
    assert model.vis.global_.offwidth == 640


def test_the_simulation_is_left_alone() -> None:
    """A trajectory with pictures is the trajectory without, bit for bit."""
    model, data = load("showcase")
    _, alone = load("showcase")
    before = content(model)
    with SceneRenderer(model, camera="tracking", **SIZE) as renderer:
        for _ in range(4):
            mujoco.mj_step(model, data, 10)
            renderer.render(data)
    mujoco.mj_step(model, alone, 40)

    assert np.array_equal(data.qpos, alone.qpos)
    assert np.array_equal(data.sensordata, alone.sensordata)
    assert np.array_equal(data.geom_xpos, alone.geom_xpos)
    assert content(model) == before


@pytest.mark.parametrize(("shadowsize", "drawn"), [(2048, 1024), (256, 256)])
def test_a_draft_is_the_model_with_less(
    table: Simulation, shadowsize: int, drawn: int
) -> None:
    """No multisampling, a shadow map of at most 1024; the model is left alone."""
    model, data = table
    model.vis.quality.shadowsize = shadowsize
    before = content(model)
    with SceneRenderer(model, camera="above", quality="draft", **SIZE) as renderer:
        draft = renderer.render(data)
    assert content(model) == before
    model.vis.quality.shadowsize = drawn
    model.vis.quality.offsamples = 0
    assert np.array_equal(draft, drawn_anew(model, data))


def test_a_picture_can_be_drawn_into_given_memory(
    renderer: SceneRenderer, table: Simulation
) -> None:
    """Which is returned; memory of another size is refused."""
    out = np.zeros((50, 70, 3), np.uint8)
    assert renderer.render(table[1], out=out) is out
    assert np.array_equal(out, renderer.render(table[1]))
    with pytest.raises(InvalidFrame, match=r"\(50, 70\)"):
        renderer.render(table[1], out=np.zeros((50, 71, 3), np.uint8))


# The floor is drawn around the camera of the picture before.
ENDLESS = """
<mujoco>
  <visual><quality shadowsize="256"/><map zfar="50"/></visual>
  <asset>
    <texture name="checks" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1"
      width="32" height="32"/>
    <material name="cloth" texture="checks" texrepeat="1.7 1.7"/>
  </asset>
  <worldbody>
    <light directional="true" dir="0 .3 -1"/>
    <geom type="plane" size="0 0 1" material="cloth"/>
    <body pos="0 0 .5"><joint type="slide" axis="1 .3 0"/><geom size=".1"/>
      <camera name="rider" pos="0 -2 1" xyaxes="1 0 0 0 .4 .9"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def ride() -> tuple[mujoco.MjModel, list[mujoco.MjData]]:
    """A camera that jumps over an infinite plane, in four moments."""
    model = mujoco.MjModel.from_xml_string(ENDLESS)
    moments = []
    for position in (0, 9.3, 17, 30):
        data = mujoco.MjData(model)
        data.qpos[:] = position
        mujoco.mj_forward(model, data)
        moments.append(data)
    return model, moments


def test_a_look_stands_for_the_picture_before(
    ride: tuple[mujoco.MjModel, list[mujoco.MjData]],
) -> None:
    """An infinite plane is where it would be, without the drawing."""
    model, moments = ride
    with SceneRenderer(model, camera="rider", **SIZE) as one:
        in_order = [one.render(data) for data in moments]
        positions = one.camera_positions
    with SceneRenderer(model, camera="rider", **SIZE) as other:
        cold = other.render(moments[2])
        other.look(moments[1])
        after_a_look = other.render(moments[2])
        other.look(moments[3])
        assert np.array_equal(other.camera_positions, positions)

    assert not np.array_equal(cold, in_order[2])
    assert np.array_equal(after_a_look, in_order[2])


def test_camera_positions_can_be_put_back(
    ride: tuple[mujoco.MjModel, list[mujoco.MjData]],
) -> None:
    """As a recording has them."""
    model, moments = ride
    with SceneRenderer(model, camera="rider", **SIZE) as renderer:
        assert not renderer.camera_positions.any()
        first = renderer.render(moments[0])
        left = renderer.camera_positions
        second = renderer.render(moments[1])
        assert not np.array_equal(renderer.render(moments[1]), second)
        renderer.camera_positions = left
        assert np.array_equal(renderer.render(moments[1]), second)
        renderer.camera_positions = np.zeros((2, 3))
        assert np.array_equal(renderer.render(moments[0]), first)


def test_fresh_pictures_do_not_depend_on_others(
    ride: tuple[mujoco.MjModel, list[mujoco.MjData]],
) -> None:
    """Each is what a new renderer draws first, as with dm_control."""
    model, moments = ride
    with SceneRenderer(model, camera="rider", fresh=True, **SIZE) as fresh:
        pictures = [fresh.render(data) for data in moments]
    for data, picture in zip(moments, pictures, strict=True):
        with SceneRenderer(model, camera="rider", **SIZE) as cold:
            assert np.array_equal(cold.render(data), picture)


# What changes in the model


def test_small_changes_show_at_once(renderer: SceneRenderer, table: Simulation) -> None:
    """Environments recolour sites while they run."""
    model, data = table
    before = renderer.render(data)
    model.site_rgba[0] = (1, 0, 1, 1)

    after = renderer.render(data)

    assert not np.array_equal(before, after)
    assert np.array_equal(after, drawn_anew(model, data))


def change_texture(model: mujoco.MjModel) -> None:
    model.mat_texid[0][model.mat_texid[0] >= 0] = model.texture("plain").id


@pytest.mark.parametrize(
    "change",
    [
        lambda model: model.hfield_data.__setitem__(slice(20, 40), 1),
        lambda model: model.tex_data.__setitem__(slice(1000), 200),
        lambda model: model.mesh_vert.__imul__((1.5, 1, 1)),
        lambda model: model.geom_size[0].__setitem__(slice(2), (0.4, 2)),
        change_texture,
        lambda model: setattr(model.vis.quality, "offsamples", 0),
    ],
    ids=["hills", "paint", "roof", "plane", "texture", "sharpness"],
)
def test_changes_that_a_context_keeps_show_when_told(
    renderer: SceneRenderer, table: Simulation, change: Any
) -> None:
    """After `model_changed` the picture is the one of a new renderer."""
    model, data = table
    before = renderer.render(data)
    change(model)
    mujoco.mj_forward(model, data)
    expected = drawn_anew(model, data)
    assert not np.array_equal(before, expected)

    renderer.model_changed()

    assert np.array_equal(renderer.render(data), expected)


# Whoever else draws


def test_a_gymnasium_environment_keeps_its_context() -> None:
    """Its viewer never makes its context current again."""
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    before = env.render()
    inner: Any = env.unwrapped
    with SceneRenderer(inner.model, camera="track", **SIZE) as renderer:
        picture = renderer.render(inner.data)
        between = env.render()
        assert np.array_equal(renderer.render(inner.data), picture)
    after = env.render()
    env.close()

    assert before.std() > 5
    assert picture.std() > 5
    assert np.array_equal(before, between)
    assert np.array_equal(before, after)


@pytest.mark.dm_control
def test_dm_control_keeps_its_context_and_gives_the_same_picture() -> None:
    """Whoever draws in between."""
    suite = pytest.importorskip("dm_control.suite")
    physics = suite.load("cartpole", "swingup", task_kwargs={"random": 0}).physics
    before = physics.render(50, 70, camera_id="fixed")
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
    with SceneRenderer(
        physics.model.ptr, camera="fixed", scene_option=option, **SIZE
    ) as renderer:
        picture = renderer.render(physics.data.ptr)
        between = physics.render(50, 70, camera_id="fixed")
    after = physics.render(50, 70, camera_id="fixed")

    assert before.std() > 5
    assert np.array_equal(before, picture)
    assert np.array_equal(before, between)
    assert np.array_equal(before, after)


def test_two_renderers_at_once(renderer: SceneRenderer, table: Simulation) -> None:
    """Each has its own model, camera and size."""
    model, data = load("pendulum")
    with SceneRenderer(model, height=20, width=30) as other:
        first = renderer.render(table[1])
        assert other.render(data).shape == (20, 30, 3)
        assert np.array_equal(renderer.render(table[1]), first)
    assert np.array_equal(renderer.render(table[1]), first)


def test_a_foreign_context_freed_on_the_thread_does_no_harm(
    renderer: SceneRenderer, table: Simulation
) -> None:
    """Garbage collection may do so; mujoco 3 then lets go of the current context."""
    model, data = table
    foreign = mujoco.GLContext(8, 8)
    first = renderer.render(data)
    data.geom_xpos[-1] += (0.3, 0, 0.2)

    renderer._canvas._thread.call(foreign.free)

    # Without a context nothing is read, and the picture before would come again.
    second = renderer.render(data)
    assert not np.array_equal(second, first)
    assert np.array_equal(second, drawn_anew(model, data))


# Its life


def test_a_closed_renderer_says_so(table: Simulation) -> None:
    """Closing twice is allowed, drawing afterwards is not."""
    earlier = gl_threads()
    renderer = SceneRenderer(table[0], **SIZE)
    renderer.close()
    renderer.close()

    with pytest.raises(ClosedError):
        renderer.render(table[1])
    assert gl_threads() == earlier


def test_a_forgotten_renderer_ends_its_thread(table: Simulation) -> None:
    """Garbage collection is enough."""
    earlier = gl_threads()
    renderer = SceneRenderer(table[0], **SIZE)
    renderer.render(table[1])
    (thread,) = set(gl_threads()) - set(earlier)

    del renderer
    gc.collect()
    thread.join(30)

    assert not thread.is_alive()


def test_a_renderer_that_cannot_be_made_leaves_no_thread(
    table: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever fails after the context was made."""
    earlier = gl_threads()

    def fail(*_: object) -> None:
        raise mujoco.FatalError("Offscreen framebuffer is not complete")

    monkeypatch.setattr(mujoco, "MjrContext", fail)
    with pytest.raises(GLError, match=r"70x50.*not complete\. .*smaller.*doctor"):
        SceneRenderer(table[0], **SIZE)

    assert gl_threads() == earlier


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"height": 0}, "height must be"),
        ({"width": 20000}, "width must be"),
        ({"camera": "abve"}, "no camera 'abve'"),
        ({"camera": 7}, "no camera number 7"),
        ({"quality": "high"}, "no quality 'high'"),
    ],
)
def test_arguments_are_checked_before_a_context_is_made(
    table: Simulation,
    arguments: dict[str, Any],
    message: str,
) -> None:
    """One clear error each."""
    earlier = gl_threads()

    with pytest.raises(InvalidArgument, match=message):
        SceneRenderer(table[0], **{**SIZE, **arguments})

    assert gl_threads() == earlier


def test_a_picture_beyond_the_driver_is_refused(
    table: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit that OpenGL tells is named; a smaller one than any real driver's."""
    told = gl_info.raw_opengl()
    name_of_limit = 0x84E8

    def tell(name: int, limit: Any) -> None:
        assert name == name_of_limit
        limit.value = 64

    monkeypatch.setattr(told, "glGetIntegerv", tell)

    with pytest.raises(InvalidArgument, match=r"70x50 pixels is larger.*64x64"):
        SceneRenderer(table[0], **SIZE)


def test_a_picture_beyond_memory_is_an_error() -> None:
    """The error of mujoco comes home, and the process lives on."""
    script = f"""
        import resource
        resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
        import mujoco
        from mjrec import GLError
        from mjrec.simulation.renderer import SceneRenderer
        model = mujoco.MjModel.from_xml_path({str(ASSETS / "pendulum.xml")!r})
        try:
            SceneRenderer(model, height=16384, width=16384)
        except GLError as error:
            print(error)
        with SceneRenderer(model, height=16, width=16) as renderer:
            renderer.render(mujoco.MjData(model))
    """

    done = run_script(script)

    assert (done.returncode, done.stderr) == (0, "")
    assert "A 16384x16384 picture cannot be drawn" in done.stdout


@pytest.mark.parametrize(
    "environment",
    [
        {"MUJOCO_GL": "off"},
        {"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "77"},
        {"MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"},
        {"MUJOCO_GL": "glfw", "DISPLAY": ""},
    ],
)
def test_without_gl_there_is_one_error_with_the_way_out(
    environment: dict[str, str],
) -> None:
    """It says which backend and why, and names `mjrec doctor`."""
    script = f"""
        import warnings
        import mujoco
        from mjrec import GLError
        from mjrec.simulation.renderer import SceneRenderer
        warnings.simplefilter("ignore")  # GLFW warns, and goes on
        model = mujoco.MjModel.from_xml_path({str(ASSETS / "pendulum.xml")!r})
        try:
            SceneRenderer(model, height=16, width=16)
        except GLError as error:
            print(error)
    """

    done = run_script(script, **environment)

    assert (done.returncode, done.stderr) == (0, "")
    assert f"MUJOCO_GL {environment['MUJOCO_GL']!r}: " in done.stdout
    assert "`mjrec doctor`" in done.stdout


@parametrize("order", ["ours first", "theirs first"])
def test_leaving_without_closing_is_silent(order: str) -> None:
    """Both mujoco and dm_control shut EGL down at exit, each when it likes."""
    script = f"""
        import mujoco
        import gymnasium
        from mjrec.simulation.renderer import SceneRenderer
        try:
            from dm_control import suite
        except Exception:  # not with every mujoco
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
            model = mujoco.MjModel.from_xml_path({str(ASSETS / "pendulum.xml")!r})
            for _ in range(2):
                kept.append(SceneRenderer(model, height=16, width=16))
                kept[-1].render(mujoco.MjData(model))

        kept = []
        steps = [ours, theirs]
        for step in steps if {order == "ours first"} else reversed(steps):
            step()
        print("end")
    """

    done = run_script(script)

    assert (done.returncode, done.stdout) == (0, "end\n")
    # Other packages' deprecations are theirs to mend.
    assert "Exception ignored" not in done.stderr
    assert "Error" not in done.stderr
    assert "mjrec" not in done.stderr


@needs_time
def test_leaving_in_the_midst_of_a_picture_is_silent() -> None:
    """Ctrl-C while the driver draws: it is waited for before EGL is shut down."""
    script = f"""
        import signal
        import mujoco
        from mjrec.simulation.renderer import SceneRenderer
        model = mujoco.MjModel.from_xml_path({str(ASSETS / "showcase.xml")!r})
        data = mujoco.MjData(model)
        renderer = SceneRenderer(model, height=480, width=640)
        renderer.render(data)
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        try:
            renderer.render(data)
        except KeyboardInterrupt:
            print("interrupted")
    """

    done = run_script(script)

    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "interrupted\n"


@pytest.mark.parametrize("drawn_by", ["SceneRenderer", "mujoco.Renderer"])
def test_a_forked_child_is_told_instead_of_hanging(drawn_by: str) -> None:
    """Mesa's threads are not copied by fork, and their work is waited for."""
    script = f"""
        import os, sys, warnings
        import mujoco
        from mjrec import GLError
        from mjrec.simulation.renderer import SceneRenderer
        warnings.simplefilter("ignore")  # Python 3.12 warns of fork with threads
        model = mujoco.MjModel.from_xml_path({str(ASSETS / "pendulum.xml")!r})
        data = mujoco.MjData(model)
        if {drawn_by == "SceneRenderer"}:
            renderer = SceneRenderer(model, height=16, width=16)
            uses = [lambda: renderer.render(data)]
            renderer.render(data)
        else:
            with mujoco.Renderer(model, 16, 16) as renderer:
                renderer.update_scene(data)
                renderer.render()
            uses = []
        uses.append(lambda: SceneRenderer(model, height=16, width=16))
        if not (child := os.fork()):
            for use in uses:
                try:
                    use()
                except GLError as error:
                    assert "fork" in str(error) and "spawn" in str(error)
                    print("told", flush=True)
            if uses[1:]:
                renderer.close()
            # As children of multiprocessing end. What mujoco does at exit to a
            # display without contexts hangs in a forked child.
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        if uses[1:]:
            renderer.render(data)
        sys.exit(status)
    """

    done = run_script(script)

    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "told\n" * (2 if drawn_by == "SceneRenderer" else 1)


def test_a_child_forked_before_anything_was_drawn_may_draw() -> None:
    """Only what used OpenGL before the fork forbids it."""
    script = f"""
        import os, sys
        import mujoco
        from mjrec.simulation.renderer import SceneRenderer
        model = mujoco.MjModel.from_xml_path({str(ASSETS / "pendulum.xml")!r})
        if (child := os.fork()):
            sys.exit(os.waitpid(child, 0)[1])
        with SceneRenderer(model, height=16, width=16) as renderer:
            print(renderer.render(mujoco.MjData(model)).shape)
    """

    done = run_script(script)

    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "(16, 16, 3)\n"


# The thread


@pytest.fixture
def thread() -> Iterator[GLThread]:
    thread = GLThread(finish=lambda: None)
    yield thread
    thread.close()


def test_errors_come_home(thread: GLThread) -> None:
    """The same object, and the thread works on."""
    error = ValueError("as it was")

    def fail() -> None:
        raise error

    with pytest.raises(ValueError, match="as it was") as caught:
        thread.call(fail)

    assert caught.value is error
    assert thread.call(lambda: 3) == 3


def test_everything_runs_on_one_thread_of_its_own() -> None:
    """Also what is called at the end."""
    identities: list[int] = []
    thread = GLThread(finish=lambda: identities.append(threading.get_ident()))
    identities += [thread.call(threading.get_ident) for _ in range(2)]
    thread.close()

    assert len(identities) == 3
    assert len(set(identities) - {threading.get_ident()}) == 1


def test_a_driver_that_hangs_is_not_waited_for(
    thread: GLThread, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next calls fail at once, and closing returns."""
    monkeypatch.setattr(gl_thread, "_TIMEOUT_S", 0.05)
    driver = threading.Event()

    with pytest.raises(GLError, match="no answer within"):
        thread.call(driver.wait)
    with pytest.raises(GLError, match="hangs"):
        thread.call(driver.wait)
    thread.close()
    driver.set()


@pytest.mark.usefixtures("default_signals")
def test_what_ctrl_c_interrupted_is_waited_for(thread: GLThread) -> None:
    """The thread may be reading a scene that the caller is about to change."""
    driver = threading.Event()
    ended: list[bool] = []
    caller = threading.get_ident()

    def draw() -> None:
        signal.pthread_kill(caller, signal.SIGINT)
        ended.append(driver.wait(30))

    with pytest.raises(KeyboardInterrupt):
        thread.call(draw)
    # It waits, or there would be nothing to interrupt.
    with ctrl_c_soon(), pytest.raises(KeyboardInterrupt):
        thread.settle()
    driver.set()
    thread.settle()

    assert ended == [True]
    assert thread.call(lambda: 3) == 3


@needs_time
def test_a_picture_after_ctrl_c_is_right() -> None:
    """It is not the one that was given up."""
    model, data = load("showcase")
    with SceneRenderer(model, height=480, width=640, camera="overview") as renderer:
        first = renderer.render(data)
        with ctrl_c_soon(), pytest.raises(KeyboardInterrupt):
            renderer.render(data)
        data.geom_xpos += 0.1
        second = renderer.render(data)
        data.geom_xpos -= 0.1
        assert not np.array_equal(second, first)
        assert np.array_equal(renderer.render(data), first)
