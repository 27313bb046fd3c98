# SPDX-License-Identifier: Apache-2.0
"""A program whose recordings name their author wherever they can.

Tests copy this file into the author's home directory and run it there.
"""

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import mjrec
from mjrec.trackers import MonitorCsvTracker, Tracker

HERE = Path(__file__).parent


class FailingTracker(Tracker):
    def episode(self, run, episode):
        raise OSError(f"no key in {HERE}/wandb.key")


class Diary(gymnasium.Env[Any, Any]):
    metadata = {"render_modes": ["ansi"], "render_fps": 4}  # noqa: RUF012  as Gymnasium declares it
    render_mode = "ansi"
    observation_space = action_space = gymnasium.spaces.Discrete(2)
    spec = gymnasium.envs.registration.EnvSpec("Diary-v0")

    def reset(self, **_):
        return 0, {}

    def step(self, _):
        return 0, 1.0, True, False, {}

    def render(self):
        return f"the diary is in {HERE}"


def pendulum():
    return gymnasium.make(
        "InvertedPendulum-v5",
        xml_file=str(HERE / "models" / "robot.xml"),
        max_episode_steps=4,
        render_mode="rgb_array",
        width=32,
        height=32,
    )


def record(directory):
    environment = mjrec.Monitor(
        pendulum(),
        directory,
        video_callable=lambda _: True,
        uid="mbrunelli-final",
        name_prefix="mbrunelli-run",
        policy_file=HERE / "policy.pt",
        trackers=[MonitorCsvTracker(), FailingTracker()],
        on_error="warn",
        workers=1,
    )
    with environment:
        for _ in range(2):
            environment.reset(seed=3, options={"goal": str(HERE / "goal.npy")})
            for _ in range(4):
                environment.step(np.zeros(1))


def write_diary(directory):
    with mjrec.Monitor(Diary(), directory, uid="brunelli-ws7.diary") as environment:
        environment.reset()
        environment.step(0)


if __name__ == "__main__":
    record(Path(sys.argv[1]) / "pendulum")
    write_diary(Path(sys.argv[1]) / "diary")
