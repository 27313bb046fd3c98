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
from parts import parametrize
from recordings import frames_of, manifest_of

import mjrec

SIZE = {"height": 48, "width": 64}


def record(directory: Path, steps: int = 3, **options: Any) -> dict[str, str]:
    """Record an episode; return the frame hashes of each video, by its name's end."""
    made = gymnasium.make("HalfCheetah-v5", max_episode_steps=steps)
    with mjrec.Monitor(made, directory, **{**SIZE, **options}) as env:
        env.reset(seed=0)
        for _ in range(steps):
            env.step(np.full(6, 0.5, np.float32))
    return {
        path.name.split(".video000000")[-1].removesuffix(".framehash"): _hashes(path)
        for path in directory.glob("*.framehash")
    }


def _hashes(path: Path) -> str:
    lines = path.read_text().splitlines()
    return "\n".join(line for line in lines if not line.startswith("#"))


# Takes more than five seconds: a monitor with renderers of its own for each camera.
@parametrize("render", ["deferred", "live"])
def test_each_camera_has_a_video_as_if_it_were_the_only_one(
    tmp_path: Path, render: str
) -> None:
    """Frame by frame, whichever stands first, drawn live or later."""
    both = record(tmp_path / "both", camera=["track", -1], render=render)
    track = record(tmp_path / "track", camera="track", render=render)
    free = record(tmp_path / "free", camera=-1, render=render)
    assert both == {"": track[""], ".-1": free[""]}


@parametrize("render", ["live", "deferred"])
def test_manifest_and_metadata_name_all_videos(tmp_path: Path, render: str) -> None:
    """Each video has its metadata, with its camera, and is in the index."""
    record(tmp_path, camera=["track", -1], render=render)
    names = [video for video, _ in manifest_of(tmp_path)["videos"]]
    assert sorted(names) == sorted(path.name for path in tmp_path.glob("*.mp4"))
    cameras = [
        json.loads((tmp_path / name.replace(".mp4", ".meta.json")).read_text())[
            "camera"
        ]
        for name in sorted(names, key=len)
    ]
    assert cameras[0] == "track"
    assert len(cameras) == 2
    assert cameras[1] != "track"


@parametrize("render", ["live", "deferred"])
def test_further_videos_name_the_first_and_their_second_name(
    tmp_path: Path, render: str
) -> None:
    """Whoever has one file finds the others."""
    record(tmp_path, camera=["track", -1], render=render, name_prefix="rl")
    [first, further] = sorted(
        tmp_path.glob("openaigym.*.mp4"), key=lambda p: len(str(p))
    )
    about = json.loads(further.with_suffix(".meta.json").read_text())
    assert about["first_video"] == first.name
    assert (tmp_path / about["also_named"]).samefile(further)
    about = json.loads(first.with_suffix(".meta.json").read_text())
    assert about["further_videos"] == [further.name]


@parametrize("render", ["live", "deferred"])
def test_cameras_side_by_side_are_one_video(tmp_path: Path, render: str) -> None:
    """The grid has the very frames of both."""
    record(tmp_path / "tiled", camera=["track", -1], tiled=True, render=render)
    record(tmp_path / "track", camera="track", render=render)
    [video] = (tmp_path / "tiled").glob("*.mp4")
    [single] = (tmp_path / "track").glob("*.mp4")
    wide, narrow = frames_of(video)[-1], frames_of(single)[-1]
    assert wide.shape == (48, 128, 3)
    difference = np.abs(wide[:, :64].astype(int) - narrow.astype(int))
    assert difference.mean() < 4
    about = json.loads(video.with_suffix(".meta.json").read_text())
    assert about["tiled"] is True


@pytest.mark.thorough
def test_live_and_deferred_captions_are_the_same(tmp_path: Path) -> None:
    """They say the same of each frame, in the same letters."""
    live = record(tmp_path / "live", camera="track", annotate=True, render="live")
    later = record(tmp_path / "later", camera="track", annotate=True, render="deferred")
    plain = record(tmp_path / "plain", camera="track", render="deferred")
    assert live == later
    assert live != plain


@parametrize("render", ["live", "deferred"])
def test_videos_have_gymnasiums_names_besides(tmp_path: Path, render: str) -> None:
    """The same files, so nothing is stored twice."""
    record(tmp_path, camera="track", name_prefix="rl-video", render=render)
    [own] = tmp_path.glob("openaigym.*.mp4")
    assert (tmp_path / "rl-video-episode-0.mp4").samefile(own)


@pytest.mark.thorough
def test_clips_have_gymnasiums_names_besides(tmp_path: Path) -> None:
    """By the number of the step that they begin before."""
    record(
        tmp_path,
        camera="track",
        name_prefix="rl-video",
        step_trigger=lambda step: step == 1,
    )
    [own] = tmp_path.glob("openaigym.*.mp4")
    assert (tmp_path / "rl-video-step-1.mp4").samefile(own)


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
