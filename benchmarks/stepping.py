# SPDX-License-Identifier: Apache-2.0
"""The stepping speed of environments, with and without recording."""

from __future__ import annotations

import functools
import statistics
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from .children import call
from .results import Promise, Reference, Result, at_least
from .rounds import Say, take_turns
from .setups import (
    BARE,
    MONITOR,
    RECORD_VIDEO,
    Setup,
    has_moviepy,
    random_actions,
    seconds_to_step,
)

TITLE = "Stepping: steps per second, including resets"

_BARE = "bare"
_COUNTED = "monitored, no episode recorded"
_CAPTURED = "every step captured, workers=0"
_DEFAULT = "every step captured, drawn beside it"
_SCHEDULED = "Monitor(env, directory) and no more"
_RECORD_VIDEO = "RecordVideo, episode recorded"

_VARIANTS: Mapping[str, dict[str, Any]] = {
    _BARE: {"recorder": BARE},
    _COUNTED: {"recorder": MONITOR, "episodes": "none"},
    _CAPTURED: {"recorder": MONITOR, "options": {"workers": 0}},
    _DEFAULT: {"recorder": MONITOR, "waits": False},
    _SCHEDULED: {"recorder": MONITOR, "episodes": "scheduled", "waits": False},
    _RECORD_VIDEO: {"recorder": RECORD_VIDEO},
}
_CAPTURED_PROMISES = {"HalfCheetah-v5": at_least(0.8), "Humanoid-v5": at_least(0.9)}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        environments: names of the environments. Episodes have their natural length.
        rounds: number of rounds.
        steps: number of steps that each variant takes in a round.
        drawn_steps: number of steps in a round with RecordVideo, which takes a thousand
            times as long.
        make: keyword arguments for `gymnasium.make`.
    """

    environments: tuple[str, ...] = ("HalfCheetah-v5", "Humanoid-v5")
    rounds: int = 11
    steps: int = 20_000
    drawn_steps: int = 60
    make: Mapping[str, Any]


FULL = Settings(make={})
QUICK = Settings(rounds=3, steps=10_000, drawn_steps=20, make={})


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return a result line for each environment and variant."""
    return [
        result
        for env_id in settings.environments
        for result in _measure_environment(env_id, settings, say)
    ]


def run_episodes(setup: dict[str, Any], steps: int) -> dict[str, float]:
    """Return the number of steps per second and per second of this thread's CPU time.

    The first reset and closing are not included. The time to close is returned
    separately.
    """
    environment = Setup(**setup)
    with tempfile.TemporaryDirectory() as directory:
        env = environment.open(directory)
        actions = random_actions(env, steps)
        env.reset(seed=0)
        start = time.thread_time()
        seconds = seconds_to_step(env, actions)
        busy = time.thread_time() - start
        closing = environment.close(env)
    return {"rate": steps / seconds, "cpu_rate": steps / busy, "closing": closing}


def _measure_environment(env_id: str, settings: Settings, say: Say) -> list[Result]:
    samples = take_turns(
        {
            (env_id, name): functools.partial(
                call,
                run_episodes,
                setup=Setup(
                    env_id=env_id, make=dict(settings.make), **options
                ).as_json(),
                steps=_steps(name, settings),
            )
            for name, options in _VARIANTS.items()
            if name != _RECORD_VIDEO or has_moviepy()
        },
        rounds=settings.rounds,
        say=say,
    )
    bare = samples[env_id, _BARE]
    return [
        _result(env_id, name, samples.get((env_id, name), []), bare)
        for name in _VARIANTS
    ]


def _steps(name: str, settings: Settings) -> int:
    return settings.drawn_steps if name == _RECORD_VIDEO else settings.steps


def _result(
    env_id: str,
    name: str,
    samples: list[dict[str, float]],
    bare: list[dict[str, float]],
) -> Result:
    result = Result(
        subject=env_id,
        variant=name,
        unit="steps/s",
        samples=_rates(samples),
    )
    if name == _BARE:
        return result
    return replace(
        result,
        reference=Reference(_BARE, _rates(bare)),
        promise=_promise(env_id, name),
        note=_note(name, samples, bare),
    )


def _promise(env_id: str, name: str) -> Promise | None:
    if name == _COUNTED:
        return at_least(0.95)
    return _CAPTURED_PROMISES.get(env_id) if name == _CAPTURED else None


def _note(
    name: str, samples: list[dict[str, float]], bare: list[dict[str, float]]
) -> str:
    if not samples:
        return "moviepy is not installed"
    by_cpu = _median(samples, "cpu_rate") / _median(bare, "cpu_rate")
    closing = f"close() {_median(samples, 'closing'):.2f} s"
    if not _VARIANTS[name].get("waits", True):
        closing += ", not waiting"
    return f"by CPU time {by_cpu:.3g}; {closing}"


def _median(samples: list[dict[str, float]], key: str) -> float:
    return statistics.median(sample[key] for sample in samples)


def _rates(samples: list[dict[str, float]]) -> tuple[float, ...]:
    return tuple(sample["rate"] for sample in samples)
