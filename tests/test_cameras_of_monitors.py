# SPDX-License-Identifier: Apache-2.0
"""Several cameras, captions and second names, through `mjrec.Monitor`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from recordings import frames_of, manifest_of

import mjrec

SIZE = {"height": 48, "width": 64}

# Of which several can be drawn live: those of `physics.render()`.
WAYS = ["deferred", pytest.param("live", marks=pytest.mark.dm_control)]
CAMERAS = {"deferred": ["track", -1], "live": ["side", "back"]}


def record(
    directory: Path, steps: int = 3, render: str = "deferred", **options: Any
) -> dict[str, str]:
    """Record an episode; return the frame hashes of each video, by its name's end."""
    made: Any
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
        path.name.split(".video000000")[-1].removesuffix(".framehash"): _hashes(path)
        for path in directory.glob("*.framehash")
    }


def _hashes(path: Path) -> str:
    lines = path.read_text().splitlines()
    return "\n".join(line for line in lines if not line.startswith("#"))


# Takes more than five seconds: a monitor with workers of its own for each camera.
@pytest.mark.parametrize("render", WAYS)
def test_each_camera_has_a_video_as_if_it_were_the_only_one(
    tmp_path: Path, render: str
) -> None:
    """Frame by frame, whichever stands first, drawn live or later."""
    first, second = CAMERAS[render]
    both = record(tmp_path / "both", camera=[first, second], render=render)
    one = record(tmp_path / "first", camera=first, render=render)
    other = record(tmp_path / "second", camera=second, render=render)
    assert both == {"": one[""], f".{second}": other[""]}
    assert one[""] != other[""]


@pytest.mark.parametrize("render", WAYS)
def test_manifest_and_metadata_name_all_videos(tmp_path: Path, render: str) -> None:
    """Each video has its metadata, with its camera, and is in the index."""
    record(tmp_path, camera=CAMERAS[render], render=render)
    names = [video for video, _ in manifest_of(tmp_path)["videos"]]
    assert sorted(names) == sorted(path.name for path in tmp_path.glob("*.mp4"))
    cameras = [
        json.loads((tmp_path / name.replace(".mp4", ".meta.json")).read_text())[
            "camera"
        ]
        for name in sorted(names, key=len)
    ]
    assert cameras[0] == CAMERAS[render][0]
    assert len(cameras) == 2
    assert cameras[1] != cameras[0]


@pytest.mark.parametrize("render", WAYS)
def test_cameras_side_by_side_are_one_video(tmp_path: Path, render: str) -> None:
    """The grid has the very frames of both."""
    cameras = CAMERAS[render]
    record(tmp_path / "tiled", camera=cameras, tiled=True, render=render)
    record(tmp_path / "single", camera=cameras[0], render=render)
    [video] = (tmp_path / "tiled").glob("*.mp4")
    [single] = (tmp_path / "single").glob("*.mp4")
    wide, narrow = frames_of(video)[-1], frames_of(single)[-1]
    assert wide.shape == (48, 128, 3)
    difference = np.abs(wide[:, :64].astype(int) - narrow.astype(int))
    assert difference.mean() < 4
    about = json.loads(video.with_suffix(".meta.json").read_text())
    assert about["tiled"] is True


@pytest.mark.thorough
def test_live_and_deferred_captions_are_the_same(tmp_path: Path) -> None:
    """They say the same of each frame, in the same letters."""

    def hashes(name: str, **options: Any) -> str:
        made = gymnasium.make(
            "HalfCheetah-v5", max_episode_steps=3, render_mode="rgb_array", **SIZE
        )
        with mjrec.Monitor(made, tmp_path / name, **options) as env:
            env.reset(seed=0)
            for _ in range(3):
                env.step(np.full(6, 0.5, np.float32))
        [path] = (tmp_path / name).glob("*.framehash")
        return _hashes(path)

    live = hashes("live", annotate=True, render="live")
    later = hashes("later", annotate=True, render="deferred")
    plain = hashes("plain", render="deferred")
    assert live == later
    assert live != plain


@pytest.mark.parametrize("options", [{"camera": "track"}, {"camera": [None, "track"]}])
def test_another_picture_than_renders_own_is_never_live(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    """The error says what to do."""
    made = gymnasium.make("HalfCheetah-v5", render_mode="rgb_array")
    with pytest.raises(mjrec.NoPictures, match=r"camera_name=.*leave render= out"):
        mjrec.Monitor(made, tmp_path / "run", render="live", **options)
    assert not (tmp_path / "run").exists()
    made.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"camera": []}, "no camera"),
        ({"camera": ["track", "track"]}, "twice"),
        ({"camera": ["track", None]}, "only the first"),
        ({"camera": ["track", "trick"]}, "trick"),
        ({"camera": "track", "tiled": True}, "one of each"),
        ({"name_prefix": "openaigym.video"}, "name_prefix"),
        ({"name_prefix": "../x"}, "name_prefix"),
        ({"annotate": 1}, "annotate"),
    ],
)
def test_what_cannot_be_is_told_before_anything_is_made(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    """One error, with what was asked for in it."""
    with pytest.raises(mjrec.InvalidArgument, match=words):
        record(tmp_path / "run", **options)
    assert not (tmp_path / "run").exists()


WITHOUT_PILLOW = """
import sys

sys.modules["PIL"] = None
import gymnasium, mjrec

try:
    mjrec.Monitor(gymnasium.make("Hopper-v5"), sys.argv[1], annotate=True)
except mjrec.MissingDependency as error:
    print(error)
"""


def test_captions_without_pillow_are_an_error_of_the_constructor(
    tmp_path: Path,
) -> None:
    """It says how to install it, and nothing is left."""
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_PILLOW, str(tmp_path / "run")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "pip install 'mjrec[annotate]'" in done.stdout
    assert not (tmp_path / "run").exists()
