# SPDX-License-Identifier: Apache-2.0
"""The time from the reset of an episode to its finished mp4."""

from __future__ import annotations

import functools
import statistics
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .children import call
from .results import Promise, Reference, Result, at_most
from .rounds import Say, take_turns
from .setups import (
    MONITOR,
    RECORD_VIDEO,
    UNENDING,
    Setup,
    has_moviepy,
    random_actions,
)

TITLE = "Time to video: seconds from reset to finished mp4, one episode"


@dataclass(frozen=True, kw_only=True)
class Case:
    """An episode that RecordVideo and mjrec draw.

    Attributes:
        env_id: id of the environment.
        variants: options for `mjrec.Monitor`, and the promised limit as a fraction of
            RecordVideo's time, keyed by the name of the variant.
    """

    env_id: str
    variants: Mapping[str, tuple[Mapping[str, Any], Promise]]


CASES = (
    Case(
        env_id="HalfCheetah-v5",
        variants={
            "every frame, full quality": ({}, at_most(0.75)),
            "every frame, draft": ({"quality": "draft"}, at_most(0.3)),
        },
    ),
    Case(
        env_id="Hopper-v5",
        variants={"max_fps=30, full quality": ({"max_fps": 30}, at_most(0.3))},
    ),
)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        steps: lengths of the episodes.
        size: height and width of the frames.
        workers: number of mjrec's drawing processes.
        cases: the cases to measure.
    """

    rounds: int = 3
    steps: tuple[int, ...] = (500, 1000)
    size: tuple[int, int] = (480, 480)
    workers: int = 2
    cases: tuple[Case, ...] = CASES


FULL = Settings()
QUICK = Settings(rounds=1, steps=(200,))


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return a result line for each case and variant."""
    return [
        result
        for case in settings.cases
        for steps in settings.steps
        for result in _measure_case(case, steps, settings, say)
    ]


def make_video(setup: dict[str, Any], steps: int) -> dict[str, float]:
    """Record one episode, and return its total time, stepping time and video size.

    Raises:
        RuntimeError: the number of videos is not one.
    """
    environment = Setup(**setup)
    with tempfile.TemporaryDirectory() as directory:
        env = environment.open(directory)
        actions = random_actions(env, steps)
        start = time.perf_counter()
        env.reset(seed=0)
        for action in actions:
            env.step(action)
        stepped = time.perf_counter()
        environment.close(env)
        end = time.perf_counter()
        sizes = [path.stat().st_size for path in Path(directory).glob("*.mp4")]
    if len(sizes) != 1:
        raise RuntimeError(f"Expected one video, but there are {len(sizes)}.")
    return {"seconds": end - start, "stepping": stepped - start, "bytes": sizes[0]}


def _measure_case(case: Case, steps: int, settings: Settings, say: Say) -> list[Result]:
    samples = take_turns(
        {
            (case.env_id, name): functools.partial(
                call, make_video, setup=setup.as_json(), steps=steps
            )
            for name, setup in _setups(case, steps, settings).items()
        },
        rounds=settings.rounds,
        say=say,
    )
    peer = samples.get((case.env_id, RECORD_VIDEO))
    reference = None if peer is None else Reference(RECORD_VIDEO, _seconds(peer))
    results = [] if peer is None else [_result(case, steps, RECORD_VIDEO, peer)]
    for name, (_, promise) in case.variants.items():
        own = samples[case.env_id, name]
        results.append(
            _result(case, steps, name, own, reference, promise if reference else None)
        )
    return results


def _setups(case: Case, steps: int, settings: Settings) -> dict[str, Setup]:
    height, width = settings.size
    make = {
        **UNENDING.get(case.env_id, {}),
        "height": height,
        "width": width,
        "max_episode_steps": steps,
    }
    setups = {
        name: Setup(
            env_id=case.env_id,
            recorder=MONITOR,
            make=make,
            options={**options, "workers": settings.workers},
        )
        for name, (options, _) in case.variants.items()
    }
    if has_moviepy():
        peer = Setup(env_id=case.env_id, recorder=RECORD_VIDEO, make=make)
        setups = {RECORD_VIDEO: peer, **setups}
    return setups


def _result(
    case: Case,
    steps: int,
    name: str,
    samples: list[dict[str, float]],
    reference: Reference | None = None,
    promise: Promise | None = None,
) -> Result:
    stepping = statistics.median(sample["stepping"] for sample in samples)
    return Result(
        subject=f"{case.env_id}, {steps} steps",
        variant=name,
        unit="s",
        samples=_seconds(samples),
        reference=reference,
        promise=promise,
        note=f"of this, {stepping:.2f} s in reset and step",
    )


def _seconds(samples: list[dict[str, float]]) -> tuple[float, ...]:
    return tuple(sample["seconds"] for sample in samples)
