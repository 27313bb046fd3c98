# SPDX-License-Identifier: Apache-2.0
"""Monitors that record states and leave the pictures to other processes."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv
from parts import parametrize
from processes import children
from recordings import frames_in, in_flight, manifest_of, metadata_of, videos_in
from touch_grid import TOUCH_GRID

import mjrec

SIZE: dict[str, Any] = {"height": 48, "width": 64}


def make(env_id: str = "InvertedPendulum-v5", **arguments: Any) -> Any:
    """Return a small environment, without a render mode unless one is given."""
    return gymnasium.make(env_id, **SIZE, **arguments)


def steps(env: Any, count: int, *, seed: int = 0) -> None:
    """Reset and take so many steps, or fewer if the episode ends."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(count):
        if any(env.step(env.action_space.sample())[2:4]):
            break


def monitored(env: Any, directory: Path, *positional: Any, **options: Any) -> Any:
    """Return a monitor that takes a reset for the end of an episode."""
    return mjrec.Monitor(env, directory, *positional, allow_early_reset=True, **options)


@pytest.fixture
def pendulum() -> Iterator[Any]:
    """An environment without a render mode."""
    env = make()
    yield env
    env.close()


# --- what is written -----------------------------------------------------------------


def test_close_leaves_a_rendered_directory(pendulum: Any, tmp_path: Path) -> None:
    """Video, hashes, metadata, trajectory, model; no log and no promise."""
    with monitored(pendulum, tmp_path, lambda e: True, workers=1) as env:
        steps(env, 3)
        steps(env, 2, seed=1)
    assert videos_in(tmp_path) == [0, 1]
    assert not list(tmp_path.glob(".*"))
    assert not in_flight(tmp_path)
    assert len(list(tmp_path.glob("*.h5"))) == 2
    assert len(list(tmp_path.glob("openaigym.model.*.mjb.gz"))) == 1
    manifest = manifest_of(tmp_path)
    assert manifest["mjrec"]["pending"] == []
    assert len(manifest["videos"]) == 2
    assert len(frames_in(tmp_path, 0)) == 4
    assert len(frames_in(tmp_path, 1)) == 3


def test_live_recording_takes_the_same_frames(tmp_path: Path) -> None:
    """And says the same of them: 25 steps a second at 10 frames are every third."""
    about = {}
    for render in ("live", "deferred"):
        options: dict[str, Any] = {"max_fps": 10, "render": render, "workers": 1}
        monitor = mjrec.Monitor(
            make(render_mode="rgb_array"), tmp_path / render, **options
        )
        with monitor as env:
            steps(env, 4)
            video = env.video_recorder
            # Under the attribute that gym had.
            assert (video.enabled, video.functional, video.empty) == (True, True, False)
            assert video.frame_count == 3
        assert video.finished
        assert Path(str(video.path)).exists()
        about[render] = metadata_of(tmp_path / render, 0)
    live, later = about["live"], about["deferred"]
    assert live.keys() - {"recording_reason"} <= later.keys()
    assert (live["recording"], later["recording"]) == ("live", "deferred")
    assert (live["pictures"], later["pictures"]) == ("env.render", "scene")
    same = "fps timestep stride frame_count frame_steps height width seed complete"
    same += " decoded_sha256 file_sha256 gl_renderer playback_speed reason"
    assert {k: live[k] for k in same.split()} == {k: later[k] for k in same.split()}
    assert (later["stride"], later["fps"]) == (3, "25/3")
    assert later["frame_steps"] == [[0, 3], [4, 4]]
    assert later["playback_speed"] == 1
    # Closed in mid-episode, which is no part of the statistics.
    assert (later["complete"], later["reason"]) == (False, "close")
    [path] = (tmp_path / "deferred").glob("*.h5")
    assert mjrec.load_trajectory(path).complete is False


# --- pending -------------------------------------------------------------------------


def test_no_workers_leave_the_videos_pending(
    pendulum: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The manifest lists them, one line says how to make them, and that makes them."""
    with monitored(pendulum, tmp_path, lambda e: e < 2, workers=0) as env:
        for seed in range(3):
            steps(env, 2, seed=seed)
    assert videos_in(tmp_path) == []
    pending = manifest_of(tmp_path)["mjrec"]["pending"]
    assert [entry["episode_id"] for entry in pending] == [0, 1]
    assert f"2 videos pending: mjrec render {tmp_path}" in caplog.text
    command = [sys.executable, "-m", "mjrec", "render", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True)
    assert videos_in(tmp_path) == [0, 1]
    assert manifest_of(tmp_path)["mjrec"]["pending"] == []
    assert len(manifest_of(tmp_path)["videos"]) == 2


def leave_by_exception(env: Any) -> None:
    with contextlib.suppress(ZeroDivisionError), env:
        steps(env, 2)
        _ = 1 // 0


def leave_without_waiting(env: Any) -> None:
    steps(env, 2)
    env.close(wait=False)


def leave_to_the_collector(env: Any) -> None:
    steps(env, 2)
    del env
    gc.collect()


LEAVING: dict[str, Callable[[Any], None]] = {
    "exception": leave_by_exception,
    "close(wait=False)": leave_without_waiting,
    "garbage collection": leave_to_the_collector,
}


@pytest.mark.parametrize("leave", LEAVING.values(), ids=LEAVING)
def test_leaving_otherwise_renders_nothing(
    leave: Callable[[Any], None],
    pendulum: Any,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Manifest and journal are there, what was not rendered is pending, no child is."""
    before = children()
    leave(mjrec.Monitor(pendulum, tmp_path, workers=1))
    assert children() == before
    [entry] = manifest_of(tmp_path)["mjrec"]["pending"]
    assert entry["episode_id"] == 0
    assert "1 video pending" in caplog.text
    assert videos_in(tmp_path) == []
    assert len(in_flight(tmp_path)) == 1
    assert len(list(tmp_path.glob("openaigym.model.*.mjb.gz"))) == 1


SCRIPT = """
import sys, gymnasium, mjrec
env = gymnasium.make("InvertedPendulum-v5", height=48, width=64)
env = mjrec.Monitor(env, sys.argv[1], workers=1)
env.reset(seed=0)
env.step(env.action_space.sample())
"""


def run_script(
    code: str, *arguments: object, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run code as `python -`, which has no file to come from."""
    return subprocess.run(
        [sys.executable, "-", *map(str, arguments)],
        input=code,
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        timeout=120,
        check=False,
    )


def test_end_of_the_interpreter_renders_nothing(tmp_path: Path) -> None:
    """One line says what is pending."""
    done = run_script(SCRIPT, tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("1 video pending: mjrec render") == 1
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == 1


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_while_waiting_leaves_the_rest_pending(
    tmp_path: Path, stuck_encoder: Path
) -> None:
    """The manifest is written, the line is said, and the process ends at once."""
    code = SCRIPT + (
        "import os, signal, threading, time\n"
        "def interrupt():\n"
        "    while not os.path.exists(sys.argv[2]): time.sleep(0.01)\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "threading.Thread(target=interrupt).start()\n"
        "env.close()\n"
    )
    done = run_script(code, tmp_path, stuck_encoder)
    assert done.returncode == -signal.SIGINT, done.stderr
    assert "1 video pending: mjrec render" in done.stderr
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == 1


# --- which way -----------------------------------------------------------------------


class Overlay(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Draws something on top."""

    def render(self) -> Any:
        frame = np.array(self.env.render())
        frame[:4] = 255
        return frame


def test_overlay_is_recorded_live_and_says_why(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its pictures do not follow from the state."""
    caplog.set_level(logging.INFO)
    env = mjrec.Monitor(Overlay(make(render_mode="rgb_array")), tmp_path)
    with env:
        steps(env, 1)
    metadata = metadata_of(tmp_path, 0)
    assert metadata["recording"] == "live"
    assert "Overlay" in metadata["recording_reason"]
    assert "Overlay" in caplog.text
    assert frames_in(tmp_path, 0)[0][0].min() > 240


def test_drawing_a_live_recording_again_says_what_is_missing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """What a wrapper painted on top is in no state."""
    with mjrec.Monitor(Overlay(make(render_mode="rgb_array")), tmp_path) as env:
        steps(env, 1)
    [path] = tmp_path.glob("*.h5")
    caplog.clear()
    assert next(mjrec.render(path))[0].max() < 240
    assert "recorded live, because the wrapper" in caplog.text
    assert "Overlay" in caplog.text


def test_deferred_by_force_is_an_error_that_names_the_class(tmp_path: Path) -> None:
    """Nothing is written."""
    env = Overlay(make(render_mode="rgb_array"))
    with pytest.raises(mjrec.PicturesDiffer, match="Overlay"):
        mjrec.Monitor(env, tmp_path / "d", render="deferred")
    assert not (tmp_path / "d").exists()
    env.close()


def test_deferred_by_force_needs_a_simulation(corridor: Any, tmp_path: Path) -> None:
    """There is nothing to defer to without a state."""
    with pytest.raises(mjrec.PicturesDiffer, match="no MuJoCo model"):
        mjrec.Monitor(corridor, tmp_path, render="deferred")


def test_off_writes_trajectories_and_no_videos(pendulum: Any, tmp_path: Path) -> None:
    """Of every episode, in evaluation mode."""
    with monitored(pendulum, tmp_path, render="off", mode="evaluation") as env:
        steps(env, 2)
        steps(env, 2)
    assert len(list(tmp_path.glob("*.h5"))) == 2
    assert not list(tmp_path.glob("*video*"))


@pytest.mark.parametrize("value", ["later", 3, ""])
def test_no_such_way_to_render(value: Any, pendulum: Any, tmp_path: Path) -> None:
    """The message lists them."""
    with pytest.raises(mjrec.InvalidArgument, match="deferred"):
        mjrec.Monitor(pendulum, tmp_path, render=value)


@pytest.mark.parametrize("value", [-1, 1.5, True, "2"])
def test_workers_are_a_number(value: Any, pendulum: Any, tmp_path: Path) -> None:
    """Of processes."""
    with pytest.raises(mjrec.InvalidArgument, match="workers"):
        mjrec.Monitor(pendulum, tmp_path, workers=value)


class Touching(MujocoEnv):
    """A ball on the floor, whose touch a plugin draws."""

    metadata: ClassVar[dict[str, Any]] = {
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 500,
    }

    def __init__(self, path: Path, render_mode: str | None) -> None:
        path.write_text(TOUCH_GRID)
        space = gymnasium.spaces.Box(-np.inf, np.inf, (13,), np.float64)
        super().__init__(
            str(path), 1, observation_space=space, render_mode=render_mode, **SIZE
        )

    def step(self, action: Any) -> Any:
        self.do_simulation(action, 1)
        return self._state(), 0.0, False, False, {}

    def reset_model(self) -> Any:
        self.set_state(self.init_qpos, self.init_qvel)
        return self._state()

    def _state(self) -> Any:
        return np.concatenate([self.data.qpos, self.data.qvel])


def test_plugin_that_draws_is_recorded_live_with_a_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its pictures do not follow from what can be put back."""
    env = Touching(tmp_path / "grid.xml", "rgb_array")
    with mjrec.Monitor(env, tmp_path / "d", env_id="Touching-v0") as monitor:
        monitor.reset()
        monitor.step(np.zeros(0))
    [said] = [r.getMessage() for r in caplog.records if "drawn live" in r.getMessage()]
    assert "mujoco.sensor.touch_grid" in said
    metadata = metadata_of(tmp_path / "d", 0)
    assert metadata["recording"] == "live"
    assert metadata["pictures"] == "env.render"
    assert len(frames_in(tmp_path / "d", 0)) == 2


@pytest.mark.parametrize(
    ("render", "mode", "error"),
    [("deferred", "rgb_array", "PicturesDiffer"), (None, None, "NoPictures")],
)
def test_plugin_that_draws_and_no_way_to_record_it(
    render: Any, mode: Any, error: str, tmp_path: Path
) -> None:
    """One clear error at the first reset, instead of unchecked pictures."""
    env = Touching(tmp_path / "grid.xml", mode)
    directory = tmp_path / "d"
    monitor = mjrec.Monitor(env, directory, render=render, env_id="Touching-v0")
    with pytest.raises(getattr(mjrec, error), match="touch_grid"):
        monitor.reset()
    monitor.close()
    assert videos_in(directory) == []


# --- which trajectories --------------------------------------------------------------


def trajectories(directory: Path) -> list[str]:
    return sorted(path.name.split(".")[-2] for path in directory.glob("*.h5"))


@parametrize(
    ("options", "kept"),
    [
        ({}, [0, 1]),
        ({"mode": "evaluation"}, [0, 1, 2]),
        ({"trajectory_callable": True}, [0, 1, 2]),
        ({"trajectory_callable": lambda episode: episode == 2}, [2]),
        ({"trajectory_callable": False}, []),
    ],
)
def test_which_trajectories_are_kept(
    options: dict[str, Any], kept: list[int], pendulum: Any, tmp_path: Path
) -> None:
    """The videos' own are removed once the videos are there, if they are not wanted."""
    with monitored(pendulum, tmp_path, workers=1, **options) as env:
        for seed in range(3):
            steps(env, 1, seed=seed)
    assert trajectories(tmp_path) == [f"episode{number:06d}" for number in kept]
    assert videos_in(tmp_path) == [0, 1]


def test_observations_are_recorded_where_asked_for(
    pendulum: Any, tmp_path: Path
) -> None:
    """One more than there are steps."""
    with mjrec.Monitor(pendulum, tmp_path, workers=0, observations=True) as env:
        first, _ = env.reset(seed=0)
        second = env.step(env.action_space.sample())[0]
    [path] = tmp_path.glob("*.h5")
    recorded = mjrec.load_trajectory(path).observations
    np.testing.assert_array_equal(recorded, [first, second])


# --- frames --------------------------------------------------------------------------


# Takes more than five seconds: the same video by several numbers of workers.
def test_video_is_the_same_bytes_whoever_draws_it(tmp_path: Path) -> None:
    """One worker or three."""
    hashes = set()
    for workers in (1, 3):
        directory = tmp_path / str(workers)
        with mjrec.Monitor(make("Hopper-v5"), directory, workers=workers) as env:
            steps(env, 8)
        [video] = directory.glob("*.mp4")
        hashes.add(hashlib.sha256(video.read_bytes()).hexdigest())
        hashes.add(metadata_of(directory, 0)["file_sha256"])
    assert len(hashes) == 1


def test_changed_texture_shows_after_model_changed(tmp_path: Path) -> None:
    """From the next frame on, as with a renderer that uploads it."""
    env = make("Ant-v5")
    with mjrec.Monitor(env, tmp_path, workers=1) as monitored:
        monitored.reset(seed=0)
        monitored.step(np.zeros(8))
        env.unwrapped.model.tex_data[:] = 255 - env.unwrapped.model.tex_data
        monitored.model_changed()
        monitored.step(np.zeros(8))
    _, before, after = frames_in(tmp_path, 0)
    assert np.abs(before.astype(int) - after).mean() > 20


def test_reset_before_any_step_replaces_the_trajectory(
    pendulum: Any, tmp_path: Path
) -> None:
    """It keeps its number."""
    with mjrec.Monitor(pendulum, tmp_path, workers=0) as env:
        env.reset(seed=1)
        env.reset(seed=2)
        env.step(np.zeros(1))
    [path] = tmp_path.glob("*.h5")
    trajectory = mjrec.load_trajectory(path)
    assert (trajectory.seed, trajectory.episode_id) == (2, 0)


# --- the simulation is left alone ----------------------------------------------------


# What Gymnasium itself has loaded (glfw) is there before.
OPENGL = """
import pathlib
def opengl():
    maps = pathlib.Path("/proc/self/maps").read_text()
    libraries = "libEGL", "libOSMesa", "libGL.", "libGLX", "libOpenGL", "libglfw"
    loaded = {name.partition(".")[0] for name in sys.modules} & {"OpenGL", "glfw"}
    return loaded | {name for name in libraries if name in maps}
"""


def test_no_opengl_in_the_simulation(tmp_path: Path) -> None:
    """A process in which MuJoCo has none records all the same, and loads none."""
    bare, recorded = SCRIPT.split("env = mjrec")
    code = (
        f"{bare}{OPENGL}before = opengl()\nenv = mjrec{recorded}env.close()\n"
        "print(sorted(opengl() - before))"
    )
    done = run_script(code, tmp_path, MUJOCO_GL="disable")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "[]\n"
    assert len(frames_in(tmp_path, 0)) == 2


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Humanoid-v5"])
def test_recording_does_not_disturb(env_id: str, tmp_path: Path) -> None:
    """Observations, rewards, states and random numbers are bit for bit the same."""

    def run(env: Any) -> list[Any]:
        seen = []
        for seed in (3, None):
            seen.append(env.reset(seed=seed)[0])
            env.action_space.seed(1)
            for _ in range(5):
                observation, reward, *_ = env.step(env.action_space.sample())
                seen += [observation, reward, env.unwrapped.data.qacc_warmstart.copy()]
        return [np.asarray(value).tobytes() for value in seen]

    assert run(make(env_id)) == run(monitored(make(env_id), tmp_path, workers=0))


@pytest.mark.thorough
def test_global_random_state_is_left_alone(tmp_path: Path) -> None:
    """Python's and NumPy's, also where a library is loaded for the first time."""
    code = (
        "import random, sys, gymnasium, numpy as np, mjrec\n"
        "env = gymnasium.make('InvertedPendulum-v5', height=48, width=64)\n"
        "def state(): return random.getstate(), np.random.get_state()[1].tolist()\n"
        "before = state()\n"
        "env = mjrec.Monitor(env, sys.argv[1], workers=1)\n"
        "env.reset(seed=0); env.step([0.0]); env.close()\n"
        "assert state() == before\n"
    )
    done = run_script(code, tmp_path)
    assert done.returncode == 0, done.stderr


# --- where monitors live -------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_forked_child_is_told_and_does_not_hang(pendulum: Any, tmp_path: Path) -> None:
    """The monitor belongs to the process that made it."""
    with mjrec.Monitor(pendulum, tmp_path, workers=1) as env:
        steps(env, 1)
        pid = os.fork()
        if pid == 0:
            try:
                env.step(np.zeros(1))
            except mjrec.Error as error:
                (tmp_path / "told.json").write_text(json.dumps(str(error)))
            os._exit(0)
        assert os.waitpid(pid, 0)[1] == 0
    assert "forked" in json.loads((tmp_path / "told.json").read_text())
    assert videos_in(tmp_path) == [0]
