# SPDX-License-Identifier: Apache-2.0
"""How much memory recording takes in the process that simulates."""

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

TITLE = "Memory: peak of the simulation's process in one episode of HalfCheetah-v5"

_BARE, _PENDING, _DRAWN = "bare", "workers=0", "workers=1"
_LITTLE = at_most(64)
# Pages come and go with what the allocator happens to do.
_NO_GROWTH = at_most(4)


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much is measured.

    Attributes:
        rounds: of all variants.
        short: the frames of the shorter episode.
        long: those of the longer one.
        size: height and width of the frames.
        drawn_size: of those that workers draw. What they draw is not in the process
            that is measured, so it need not be large.
        recorders: who is measured, the bare environment among them; RecordVideo with
            the shorter episode only.
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
    """Return how much more each variant takes, and how that grows with the episode."""
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
            # At the lower quality, or ten thousand take half an hour.
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
    """Yield what the longer episode takes more than the shorter one."""
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
