# SPDX-License-Identifier: Apache-2.0
"""The memory that recording needs in the simulating process."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from .children import call
from .process_memory import peak_memory
from .results import Reference, Result, at_most
from .rounds import Say, take_turns
from .setups import BARE, MONITOR, RECORD_VIDEO, Setup, has_moviepy, random_actions

TITLE = "Memory: peak in the simulating process, one episode of HalfCheetah-v5"

_BARE, _PENDING, _DRAWN = "bare", "workers=0", "workers=1"
_LITTLE = at_most(64)
# The number of pages varies a little with the behavior of the allocator.
_NO_GROWTH = at_most(4)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
        short: number of frames in the shorter episode.
        long: number of frames in the longer episode.
        size: height and width of the frames.
        drawn_size: height and width of the frames that workers draw. These frames can
            be small, because they are not in the measured process.
        recorders: the variants to measure, including the bare environment. RecordVideo
            is measured only with the shorter episode.
    """

    rounds: int = 3
    short: int = 1000
    long: int = 10_000
    size: tuple[int, int] = (480, 480)
    drawn_size: tuple[int, int] = (64, 64)
    recorders: tuple[str, ...] = (_BARE, _PENDING, _DRAWN, RECORD_VIDEO)


FULL = Settings()
QUICK = Settings(rounds=1, short=100, long=1000)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the memory of each variant, and its growth with the episode's length."""
    samples = take_turns(
        {
            key: functools.partial(
                call, record_episode, setup=setup.as_json(), steps=key[1]
            )
            for key, setup in _setups(settings)
        },
        rounds=settings.rounds,
        say=say,
    )
    peaks = {key: tuple(values) for key, values in samples.items()}
    return [*_peaks(peaks, settings), *_growths(peaks, settings)]


def record_episode(setup: dict[str, Any], steps: int) -> float:
    """Record one episode and return the peak of this process's memory, in MB."""
    environment = Setup(**setup)
    with tempfile.TemporaryDirectory() as directory:
        env = environment.open(directory)
        actions = random_actions(env, steps)
        env.reset(seed=0)
        for action in actions:
            env.step(action)
        environment.close(env)
    return peak_memory()


_Peaks = dict[tuple[str, int], tuple[float, ...]]


def _setups(settings: Settings) -> Iterator[tuple[tuple[str, int], Setup]]:
    for steps in (settings.short, settings.long):
        full, small = _make(steps, settings.size), _make(steps, settings.drawn_size)
        setups = {
            _BARE: _setup(BARE, full),
            _PENDING: _setup(MONITOR, full, workers=0),
            # Draft quality, because ten thousand frames would take half an hour.
            _DRAWN: _setup(MONITOR, small, workers=1, quality="draft"),
        }
        if steps == settings.short and has_moviepy():
            setups[RECORD_VIDEO] = _setup(RECORD_VIDEO, full)
        for name in settings.recorders:
            if name in setups:
                yield (name, steps), setups[name]


def _setup(recorder: str, make: dict[str, Any], **options: Any) -> Setup:
    return Setup(env_id="HalfCheetah-v5", recorder=recorder, make=make, options=options)


def _make(steps: int, size: tuple[int, int]) -> dict[str, Any]:
    height, width = size
    return {"max_episode_steps": steps, "height": height, "width": width}


def _peaks(peaks: _Peaks, settings: Settings) -> Iterator[Result]:
    for (name, steps), samples in peaks.items():
        bare = Reference(_BARE, peaks[_BARE, steps], is_ratio=False)
        yield Result(
            subject=f"{steps} frames",
            variant=name,
            unit="MB",
            samples=samples,
            reference=None if name == _BARE else bare,
            promise=_LITTLE if name in (_PENDING, _DRAWN) else None,
            note=_note(name, settings),
        )


def _note(name: str, settings: Settings) -> str:
    height, width = settings.drawn_size if name == _DRAWN else settings.size
    if name == _BARE:
        return ""
    return f"{width}x{height}" + (", draft" if name == _DRAWN else "")


def _growths(peaks: _Peaks, settings: Settings) -> Iterator[Result]:
    """Yield the additional memory that the longer episode needs."""
    for name in settings.recorders:
        if (name, settings.long) not in peaks:
            continue
        yield Result(
            subject=f"{settings.short} to {settings.long} frames",
            variant=f"{name}, growth",
            unit="MB",
            samples=peaks[name, settings.long],
            reference=Reference(
                f"{settings.short} frames",
                peaks[name, settings.short],
                is_ratio=False,
            ),
            promise=None if name == _BARE else _NO_GROWTH,
        )
