# SPDX-License-Identifier: Apache-2.0
"""Several cameras, captions and second names, through `mjrec.Monitor`."""

import json

import gymnasium
import numpy as np
import pytest
from other_python import run_python
from recordings import frames_of, hashes_at, manifest_of

import mjrec

SIZE = {"height": 48, "width": 64}

# Of which several can be drawn live: those of `physics.render()`.
WAYS = ["deferred", pytest.param("live", marks=pytest.mark.dm_control)]
CAMERAS = {"deferred": ["track", -1], "live": ["side", "back"]}


def record(directory, steps=3, render="deferred", **options):
    """Record an episode; return the frame hashes of each video, by its name's end."""
    if render == "live":
        from dm_control import suite

        made = suite.load("cheetah", "run", task_kwargs={"random": 0})
        options["env_id"] = "dm_control/cheetah-run"
    else:
        made = gymnasium.make("HalfCheetah-v5", max_episode_steps=steps)
    with mjrec.Monitor(made, directory, render=render, **{**SIZE, **options}) as env:
        env.reset(**({} if render == "live" else {"seed": 0}))
        for _ in range(steps):
            env.step(np.full(6, 0.5, np.float32))
    return {
        path.name.split(".video000000")[-1].removesuffix(".framehash"): hashes_at(path)
        for path in directory.glob("*.framehash")
    }


# Takes more than five seconds: several monitors with workers of their own.
@pytest.mark.parametrize("render", WAYS)
def test_several_cameras(tmp_path, render):
    """Each has the video that it would have alone; side by side they are one."""
    first, second = CAMERAS[render]
    several = {"camera": [first, second], "render": render}
    both = record(tmp_path / "both", **several)
    assert both.keys() == {"", f".{second}"}
    assert both[""] != both[f".{second}"]
    other = record(tmp_path / "second", camera=second, render=render)
    assert other == {"": both[f".{second}"]}
    names = [video for video, _ in manifest_of(tmp_path / "both")["videos"]]
    videos = sorted((tmp_path / "both").glob("*.mp4"), key=lambda p: len(p.name))
    assert sorted(names) == sorted(path.name for path in videos)
    cameras = [
        json.loads(path.with_suffix(".meta.json").read_text())["camera"]
        for path in videos
    ]
    assert cameras[0] == first != cameras[1]
    record(tmp_path / "tiled", tiled=True, **several)
    [video] = (tmp_path / "tiled").glob("*.mp4")
    assert json.loads(video.with_suffix(".meta.json").read_text())["tiled"] is True
    wide = frames_of(video)[-1]
    assert wide.shape == (48, 128, 3)
    for half, single in zip((wide[:, :64], wide[:, 64:]), videos, strict=True):
        difference = np.abs(half.astype(int) - frames_of(single)[-1].astype(int))
        assert difference.mean() < 4


WITHOUT_PILLOW = """
import sys

sys.modules["PIL"] = None
import gymnasium, mjrec

try:
    mjrec.Monitor(gymnasium.make("Hopper-v5"), sys.argv[1], annotate=True)
except mjrec.MissingDependency as error:
    print(error)
"""


def test_captions_without_pillow_are_an_error_of_the_constructor(tmp_path):
    """It says how to install it, and nothing is left."""
    said = run_python(WITHOUT_PILLOW, tmp_path / "run").stdout
    assert "pip install 'mjrec[annotate]'" in said
    assert not (tmp_path / "run").exists()
