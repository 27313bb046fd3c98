# SPDX-License-Identifier: Apache-2.0
"""Monitor directories of short honest runs, one function for each kind of run."""

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
    """Record evaluated episodes that end by a fall or after five steps."""
    env = _made(longest=longest, **dict(make))
    play(_monitored(env, directory, **{"uid": "u", **options}), episodes)


def cheetah(directory, **options):
    """Record an environment that never falls, with one seed at the first reset."""
    monitor = _monitored(_made(_CHEETAH, 4), directory, **options)
    play(monitor, 3, seed=lambda episode: None if episode else 7)


def large(directory):
    """Record videos that are most of an archive."""
    play(_monitored(_made(_CHEETAH, 4, height=480, width=640), directory), 2)


def suite(directory):
    """Record a task of dm_control's suite."""
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
    """Record one of two environments that reset themselves."""
    options = {"vectorization_mode": "sync", "max_episode_steps": 4, **_SMALL}
    monitor = _monitored(gymnasium.make_vec(_POLE, 2, **options), directory)
    monitor.reset(seed=3)
    for _ in range(12):
        monitor.step(np.zeros(monitor.action_space.shape, np.float32))
    monitor.close()


def evaluated(directory, **options):
    """Evaluate episodes in several chunks, whose videos are chosen among all."""
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
    """Evaluate a policy that raises in some episodes."""
    _evaluated_until_right(directory, _raise)


def evaluated_to_death(directory):
    """Evaluate a policy that kills its process in some episodes."""
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
    """Evaluate one seed, and later one more."""
    evaluated(directory, num_seeds=1)
    evaluated(directory, num_seeds=2, resume=True)


def clips(directory):
    """Record clips of four steps, which cross episodes."""
    pendulum(directory, step_trigger=lambda step: step % 6 == 0, video_length=4)


def kept(directory, *, rule="worst:1"):
    """Record the video of one episode, chosen when all had ended."""
    pendulum(directory, episodes=5, longest=9, keep=rule)


def kept_in_training(directory):
    """Record as `mjrec record --keep` does, which keeps no actions of other videos."""
    pendulum(directory, episodes=4, longest=9, keep="best:1", mode="training")


def live(directory):
    """Record frames of `env.render()` itself."""
    pendulum(directory, episodes=2, render="live")


def several(directory):
    """Record two monitors in one directory."""
    pendulum(directory, episodes=2)
    pendulum(directory, episodes=2, uid="v", resume="join")


def resumed(directory):
    """Record on in a second monitor, where the first one stopped."""
    pendulum(directory, episodes=2)
    pendulum(directory, episodes=2, resume=True)


def killed(directory):
    """Record in a process that is killed in its third episode, and finish that."""
    child = os.fork()
    if child == 0:
        monitor = _monitored(_made(), directory, uid="u")
        for episode, steps in enumerate((5, 5, 2)):
            monitor.reset(seed=episode)
            for _ in range(steps):
                monitor.step(_PUSH)
        _die()
    os.waitpid(child, 0)
    # The worker of the killed process may still be drawing.
    mjrec.recover(directory, timeout=60)
    mjrec.render_videos(directory)


def unseeded(directory):
    """Record episodes whose beginning nothing leads to."""
    play(_monitored(_made(), directory), 2, seed=lambda _: None)


def early(directory):
    """Record an episode that a reset cut off."""
    play(_monitored(_made(longest=9), directory, allow_early_reset=True), 3, most=2)


def wrapped(directory):
    """Record with wrappers of Gymnasium's own between monitor and environment."""
    env = _made(_CHEETAH, 4)
    env = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    play(_monitored(env, directory), 2)


def wrapped_in_code(directory):
    """Record with a wrapper that only its author has."""
    env = gymnasium.wrappers.TransformReward(_made(_CHEETAH, 4), lambda r: 2 * r)
    play(_monitored(env, directory), 2)


class _Away(Tracker):
    def episode(self, *_):
        raise ConnectionError("the server is away")


def tracker_away(directory):
    """Record on when a tracker has raised."""
    pendulum(directory, episodes=3, trackers=_Away())


def _undecided(episode):
    if episode == 1:
        raise ValueError("no idea")
    return True


def schedule_raises(directory):
    """Record on when a schedule has raised for the second of three episodes."""
    pendulum(directory, episodes=3, video_callable=_undecided, on_error="warn")


def trigger_raises(directory):
    """Record on when the trigger of clips has raised."""
    clips = {"step_trigger": _undecided, "video_length": 3}
    pendulum(directory, episodes=2, on_error="warn", **clips)


def encoder_killed(directory):
    """Record on when the encoder of a live video was killed in the second episode."""
    with _monitored(_made(), directory, render="live", on_error="warn") as monitor:
        for episode in range(2):
            monitor.reset(seed=episode)
            for step in range(5):
                if (episode, step) == (1, 2):
                    kill_children("ffmpeg")
                monitor.step(_PUSH)


def frame_missing(directory):
    """Record on when `render` has raised in the second episode of a live recording."""
    env = _made()
    draw, drawn = env.unwrapped.render, iter([*range(5), None])

    def render():
        if next(drawn, 0) is None:
            raise RuntimeError("the window is gone")
        return draw()

    vars(env.unwrapped)["render"] = render
    play(_monitored(env, directory, render="live", on_error="warn"), 2)


def _on_a_full_disk(directory, longest, full, **options):
    """Record three episodes. In the second one, the disk is full at these steps.

    Its reset is step -1.
    """
    env, generator = _made(_CHEETAH, longest), np.random.default_rng(5)
    with _monitored(env, directory, on_error="warn", **options) as monitor:
        for episode in range(3):
            with contextlib.ExitStack() as limits:
                for step in range(-1, longest):
                    if (episode, step) == (1, full.start):
                        # A thread stores it, and this is not about that.
                        wait_until(lambda: list(directory.glob("*.mjb.gz")))
                        limits.enter_context(file_size_limit(200))
                    if (episode, step) == (1, full.stop):
                        limits.close()
                    if step < 0:
                        monitor.reset(seed=episode)
                    else:
                        monitor.step(generator.uniform(-1, 1, 6).astype(np.float32))


def trajectory_lost(directory):
    """Record on when the disk was full during the second of three episodes."""
    _on_a_full_disk(directory, 4, range(-1, 4))


def end_lost(directory):
    """Record on when no rows could be written from the middle of an episode on."""
    _on_a_full_disk(directory, 200, range(2, 198), max_fps=1)


def end_written_late(directory):
    """Record on when the disk was full at the last step of an episode."""
    _on_a_full_disk(directory, 4, range(3, 4))


def text(directory):
    """Record an environment that draws with letters."""
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
    """Record a training run, which keeps the actions of scheduled episodes only."""
    pendulum(directory, episodes=4, mode="training")


def doubles(directory):
    """Record actions in float64."""
    play(_monitored(_made(_CHEETAH, 4), directory), 2, kind=np.float64)


def views(directory):
    """Record from another camera, at another size and rate, with the observations."""
    options = {"width": 48, "height": 32, "max_fps": 10, "observations": True}
    options["camera"] = [{"azimuth": 70.0, "distance": 3.0}, "track", -1]
    options["video_callable"] = lambda episode: episode == 1
    play(_monitored(_made(_CHEETAH, 6), directory, **options), 2)
