# SPDX-License-Identifier: Apache-2.0
"""Record short honest runs, with one function for each kind of run."""

import contextlib
import os
import signal

import gymnasium
import numpy as np
import pytest
from full_disk import file_size_limit
from processes import kill_children
from waiting import wait_until

import mjrec
from mjrec.environments.mjcf_environments import MjcfEnvironment
from mjrec.trackers import Tracker

_SMALL = {"render_mode": "rgb_array", "width": 32, "height": 32}
_POLE, _CHEETAH = "InvertedPendulum-v5", "HalfCheetah-v5"
_PUSH = np.full(1, 0.1, np.float32)

_ROBOT = """
<mujoco>
  <visual><global offwidth="64" offheight="64"/></visual>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="pole" pos="0 0 1">
      <joint name="hinge" type="hinge" axis="0 1 0"/>
      <geom name="rod" type="capsule" size=".05" fromto="0 0 0 0 0 .6" rgba="1 0 0 1"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="hinge" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


def play(env, episodes, *, seed=lambda episode: episode, most=20, kind=np.float32):
    """Play episodes with random actions, and close the environment."""
    generator, space = np.random.default_rng(5), env.action_space
    with contextlib.closing(env):
        for episode in range(episodes):
            env.reset(seed=seed(episode))
            for _ in range(most):
                action = 0.9 * generator.uniform(space.low, space.high)
                _, _, terminated, truncated, _ = env.step(action.astype(kind))
                if terminated or truncated:
                    break


def _made(env_id=_POLE, longest=5, **options):
    return gymnasium.make(env_id, max_episode_steps=longest, **{**_SMALL, **options})


def _monitored(env, directory, **options):
    usual = {"mode": "evaluation", "workers": 1}
    return mjrec.Monitor(env, directory, **{**usual, **options})


def pendulum(directory, episodes=4, *, longest=5, make=(), **options):
    """Record evaluation episodes that end in a fall or after five steps."""
    env = _made(longest=longest, **dict(make))
    play(_monitored(env, directory, **{"uid": "u", **options}), episodes)


def cheetah(directory, **options):
    """Record an environment that never falls, and seed only the first reset."""
    monitor = _monitored(_made(_CHEETAH, 4), directory, **options)
    play(monitor, 3, seed=lambda episode: None if episode else 7)


def large(directory):
    """Record videos that make up most of an archive."""
    play(_monitored(_made(_CHEETAH, 4, height=480, width=640), directory), 2)


def suite(directory):
    """Record a task from the dm_control suite."""
    tasks = pytest.importorskip("dm_control.suite")
    given = {"random": 3, "time_limit": 0.04}
    env = tasks.load("cartpole", "balance", task_kwargs=given)
    options = {"env_id": "dm_control/cartpole-balance", "width": 32, "height": 32}
    generator = np.random.default_rng(3)
    with contextlib.closing(_monitored(env, directory, **options)) as monitor:
        for _ in range(2):
            monitor.reset()
            for _ in range(4):
                monitor.step(generator.uniform(-1, 1, monitor.action_spec().shape))


def vector(directory):
    """Record a vector of two environments that reset themselves."""
    options = {"vectorization_mode": "sync", "max_episode_steps": 4, **_SMALL}
    monitor = _monitored(gymnasium.make_vec(_POLE, 2, **options), directory)
    monitor.reset(seed=3)
    for _ in range(12):
        monitor.step(np.zeros(monitor.action_space.shape, np.float32))
    monitor.close()


def evaluated(directory, **options):
    """Evaluate in several chunks, and choose videos among all episodes."""
    given = {"policy": "random", "num_seeds": 3, "keep": "best,failures"}
    given |= {"max_steps": 4, "height": 32, "width": 32, "workers": 1, **options}
    mjrec.evaluate([_POLE], directory=directory, episodes=1, **given)


def _die(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def _raise(*_):
    raise ValueError("it is on the right")


def _evaluated_until_right(directory, end):
    def policy(observation):
        if observation[0] > 0:
            end()
        return np.zeros(1, np.float32)

    evaluated(directory, policy=policy)


def evaluated_in_part(directory):
    """Evaluate a policy that sometimes raises."""
    _evaluated_until_right(directory, _raise)


def evaluated_to_death(directory):
    """Evaluate a policy that sometimes kills its process."""
    _evaluated_until_right(directory, _die)


def evaluated_again(directory):
    """Evaluate a policy that kills its process at its seventh action."""
    calls = []

    def policy(observation):
        calls.append(observation)
        if len(calls) == 7:
            _die()
        return np.zeros(1, np.float32)

    evaluated(directory, policy=policy)


def extended(directory):
    """Evaluate one seed, then resume with a second one."""
    evaluated(directory, num_seeds=1)
    evaluated(directory, num_seeds=2, resume=True)


def clips(directory):
    """Record clips of four steps that span episodes."""
    pendulum(directory, step_trigger=lambda step: step % 6 == 0, video_length=4)


def kept(directory, *, rule="worst:1"):
    """Record one video, chosen after all episodes have ended."""
    pendulum(directory, episodes=5, longest=9, keep=rule)


def kept_in_training(directory):
    """Record like `mjrec record --keep`, which keeps no actions of other episodes."""
    pendulum(directory, episodes=4, longest=9, keep="best:1", mode="training")


def live(directory):
    """Record frames from `env.render()`."""
    pendulum(directory, episodes=2, render="live")


def several(directory):
    """Record two monitors in one directory."""
    pendulum(directory, episodes=2)
    pendulum(directory, episodes=2, uid="v", resume="join")


def resumed(directory):
    """Resume a recording with a second monitor."""
    pendulum(directory, episodes=2)
    pendulum(directory, episodes=2, resume=True)


def killed(directory):
    """Kill the process during its third episode, then finish its recording."""
    child = os.fork()
    if child == 0:
        monitor = _monitored(_made(), directory, uid="u")
        for episode, steps in enumerate((5, 5, 2)):
            monitor.reset(seed=episode)
            for _ in range(steps):
                monitor.step(_PUSH)
        _die()
    os.waitpid(child, 0)
    # A rendering worker may outlive the killed process.
    mjrec.recover(directory, timeout=60)
    mjrec.render_videos(directory)


def unseeded(directory):
    """Record episodes without a seed."""
    play(_monitored(_made(), directory), 2, seed=lambda _: None)


def early(directory):
    """Record an episode that a reset ends early."""
    play(_monitored(_made(longest=9), directory, allow_early_reset=True), 3, most=2)


def wrapped(directory):
    """Record with a Gymnasium wrapper between the monitor and the environment."""
    env = _made(_CHEETAH, 4)
    env = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    play(_monitored(env, directory), 2)


def wrapped_in_code(directory):
    """Record with a wrapper whose code is not available to readers."""
    env = gymnasium.wrappers.TransformReward(_made(_CHEETAH, 4), lambda r: 2 * r)
    play(_monitored(env, directory), 2)


class _Away(Tracker):
    def episode(self, *_):
        raise ConnectionError("the server is away")


def tracker_away(directory):
    """Keep recording after a tracker raises."""
    pendulum(directory, episodes=3, trackers=_Away())


def _undecided(episode):
    if episode == 1:
        raise ValueError("no idea")
    return True


def schedule_raises(directory):
    """Keep recording after the schedule raises for the second of three episodes."""
    pendulum(directory, episodes=3, video_callable=_undecided, on_error="warn")


def trigger_raises(directory):
    """Keep recording after the clip trigger raises."""
    clips = {"step_trigger": _undecided, "video_length": 3}
    pendulum(directory, episodes=2, on_error="warn", **clips)


def encoder_killed(directory):
    """Keep recording after the live encoder is killed in the second episode."""
    with _monitored(_made(), directory, render="live", on_error="warn") as monitor:
        for episode in range(2):
            monitor.reset(seed=episode)
            for step in range(5):
                if (episode, step) == (1, 2):
                    kill_children("ffmpeg")
                monitor.step(_PUSH)


def frame_missing(directory):
    """Keep recording after `render` raises in the second episode of a live video."""
    env = _made()
    draw, drawn = env.unwrapped.render, iter([*range(5), None])

    def render():
        if next(drawn, 0) is None:
            raise RuntimeError("the window is gone")
        return draw()

    vars(env.unwrapped)["render"] = render
    play(_monitored(env, directory, render="live", on_error="warn"), 2)


def _on_a_full_disk(directory, longest, full, **options):
    """Record three episodes with the disk full during some steps of the second one.

    Step -1 is the reset.
    """
    env, generator = _made(_CHEETAH, longest), np.random.default_rng(5)
    with _monitored(env, directory, on_error="warn", **options) as monitor:
        for episode in range(3):
            with contextlib.ExitStack() as limits:
                for step in range(-1, longest):
                    if (episode, step) == (1, full.start):
                        # A background thread must store the model while there is room.
                        wait_until(lambda: list(directory.glob("*.mjb.gz")))
                        limits.enter_context(file_size_limit(200))
                    if (episode, step) == (1, full.stop):
                        limits.close()
                    if step < 0:
                        monitor.reset(seed=episode)
                    else:
                        monitor.step(generator.uniform(-1, 1, 6).astype(np.float32))


def trajectory_lost(directory):
    """Keep recording while the disk is full for the whole second episode."""
    _on_a_full_disk(directory, 4, range(-1, 4))


def end_lost(directory):
    """Record an episode that loses its rows from the middle on."""
    _on_a_full_disk(directory, 200, range(2, 198), max_fps=1)


def end_written_late(directory):
    """Keep recording after the disk was full at the last step of an episode."""
    _on_a_full_disk(directory, 4, range(3, 4))


def text(directory):
    """Record an environment that renders text."""
    env = gymnasium.make("Taxi-v4", render_mode="ansi", max_episode_steps=3)
    with _monitored(env, directory) as monitor:
        for seed in range(2):
            monitor.reset(seed=seed)
            for action in (0, 1, 2):
                monitor.step(action)


def mjcf(directory):
    """Record the environment of an MJCF file."""
    path = directory.with_name("robot.xml")
    path.write_text(_ROBOT)
    env = gymnasium.wrappers.TimeLimit(MjcfEnvironment(path, width=32, height=32), 4)
    play(_monitored(env, directory), 2)


def training(directory):
    """Record a training run, which keeps actions only for scheduled episodes."""
    pendulum(directory, episodes=4, mode="training")


def doubles(directory):
    """Record float64 actions."""
    play(_monitored(_made(_CHEETAH, 4), directory), 2, kind=np.float64)


def views(directory):
    """Record observations, and use another camera, size and rate."""
    options = {"width": 48, "height": 32, "max_fps": 10, "observations": True}
    options["camera"] = [{"azimuth": 70.0, "distance": 3.0}, "track", -1]
    options["video_callable"] = lambda episode: episode == 1
    play(_monitored(_made(_CHEETAH, 6), directory, **options), 2)
