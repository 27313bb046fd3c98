# SPDX-License-Identifier: Apache-2.0
"""Vector environments for tests, without a simulator."""

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from recordings import frames_of

if not hasattr(gymnasium.vector, "AutoresetMode"):
    pytest.skip("Gymnasium before 1.1 has one mode only", allow_module_level=True)

AutoresetMode = gymnasium.vector.AutoresetMode
MODES = tuple(AutoresetMode)
NEXT_STEP = AutoresetMode.NEXT_STEP
SAME_STEP = AutoresetMode.SAME_STEP
DISABLED = AutoresetMode.DISABLED


class VectorCorridor(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """A vector environment whose corridors grow by 16 pixels with each step."""

    def __init__(
        self, lengths=(2, 3), mode=NEXT_STEP, *, render_mode="rgb_array", heights=None
    ):
        self.num_envs = len(lengths)
        self.lengths = np.array(lengths)
        self.metadata = {"render_fps": 10, "autoreset_mode": mode}
        self.render_mode = render_mode
        self.heights = heights or (32,) * self.num_envs
        self.single_observation_space = gymnasium.spaces.Box(0, 99, (1,), np.float64)
        self.single_action_space = gymnasium.spaces.Discrete(9)
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, self.num_envs
        )
        self.action_space = gymnasium.vector.utils.batch_space(
            self.single_action_space, self.num_envs
        )
        self.positions = np.zeros(self.num_envs, int)
        self.rendered = 0
        self.closings = []

    def reset(self, *, seed=None, options=None):
        mask = (options or {}).pop("reset_mask", np.ones(self.num_envs, bool))
        self.positions[mask] = 0
        return self._observations(), {}

    def step(self, actions):
        mode = self.metadata["autoreset_mode"]
        begins = (self.positions >= self.lengths) & (mode == NEXT_STEP)
        self.positions = np.where(begins, 0, self.positions + 1)
        ends = self.positions >= self.lengths
        infos = {}
        if mode == SAME_STEP and ends.any():
            last = np.full(self.num_envs, None, object)
            for index in np.flatnonzero(ends):
                last[index] = self._observations()[index]
            infos = {
                "final_obs": last,
                "_final_obs": ends,
                "final_info": {"is_success": ends.copy(), "_is_success": ends},
                "_final_info": ends,
            }
            self.positions[ends] = 0
        rewards = np.where(begins, 0.0, 0.5)
        return self._observations(), rewards, ends, np.zeros_like(ends), infos

    def render(self):
        self.rendered += 1
        return tuple(
            _frame(position, height)
            for position, height in zip(self.positions, self.heights, strict=True)
        )

    def close_extras(self, **kwargs):
        self.closings.append(kwargs)

    def _observations(self):
        return self.positions[:, None].astype(float)


def _frame(position, height):
    frame = np.zeros((height, 64, 3), np.uint8)
    frame[:, : 16 * position + 16] = (200, 40, 10)
    return frame


def play(env, steps, *, seed=None):
    """Reset, then take steps; in mode DISABLED, also reset after each episode."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    for _ in range(steps):
        _, _, terminations, truncations, _ = env.step(env.action_space.sample())
        ends = np.asarray(terminations) | np.asarray(truncations)
        if env.metadata["autoreset_mode"] == DISABLED and ends.any():
            env.reset(options={"reset_mask": ends})


def path_of(monitor, episode, ending):
    name = f"openaigym.video.{monitor.infix}.video{episode:06d}.{ending}"
    return Path(monitor.directory) / name


def shown(path, *, step=4):
    """Return the positions in the corridor that a video shows."""
    columns = [int((frame[0, :, 0] > 128).sum()) for frame in frames_of(path)]
    return [round(count / step) - 1 for count in columns]


def metadata_at(path):
    return json.loads(path.read_text())
