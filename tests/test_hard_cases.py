# SPDX-License-Identifier: Apache-2.0
"""Recordings survive difficult environments and users, checked from outside.

Each case is recorded as a user would, and the rendered frames are compared with
those of the environment.
"""

import hashlib
import os
import shutil

import gymnasium
import mujoco
import numpy as np
import pytest
from compiled_tasks import growing
from other_python import run_python
from recordings import events_of, hashes_at
from robots import robots_that_reset

import mjrec
from mjrec.commands import main
from mjrec.formats.monitor_directory import infix_of

SIZE = {"height": 32, "width": 48}


class Around(gymnasium.Wrapper):
    """Run a function before every step, and another on its result."""

    def __init__(self, env, before=lambda *_: None, after=lambda _, result: result):
        super().__init__(env)
        self.before, self.after, self.steps = before, after, 0

    def step(self, action):
        self.steps += 1
        self.before(self.steps, self.env.unwrapped)
        return self.after(self.steps, self.env.step(action))


def pendulum(length=5, **more):
    """Return a small environment whose episodes have `length` steps."""
    made = {"max_episode_steps": length, "render_mode": "rgb_array", **SIZE, **more}
    return gymnasium.make("InvertedPendulum-v5", **made)


def play(env, steps, *, seen=None):
    """Take steps with small actions, and reset after each episode."""
    is_over = True
    for number in range(steps):
        if is_over:
            env.reset(seed=number)
            _see(env, seen)
        action = np.full(env.action_space.shape, 0.1 * (number % 3 - 1), np.float32)
        *_, terminated, truncated, _ = env.step(action)
        is_over = terminated or truncated
        _see(env, seen)


def _see(env, seen):
    if seen is not None:
        seen.append(hashlib.sha256(env.render().tobytes()).hexdigest())


def hashes(directory):
    """Return the hashes of all frames, with the videos sorted by name."""
    return [
        h for path in sorted(directory.glob("*.framehash")) for h in hashes_at(path)
    ]


def trajectories(directory):
    for path in sorted(directory.glob("*.h5")):
        yield mjrec.load_trajectory(path)


def paint(number, env):
    """Change colors, like environments that show touch sensors."""
    env.model.geom_rgba[:, 0] = number % 5 / 4


def grow(number, env):
    """Change fields that affect shadows and fields that require a new context."""
    env.model.stat.extent *= 1.2
    env.model.vis.rgba.fog[:3] = number // 4 / 4


@pytest.mark.parametrize(
    ("env_id", "before", "workers"),
    [
        ("InvertedPendulum-v5", paint, 1),
        ("HalfCheetah-v5", grow, 1),
        ("HalfCheetah-v5", grow, 2),
    ],
)
def test_a_model_that_changes_at_every_step(tmp_path, env_id, before, workers):
    """Each frame shows the model at its step, whichever worker renders it."""
    made = {"max_episode_steps": 5, "render_mode": "rgb_array", **SIZE}
    env = Around(gymnasium.make(env_id, **made), before=before)
    seen = []
    with mjrec.Monitor(env, tmp_path, lambda _: True, workers=workers) as monitor:
        play(monitor, 10, seen=seen)
    assert len(set(seen)) > 5
    assert hashes(tmp_path) == seen


@pytest.mark.dm_control
@pytest.mark.parametrize("is_older", [False, True])
def test_another_renderer_is_closed_between_live_frames(is_older, tmp_path):
    """All frames are rendered although closing the other renderer changes contexts."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    options = {"video_callable": lambda _: True, "render": "live", **SIZE}
    drawn = []
    for way in ("alone", "beside"):
        with mjrec.Monitor(growing(), tmp_path / way, **options) as env:
            other = mujoco.Renderer(model, 8, 8) if is_older else None
            timestep = env.reset()
            while not timestep.last():
                if way == "beside":
                    (other or mujoco.Renderer(model, 8, 8)).close()
                timestep = env.step(np.zeros(env.action_spec().shape))
            drawn.append([env.physics.render(**SIZE).tobytes()])
        drawn[-1] += hashes(tmp_path / way)
    assert drawn[0] == drawn[1]


def test_an_environment_that_moves_things_while_it_draws(tmp_path):
    """Fetch moves its target in `_render_callback` without affecting the simulation."""
    pytest.importorskip("gymnasium_robotics")
    made = {"max_episode_steps": 5, "render_mode": "rgb_array", **SIZE}
    options = {"max_fps": 10, "workers": 1}
    for way in ("live", "deferred"):
        with robots_that_reset():
            env = gymnasium.make("FetchReach-v4", **made)
            with mjrec.Monitor(env, tmp_path / way, render=way, **options) as env:
                play(env, 5)
    assert hashes(tmp_path / "live") == hashes(tmp_path / "deferred")
    [trajectory] = trajectories(tmp_path / "deferred")
    assert trajectory.frame_steps.tolist() == [0, 3, 5]


def test_large_observations_and_actions_that_change(tmp_path):
    """Steps return 300 KiB observations, and one action has a different shape."""
    env = Around(
        pendulum(9),
        after=lambda number, result: (
            np.full((300, 1024), number, np.uint8),
            *result[1:],
        ),
    )
    env.reset = lambda **options: (
        np.zeros((300, 1024), np.uint8),
        env.env.reset(**options)[1],
    )
    options = {"trajectory_callable": True, "observations": True}
    with mjrec.Monitor(env, tmp_path, False, **options) as monitor:
        monitor.reset(seed=1)
        for number in range(9):
            action = np.full((1, 1) if number == 4 else (1,), 0.1, np.float32)
            env.before = lambda *_, a=action: a.resize((1,), refcheck=False)
            monitor.step(action)
    [trajectory] = trajectories(tmp_path)
    assert (trajectory.observations[:, 0, 0] == np.arange(10)).all()
    given = np.full((9, 1), np.float32(0.1))
    given[4] = 0
    np.testing.assert_array_equal(trajectory.actions, given)
    assert trajectory.facts["irregular_actions_from"] == 4
    assert trajectory.facts["action_dtypes"] == [[0, "float32"]]
    odd = {"value": [[float(np.float32(0.1))]], "dtype": "float32"}
    said = {"episode_id": 0, "step": 4, **odd}
    assert events_of(tmp_path, "action") == [said]


@pytest.mark.skipif(
    not hasattr(gymnasium.vector, "AutoresetMode"),
    reason="Gymnasium before 1.1 has one mode only",
)
def test_a_state_that_is_reset_away_is_not_shown(tmp_path):
    """If an environment resets inside its last step, the terminal frame is left out."""
    vector = gymnasium.vector.SyncVectorEnv(
        [pendulum], autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP
    )
    with mjrec.Monitor(vector, tmp_path, lambda _: True, workers=1) as env:
        env.reset(seed=1)
        for _ in range(5):
            env.step(np.zeros((1, 1), np.float32))
    first = next(trajectories(tmp_path))
    assert len(first.actions) == 5
    is_known = ~np.isnan(first.states).any(axis=1)
    assert len(first.frame_steps) == is_known.sum()


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_fork_in_mid_episode(tmp_path):
    """The child cannot write to its parent's recording and exits normally."""
    with mjrec.Monitor(pendulum(), tmp_path, lambda _: True, workers=0) as env:
        env.reset(seed=0)
        env.step(np.zeros(1, np.float32))
        child = os.fork()
        if child == 0:
            try:
                env.step(np.zeros(1, np.float32))
            except mjrec.Error:
                os._exit(5)
            os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 5
        for _ in range(4):
            env.step(np.zeros(1, np.float32))
    mjrec.render_videos(tmp_path)
    assert len(hashes(tmp_path)) == 6


FORK = """
import os, sys, gymnasium, mjrec
env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=5, height=32, width=48)
env = mjrec.Monitor(env, sys.argv[1], lambda _: True, workers=1)
env.reset(seed=0)
env.step([0.0])
if child := os.fork():
    assert os.waitpid(child, 0)[1] == 0
    for _ in range(4):
        env.step([0.0])
    env.close()
else:
    exec(sys.argv[2])
"""


@pytest.mark.parametrize("ending", ["pass", "sys.exit()", "os._exit(0)"])
def test_a_forked_child_that_ends_leaves_its_parents_recording_alone(ending, tmp_path):
    """The rendering process survives too, and the child has no files of its own."""
    done = run_python(FORK, tmp_path, ending)
    assert "gone" not in done.stderr
    assert len(hashes(tmp_path)) == 6
    [trajectory] = trajectories(tmp_path)
    assert (trajectory.facts["complete"], len(trajectory.rewards)) == (True, 5)
    assert events_of(tmp_path, "cut") == []
    assert len(events_of(tmp_path, "closed")) == 1
    infixes = {infix_of(path.name) for path in tmp_path.iterdir()}
    assert len(infixes - {None}) == 1
    assert not list(tmp_path.glob(".*"))


def test_a_run_that_another_machine_renders(tmp_path, monkeypatch):
    """`close(wait=False)` renders nothing, and a copy can be rendered elsewhere."""
    seen = []
    env = mjrec.Monitor(pendulum(), tmp_path / "here", lambda _: True, workers=0)
    play(env, 10, seen=seen)
    env.close(wait=False)
    assert not list((tmp_path / "here").glob("*.mp4"))
    shutil.copytree(tmp_path / "here", tmp_path / "there")
    # The other user has not stored this model.
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert main(["render", str(tmp_path / "there"), "--workers", "1"]) == 0
    assert hashes(tmp_path / "there") == seen


MILLION = """
import resource, sys, gymnasium, mjrec, numpy
env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=10**7)
env = mjrec.Monitor(env, sys.argv[1], False, trajectory_callable=True)
start, action = (env.unwrapped.init_qpos, env.unwrapped.init_qvel), numpy.zeros(1)
env.reset(seed=0)
for step in range(int(sys.argv[2])):
    if step % 10 == 0:
        env.unwrapped.set_state(*start)
    env.step(action)
env.close()
for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
    print(resource.getrusage(whose).ru_maxrss)
"""


# Takes more than five seconds: a million steps.
@pytest.mark.thorough
def test_an_episode_of_a_million_steps_needs_no_more_memory(tmp_path):
    """The recorder's memory stays constant; its child uses a few bytes per step."""
    few, many = (
        run_python(MILLION, tmp_path / str(steps), steps, timeout=900).stdout.split()
        for steps in (10_000, 1_000_000)
    )
    here, child = (int(b) - int(a) for a, b in zip(few, many, strict=True))
    assert (here < 32 << 10, child < 48 << 10) == (True, True), (few, many)
