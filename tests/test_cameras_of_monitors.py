# SPDX-License-Identifier: Apache-2.0
"""Test monitors with several cameras or with captions."""

import json
import sys

import gymnasium
import numpy as np
import pytest
from recordings import frames_of, hashes_at, manifest_of

import mjrec
from mjrec.annotation import check_annotation

SIZE = {"height": 48, "width": 64}

# dm_control's `physics.render()` can render several cameras live.
WAYS = ["deferred", pytest.param("live", marks=pytest.mark.dm_control)]
CAMERAS = {"deferred": ["track", -1], "live": ["side", "back"]}


def record(directory, steps=3, render="deferred", **options):
    """Record an episode; return the frame hashes of each video by name suffix."""
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


def metadata_of(video):
    return json.loads(video.with_suffix(".meta.json").read_text())


# Takes more than five seconds: three monitors start workers.
@pytest.mark.parametrize("render", WAYS)
def test_each_camera_has_its_own_video_or_they_are_tiled(tmp_path, render):
    """Each video equals that of a monitor with only this camera."""
    first, second = CAMERAS[render]
    several = {"camera": [first, second], "render": render}
    both = record(tmp_path / "both", **several)
    assert both.keys() == {"", f".{second}"}
    assert both[""] != both[f".{second}"]
    other = record(tmp_path / "second", camera=second, render=render)
    assert other == {"": both[f".{second}"]}
    videos = sorted((tmp_path / "both").glob("*.mp4"), key=lambda p: len(p.name))
    listed = {name for name, _ in manifest_of(tmp_path / "both")["videos"]}
    assert listed == {path.name for path in videos}
    assert metadata_of(videos[0])["camera"] == first != metadata_of(videos[1])["camera"]
    record(tmp_path / "tiled", tiled=True, **several)
    [video] = (tmp_path / "tiled").glob("*.mp4")
    assert metadata_of(video)["tiled"] is True
    wide = frames_of(video)[-1]
    assert wide.shape == (48, 128, 3)
    for half, single in zip((wide[:, :64], wide[:, 64:]), videos, strict=True):
        difference = np.abs(half.astype(int) - frames_of(single)[-1].astype(int))
        assert difference.mean() < 4


def test_captions_without_pillow_are_an_error(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    check_annotation.cache_clear()
    with pytest.raises(mjrec.MissingDependency, match=r"install 'mjrec\[annotate\]'"):
        mjrec.Monitor(gymnasium.make("Hopper-v5"), tmp_path / "run", annotate=True)
    assert not (tmp_path / "run").exists()
