# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures: the OpenGL backend, small environments and helpers."""

import gc
import importlib.util
import os
import signal

# mujoco reads this variable once, when it is imported.
os.environ.setdefault("MUJOCO_GL", "egl")

from pathlib import Path
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
from packed_runs import record_pendulum
from processes import children, kill_children
from trajectories_by_hand import Painter

from mjrec.commands import main
from mjrec.formats.ffmpeg import ffmpeg_executable
from mjrec.rendering import finish

_HAS_DM_CONTROL = importlib.util.find_spec("dm_control") is not None

# These tests run only in an environment with Stable-Baselines3.
collect_ignore = ["test_stable_baselines3.py"]
if importlib.util.find_spec("stable_baselines3"):
    collect_ignore.clear()


@pytest.fixture(scope="session", autouse=True)
def own_state_home(tmp_path_factory):
    """Keep lists of models and caches out of the home directory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def default_signals():
    """Start child processes with the default handling of SIGINT and SIGHUP.

    Otherwise, a child started under `nohup` or in a background job ignores both.
    """
    earlier = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if earlier[signal.SIGHUP] is signal.SIG_IGN:
        # Unlike an ignored signal, a handler is not inherited by children.
        signal.signal(signal.SIGHUP, lambda *_: None)
    yield
    for signum, handler in earlier.items():
        signal.signal(signum, handler)


def pytest_report_header():
    return [f"MUJOCO_GL={os.environ['MUJOCO_GL']}", f"dm_control: {_HAS_DM_CONTROL}"]


class Corridor(gymnasium.Env):
    """An environment without a simulator whose frames show its position as a bar."""

    metadata: ClassVar = {
        "render_modes": ["rgb_array", "ansi", "rgb_array_list"],
        "render_fps": 10,
    }
    observation_space = gymnasium.spaces.Box(0, 1000, (1,), np.float64)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, length=3, render_mode="rgb_array", size=(32, 48)):
        self.length = length
        self.render_mode = render_mode
        self.size = size
        self.position = self.closed = self.rendered = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = 0
        return self._observation(), {}

    def step(self, action):
        self.position += 1
        return self._observation(), 0.5, self.position >= self.length, False, {}

    def render(self):
        self.rendered += 1
        if self.render_mode == "ansi":
            return "." * self.position + "o\n"
        frame = np.zeros((*self.size, 3), np.uint8)
        frame[:, : 4 * self.position + 4] = (200, 40, 10)
        return [frame] if self.render_mode == "rgb_array_list" else frame

    def close(self):
        self.closed += 1

    def _observation(self):
        return np.array([self.position], np.float64)


@pytest.fixture(autouse=True)
def free_dm_control_scenes(request):
    """Free dm_control's OpenGL contexts on the thread that made them.

    The environments are cyclic garbage. If another thread collects them during a
    later test, dm_control fails, because this thread holds the context.
    """
    yield
    if request.node.get_closest_marker("dm_control"):
        gc.collect()


@pytest.fixture(scope="session")
def pendulums(tmp_path_factory):
    """Return a function that records pendulums once per session for read-only use."""
    made = {}

    def recorded(episodes, **options):
        key = f"{episodes} {sorted(options.items())}"
        if key not in made:
            directory = tmp_path_factory.mktemp("pendulum") / "recorded"
            record_pendulum(directory, episodes, **options)
            made[key] = directory
        return made[key]

    return recorded


@pytest.fixture
def corridor():
    """Return an environment with episodes of three steps and 48x32 frames."""
    return Corridor()


@pytest.fixture
def make_corridor():
    """Return the `Corridor` class."""
    return Corridor


def run_episodes(env, count, *, seed=None):
    for _ in range(count):
        env.reset(seed=seed)
        done = False
        while not done:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            done = terminated or truncated


@pytest.fixture
def play():
    return run_episodes


@pytest.fixture
def command(capsys):
    """Return a function that runs `mjrec`, checks its status and returns its output."""

    def run(*arguments, status=0):
        assert main([*map(str, arguments)]) == status
        return capsys.readouterr()

    return run


@pytest.fixture
def kill_ffmpeg():
    """Return a function that kills this process's encoders."""
    return lambda: kill_children("ffmpeg")


@pytest.fixture
def no_process_is_left():
    """Check that a test leaves no process behind, not even a zombie."""
    before = children()
    yield
    gc.collect()
    assert children() <= before


@pytest.fixture
def stuck_encoder(tmp_path_factory, monkeypatch):
    """Make encoders hang; the returned file appears when one has started."""
    begun = tmp_path_factory.mktemp("encoder") / "begun"
    program = begun.with_name("ffmpeg")
    program.write_text(
        f'#!/bin/sh\ncase "$*" in *libx264*) touch {begun}; exec sleep 60;; esac\n'
        f'exec "{ffmpeg_executable()}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    return begun


@pytest.fixture
def painter(monkeypatch):
    """Render without processes or OpenGL, but encode with the real encoder."""
    painter = Painter()
    monkeypatch.setattr(finish, "WorkerPool", lambda count, **rest: painter)
    return painter


@pytest.fixture
def names():
    """Return a function that lists a directory's file names in sorted order."""
    return lambda directory: sorted(p.name for p in Path(directory).iterdir())


@pytest.fixture
def halfcheetah():
    """Return a HalfCheetah-v5 that renders small frames."""
    env = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array", width=64, height=48)
    yield env
    env.close()
