# SPDX-License-Identifier: Apache-2.0
"""The time that commands which draw nothing take, from the shell to their end."""

from __future__ import annotations

import functools
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from .many_monitors import write_monitors
from .results import Result, at_most
from .rounds import Say, take_turns

TITLE = "Starting: commands that draw nothing"

_PROMISES = {"mjrec --help": at_most(0.4), "mjrec list": at_most(0.5)}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """The size of the measurement.

    Attributes:
        rounds: number of rounds.
    """

    rounds: int = 11


FULL = Settings()
QUICK = Settings(rounds=5)


def measure(settings: Settings, say: Say) -> list[Result]:
    """Return the seconds that each command takes."""
    with tempfile.TemporaryDirectory() as place:
        recorded = Path(place, "recorded")
        write_monitors(recorded, monitors=1, episodes=10)
        variants = {
            "mjrec --help": functools.partial(_seconds, "--help"),
            "mjrec list": functools.partial(_seconds, "list", str(recorded)),
        }
        samples = take_turns(variants, rounds=settings.rounds, say=say)
    return [
        Result(
            subject="from the shell to the end",
            variant=name,
            unit="s",
            samples=tuple(samples[name]),
            promise=promise,
        )
        for name, promise in _PROMISES.items()
    ]


def _seconds(*arguments: str) -> float:
    start = time.perf_counter()
    command = [sys.executable, "-m", "mjrec", *arguments]
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - start
