# SPDX-License-Identifier: Apache-2.0
import contextlib
import gc
import hashlib
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from recordings import frames_of, hashes_at
from vector_environments import (
    DISABLED,
    NEXT_STEP,
    SAME_STEP,
    VectorCorridor,
    metadata_at,
    path_of,
    play,
)

import mjrec
from mjrec import InvalidArgument
from mjrec.frames import grid_frame

LENGTHS = (2, 3, 2)


@pytest.fixture
def corridors(make_corridor):
    """Make three corridors in this process, or one object that has three."""

    def make(mode, *, inside):
        if not inside:
            return VectorCorridor(LENGTHS, mode)
        each = [lambda n=n: make_corridor(n, size=(32, 64)) for n in LENGTHS]
        return SyncVectorEnv(each, autoreset_mode=mode)

    return make


def tiles_at(path, *, step):
    """Return the position that each tile of a 2x2 grid of 32x64 frames shows."""
    shown = []
    for frame in frames_of(path):
        assert frame.shape == (64, 128, 3)
        tiles = [frame[y, x : x + 64, 0] for y in (16, 48) for x in (0, 64)]
        shown.append([round(int((row > 128).sum()) / step) - 1 for row in tiles])
    return shown


@pytest.mark.parametrize("inside", [True, False])
@pytest.mark.parametrize("mode", [NEXT_STEP, DISABLED])
def test_one_video_shows_all(corridors, tmp_path, mode, inside):
    """It follows the first's episodes, and is listed in its manifest."""
    with mjrec.Monitor(corridors(mode, inside=inside), tmp_path, tiled=True) as env:
        play(env, 8)
    path = path_of(env.monitors[0], 0, "tiled.mp4")
    shown = tiles_at(path, step=4 if inside else 16)
    # The last of the four is the padding.
    assert shown == [[0, 0, 0, -1], [1, 1, 1, -1], [2, 2, 2, -1]]
    second = tiles_at(
        path_of(env.monitors[0], 1, "tiled.mp4"), step=4 if inside else 16
    )
    assert [tiles[0] for tiles in second] == [0, 1, 2]
    said = metadata_at(path.with_suffix(".meta.json"))
    assert (said["tiled"], said["rows"], said["columns"]) == (True, 2, 2)
    assert (said["complete"], said["length"], said["reward"]) == (True, 2, 1.0)
    assert len(hashes_at(path.with_suffix(".framehash"))) == 3
    infix = env.monitors[0].infix
    manifest = metadata_at(tmp_path / f"openaigym.manifest.{infix}.manifest.json")
    names = [Path(video).name for video, _ in manifest["videos"]]
    assert path.name in names
    assert path_of(env.monitors[0], 0, "mp4").name in names


@pytest.mark.parametrize("inside", [True, False])
def test_the_frame_that_a_reset_hides_is_said_to_be_missing(
    corridors, tmp_path, inside
):
    """In SAME_STEP the first tile shows the reset at last."""
    with mjrec.Monitor(
        corridors(SAME_STEP, inside=inside), tmp_path, tiled=True
    ) as env:
        play(env, 4)
    for episode in (0, 1):
        path = path_of(env.monitors[0], episode, "tiled.mp4")
        shown = tiles_at(path, step=4 if inside else 16)
        assert [tiles[0] for tiles in shown] == [0, 1, 0]
        said = metadata_at(path.with_suffix(".meta.json"))
        assert said["final_frame"] == "missing"
        assert (said["complete"], said["length"]) == (True, 2)


@pytest.mark.parametrize("how", ["reset", "close", "error"])
def test_a_video_that_is_cut_off_says_so(corridors, tmp_path, how):
    """Its metadata has the reason."""
    vector = corridors(NEXT_STEP, inside=False)
    with (
        contextlib.suppress(RuntimeError),
        mjrec.Monitor(vector, tmp_path, tiled=True) as env,
    ):
        env.reset()
        env.step(np.array([0, 0, 0]))
        if how == "reset":
            env.reset()
        if how == "error":
            raise RuntimeError("enough")
    said = metadata_at(path_of(env.monitors[0], 0, "tiled.meta.json"))
    assert said["complete"] is False
    assert said["reason"] == {"error": "exception"}.get(how, how)
    assert (said["length"], said["frame_count"]) == (1, 2)


def drawn_by(env):
    """Return its frame; Gymnasium draws into whichever context is current."""
    env.unwrapped.mujoco_renderer.viewer.make_context_current()
    return env.render()


# Takes more than five seconds: every environment alone, and all in one video.
def test_pixels_are_those_of_each_environment(tmp_path):
    """Each tile is what its own environment's `render()` gives."""
    view = {"render_mode": "rgb_array", "width": 64, "height": 64}
    several = [gymnasium.make("Hopper-v5", **view) for _ in range(2)]
    vector = SyncVectorEnv([lambda e=e: e for e in several])
    expected = []
    # What earlier tests have left would take its OpenGL context along at any moment.
    gc.collect()
    with mjrec.Monitor(vector, tmp_path, tiled=True) as env:
        env.reset(seed=4)
        for _ in range(2):
            env.step(env.action_space.sample())
            drawn = grid_frame([drawn_by(each) for each in several])
            expected.append(hashlib.sha256(drawn.tobytes()).hexdigest())
    path = path_of(env.monitors[0], 0, "tiled.framehash")
    assert hashes_at(path)[1:] == expected


def test_a_bad_frame_can_be_tolerated(tmp_path, caplog):
    """Sizes that differ are an error, or with `on_error="warn"` no tiled video."""
    vector = VectorCorridor(heights=(32, 48))
    with (
        mjrec.Monitor(vector, tmp_path / "raise", tiled=True) as env,
        pytest.raises(InvalidArgument, match="64x32, 64x48"),
    ):
        env.reset()
    with mjrec.Monitor(vector, tmp_path, tiled=True, on_error="warn") as env:
        play(env, 3)
    assert "64x32, 64x48" in caplog.text
    assert not list(tmp_path.glob("*.tiled.mp4"))
    assert path_of(env.monitors[1], 0, "mp4").exists()
