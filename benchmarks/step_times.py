# SPDX-License-Identifier: Apache-2.0
"""Times of single steps, in one process: `python -m benchmarks.step_times`.

On a busy machine, whole runs differ from each other by more than the cost of a monitor.
Therefore each step is timed separately in alternating rounds, and the quantiles of all
step times are printed. The cost of writing and of beginning and ending episodes shows
in the times of the episodes, and in the CPU time of whole runs divided by their number
of steps. For comparison, a prototype (`prototype`) only saves the state of each step.
"""

from __future__ import annotations

import tempfile
from time import perf_counter_ns, thread_time_ns
from typing import Any

import gymnasium
import numpy as np

import mjrec

from .prototype import PrototypeRecorder
from .setups import SUITE, is_there, random_actions, suite_environment

STEPS = {"HalfCheetah-v5": 6000, "Humanoid-v5": 3000, f"{SUITE}cheetah-run": 6000}
ROUNDS = 5
QUANTILES = (5, 25, 50)


def make(env_id: str) -> Any:
    """Return an environment from Gymnasium or from dm_control's suite."""
    if env_id.startswith(SUITE):
        return suite_environment(env_id)
    return gymnasium.make(env_id)


def reset(env: Any, seed: int) -> None:
    """Begin an episode. Only Gymnasium environments use the seed."""
    if hasattr(env, "action_space"):
        env.reset(seed=seed)
    else:
        env.reset()


def is_over(result: Any) -> bool:
    """Return whether the result of a step ends an episode."""
    return bool(result[2] or result[3] if len(result) == 5 else result.last())


def times(env: Any, actions: list[Any]) -> tuple[list[int], list[int], list[float]]:
    """Run episodes and return their times in nanoseconds.

    Returns:
        The time of each step, the time of each episode with its reset, and this
        thread's CPU time per step.
    """
    steps, episodes, seed = [], [], 0
    began, started = perf_counter_ns(), thread_time_ns()
    reset(env, seed)
    for action in actions:
        start = perf_counter_ns()
        result = env.step(action)
        steps.append(perf_counter_ns() - start)
        if is_over(result):
            seed += 1
            reset(env, seed)
            episodes.append(perf_counter_ns() - began)
            began = perf_counter_ns()
    return steps, episodes, [(thread_time_ns() - started) / len(actions)]


def measure(env_id: str, count: int) -> None:
    """Print the quantiles for one environment."""
    bare = make(env_id)
    actions = random_actions(bare, count)
    with (
        tempfile.TemporaryDirectory() as counted,
        tempfile.TemporaryDirectory() as all_,
    ):
        variants = {
            "bare": bare,
            "counted": _monitored(env_id, counted, lambda episode: False),
            "captured": _monitored(env_id, all_, lambda episode: True),
        }
        if not env_id.startswith(SUITE):
            variants["prototype"] = PrototypeRecorder(make(env_id))
        found: dict[str, Any] = {name: ([], [], []) for name in variants}
        for _ in range(ROUNDS):
            for name, env in variants.items():
                for total, part in zip(found[name], times(env, actions), strict=True):
                    total += part
        variants["counted"].close(wait=False)
        variants["captured"].close(wait=False)
    for name in variants.keys() - {"counted", "captured"}:
        variants[name].close()
    for index, unit in enumerate(("step", "episode", "CPU")):
        for quantile in QUANTILES:
            values = [np.percentile(found[name][index], quantile) for name in variants]
            print(
                f"{env_id:22} {unit:8} {quantile:3}% "
                + " ".join(f"{value / 1e3:10.1f}us" for value in values)
                + "   "
                + " ".join(f"{values[0] / value:.3f}" for value in values[1:])
                + " of bare"
            )


def _monitored(env_id: str, directory: str, schedule: Any) -> Any:
    return mjrec.Monitor(
        make(env_id), directory, schedule, workers=0, allow_early_reset=True
    )


def main() -> None:
    """Measure every environment."""
    columns = ("bare", "counted", "captured", "prototype")
    print(f"{'':37}" + "".join(f"{column:>13}" for column in columns))
    for env_id, count in STEPS.items():
        if is_there(env_id):
            measure(env_id, count)
        else:
            print(f"{env_id}: dm_control is not installed")


if __name__ == "__main__":
    main()
