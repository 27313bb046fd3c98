# SPDX-License-Identifier: Apache-2.0
"""What goes wrong while videos are rendered costs no more than it must.

One clear error; the video stays pending, and the manifest says why; nothing is left
half-written; all other episodes are rendered, and a later try finds all it needs.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from full_disk import file_size_limit
from parts import parametrize
from recordings import frames_in, frames_of, manifest_of, metadata_of
from trajectories_by_hand import Painter, write_log, write_pending_manifest

from mjrec import (
    BlankVideo,
    FileNotWritten,
    Monitor,
    RenderError,
    VideoRecorder,
    render_videos,
)
from mjrec.formats.ffmpeg import ffmpeg_executable
from mjrec.formats.spans import recordings_in_flight
from mjrec.formats.trajectory_file import (
    find_trajectory,
    finish_trajectory,
    open_trajectory,
)
from mjrec.formats.video_metadata import metadata_path
from mjrec.rendering import finish as module
from mjrec.rendering.jobs import Outcome
from mjrec.rendering.progress import Progress
from mjrec.rendering.recordings import recorded_episodes

VIDEO = "openaigym.video.0.7.video00000{}.mp4"
FRAMES = 5


@pytest.fixture
def two(tmp_path: Path, painter: Painter) -> Path:
    """A directory with two pending videos and a manifest that says so."""
    directory = tmp_path / "two"
    directory.mkdir()
    for episode_id in range(2):
        # Metadata of more bytes than the video has.
        write_log(directory, episode_id, options={"why": 3000 * "x"})
    write_pending_manifest(directory, 0, 1)
    return directory


def finish(directory: Path, **options: Any) -> list[Outcome]:
    return list(module.finish(directory, workers=1, **options))


def reasons_in(directory: Path) -> dict[str, str | None]:
    """Return why the videos are pending, by their names."""
    [path] = directory.glob("*.manifest.json")
    pending = json.loads(path.read_text())["mjrec"]["pending"]
    return {entry["video"]: entry.get("reason") for entry in pending}


def check_nothing_is_half(directory: Path) -> None:
    """Whatever has a final name is whole, and nothing else is there."""
    assert not list(directory.glob(".*"))
    for video in directory.glob("*.mp4"):
        assert len(frames_of(video)) == FRAMES
        hashes = video.with_suffix(".framehash").read_text().splitlines()
        assert len([line for line in hashes if line[0] != "#"]) == FRAMES
        assert metadata_path(video).exists()
    for path in directory.glob("*.json"):
        assert json.loads(path.read_text())
    for key in recorded_episodes(directory):
        path = find_trajectory(directory, key.infix, key.number)
        assert path is not None
        with open_trajectory(path) as reader:
            assert reader.frame_count == FRAMES


def check_all_is_there_after_another_try(directory: Path) -> None:
    assert [outcome.failure for outcome in finish(directory) if outcome.failure] == []
    check_nothing_is_half(directory)
    assert len(list(directory.glob("*.mp4"))) == 2
    assert reasons_in(directory) == {}


# Encoders that are killed or hang


def use_encoder(
    folder: Path, monkeypatch: pytest.MonkeyPatch, *, of: str, instead: str
) -> None:
    """Let one video's encoder do something else, in the shell; all others encode."""
    program = folder / "ffmpeg"
    program.write_text(
        "#!/bin/sh\n"
        f'case "$*" in *libx264*{of}*.part*) {instead};; esac\n'
        f'exec "{ffmpeg_executable()}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))


KILLED = "head -c 3000 >/dev/null; echo no memory >&2; kill -9 $$"


def test_a_killed_encoder_gets_a_second_try(
    two: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """In mid-video; every frame is in the file once, and each is told once."""
    flag = tmp_path / "killed"
    once = f"if mkdir {flag} 2>/dev/null; then {KILLED}; fi"
    use_encoder(tmp_path, monkeypatch, of="video000000", instead=once)
    told: list[Progress] = []
    outcomes = finish(two, on_progress=told.append)
    assert flag.exists()
    assert [outcome.failure for outcome in outcomes] == [None, None]
    assert "begun anew" in caplog.text
    assert "no memory" in caplog.text
    assert max(progress.frames_done for progress in told) == 2 * FRAMES
    check_nothing_is_half(two)


def test_an_encoder_that_is_killed_again_leaves_the_video_pending(
    two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With what it said; the other video is rendered."""
    use_encoder(tmp_path, monkeypatch, of="video000000", instead=KILLED)
    first, second = finish(two)
    assert first.failure is not None
    assert "video000000.mp4 could not be encoded" in first.failure
    assert "exit status: -9" in first.failure
    assert "no memory" in first.failure
    assert (second.failure, second.frame_count) == (None, FRAMES)
    [(name, reason)] = reasons_in(two).items()
    assert name == VIDEO.format(0)
    assert reason is not None
    assert reason.endswith("no memory")
    check_nothing_is_half(two)
    monkeypatch.delenv("IMAGEIO_FFMPEG_EXE")
    check_all_is_there_after_another_try(two)


# Takes more than five seconds: the encoder's timeout, twice.
@parametrize("instead", ["exec sleep 60", "cat >/dev/null; sleep 60"])
def test_an_encoder_that_hangs_leaves_the_video_pending(
    instead: str, two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether it takes nothing or does not end; the other video is rendered."""
    monkeypatch.setenv("MJREC_PATIENCE", "2")
    use_encoder(tmp_path, monkeypatch, of="video000000", instead=instead)
    # More than a pipe takes.
    began = time.monotonic()
    first, second = finish(two)
    assert time.monotonic() - began < 30
    assert first.failure is not None
    assert "made no progress for 2 seconds" in first.failure
    assert second.failure is None
    assert list(reasons_in(two)) == [VIDEO.format(0)]
    check_nothing_is_half(two)
    monkeypatch.delenv("IMAGEIO_FFMPEG_EXE")
    check_all_is_there_after_another_try(two)


def test_an_encoder_that_never_begins_is_not_waited_for(
    two: Path, stuck_encoder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Already the trial that each encoder is given ends."""
    monkeypatch.setenv("MJREC_PATIENCE", "0.5")
    outcomes = finish(two)
    assert stuck_encoder.exists()
    assert all("made no progress" in str(outcome.failure) for outcome in outcomes)
    assert len(reasons_in(two)) == 2
    check_nothing_is_half(two)


# Full disks

ROOM = [30, 600, 800, 1200, 1600, 2000, 2500, 3000]


@pytest.mark.parametrize(
    ("finished", "room"),
    [(False, 100), (False, 4000), *((True, room) for room in ROOM)],
)
def test_a_full_disk_is_one_clear_error_wherever_it_comes(
    finished: bool, room: int, two: Path
) -> None:
    """Be it at the trajectory, the hashes, the video, its metadata or the manifest."""
    if finished:
        for recording in recordings_in_flight(two):
            finish_trajectory(recording.path)
        assert not list(two.glob("*.states.*"))
    with file_size_limit(room):
        failures = [str(outcome.failure) for outcome in finish(two)]
    for failure in failures:
        assert "File too large" in failure
        assert str(two / "openaigym.") in failure
    check_nothing_is_half(two)
    assert not list(two.glob("*.mp4"))
    assert list(reasons_in(two)) == [VIDEO.format(0), VIDEO.format(1)]
    check_all_is_there_after_another_try(two)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 256 KiB, where one can be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False)
        refusal = mounted.stderr.decode().strip() if mounted.returncode else None
    except OSError as error:
        refusal = str(error)
    if refusal is not None:
        pytest.skip(f"no file system can be mounted here: {refusal}")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


@pytest.mark.parametrize("pages", [0, 1, 3, 4, 6])
def test_a_really_full_disk(
    pages: int, small_disk: Path, tmp_path: Path, painter: Painter
) -> None:
    """As before, with the system's own refusal."""
    # As long as they are written, logs take more.
    recorded = tmp_path / "recorded"
    recorded.mkdir()
    for episode_id in range(2):
        write_log(recorded, episode_id)
    write_pending_manifest(recorded, 0, 1)
    shutil.copytree(recorded, small_disk, dirs_exist_ok=True)
    ballast = small_disk / "ballast"
    with ballast.open("wb", buffering=0) as file:
        with contextlib.suppress(OSError):
            while True:
                file.write(bytes(4096))
        file.truncate(file.tell() - 4096 * pages)
    try:
        told = [str(outcome.failure) for outcome in finish(small_disk)]
    except FileNotWritten as error:
        # The manifest, once all videos are there.
        told = [str(error)]
    for failure in told:
        assert failure == "None" or "No space left on device" in failure
        assert failure == "None" or str(small_disk / "openaigym.") in failure
    assert set(told) != {"None"}
    ballast.unlink()
    check_nothing_is_half(small_disk)
    check_all_is_there_after_another_try(small_disk)


# Damaged logs


@pytest.mark.parametrize(
    "damage", [b"?\n", b'{"format": "mjrec spans", "version": 99}\n']
)
def test_a_list_that_cannot_be_read_is_told_and_costs_no_other(
    damage: bytes, two: Path
) -> None:
    """Nobody knows what it was of; it stays, set aside where mjrec is not too old."""
    damaged = min(two.glob("*.spans"))
    damaged.write_bytes(damage)
    rendered = render_videos(two, workers=1)
    assert list(rendered.videos) == [VIDEO.format(1)]
    assert list(rendered.failures) == [damaged.name]
    assert "Cannot read" in rendered.failures[damaged.name]
    [kept] = two.glob(f"{damaged.name}*")
    assert kept.read_bytes() == damage
    assert list(reasons_in(two)) == [VIDEO.format(0)]


def test_rows_that_are_not_there_cost_their_own_video_only(two: Path) -> None:
    """The manifest says why; with the rows it is rendered."""
    rows = min(two.glob("*.log"))
    hidden = rows.rename(two.parent / "hidden")
    first, second = finish(two)
    assert "Cannot read" in str(first.failure)
    assert second.is_video
    assert list(reasons_in(two).values()) == [first.failure]
    hidden.rename(rows)
    check_all_is_there_after_another_try(two)


# The whole way, with workers, a simulation and OpenGL

DARK = """
<mujoco>
  <visual><headlight ambient="0 0 0" diffuse="0 0 0" specular="0 0 0"/></visual>
  <worldbody>
    <geom name="rail" type="capsule" size=".02 1" euler="0 90 0"/>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" range="-1 1"/>
      <geom type="capsule" size=".1 .1" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 .6" size=".05" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slider" ctrlrange="-3 3" gear="100"/></actuator>
</mujoco>
"""


def pendulum(folder: Path | None = None, **arguments: Any) -> Any:
    """Return a small environment; one without any light, if there is a folder."""
    if folder is not None:
        model = folder / "dark.xml"
        model.write_text(DARK)
        arguments["xml_file"] = str(model)
    return gymnasium.make(
        "InvertedPendulum-v5", width=40, height=32, max_episode_steps=3, **arguments
    )


def run(monitor: Any, *, episodes: int) -> None:
    for episode in range(episodes):
        monitor.reset(seed=episode)
        done = False
        while not done:
            _, _, terminated, truncated, _ = monitor.step(monitor.action_space.sample())
            done = terminated or truncated


def test_a_killed_encoder_beside_a_simulation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`close` tells of it, all else is there, and `mjrec render` makes what lacks."""
    use_encoder(tmp_path, monkeypatch, of="video000001", instead=KILLED)
    directory = tmp_path / "run"
    monitor = Monitor(pendulum(), directory, lambda _: True, workers=1, quality="draft")
    run(monitor, episodes=3)
    with pytest.raises(RenderError, match="no memory") as caught:
        monitor.close()
    [name] = caught.value.failures
    assert name.endswith("video000001.mp4")
    assert len(list(directory.glob("*.mp4"))) == 2
    [(pending, reason)] = reasons_in(directory).items()
    assert pending == name
    assert reason is not None
    assert reason.endswith("no memory")
    assert not list(directory.glob(".*"))
    monkeypatch.delenv("IMAGEIO_FFMPEG_EXE")
    assert [outcome.failure for outcome in finish(directory)] == [None]
    assert reasons_in(directory) == {}


@pytest.mark.parametrize("render", ["deferred", "live"])
def test_a_dark_scene_is_suspect_whichever_way_it_is_drawn(
    render: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The metadata says so, and the log warns; with `strict` it is an error.

    Drawn live as its episode ends, else as the monitor closes. The video is there.
    """
    for strict in (False, True):
        directory = tmp_path / str(strict)
        env = pendulum(tmp_path, render_mode="rgb_array")
        monitor = Monitor(
            env, directory, lambda _: True, render=render, strict=strict, workers=1
        )
        kind = BlankVideo if render == "live" else RenderError
        with (
            pytest.raises(kind, match="frames are black")
            if strict
            else contextlib.nullcontext()
        ):
            run(monitor, episodes=1)
            monitor.close()
        monitor.close()
        assert metadata_of(directory, 0)["suspect_black"] is True
        assert len(manifest_of(directory)["videos"]) == 1
        assert len(frames_in(directory, 0)) >= 2
    assert "frames are black" in caplog.text


def test_with_strict_a_dark_video_of_a_recorder_is_an_error(tmp_path: Path) -> None:
    """As it closes."""
    env = pendulum(tmp_path, render_mode="rgb_array")
    recorder = VideoRecorder(env, tmp_path / "v.mp4", strict=True)
    env.reset(seed=0)
    for _ in range(3):
        recorder.capture_frame()
    with pytest.raises(BlankVideo, match="all 3 frames are black"):
        recorder.close()
    env.close()
