# SPDX-License-Identifier: Apache-2.0
"""Videos counted in steps: `step_trigger` and `video_length`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from recordings import frames_of

import mjrec


class Counting(gymnasium.Env[np.ndarray, int]):
    """Shows how many steps were taken so far, as the brightness of its pictures."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  Gymnasium's own annotation
    observation_space = gymnasium.spaces.Box(-1, 1, (1,))
    action_space = gymnasium.spaces.Discrete(2)
    render_mode = "rgb_array"

    def __init__(self, length: int) -> None:
        self.length = length
        self.taken = 0
        self.in_episode = 0

    def reset(self, **_: Any) -> tuple[np.ndarray, dict[str, Any]]:
        self.in_episode = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.taken += 1
        self.in_episode += 1
        return np.zeros(1, np.float32), 1.0, self.in_episode == self.length, False, {}

    def render(self) -> np.ndarray:
        return np.full((32, 32, 3), 5 * self.taken, np.uint8)


def ride(env: Any, steps: int) -> None:
    """Take so many steps, with resets where they are needed."""
    done = True
    for _ in range(steps):
        if done:
            env.reset()
        *_, terminated, truncated, _ = env.step(0)
        done = terminated or truncated


def shown(video: Path) -> list[int]:
    """Return how many steps had been taken at each frame of a video."""
    return [round(float(frame.mean()) / 5) for frame in frames_of(video)]


def videos(directory: Path) -> dict[str, list[int]]:
    """Return what each video of a directory shows, by the end of its name."""
    return {
        path.name.split(".video")[-1].removesuffix(".mp4"): shown(path)
        for path in sorted(directory.glob("*.mp4"))
    }


def test_clip_is_the_first_picture_and_so_many_steps(tmp_path: Path) -> None:
    """The picture before the step that began it, and no more than asked for."""
    with mjrec.Monitor(
        Counting(100),
        tmp_path,
        step_trigger=lambda step: step in (0, 7),
        video_length=4,
        allow_early_reset=True,
    ) as env:
        ride(env, 20)
    assert videos(tmp_path) == {
        "000000.step000000": [0, 1, 2, 3, 4],
        "000000.step000007": [7, 8, 9, 10, 11],
    }


def test_clip_goes_on_across_resets(tmp_path: Path) -> None:
    """A reset adds its picture; steps are what is counted."""
    with mjrec.Monitor(
        Counting(3), tmp_path, step_trigger=lambda step: step == 2, video_length=5
    ) as env:
        ride(env, 12)
    [(name, taken)] = videos(tmp_path).items()
    assert name == "000000.step000002"
    # Steps 3, 6 end an episode; the picture after each is that of the reset.
    assert taken == [2, 3, 3, 4, 5, 6, 6, 7]
    [about] = tmp_path.glob("*.meta.json")
    metadata = json.loads(about.read_text())
    assert (metadata["length"], metadata["complete"]) == (5, True)
    assert (metadata["episode_id"], metadata["last_episode_id"]) == (0, 2)


def test_no_clip_begins_while_another_runs(tmp_path: Path) -> None:
    """Each has all of its steps, whatever the trigger says meanwhile."""
    with mjrec.Monitor(
        Counting(100),
        tmp_path,
        step_trigger=lambda step: step % 2 == 0,
        video_length=3,
        allow_early_reset=True,
    ) as env:
        ride(env, 8)
    assert videos(tmp_path) == {
        "000000.step000000": [0, 1, 2, 3],
        "000000.step000004": [4, 5, 6, 7],
    }


def test_without_a_length_a_clip_ends_with_its_episode(tmp_path: Path) -> None:
    """As a scheduled video does, from the step on that began it."""
    with mjrec.Monitor(
        Counting(5), tmp_path, step_trigger=lambda step: step == 3
    ) as env:
        ride(env, 15)
    assert videos(tmp_path) == {"000000.step000003": [3, 4, 5]}


def test_length_cuts_and_prolongs_scheduled_videos(tmp_path: Path) -> None:
    """`video_length` with a schedule: the episode begins the video, steps end it."""
    with mjrec.Monitor(
        Counting(3),
        tmp_path,
        lambda episode: episode in (0, 3),
        video_length=4,
    ) as env:
        ride(env, 15)
    assert videos(tmp_path) == {
        "000000": [0, 1, 2, 3, 3, 4],
        "000003": [9, 10, 11, 12, 12, 13],
    }


def test_clip_that_runs_at_close_is_kept_and_marked(tmp_path: Path) -> None:
    """It is shorter than asked for, and says so."""
    with mjrec.Monitor(
        Counting(100),
        tmp_path,
        step_trigger=lambda step: step == 1,
        video_length=50,
        allow_early_reset=True,
    ) as env:
        ride(env, 4)
    assert videos(tmp_path) == {"000000.step000001": [1, 2, 3, 4]}
    [about] = tmp_path.glob("*.meta.json")
    metadata = json.loads(about.read_text())
    assert (metadata["complete"], metadata["reason"]) == (False, "close")
    assert metadata["length"] == 3


def test_clips_are_in_the_manifest(tmp_path: Path) -> None:
    """Whoever reads the index finds every video."""
    with mjrec.Monitor(
        Counting(3), tmp_path, step_trigger=lambda step: step in (0, 4)
    ) as env:
        ride(env, 6)
    results = mjrec.load_results(tmp_path)
    assert [Path(video).name for video, _ in results["videos"]] == [
        path.name for path in sorted(tmp_path.glob("*.mp4"))
    ]
    assert results["episode_lengths"] == [3, 3]


@pytest.mark.parametrize("render", [None, "live"])
def test_mujoco_clips_are_rendered_later(render: str | None, tmp_path: Path) -> None:
    """They have the same pictures either way, and the metadata says which it was."""
    made = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array", width=64)
    with mjrec.Monitor(
        made,
        tmp_path,
        step_trigger=lambda step: step == 1,
        video_length=3,
        render=render,
    ) as env:
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(1, np.float32))
    [about] = tmp_path.glob("*.meta.json")
    metadata = json.loads(about.read_text())
    assert metadata["recording"] == (render or "deferred")
    assert metadata["frame_count"] == 4


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"step_trigger": 5}, "step_trigger must be a function"),
        ({"step_trigger": lambda: True}, "called with one argument"),
        ({"keep": lambda a, b: [0]}, "called with one argument"),
        ({"step_trigger": bool, "video_callable": bool}, "one of them"),
        ({"video_length": 0}, "positive whole number"),
        ({"video_length": True}, "positive whole number"),
        ({"video_length": 3, "render": "off"}, 'render="off"'),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_made(
    options: dict[str, Any], words: str, tmp_path: Path
) -> None:
    """One error with the way out, and no directory."""
    with pytest.raises(mjrec.InvalidArgument, match=words):
        mjrec.Monitor(Counting(3), tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


def test_what_cannot_be_rendered_later_is_no_clip_to_be(tmp_path: Path) -> None:
    """Asked for by name it is an error, before anything is made."""
    with pytest.raises(mjrec.PicturesDiffer, match='render="live"'):
        mjrec.Monitor(
            Counting(3), tmp_path / "run", step_trigger=bool, render="deferred"
        )
    assert not (tmp_path / "run").exists()
