# SPDX-License-Identifier: Apache-2.0
"""How much faster two workers evaluate a policy than one."""

from __future__ import annotations

import functools
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mjrec

from .children import call
from .results import Reference, Result, at_most
from .rounds import Say, take_turns

TITLE = "Evaluating: the random policy in the suite, without videos"

# Of all sizes, in the order of the alphabet: what takes long does not come first.
_TASKS = (
    *("acrobot-swingup", "ball_in_cup-catch", "cartpole-swingup", "cheetah-run"),
    *("finger-spin", "hopper-hop", "humanoid-walk", "pendulum-swingup"),
    *("quadruped-walk", "reacher-easy", "swimmer-swimmer6", "walker-walk"),
)
_PROMISE = at_most(1 / 1.7)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much is measured.

    Attributes:
        rounds: of both variants.
        tasks: of the suite.
        episodes: of each task.
        steps: of each episode; None is all of them.
    """

    rounds: int = 5
    tasks: int = len(_TASKS)
    episodes: int = 2
    steps: int | None = None


FULL = Settings()
QUICK = Settings(rounds=3, steps=250)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return how long one worker takes, and two."""
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
    """Return how long an evaluation takes, from the call to its results."""
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
