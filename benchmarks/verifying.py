# SPDX-License-Identifier: Apache-2.0
"""What verifying the physics of recorded episodes costs, beside stepping them."""

from __future__ import annotations

import functools
import re
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

import mjrec
from mjrec.environments.made_again import NotMadeAgain
from mjrec.evidence.verification import Check, Level, Verdict
from mjrec.evidence.verifying.episode_physics import EpisodePhysics
from mjrec.evidence.verifying.physics_checks import check_physics
from mjrec.evidence.verifying.recorded_models import RecordedModels
from mjrec.evidence.verifying.task import Task
from mjrec.formats.trajectory_file import open_trajectory

from .children import call
from .results import Reference, Result, at_most
from .rounds import Say, take_turns
from .setups import random_actions, seconds_to_step

TITLE = "Verifying: physics of recorded episodes of HalfCheetah-v5"

_ENV_ID = "HalfCheetah-v5"
_BARE, _STEPS, _ALL = "stepped, bare", "steps alone", "steps and environment"
_PROMISES = {_STEPS: at_most(1.5), _ALL: at_most(2.5)}
# Pages come and go with what the allocator happens to do.
_NO_GROWTH = at_most(4)

_PEAK = re.compile(r"^VmHWM:\s+(\d+) kB$", re.MULTILINE)
_MEGABYTE = 1e6


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much is measured.

    Attributes:
        rounds: of all variants.
        episodes: that are recorded, once, and verified in each round.
        few: of them, with which the memory is compared.
        steps: of each.
    """

    rounds: int = 5
    episodes: int = 100
    few: int = 10
    steps: int = 1000


FULL = Settings()
QUICK = Settings(rounds=3, episodes=20, few=5)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return how long each variant takes, and how its memory grows."""
    with tempfile.TemporaryDirectory() as place:
        all_of_them, few = Path(place) / "all", Path(place) / "few"
        say(f"recording {settings.episodes} episodes")
        call(
            record,
            directory=str(all_of_them),
            episodes=settings.episodes,
            steps=settings.steps,
        )
        _take_some(all_of_them, few, settings.few)
        samples = take_turns(
            _variants(all_of_them, few, settings), rounds=settings.rounds, say=say
        )
    return [*_times(samples, settings), *_growth(samples, settings)]


def record(directory: str, episodes: int, steps: int) -> None:
    """Record episodes of random actions, without pictures."""
    env = gymnasium.make(_ENV_ID, max_episode_steps=steps)
    monitor: Any = mjrec.Monitor(
        env, directory, False, trajectory_callable=lambda _: True
    )
    for number, actions in enumerate(_actions_of(env, episodes, steps)):
        monitor.reset(seed=number)
        for action in actions:
            monitor.step(action)
    monitor.close()


def step_bare(episodes: int, steps: int) -> dict[str, float]:
    """Return the seconds that the bare environment takes for the same steps."""
    env = gymnasium.make(_ENV_ID, max_episode_steps=steps)
    env.reset(seed=0)
    start = time.process_time()
    seconds = sum(
        seconds_to_step(env, actions) for actions in _actions_of(env, episodes, steps)
    )
    busy = time.process_time() - start
    env.close()
    return {"seconds": seconds, "busy": busy, "peak": _peak_memory()}


def check_steps(directory: str, warm_up: str) -> dict[str, float]:
    """Return the seconds that it takes to make each state from the one before.

    Args:
        directory: of the recordings.
        warm_up: of few of them, which are verified before.
    """
    _check_steps(warm_up)
    return _timed(lambda: _check_steps(directory))


def _check_steps(directory: str) -> list[Check]:
    models = RecordedModels(Path(directory))
    found: list[Check] = []
    for path in sorted(Path(directory).glob("*.h5")):
        with open_trajectory(path) as reader:
            physics = EpisodePhysics(reader, path.name, models)
            found += physics.checks(_not_made)
    return found


def check_all(directory: str, warm_up: str) -> dict[str, float]:
    """Return the same with the environment as well."""
    _check_all(warm_up)
    return _timed(lambda: _check_all(directory))


def _check_all(directory: str) -> list[Check]:
    task = Task(recordings=Path(directory), level=Level.PHYSICS)
    return list(check_physics(task, lambda done, total: None))


def _not_made(facts: Mapping[str, Any]) -> Any:
    raise NotMadeAgain("it is not asked for")


def _timed(checks: Callable[[], list[Check]]) -> dict[str, float]:
    start, start_busy = time.perf_counter(), time.process_time()
    found = checks()
    seconds = time.perf_counter() - start
    busy = time.process_time() - start_busy
    if any(check.verdict is Verdict.FAIL for check in found):
        raise RuntimeError("an honest recording was not believed")
    return {"seconds": seconds, "busy": busy, "peak": _peak_memory()}


def _actions_of(env: Any, episodes: int, steps: int) -> list[list[Any]]:
    return [random_actions(env, steps)] * episodes


def _take_some(directory: Path, to: Path, count: int) -> None:
    """Copy some of the recorded episodes, and what they need."""
    to.mkdir()
    for path in directory.glob("openaigym.model.*"):
        shutil.copy(path, to)
    for path in sorted(directory.glob("*.h5"))[:count]:
        shutil.copy(path, to)


def _variants(
    all_of_them: Path, few: Path, settings: Settings
) -> dict[tuple[str, int], Callable[[], dict[str, float]]]:
    many = settings.episodes
    bare = functools.partial(call, step_bare, episodes=many, steps=settings.steps)
    variants: dict[tuple[str, int], Callable[[], dict[str, float]]] = {
        (_BARE, many): bare
    }
    for name, function in ((_STEPS, check_steps), (_ALL, check_all)):
        for count, directory in ((many, all_of_them), (settings.few, few)):
            variants[name, count] = functools.partial(
                call, function, directory=str(directory), warm_up=str(few)
            )
    return variants


def _times(
    samples: Mapping[tuple[str, int], list[dict[str, float]]], settings: Settings
) -> list[Result]:
    many = settings.episodes
    bare = Reference(_BARE, _of("seconds", samples[_BARE, many]))
    return [
        Result(
            subject=f"{many} episodes of {settings.steps} steps",
            variant=name,
            unit="s",
            samples=_of("seconds", samples[name, many]),
            reference=None if name == _BARE else bare,
            promise=_PROMISES.get(name),
            note=_note(samples[name, many], samples[_BARE, many]),
        )
        for name in (_BARE, _STEPS, _ALL)
    ]


def _note(samples: list[dict[str, float]], bare: list[dict[str, float]]) -> str:
    """Return what else there is to say; the start of a process is in no number."""
    busy, reference = (statistics.median(_of("busy", each)) for each in (samples, bare))
    return f"by CPU time {busy / reference:.3g}"


def _growth(
    samples: Mapping[tuple[str, int], list[dict[str, float]]], settings: Settings
) -> list[Result]:
    many, few = settings.episodes, settings.few
    return [
        Result(
            subject=f"{few} to {many} episodes",
            variant=f"{name}, growth",
            unit="MB",
            samples=_of("peak", samples[name, many]),
            reference=Reference(
                f"{few} episodes", _of("peak", samples[name, few]), is_ratio=False
            ),
            promise=_NO_GROWTH,
        )
        for name in (_STEPS, _ALL)
    ]


def _of(key: str, samples: list[dict[str, float]]) -> tuple[float, ...]:
    return tuple(sample[key] for sample in samples)


def _peak_memory() -> float:
    match = _PEAK.search(Path("/proc/self/status").read_text())
    assert match is not None
    return int(match[1]) * 1024 / _MEGABYTE
