# SPDX-License-Identifier: Apache-2.0
"""Measure the cost of recording and compare it with the promised limits.

Run `python -m benchmarks`. Each measurement runs its variants alternately, each in a
separate process, and the table shows the medians over the rounds. The range next to a
number contains half of the samples. The machine should be idle otherwise.
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

# Modules of this package. They are imported after OpenGL has been chosen, because some
# of them import mujoco.
MEASUREMENTS = (
    *("stepping", "time_to_video", "memory", "rendering", "disk", "encoding"),
    *("verifying", "evaluating", "reporting", "scaling", "engines", "starting"),
)


# Measurements that have a variant with the time of each phase.
_PHASES = {"time_to_video": "video_phases"}


@dataclass(frozen=True)
class Report:
    """The results of a benchmark run.

    Attributes:
        machine: the machine that the benchmarks ran on.
        quick: whether the benchmarks ran with `--quick`.
        results: the results, keyed by the name of the measurement.
        seconds: duration of each measurement, keyed by its name.
    """

    machine: Machine
    quick: bool
    results: Mapping[str, list[Result]]
    seconds: Mapping[str, float]

    def as_json(self) -> dict[str, Any]:
        """Return the report as values that JSON can represent."""
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
    """Run the requested measurements, and return 1 if a limit is exceeded."""
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
            # Written after each measurement, so that an interrupted run leaves results.
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
        help=f"run only some of {', '.join(MEASUREMENTS)}",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="use fewer rounds and steps: takes minutes, but is less accurate",
    )
    parser.add_argument(
        "--phases",
        action="store_true",
        help="measure the phases of time_to_video instead of its total time",
    )
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write every sample to this file"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
