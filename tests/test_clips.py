# SPDX-License-Identifier: Apache-2.0
"""Videos counted in steps: `step_trigger` and `video_length`."""

from pathlib import Path

import numpy as np
import pytest
from recordings import frames_of

import mjrec
from conftest import Corridor


class Counting(Corridor):
    """Shows how many steps were taken so far, as the brightness of its frames."""

    def __init__(self, length):
        super().__init__(length)
        self.taken = 0

    def step(self, action):
        self.taken += 1
        return super().step(action)

    def render(self):
        return np.full((32, 32, 3), 5 * self.taken, np.uint8)


def ride(env, steps):
    """Take so many steps, with resets where they are needed."""
    done = True
    for _ in range(steps):
        if done:
            env.reset()
        *_, terminated, truncated, _ = env.step(0)
        done = terminated or truncated


def videos(directory):
    """Return how many steps each frame of each video shows, by the end of its name."""
    return {
        path.name.split(".video")[-1].removesuffix(".mp4"): [
            round(float(frame.mean()) / 5) for frame in frames_of(path)
        ]
        for path in sorted(directory.glob("*.mp4"))
    }


def begins(at):
    """Return the option to begin at these steps."""
    return {"step_trigger": lambda step: step in at}


@pytest.mark.parametrize(
    ("length", "steps", "options", "shown"),
    [
        # The frame before the step that began it, and no more than asked for.
        (
            *(100, 20, {**begins((0, 7)), "video_length": 4}),
            {
                "000000.step000000": [0, 1, 2, 3, 4],
                "000000.step000007": [7, 8, 9, 10, 11],
            },
        ),
        # None begins while another runs.
        (
            *(100, 8, {**begins(range(0, 9, 2)), "video_length": 3}),
            {"000000.step000000": [0, 1, 2, 3], "000000.step000004": [4, 5, 6, 7]},
        ),
        # Across resets: steps 3 and 6 end an episode.
        (
            *(3, 12, {**begins((2,)), "video_length": 5}),
            {"000000.step000002": [2, 3, 3, 4, 5, 6, 6, 7]},
        ),
        # At close it is shorter.
        (
            9,
            4,
            {**begins((1,)), "video_length": 50},
            {"000000.step000001": [1, 2, 3, 4]},
        ),
        # Without a length it ends with its episode.
        (5, 15, begins((3,)), {"000000.step000003": [3, 4, 5]}),
        # With a schedule the episode begins the video, and steps end it.
        (
            *(3, 15),
            {"video_callable": (0, 3).__contains__, "video_length": 4},
            {"000000": [0, 1, 2, 3, 3, 4], "000003": [9, 10, 11, 12, 12, 13]},
        ),
    ],
)
def test_a_clip_is_its_first_frame_and_n_steps(length, steps, options, shown, tmp_path):
    """A reset adds its frame; steps are what is counted."""
    env = Counting(length)
    with mjrec.Monitor(env, tmp_path, allow_early_reset=True, **options) as monitor:
        ride(monitor, steps)
    assert videos(tmp_path) == shown
    results = mjrec.load_results(tmp_path)
    listed = [Path(video).name for video, _ in results["videos"]]
    assert listed == [path.name for path in sorted(tmp_path.glob("*.mp4"))]
