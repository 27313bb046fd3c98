# SPDX-License-Identifier: Apache-2.0
"""What recording costs, beside what was promised: `python -m benchmarks`.

Each measurement runs its variants in turns, every one in a process of its own, and the
table has the medians of the rounds. Half of the samples lie within the range beside a
number. The machine should have nothing else to do.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from rich.console import Console

import mjrec

from .machine import Machine, examine
from .results import Result
from .tables import table_of

# Modules of this package, imported after the choice of OpenGL: some import mujoco.
MEASUREMENTS = (
    *("stepping", "time_to_video", "memory", "rendering", "disk", "encoding"),
    *("verifying", "evaluating", "reporting", "scaling", "engines"),
)


# Those that can also be measured part by part.
_PHASES = {"time_to_video": "video_phases"}


@dataclass(frozen=True)
class Report:
    """What a run of the benchmarks found.

    Attributes:
        machine: that they ran on.
        quick: whether they ran shortly.
        results: by the names of the measurements.
        seconds: that each took.
    """

    machine: Machine
    quick: bool
    results: Mapping[str, list[Result]]
    seconds: Mapping[str, float]

    def as_json(self) -> dict[str, Any]:
        """Return everything in what JSON can hold."""
        return {
            "machine": asdict(self.machine),
            "quick": self.quick,
            "seconds": dict(self.seconds),
            "measurements": {
                name: [result.as_json() for result in results]
                for name, results in self.results.items()
            },
        }


def main(arguments: list[str] | None = None) -> int:
    """Measure what was asked for; return 1 where a promise is not kept."""
    options = _parser().parse_args(arguments)
    console, waiting = Console(), Console(stderr=True)
    machine = examine(mjrec.use_gl())
    results: dict[str, list[Result]] = {}
    seconds: dict[str, float] = {}
    for line in machine.lines():
        console.print(line, highlight=False)
    names = [*(options.only or MEASUREMENTS)]
    if options.phases:
        names = [_PHASES.get(name, name) for name in names]
    for name in names:
        module = importlib.import_module(f".{name}", __package__)
        start = time.monotonic()
        results[name] = _measured(name, module, options.quick, waiting)
        seconds[name] = time.monotonic() - start
        console.print()
        console.print(table_of(module.TITLE, results[name]))
        if options.json:
            # After each, so that an interrupted run has given something.
            report = Report(machine, options.quick, results, seconds)
            options.json.write_text(json.dumps(report.as_json(), indent=2) + "\n")
    broken = [r for each in results.values() for r in each if r.is_kept is False]
    return 1 if broken else 0


def _measured(
    name: str, module: ModuleType, quick: bool, waiting: Console
) -> list[Result]:
    settings = module.QUICK if quick else module.FULL
    with waiting.status(name) as status:
        results: list[Result] = module.measure(
            settings, lambda words: status.update(f"{name}: {words}")
        )
    return results


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=(__doc__ or "").partition("\n\n")[0]
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=MEASUREMENTS,
        metavar="NAME",
        help=f"some of {', '.join(MEASUREMENTS)}; all without it",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="fewer rounds and steps: minutes, and numbers to be taken with care",
    )
    parser.add_argument(
        "--phases",
        action="store_true",
        help="the parts of time_to_video, in its place",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write every sample to this file"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
