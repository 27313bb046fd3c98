# SPDX-License-Identifier: Apache-2.0
"""The speed of an evaluation with one worker, two workers, and bare processes."""

from __future__ import annotations

import functools
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mjrec

from .children import call
from .results import Reference, Result, at_most
from .rounds import Say, take_turns

TITLE = "Evaluating: the random policy, without videos"

# Tasks of all sizes, in alphabetical order, so that slow tasks do not come first.
_TASKS = (
    *("acrobot-swingup", "ball_in_cup-catch", "cartpole-swingup", "cheetah-run"),
    *("finger-spin", "hopper-hop", "humanoid-walk", "pendulum-swingup"),
    *("quadruped-walk", "reacher-easy", "swimmer-swimmer6", "walker-walk"),
)
_PROMISE = at_most(1 / 1.7)
_BARE_PROMISE = at_most(1 / 0.9)

_BARE = "2 bare processes"
# A script that steps the environment with random actions and evaluates nothing.
_STEPPING = """
import sys
import gymnasium

env = gymnasium.make("HalfCheetah-v5")
for seed in range(int(sys.argv[1])):
    env.reset(seed=seed)
    is_over = False
    while not is_over:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        is_over = terminated or truncated
"""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        tasks: number of tasks from the suite.
        episodes: number of episodes per task.
        steps: maximum number of steps per episode; None for no limit.
        bare: numbers of HalfCheetah episodes that two workers evaluate, to be compared
            with two processes that only step the environment.
    """

    rounds: int = 5
    tasks: int = len(_TASKS)
    episodes: int = 2
    steps: int | None = None
    bare: tuple[int, ...] = (40, 200)


FULL = Settings()
QUICK = Settings(rounds=3, steps=250, bare=(40,))


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the times that one worker, two workers and bare processes take."""
    return [
        *_measure_workers(settings, say),
        *(
            result
            for episodes in settings.bare
            for result in _measure_bare(episodes, settings, say)
        ),
    ]


def _measure_workers(settings: Settings, say: Say) -> list[Result]:
    variants: dict[int, Callable[[], float]] = {
        workers: functools.partial(
            call,
            seconds_to_evaluate,
            workers=workers,
            tasks=settings.tasks,
            episodes=settings.episodes,
            steps=settings.steps,
        )
        for workers in (1, 2)
    }
    samples = take_turns(variants, rounds=settings.rounds, say=say)
    one = Reference("1 worker", tuple(samples[1]))
    return [
        Result(
            subject=f"{settings.tasks} tasks, {settings.episodes} episodes each",
            variant=f"{workers} worker" + "s" * (workers > 1),
            unit="s",
            samples=tuple(samples[workers]),
            reference=one if workers > 1 else None,
            promise=_PROMISE if workers > 1 else None,
        )
        for workers in (1, 2)
    ]


def seconds_to_evaluate(
    workers: int, tasks: int, episodes: int, steps: int | None
) -> float:
    """Return the seconds that an evaluation takes, from the call to its results."""
    with tempfile.TemporaryDirectory() as place:
        start = time.perf_counter()
        mjrec.evaluate(
            [f"dm_control/{task}" for task in _TASKS[:tasks]],
            policy="random",
            directory=Path(place) / "evaluation",
            episodes=episodes,
            seeds=[0],
            workers=workers,
            keep="none",
            max_steps=steps,
        )
        return time.perf_counter() - start


def _measure_bare(episodes: int, settings: Settings, say: Say) -> list[Result]:
    variants: dict[str, Callable[[], float]] = {
        _BARE: functools.partial(call, seconds_to_step_bare, episodes=episodes),
        "2 workers": functools.partial(
            call, seconds_to_evaluate_cheetah, episodes=episodes
        ),
    }
    samples = take_turns(variants, rounds=settings.rounds, say=say)
    return [
        Result(
            subject=f"HalfCheetah-v5, {episodes} episodes, from start to end",
            variant=name,
            unit="s",
            samples=tuple(values),
            reference=None
            if name == _BARE
            else Reference(_BARE, tuple(samples[_BARE])),
            promise=None if name == _BARE else _BARE_PROMISE,
        )
        for name, values in samples.items()
    ]


def seconds_to_step_bare(episodes: int) -> float:
    """Return the seconds that two processes take to step half of the episodes each."""
    start = time.perf_counter()
    command = [sys.executable, "-c", _STEPPING, str(episodes // 2)]
    processes = [subprocess.Popen(command) for _ in range(2)]
    if any(process.wait() for process in processes):
        raise RuntimeError("A process that steps the environment has failed.")
    return time.perf_counter() - start


def seconds_to_evaluate_cheetah(episodes: int) -> float:
    """Return the seconds that two workers take, including all files they write."""
    with tempfile.TemporaryDirectory() as place:
        start = time.perf_counter()
        mjrec.evaluate(
            "HalfCheetah-v5",
            policy="random",
            directory=Path(place) / "evaluation",
            episodes=4,
            num_seeds=episodes // 4,
            workers=2,
            keep="none",
        )
        return time.perf_counter() - start
