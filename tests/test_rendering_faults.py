# SPDX-License-Identifier: Apache-2.0
"""What goes wrong while videos are rendered costs no more than it must.

One clear error; the video stays pending, and the manifest says why; nothing is left
half-written; all other episodes are rendered, and a later try finds all it needs.
"""

import contextlib
import json
import time

import gymnasium
import pytest
from full_disk import file_size_limit
from parts import parametrize
from recordings import frames_in, frames_of, manifest_of, metadata_of
from trajectories_by_hand import write_log, write_pending_manifest

from mjrec import BlankVideo, Monitor, RenderError, render_videos
from mjrec.formats.ffmpeg import ffmpeg_executable
from mjrec.formats.spans import find_trajectory, recordings_in_flight
from mjrec.formats.trajectory_file import (
    finish_trajectory,
    open_trajectory,
)
from mjrec.formats.video_metadata import metadata_path
from mjrec.rendering import finish as module
from mjrec.rendering.recordings import recordings

VIDEO = "openaigym.video.0.7.video00000{}.mp4"
FRAMES = 5


@pytest.fixture
def two(tmp_path, painter):
    """A directory with two pending videos and a manifest that says so."""
    directory = tmp_path / "two"
    directory.mkdir()
    for episode_id in range(2):
        # Metadata of more bytes than the video has.
        write_log(directory, episode_id, options={"why": 3000 * "x"})
    write_pending_manifest(directory, 0, 1)
    return directory


def finish(directory, **options):
    return list(module.finish(directory, workers=1, **options))


def reasons_in(directory):
    """Return why the videos are pending, by their names."""
    [path] = directory.glob("*.manifest.json")
    pending = json.loads(path.read_text())["mjrec"]["pending"]
    return {entry["video"]: entry.get("reason") for entry in pending}


def check_nothing_is_half(directory):
    """Whatever has a final name is whole, and nothing else is there."""
    assert not list(directory.glob(".*"))
    for video in directory.glob("*.mp4"):
        assert len(frames_of(video)) == FRAMES
        hashes = video.with_suffix(".framehash").read_text().splitlines()
        assert len([line for line in hashes if line[0] != "#"]) == FRAMES
        assert metadata_path(video).exists()
    for path in directory.glob("*.json"):
        assert json.loads(path.read_text())
    for key in recordings(directory):
        path = find_trajectory(directory, key.infix, key.number)
        assert path is not None
        with open_trajectory(path) as reader:
            assert reader.frame_count == FRAMES


def check_all_is_there_after_another_try(directory):
    assert not [each for each in finish(directory) if each.failures]
    check_nothing_is_half(directory)
    assert len(list(directory.glob("*.mp4"))) == 2
    assert reasons_in(directory) == {}


# Encoders that are killed or hang


def use_encoder(folder, monkeypatch, *, of, instead):
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


def test_a_killed_encoder_gets_a_second_try(two, tmp_path, monkeypatch, caplog):
    """In mid-video; every frame is in the file once, and each is told once."""
    flag = tmp_path / "killed"
    once = f"if mkdir {flag} 2>/dev/null; then {KILLED}; fi"
    use_encoder(tmp_path, monkeypatch, of="video000000", instead=once)
    told = []
    results = finish(two, on_progress=told.append)
    assert flag.exists()
    assert not [each for each in results if each.failures]
    assert "Restarting the video" in caplog.text
    assert "no memory" in caplog.text
    assert max(progress.frames_done for progress in told) == 2 * FRAMES
    check_nothing_is_half(two)


# Takes more than five seconds: the encoder's timeout, twice.
@parametrize("instead", ["exec sleep 60", "cat >/dev/null; sleep 60"])
def test_an_encoder_that_hangs_leaves_the_video_pending(
    instead, two, tmp_path, monkeypatch
):
    """Whether it takes nothing or does not end; the other video is rendered."""
    monkeypatch.setenv("MJREC_TIMEOUT", "2")
    use_encoder(tmp_path, monkeypatch, of="video000000", instead=instead)
    # More than a pipe takes.
    began = time.monotonic()
    first, second = finish(two)
    assert time.monotonic() - began < 30
    assert "made no progress for 2 seconds" in str(first.failures)
    assert second.videos
    assert list(reasons_in(two)) == [VIDEO.format(0)]
    check_nothing_is_half(two)
    monkeypatch.delenv("IMAGEIO_FFMPEG_EXE")
    check_all_is_there_after_another_try(two)


# Full disks

ROOM = [30, 800, 1600, 2500, 3000]


@pytest.mark.parametrize(
    ("finished", "room"),
    [(False, 100), (False, 4000), *((True, room) for room in ROOM)],
)
def test_a_full_disk_is_one_clear_error_wherever_it_comes(finished, room, two):
    """Be it at the trajectory, the hashes, the video, its metadata or the manifest."""
    if finished:
        for recording in recordings_in_flight(two):
            finish_trajectory(recording.path)
        assert not list(two.glob("*.states.*"))
    with file_size_limit(room):
        failures = [str(each.failures) for each in finish(two)]
    for failure in failures:
        assert "File too large" in failure
        assert str(two / "openaigym.") in failure
    check_nothing_is_half(two)
    assert not list(two.glob("*.mp4"))
    assert list(reasons_in(two)) == [VIDEO.format(0), VIDEO.format(1)]
    check_all_is_there_after_another_try(two)


# Damaged logs


@pytest.mark.parametrize("line", [b"?\n", b'{"rows": {"number": 0, "version": 99}}\n'])
def test_a_log_of_unknown_rows_is_told_and_costs_no_other(line, two):
    """It stays; what it was of is not known."""
    [journal] = two.glob("*.jsonl")
    _, *rest = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(line + b"".join(rest))
    damaged = min(two.glob("*.log"))
    rendered = render_videos(two, workers=1)
    assert list(rendered.videos) == [VIDEO.format(1)]
    assert list(rendered.failures) == [damaged.name]
    assert "Cannot read" in rendered.failures[damaged.name]
    assert damaged.exists()
    assert list(reasons_in(two)) == [VIDEO.format(0)]


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


def pendulum(folder=None, **arguments):
    """Return a small environment; one without any light, if there is a folder."""
    if folder is not None:
        model = folder / "dark.xml"
        model.write_text(DARK)
        arguments["xml_file"] = str(model)
    return gymnasium.make(
        "InvertedPendulum-v5", width=40, height=32, max_episode_steps=3, **arguments
    )


def run(monitor, *, episodes):
    for episode in range(episodes):
        monitor.reset(seed=episode)
        done = False
        while not done:
            _, _, terminated, truncated, _ = monitor.step(monitor.action_space.sample())
            done = terminated or truncated


def test_a_killed_encoder_beside_a_simulation(tmp_path, monkeypatch):
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
    assert not [each for each in finish(directory) if each.failures]
    assert reasons_in(directory) == {}


@pytest.mark.parametrize("render", ["deferred", "live"])
def test_a_dark_scene_is_suspect_whichever_way_it_is_drawn(render, tmp_path, caplog):
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
