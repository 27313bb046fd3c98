# SPDX-License-Identifier: Apache-2.0
"""Monitors record states and leave the frames to other processes."""

import contextlib
import copy
import gc
import itertools
import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from other_python import run_python
from processes import children
from recordings import frames_in, in_flight, manifest_of, metadata_of, videos_in
from waiting import wait_until

import mjrec
from mjrec.commands import main
from mjrec.environments.mjcf_environments import MjcfEnvironment

SIZE = {"height": 48, "width": 64}
# This plugin senses contacts between a ball and the floor, and draws them.
TOUCH_GRID = """
<mujoco>
  <extension><plugin plugin="mujoco.sensor.touch_grid"/></extension>
  <worldbody>
    <geom type="plane" size="1 1 1"/><light pos="0 0 3"/>
    <body pos="0 0 .09"><freejoint/><geom size=".1"/><site name="s"/></body>
  </worldbody>
  <sensor>
    <plugin plugin="mujoco.sensor.touch_grid" objtype="site" objname="s">
      <config key="size" value="7 7"/><config key="fov" value="45 45"/>
      <config key="gamma" value="0"/><config key="nchannel" value="1"/>
    </plugin>
  </sensor>
</mujoco>
"""


def make(env_id="InvertedPendulum-v5", **arguments):
    """Return a small environment, by default without a render mode."""
    return gymnasium.make(env_id, **SIZE, **arguments)


def steps(env, count, *, seed=0):
    """Reset, then take N steps or stop when the episode ends."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(count):
        if any(env.step(env.action_space.sample())[2:4]):
            break


def monitored(env, directory, *positional, **options):
    """Return a monitor that accepts early resets."""
    options = {"workers": 1, "allow_early_reset": True, **options}
    return mjrec.Monitor(env, directory, *positional, **options)


def pending_in(directory):
    entries = manifest_of(directory)["mjrec"]["pending"]
    return [entry["episode_id"] for entry in entries]


def trajectory_in(directory):
    """Return the only trajectory in a directory."""
    [path] = directory.glob("*.h5")
    return mjrec.load_trajectory(path)


def test_close_leaves_a_rendered_directory(tmp_path):
    """There is no log, nothing is pending, and gym's attribute names the video."""
    with monitored(make(), tmp_path) as env:
        steps(env, 3)
        video = env.video_recorder
        assert (video.enabled, video.functional, video.empty) == (True, True, False)
        assert (video.frame_count, video.finished) == (4, False)
    assert video.finished
    assert Path(video.path).exists()
    assert not [*tmp_path.glob(".*"), *in_flight(tmp_path)]
    assert len(list(tmp_path.glob("openaigym.model.*.mjb.gz"))) == 1
    assert pending_in(tmp_path) == []
    assert len(manifest_of(tmp_path)["videos"]) == 1
    assert len(frames_in(tmp_path, 0)) == 4
    # An unfinished episode does not count in the statistics.
    metadata = metadata_of(tmp_path, 0)
    assert (metadata["complete"], metadata["reason"]) == (False, "close")
    assert not trajectory_in(tmp_path).complete


def test_a_deferred_video_is_the_live_one(tmp_path):
    """The bytes are equal, and all live metadata is in the deferred metadata."""
    found = []
    for how in ("live", "deferred"):
        env = make(render_mode="rgb_array")
        directory = tmp_path / how
        with mjrec.Monitor(env, directory, workers=1, max_fps=10, render=how) as env:
            steps(env, 4)
        found.append(metadata_of(directory, 0))
    live, deferred = found
    assert live.keys() - {"recording_reason"} <= deferred.keys()
    assert (live["recording"], deferred["recording"]) == ("live", "deferred")
    assert (live["pictures"], deferred["pictures"]) == ("env.render", "scene")
    same = "fps timestep stride frame_count frame_steps height width seed complete"
    for key in [*same.split(), "decoded_sha256", "file_sha256", "gl_renderer"]:
        assert live[key] == deferred[key], key
    assert deferred["playback_speed"] == 1
    # At 25 steps a second, every third step is shown, plus the last one.
    assert (deferred["stride"], deferred["fps"]) == (3, "25/3")
    assert deferred["frame_steps"] == [[0, 3], [4, 4]]
    assert len(frames_in(directory, 0)) == 3


@pytest.mark.parametrize(
    ("options", "kept", "filmed"),
    [
        ({}, [0, 1], [0, 1]),
        ({"trajectory_callable": lambda episode: episode == 2}, [2], [0, 1]),
        ({"mode": "evaluation", "render": "off"}, [0, 1, 2], []),
        ({"trajectory_callable": False, "render": "off"}, [], []),
        pytest.param(
            {"trajectory_callable": False}, [], [0, 1], marks=pytest.mark.thorough
        ),
    ],
)
def test_trajectories_are_kept_as_asked(options, kept, filmed, tmp_path):
    """Unwanted trajectories are removed once their videos are finished."""
    asked = []
    if callable(choose := options.get("trajectory_callable")):
        options = {"trajectory_callable": lambda k: asked.append(k) or choose(k)}
    with monitored(make(), tmp_path, **options) as env:
        for seed in range(3):
            env.reset()
            steps(env, 1, seed=seed)
    # A reset that replaces another has the same number and does not ask again.
    assert asked == ([0, 1, 2] if callable(choose) else [])
    assert sorted(int(path.stem[-6:]) for path in tmp_path.glob("*.h5")) == kept
    assert videos_in(tmp_path) == filmed


@pytest.mark.parametrize("way", ["close", "render", "recover"])
def test_a_monitor_that_never_ends_is_left_alone(way, tmp_path):
    """Finishing another monitor's files in the same directory leaves it untouched."""

    def own():
        paths = [p for p in tmp_path.iterdir() if f".{living.infix}." in p.name]
        return {path.name: path.read_bytes() for path in paths}

    living = monitored(make(), tmp_path, workers=0)
    steps(living, 2)
    before = own()
    env = monitored(make(), tmp_path, lambda _: True, resume=True)
    steps(env, 2)
    env.close(wait=way == "close")
    if way == "render":
        assert main(["render", str(tmp_path), "--workers", "1"]) == 0
    if way == "recover":
        assert mjrec.recover(tmp_path).open_monitors == (living.infix,)
    assert len(list(tmp_path.glob("*.mp4"))) == (way != "recover")
    assert env.infix in trajectory_in(tmp_path).path.name
    assert own() == before
    living.step([0.0])
    living.close()
    assert len(list(tmp_path.glob("*.h5"))) == 2


def test_the_same_workers_draw_one_video_after_another(tmp_path):
    """The workers stay until the monitor closes."""
    before, seen = children(), []
    env = make(max_episode_steps=2)
    with monitored(env, tmp_path, lambda _: True, workers=2) as env:
        for number in range(3):
            steps(env, 2)
            wait_until(lambda: len(list(tmp_path.glob("*.meta.json"))) > number)  # noqa: B023  called at once
            [process] = children() - before
            seen.append(children(process))
    assert videos_in(tmp_path) == [0, 1, 2]
    assert len(seen[0]) == 2
    assert seen == [seen[0]] * 3


@pytest.mark.parametrize("way", ["exception", "wait=False", "collector"])
def test_leaving_otherwise_renders_nothing(way, tmp_path, caplog):
    """A message names the pending video, and no child process remains."""
    before = children()
    env = mjrec.Monitor(make(), tmp_path, workers=1)
    if way == "exception":
        with contextlib.suppress(ZeroDivisionError), env:
            steps(env, 2)
            _ = 1 // 0
    else:
        steps(env, 2)
    if way == "wait=False":
        env.close(wait=False)
    del env
    gc.collect()
    assert children() == before
    assert pending_in(tmp_path) == [0]
    assert "1 video pending" in caplog.text
    assert videos_in(tmp_path) == []
    assert len(in_flight(tmp_path)) == 1
    assert len(list(tmp_path.glob("openaigym.model.*.mjb.gz"))) == 1


SCRIPT = """
import sys, gymnasium, mjrec
env = gymnasium.make("InvertedPendulum-v5", height=48, width=64)
env = mjrec.Monitor(env, sys.argv[1], workers=1)
env.reset(seed=0)
env.step([0.0])
"""


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_while_waiting_leaves_the_rest_pending(tmp_path, stuck_encoder):
    """The manifest is written, a message is logged, and the process ends at once."""
    code = SCRIPT + (
        "import os, signal, threading, time\n"
        "def interrupt():\n"
        "    while not os.path.exists(sys.argv[2]): time.sleep(0.01)\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "threading.Thread(target=interrupt).start()\n"
        "env.close()\n"
    )
    done = run_python(code, tmp_path, stuck_encoder, status=-signal.SIGINT)
    assert "1 video pending: mjrec render" in done.stderr
    assert pending_in(tmp_path) == [0]


# Takes more than five seconds: the same video is rendered with one and three workers.
def test_changes_of_the_model_show_and_one_worker_draws_the_bytes_of_three(tmp_path):
    """Color changes show at once, texture changes after `model_changed`."""
    videos = set()
    for workers in (1, 3):
        directory = tmp_path / str(workers)
        env = make("Ant-v5")
        model = env.unwrapped.model
        with mjrec.Monitor(env, directory, workers=workers) as monitor:
            monitor.reset(seed=0)
            monitor.step(np.zeros(8))
            model.tex_data[:] = 255 - model.tex_data
            monitor.model_changed()
            monitor.step(np.zeros(8))
            model.geom_rgba[:] = (0, 1, 0, 1)
            monitor.step(np.zeros(8))
        [video] = directory.glob("*.mp4")
        videos.add(video.read_bytes())
    assert len(videos) == 1
    _, *shown = (frame.astype(int) for frame in frames_in(directory, 0))
    textured, coloured = (np.abs(a - b) for a, b in itertools.pairwise(shown))
    assert textured.mean() > 20
    assert coloured.max() > 60


# Take the state before recording, because Gymnasium itself has loaded glfw.
BESIDE = """
import pathlib, random
import numpy as np
def state():
    maps = pathlib.Path("/proc/self/maps").read_text()
    libraries = "libEGL", "libOSMesa", "libGL.", "libGLX", "libOpenGL", "libglfw"
    loaded = {name.partition(".")[0] for name in sys.modules} & {"OpenGL", "glfw"}
    loaded |= {name for name in libraries if name in maps}
    return loaded, random.getstate(), np.random.get_state()[1].tolist()
before = state()
"""


def test_a_script_without_opengl_and_a_main_guard(tmp_path):
    """OpenGL stays unloaded, the script runs once, and random states stay the same."""
    bare, recorded = SCRIPT.split("env = mjrec")
    script = tmp_path / "script.py"
    (tmp_path / "h5py.py").write_text("raise RuntimeError('not this one')")
    script.write_text(
        f"{bare}{BESIDE}env = mjrec{recorded}env.close()\n"
        "assert state() == before, state()\nprint('once')\n"
    )
    done = subprocess.run(
        [sys.executable, str(script), str(tmp_path / "out")],
        env={**os.environ, "MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
    )
    assert (done.stdout, done.returncode) == ("once\n", 0), done.stderr
    assert len(frames_in(tmp_path / "out", 0)) == 2


def test_without_a_simulation_there_are_actions_and_rewards(tmp_path, make_corridor):
    """Dictionaries become one vector, and the facts list their parts."""
    kinds = {
        "arm": gymnasium.spaces.Box(-1, 1, (2,)),
        "grip": gymnasium.spaces.Box(-1, 1),
    }
    first = {"arm": np.array([1.0, 2.0]), "grip": np.array([3.0])}
    env = make_corridor()
    env.action_space = env.observation_space = gymnasium.spaces.Dict(kinds)
    env._observation = lambda: first
    options = {"trajectory_callable": True, "observations": True}
    with mjrec.Monitor(env, tmp_path, False, **options) as monitor:
        monitor.reset()
        monitor.step(first)
        monitor.step({"arm": np.array([1.0, 2.0, 3.0])})
    recorded = trajectory_in(tmp_path)
    assert recorded.actions.tolist() == [[1, 2, 3], [0, 0, 0]]
    assert recorded.observations.tolist() == [[1, 2, 3]] * 3
    assert recorded.rewards.tolist() == [0.5, 0.5]
    parts = [["arm", [2]], ["grip", [1]]]
    expected = {"action_parts": parts, "observation_parts": parts, "rate": "10"}
    assert recorded.facts.items() >= expected.items()
    assert recorded.facts["irregular_actions_from"] == 1


def test_data_may_be_replaced_and_deleted_and_actions_change_their_dtype(tmp_path):
    """Rows follow the current data and keep the dtypes of the given actions."""
    env = make("HalfCheetah-v5")
    shown = []
    with monitored(env, tmp_path, workers=0) as monitor:
        inner = env.unwrapped
        monitor.reset(seed=0)
        for kind in ("float32", "float32", "float64", "float64"):
            monitor.step(np.full(6, 0.1, kind))
            shown.append(inner.data.qpos.copy())
            inner.data = inner.mujoco_renderer.data = copy.copy(inner.data)
            gc.collect()
        del inner.data, inner.model
        inner.mujoco_renderer.data = inner.mujoco_renderer.model = None
        gc.collect()
    trajectory = trajectory_in(tmp_path)
    # The first column of the states is the time.
    np.testing.assert_array_equal(trajectory.states[1:, 1:10], shown)
    assert trajectory.facts["action_dtypes"] == [[0, "float32"], [2, "float64"]]


class Overlay(gymnasium.Wrapper):
    """Draw a white bar over the frame."""

    def render(self):
        frame = np.array(self.env.render())
        frame[:4] = 255
        return frame


def test_an_overlay_is_recorded_live_and_says_why(tmp_path, caplog):
    """A message names the wrapper while recording, and again while rerendering."""
    caplog.set_level(logging.INFO)
    with mjrec.Monitor(Overlay(make(render_mode="rgb_array")), tmp_path) as env:
        steps(env, 1)
    metadata = metadata_of(tmp_path, 0)
    assert metadata["recording"] == "live"
    assert "Overlay" in metadata["recording_reason"]
    assert "Overlay" in caplog.text
    assert frames_in(tmp_path, 0)[0][0].min() > 240
    caplog.clear()
    [path] = tmp_path.glob("*.h5")
    assert next(mjrec.render(path))[0].max() < 240
    assert "recorded live, because the wrapper" in caplog.text


@pytest.mark.parametrize(
    ("how", "mode", "error"),
    [
        (None, "rgb_array", None),
        ("deferred", "rgb_array", mjrec.PicturesDiffer),
        (None, None, mjrec.NoPictures),
    ],
)
def test_a_plugin_that_draws_is_recorded_live_or_refused(
    how, mode, error, tmp_path, caplog
):
    """States cannot reproduce the plugin's drawing, and one message says so."""
    path = tmp_path / "grid.xml"
    path.write_text(TOUCH_GRID)
    env = MjcfEnvironment(path, render_mode=mode, **SIZE)
    said = "its plugins may draw"
    with (
        mjrec.Monitor(env, tmp_path, render=how, env_id="Touching-v0") as monitor,
        pytest.raises(error, match=said) if error else contextlib.nullcontext(),
    ):
        monitor.reset()
        monitor.step(np.zeros(0))
    assert videos_in(tmp_path) == ([] if error else [0])
    if not error:
        messages = [each for each in caplog.messages if "drawn live" in each]
        assert [said in each for each in messages] == [True]
        metadata = metadata_of(tmp_path, 0)
        assert (metadata["recording"], metadata["pictures"]) == ("live", "env.render")
        assert len(frames_in(tmp_path, 0)) == 2
