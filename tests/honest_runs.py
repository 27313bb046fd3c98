# SPDX-License-Identifier: Apache-2.0
"""Monitor directories of short honest runs, one function for each kind of run."""

import contextlib
import os
import signal

import gymnasium
import numpy as np
import pytest
from processes import kill_children

import mjrec
from mjrec.environments.mjcf_environments import MjcfEnvironment
from mjrec.trackers import Tracker

_SMALL = {"render_mode": "rgb_array", "width": 32, "height": 32}
_POLE = "InvertedPendulum-v5"

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


def pendulum(directory, episodes=4, *, longest=5, **options):
    """Record evaluated episodes that end by a fall or after five steps."""
    make = {**_SMALL, **options.pop("make", {})}
    env = gymnasium.make(_POLE, max_episode_steps=longest, **make)
    options = {"mode": "evaluation", "uid": "u", "workers": 1, **options}
    play(mjrec.Monitor(env, directory, **options), episodes)


def cheetah(directory, **options):
    """Record an environment that never falls, with one seed at the first reset."""
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=4, **_SMALL)
    monitor = mjrec.Monitor(env, directory, workers=1, mode="evaluation", **options)
    play(monitor, 3, seed=lambda episode: None if episode else 7)


def suite(directory, **options):
    """Record a task of dm_control's suite."""
    tasks = pytest.importorskip("dm_control.suite")
    given = {"random": 3, "time_limit": 0.04}
    env = tasks.load("cartpole", "balance", task_kwargs=given)
    options = {"mode": "evaluation", "env_id": "dm_control/cartpole-balance", **options}
    monitor = mjrec.Monitor(env, directory, workers=1, width=32, height=32, **options)
    generator = np.random.default_rng(3)
    with contextlib.closing(monitor):
        for _ in range(2):
            monitor.reset()
            for _ in range(4):
                monitor.step(generator.uniform(-1, 1, monitor.action_spec().shape))


def vector(directory, **options):
    """Record one of two environments that reset themselves."""
    env = gymnasium.make_vec(
        _POLE, 2, vectorization_mode="sync", max_episode_steps=4, **_SMALL
    )
    monitor = mjrec.Monitor(env, directory, mode="evaluation", workers=1, **options)
    monitor.reset(seed=3)
    for _ in range(12):
        monitor.step(np.zeros(monitor.action_space.shape, np.float32))
    monitor.close()


def evaluated(directory, **options):
    """Evaluate episodes in several chunks, whose videos are chosen among all."""
    given = {"policy": "random", "num_seeds": 3, "keep": "best,failures"}
    given |= {"max_steps": 4, **options}
    mjrec.evaluate(
        [_POLE],
        directory=directory,
        episodes=1,
        height=32,
        width=32,
        workers=1,
        **given,
    )


def evaluated_in_part(directory):
    """Evaluate a policy that raises in some episodes."""

    def policy(observation):
        if observation[0] > 0:
            raise ValueError("it is on the right")
        return np.zeros(1, np.float32)

    evaluated(directory, policy=policy)


def evaluated_to_death(directory):
    """Evaluate a policy that kills its process in some episodes."""

    def policy(observation):
        if observation[0] > 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.zeros(1, np.float32)

    evaluated(directory, policy=policy)


def evaluated_again(directory):
    """Evaluate a policy that kills its process at its seventh action."""
    calls = []

    def policy(observation):
        calls.append(observation)
        if len(calls) == 7:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.zeros(1, np.float32)

    evaluated(directory, policy=policy)


def extended(directory):
    """Evaluate one seed, and later one more."""
    evaluated(directory, num_seeds=1)
    evaluated(directory, num_seeds=2, resume=True)


def clips(directory):
    """Record clips of four steps, which cross episodes."""
    pendulum(directory, step_trigger=_every_sixth, video_length=4)


def _every_sixth(step):
    return step % 6 == 0


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
        env = gymnasium.make(_POLE, max_episode_steps=5, **_SMALL)
        monitor = mjrec.Monitor(env, directory, uid="u", mode="evaluation", workers=1)
        for episode in range(3):
            monitor.reset(seed=episode)
            for _ in range(3 if episode < 2 else 2):
                monitor.step(np.full(1, 0.1, np.float32))
            if episode < 2:
                monitor.step(np.full(1, 0.1, np.float32))
                monitor.step(np.full(1, 0.1, np.float32))
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    # The worker of the killed process may still be drawing.
    mjrec.recover(directory, timeout=60)
    mjrec.render_videos(directory)


def unseeded(directory):
    """Record episodes whose beginning nothing leads to."""
    env = gymnasium.make(_POLE, max_episode_steps=5, **_SMALL)
    monitor = mjrec.Monitor(env, directory, mode="evaluation", workers=1)
    play(monitor, 2, seed=lambda _: None)


def early(directory):
    """Record an episode that a reset cut off."""
    env = gymnasium.make(_POLE, max_episode_steps=9, **_SMALL)
    monitor = mjrec.Monitor(
        env, directory, mode="evaluation", workers=1, allow_early_reset=True
    )
    play(monitor, 3, most=2)


def wrapped(directory):
    """Record with wrappers of Gymnasium's own between monitor and environment."""
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=4, **_SMALL)
    env = gymnasium.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    play(mjrec.Monitor(env, directory, mode="evaluation", workers=1), 2)


def wrapped_in_code(directory):
    """Record with a wrapper that only its author has."""
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=4, **_SMALL)
    env = gymnasium.wrappers.TransformReward(env, lambda reward: 2 * reward)
    play(mjrec.Monitor(env, directory, mode="evaluation", workers=1), 2)


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
    env = gymnasium.make(_POLE, max_episode_steps=5, **_SMALL)
    monitor = mjrec.Monitor(
        env, directory, mode="evaluation", render="live", on_error="warn"
    )
    with monitor:
        for episode in range(2):
            monitor.reset(seed=episode)
            for step in range(5):
                if (episode, step) == (1, 2):
                    kill_children("ffmpeg")
                monitor.step(np.full(1, 0.1, np.float32))


def frame_missing(directory):
    """Record on when `render` has raised in the second episode of a live recording."""
    env = gymnasium.make(_POLE, max_episode_steps=5, **_SMALL)
    draw = env.unwrapped.render
    drawn = iter([*range(5), None])

    def render():
        if next(drawn, 0) is None:
            raise RuntimeError("the window is gone")
        return draw()

    vars(env.unwrapped)["render"] = render
    monitor = mjrec.Monitor(
        env, directory, mode="evaluation", render="live", on_error="warn"
    )
    play(monitor, 2)


def text(directory):
    """Record an environment that draws with letters."""
    env = gymnasium.make("Taxi-v4", render_mode="ansi", max_episode_steps=3)
    with mjrec.Monitor(env, directory, mode="evaluation") as monitor:
        for seed in range(2):
            monitor.reset(seed=seed)
            for action in (0, 1, 2):
                monitor.step(action)


def mjcf(directory):
    """Record the environment of an MJCF file."""
    path = directory.with_name("robot.xml")
    path.write_text(_ROBOT)
    env = gymnasium.wrappers.TimeLimit(MjcfEnvironment(path, width=32, height=32), 4)
    play(mjrec.Monitor(env, directory, mode="evaluation", workers=1), 2)


def training(directory):
    """Record a training run, which keeps the actions of scheduled episodes only."""
    pendulum(directory, episodes=4, mode="training")


def doubles(directory):
    """Record actions in float64."""
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=4, **_SMALL)
    play(
        mjrec.Monitor(env, directory, mode="evaluation", workers=1), 2, kind=np.float64
    )


def views(directory):
    """Record from another camera, at another size and rate, with the observations."""
    env = gymnasium.make("HalfCheetah-v5", max_episode_steps=6, **_SMALL)
    monitor = mjrec.Monitor(
        env,
        directory,
        mode="evaluation",
        workers=1,
        camera=[{"azimuth": 70.0, "distance": 3.0}, "track", -1],
        width=48,
        height=32,
        max_fps=10,
        observations=True,
        video_callable=lambda episode: episode == 1,
    )
    play(monitor, 2)
