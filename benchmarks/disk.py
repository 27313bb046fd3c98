# SPDX-License-Identifier: Apache-2.0
"""How many bytes recorded episodes are, and how long their final form takes."""

from __future__ import annotations

import functools
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mjrec
from mjrec.formats.spans import recordings_in_flight
from mjrec.formats.trajectory_file import finish_trajectory, open_trajectory

from .children import call
from .results import Result
from .rounds import Say, take_turns
from .setups import (
    MONITOR,
    SUITE,
    UNENDING,
    Setup,
    is_there,
    random_actions,
    suite_environment,
)

TITLE = "Disk: bytes of an episode, every step captured"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How much is measured.

    Attributes:
        environments: their names; those of dm_control as `dm_control/dog-run`.
        rounds: of all environments; only the time depends on them.
        steps: the length of the episodes.
    """

    environments: tuple[str, ...] = (
        "HalfCheetah-v5",
        "Humanoid-v5",
        "dm_control/dog-run",
    )
    rounds: int = 3
    steps: int = 1000


FULL = Settings()
QUICK = Settings(rounds=1)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the lines of each environment."""
    samples = take_turns(
        {
            name: functools.partial(
                call, record_and_finish, name=name, steps=settings.steps
            )
            for name in settings.environments
            if is_there(name)
        },
        rounds=settings.rounds,
        say=say,
    )
    results = [
        result
        for name, values in samples.items()
        for result in _results(name, values, settings.steps)
    ]
    missing = [name for name in settings.environments if name not in samples]
    return [*results, *map(_missing, missing)]


def record_and_finish(name: str, steps: int) -> dict[str, float]:
    """Record an episode of random actions and give its trajectory the final form.

    Returns:
        Bytes of the log, of the finished file and of the model's files, and the
        seconds that finishing took.
    """
    with tempfile.TemporaryDirectory() as directory:
        if name.startswith(SUITE):
            env = _recorded_dm_control(name, steps, directory)
        else:
            env = _recorded_gymnasium(name, steps, directory)
        [recording] = recordings_in_flight(Path(directory))
        row = recording.dtype.itemsize
        with open_trajectory(recording.path) as reader:
            sizes = {"log": reader.row_count * row}
        start = time.perf_counter()
        finished = finish_trajectory(recording.path)
        seconds = time.perf_counter() - start
        sizes["finished"] = finished.stat().st_size
        # Which waits until the model is stored.
        env.close()
        for path in sorted(Path(directory).glob("openaigym.model.*")):
            sizes[f"model, {_ending(path.name)}"] = path.stat().st_size
        return {**sizes, "seconds": seconds}


def _ending(name: str) -> str:
    """Return what comes behind the hash in a model's name."""
    return "." + name.split(".", 3)[3]


def _recorded_gymnasium(env_id: str, steps: int, directory: str) -> Any:
    """Return a monitor whose episode is over."""
    make = {**UNENDING.get(env_id, {}), "max_episode_steps": steps}
    env = Setup(
        env_id=env_id, recorder=MONITOR, make=make, options={"workers": 0}
    ).open(directory)
    env.reset(seed=0)
    for action in random_actions(env, steps):
        env.step(action)
    return env


def _recorded_dm_control(env_id: str, steps: int, directory: str) -> Any:
    """Return a monitor whose episode is over."""
    env = suite_environment(env_id)
    monitor = mjrec.Monitor(env, directory, workers=0, env_id=env_id)
    monitor.reset()
    for action in random_actions(env, steps):
        monitor.step(action)
    # Whether it was over or not.
    monitor.reset()
    return monitor


def _results(
    name: str, samples: list[dict[str, float]], steps: int
) -> Iterator[Result]:
    per_thousand = 1000 / steps
    labels = {
        "log": "log, per 1000 steps",
        "finished": "finished .h5, per 1000 steps",
        "seconds": "time to finish, per 1000 steps",
    }
    for key in samples[0]:
        scale = per_thousand if key in labels else 1.0
        is_time = key == "seconds"
        yield Result(
            subject=name,
            variant=labels.get(key, key),
            unit="s" if is_time else "MB",
            samples=tuple(
                sample[key] * scale / (1 if is_time else 1e6) for sample in samples
            ),
        )


def _missing(name: str) -> Result:
    return Result(
        subject=name,
        variant="",
        unit="MB",
        samples=(),
        note="dm_control is not installed",
    )
