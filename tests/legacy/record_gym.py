# SPDX-License-Identifier: Apache-2.0
"""Record the directories under tests/data/gym/<version>/ with a real gym.

Run the script in an environment with gym 0.7.4 to 0.22 and numpy<1.24::

    python tests/legacy/record_gym.py tests/data/gym

The code must run on Python 3.6, because some versions of gym need it.
"""

import multiprocessing
import pathlib
import shutil
import sys
import types

import gym
import gym.spaces
from gym import version, wrappers


class Tiny(gym.Env):
    """An environment that counts steps, with gym's old (`_step`) and new methods."""

    metadata = {"render.modes": ["ansi"], "video.frames_per_second": 2}  # noqa: RUF012 as in gym
    observation_space = gym.spaces.Discrete(100)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, spec_id, lengths, rewards):
        self.spec = spec_id and types.SimpleNamespace(id=spec_id, timestep_limit=None)
        self.lengths = list(lengths)
        self.rewards = list(rewards)
        self.count = 0

    def reset(self):
        self.count = 0
        return 0

    def step(self, action):
        self.count += 1
        done = self.count >= self.lengths[0]
        reward = self.rewards[0]
        if done:
            self.lengths.append(self.lengths.pop(0))
            self.rewards.append(self.rewards.pop(0))
        return self.count, reward, done, {}

    def render(self, mode="human", close=False):
        return None if close else "count {}\n".format(self.count)  # noqa: UP032 Python 3.6

    def close(self):
        pass

    _reset, _step, _render, _close = reset, step, render, close


def monitor(
    directory, spec_id="Tiny-v0", lengths=(3, 1, 2), rewards=(1.5, -2, 0.25), **options
):
    options.setdefault("video_callable", False)
    return wrappers.Monitor(Tiny(spec_id, lengths, rewards), directory, **options)


def play(env, resets=1, steps=1000):
    for _ in range(resets):
        env.reset()
    for _ in range(steps):
        if env.step(0)[2]:
            return


def plain(directory):
    env = monitor(directory)
    for _ in range(3):
        play(env)
    env.close()


def empty(directory):
    monitor(directory).close()


def resets_in_a_row(directory):
    env = monitor(directory)
    play(env, resets=2)
    set_mode(env, "evaluation")
    play(env)
    play(env, resets=2)
    env.close()


def unfinished(directory):
    env = monitor(directory, mode="evaluation")
    play(env)
    play(env)
    play(env, steps=0)
    env.close()


def no_spec(directory):
    env = monitor(directory, spec_id=None)
    play(env)
    env.close()


def not_finite(directory):
    rewards = (float("nan"), float("inf"), -float("inf"))
    env = monitor(directory, rewards=rewards)
    for _ in range(3):
        play(env)
    env.close()


def two_monitors(directory):
    """Two monitors take turns, and a third, in evaluation, takes only one step."""
    first, idle, second = [
        monitor(directory, resume=True, mode=mode)
        for mode in ("training", "evaluation", "evaluation")
    ]
    play(first, resets=2)
    play(second)
    play(first)
    play(second)
    play(idle, steps=1)
    for env in (first, idle, second):
        env.close()


def text(directory):
    env = monitor(directory, video_callable=lambda episode: episode != 1)
    for _ in range(3):
        play(env)
    env.close()


def set_mode(env, mode):
    env.set_monitor_mode(mode)


CASES = (
    plain,
    empty,
    resets_in_a_row,
    unfinished,
    no_spec,
    not_finite,
    two_monitors,
    text,
)


def main(root):
    target = pathlib.Path(root).resolve() / version.VERSION
    shutil.rmtree(str(target), ignore_errors=True)
    for case in CASES:
        directory = str(target / case.__name__)
        # Gym numbers the monitors of a process, so each case needs a new process.
        process = multiprocessing.Process(target=case, args=(directory,))
        process.start()
        process.join()
        if process.exitcode:
            sys.exit("{} failed".format(case.__name__))  # noqa: UP032 Python 3.6


if __name__ == "__main__":
    main(sys.argv[1])
