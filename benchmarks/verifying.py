# SPDX-License-Identifier: Apache-2.0
"""The cost of verification, compared with recording and drawing."""

from __future__ import annotations

import functools
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

import mjrec

from .children import call
from .results import Reference, Result, at_most
from .rounds import Say, take_turns
from .setups import random_actions

TITLE = "Verification: packed runs of HalfCheetah-v5, recreated and compared"

_ENV_ID = "HalfCheetah-v5"
_STATS, _PHYSICS, _PIXELS = "--level stats", "--level physics", "all frames"
_RECORDED = "recorded and drawn"
# Seconds for 1000 episodes of 25 steps.
_STATS_PROMISE = at_most(20)
# Four times as many episodes take at most four times as long, plus some tolerance.
_LINEAR = at_most(4.2)
_STEPS_PER_SECOND = 2000
_PIXELS_PROMISE = at_most(1.5)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        episodes: number of short episodes without videos. Four times as many are
            measured as well.
        short: number of steps in a short episode.
        long_episodes: number of long episodes without videos.
        long: number of steps in a long episode.
        videos: number of videos.
        frames: number of frames per video.
        size: width and height of the videos.
        workers: number of drawing processes.
    """

    rounds: int = 3
    episodes: int = 1000
    short: int = 25
    long_episodes: int = 20
    long: int = 1000
    videos: int = 4
    frames: int = 250
    size: int = 480
    workers: int = 2


FULL = Settings()
QUICK = Settings(rounds=1, videos=2, frames=100)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the times that verifications take."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for run, episodes, steps in (
            ("some", settings.episodes, settings.short),
            ("many", 4 * settings.episodes, settings.short),
            ("long", settings.long_episodes, settings.long),
        ):
            say(f"recording {episodes} episodes")
            call(record, directory=str(place / run), episodes=episodes, steps=steps)
        samples = take_turns(
            _variants(place, settings), rounds=settings.rounds, say=say
        )
    return _results(samples, settings)


def record(directory: str, episodes: int, steps: int, **options: Any) -> None:
    """Record episodes with random actions."""
    env = gymnasium.make(_ENV_ID, max_episode_steps=steps)
    options = {"video_callable": False, "workers": 0, **options}
    monitor: Any = mjrec.Monitor(env, directory, mode="evaluation", **options)
    actions = random_actions(env, steps)
    for number in range(episodes):
        monitor.reset(seed=None if number else 0)
        for action in actions:
            monitor.step(action)
    monitor.close()


def verify(path: str, level: str) -> dict[str, float]:
    """Return the seconds that a verification takes."""
    start = time.perf_counter()
    verification = mjrec.verify(path, level=level)
    if verification.failures:
        raise RuntimeError("Verification of a genuine recording failed.")
    return {"seconds": time.perf_counter() - start}


def record_and_draw(
    directory: str, archive: str, videos: int, steps: int, size: int, workers: int
) -> dict[str, float]:
    """Record videos, pack them, and return the seconds that recording took."""
    shutil.rmtree(directory, ignore_errors=True)
    Path(archive).unlink(missing_ok=True)
    start = time.perf_counter()
    record(
        directory,
        videos,
        steps,
        video_callable=lambda _: True,
        workers=workers,
        height=size,
        width=size,
    )
    seconds = time.perf_counter() - start
    mjrec.pack(directory, archive)
    return {"seconds": seconds}


def _variants(
    place: Path, settings: Settings
) -> dict[str, Callable[[], dict[str, float]]]:
    archive = str(place / "run.zip")
    return {
        "some": functools.partial(
            call, verify, path=str(place / "some"), level="stats"
        ),
        "many": functools.partial(
            call, verify, path=str(place / "many"), level="stats"
        ),
        "long": functools.partial(
            call, verify, path=str(place / "long"), level="physics"
        ),
        _RECORDED: functools.partial(
            call,
            record_and_draw,
            directory=str(place / "drawn"),
            archive=archive,
            videos=settings.videos,
            # The reset adds one frame.
            steps=settings.frames - 1,
            size=settings.size,
            workers=settings.workers,
        ),
        _PIXELS: functools.partial(call, verify, path=archive, level="pixels"),
    }


def _results(
    samples: dict[str, list[dict[str, float]]], settings: Settings
) -> list[Result]:
    seconds = {
        name: tuple(each["seconds"] for each in of_one)
        for name, of_one in samples.items()
    }
    steps = settings.long_episodes * settings.long
    videos = f"{settings.videos} videos of {settings.frames} frames"
    some = f"{settings.episodes} episodes of {settings.short} steps"
    return [
        _result(some, _STATS, seconds["some"], promise=_STATS_PROMISE),
        _result(
            f"{4 * settings.episodes} episodes of {settings.short} steps",
            _STATS,
            seconds["many"],
            reference=Reference(some, seconds["some"]),
            promise=_LINEAR,
        ),
        _result(
            f"{steps} steps",
            _PHYSICS,
            seconds["long"],
            promise=at_most(steps / _STEPS_PER_SECOND),
        ),
        _result(videos, _RECORDED, seconds[_RECORDED]),
        _result(
            videos,
            _PIXELS,
            seconds[_PIXELS],
            reference=Reference(_RECORDED, seconds[_RECORDED]),
            promise=_PIXELS_PROMISE,
        ),
    ]


def _result(
    subject: str, variant: str, seconds: tuple[float, ...], **compared: Any
) -> Result:
    known: dict[str, Any] = {"reference": None, "promise": None, **compared}
    return Result(subject=subject, variant=variant, unit="s", samples=seconds, **known)
