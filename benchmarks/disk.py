# SPDX-License-Identifier: Apache-2.0
"""The size of recorded episodes, and the time to finish their trajectory files."""

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

TITLE = "Disk: size of an episode, with every step captured"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        environments: names of the environments; dm_control's tasks have names such as
            `dm_control/dog-run`.
        rounds: number of rounds. Only the times differ from round to round.
        steps: length of the episodes.
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
    """Return the result lines for all environments."""
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
    """Record an episode of random actions and finish its trajectory file.

    Returns:
        The sizes of the log, of the finished file and of the model's files in bytes,
        and the time to finish the file in seconds.
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
        # Closing waits until the model is stored.
        env.close()
        for path in sorted(Path(directory).glob("openaigym.model.*")):
            sizes[f"model, {_ending(path.name)}"] = path.stat().st_size
        return {**sizes, "seconds": seconds}


def _ending(name: str) -> str:
    """Return the part after the hash in the name of a model file."""
    return "." + name.split(".", 3)[3]


def _recorded_gymnasium(env_id: str, steps: int, directory: str) -> Any:
    """Record an episode and return the monitor, which is still open."""
    make = {**UNENDING.get(env_id, {}), "max_episode_steps": steps}
    env = Setup(
        env_id=env_id, recorder=MONITOR, make=make, options={"workers": 0}
    ).open(directory)
    env.reset(seed=0)
    for action in random_actions(env, steps):
        env.step(action)
    return env


def _recorded_dm_control(env_id: str, steps: int, directory: str) -> Any:
    """Record an episode and return the monitor, which is still open."""
    env = suite_environment(env_id)
    monitor = mjrec.Monitor(env, directory, workers=0, env_id=env_id)
    monitor.reset()
    for action in random_actions(env, steps):
        monitor.step(action)
    # Ends the episode if it has not ended yet.
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
