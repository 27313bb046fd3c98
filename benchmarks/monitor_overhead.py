# SPDX-License-Identifier: Apache-2.0
"""What a monitor costs an environment whose episodes are counted and not drawn.

Steps of the bare environment and of the monitored one, in rounds that take turns; the
table has the medians of the rounds.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from typing import Any

import gymnasium

import mjrec

ENVIRONMENTS = ("HalfCheetah-v5", "Humanoid-v5")
ROUNDS = 11
STEPS = 4000
EPISODE = 200


def seconds_per_step(env: Any) -> float:
    """Return the mean time of a step over many short episodes."""
    actions = [env.action_space.sample() for _ in range(EPISODE)]
    start = time.perf_counter()
    steps = 0
    while steps < STEPS:
        env.reset(seed=steps)
        for action in actions:
            steps += 1
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                break
    return (time.perf_counter() - start) / steps


def measure(env_id: str) -> tuple[float, float]:
    """Return the seconds of a bare and of a monitored step."""
    bare = gymnasium.make(env_id, max_episode_steps=EPISODE)
    inner = gymnasium.make(env_id, max_episode_steps=EPISODE)
    bare.action_space.seed(0)
    inner.action_space.seed(0)
    rounds: list[tuple[float, float]] = []
    with (
        tempfile.TemporaryDirectory() as directory,
        mjrec.Monitor(
            inner, directory, video_callable=False, allow_early_reset=True
        ) as monitored,
    ):
        for _ in range(ROUNDS):
            rounds.append((seconds_per_step(bare), seconds_per_step(monitored)))
    bare.close()
    return (
        statistics.median(first for first, _ in rounds),
        statistics.median(second for _, second in rounds),
    )


def main() -> None:
    """Print a line for each environment."""
    print(f"{'environment':16} {'bare':>10} {'monitored':>10} {'speed':>6}")
    for env_id in ENVIRONMENTS:
        bare, monitored = measure(env_id)
        print(
            f"{env_id:16} {bare * 1e6:8.1f}us {monitored * 1e6:8.1f}us "
            f"{bare / monitored:6.3f}"
        )


if __name__ == "__main__":
    main()
