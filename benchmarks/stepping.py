# SPDX-License-Identifier: Apache-2.0
"""How fast environments step, bare and recorded."""

from __future__ import annotations

import functools
import statistics
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
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

__all__ = ["FULL", "QUICK", "TITLE", "Settings", "measure", "run_episodes"]

TITLE = "Stepping: steps per second, resets included"

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
    """How much is measured.

    Attributes:
        environments: their names; the episodes are as long as they are.
        rounds: of all variants.
        steps: of each variant in a round.
        drawn_steps: likewise of RecordVideo, which takes a thousand times as long.
        make: keyword arguments of `gymnasium.make`.
    """

    environments: tuple[str, ...] = ("HalfCheetah-v5", "Humanoid-v5")
    rounds: int = 11
    steps: int = 20_000
    drawn_steps: int = 60
    make: Mapping[str, Any]


FULL = Settings(make={})
QUICK = Settings(rounds=3, steps=10_000, drawn_steps=20, make={})


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return a line for each environment and variant."""
    return [
        result
        for env_id in settings.environments
        for result in _measure_environment(env_id, settings, say)
    ]


def run_episodes(setup: dict[str, Any], steps: int) -> dict[str, float]:
    """Return steps per second and how long closing took, in seconds.

    What is done once, in the first reset, does not count.
    """
    environment = Setup(**setup)
    with tempfile.TemporaryDirectory() as directory:
        env = environment.open(directory)
        actions = random_actions(env, steps)
        env.reset(seed=0)
        seconds = seconds_to_step(env, actions)
        closing = environment.close(env)
    return {"rate": steps / seconds, "closing": closing}


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
    bare = Reference(_BARE, _rates(samples[env_id, _BARE]))
    return [
        _result(env_id, name, samples.get((env_id, name), []), bare)
        for name in _VARIANTS
    ]


def _steps(name: str, settings: Settings) -> int:
    return settings.drawn_steps if name == _RECORD_VIDEO else settings.steps


def _result(
    env_id: str, name: str, samples: list[dict[str, float]], bare: Reference
) -> Result:
    return Result(
        subject=env_id,
        variant=name,
        unit="steps/s",
        samples=_rates(samples),
        reference=None if name == _BARE else bare,
        promise=_promise(env_id, name),
        note=_note(name, samples),
    )


def _promise(env_id: str, name: str) -> Promise | None:
    if name == _COUNTED:
        return at_least(0.95)
    return _CAPTURED_PROMISES.get(env_id) if name == _CAPTURED else None


def _note(name: str, samples: list[dict[str, float]]) -> str:
    if not samples:
        return "moviepy is not installed"
    if name in (_BARE, _COUNTED):
        return ""
    closing = statistics.median(sample["closing"] for sample in samples)
    waits = _VARIANTS[name].get("waits", True)
    return f"close() {closing:.2f} s" if waits else "not waited for the videos"


def _rates(samples: list[dict[str, float]]) -> tuple[float, ...]:
    return tuple(sample["rate"] for sample in samples)
