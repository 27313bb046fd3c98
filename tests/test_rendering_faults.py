# SPDX-License-Identifier: Apache-2.0
"""Failures while videos are rendered.

Each is one error. The video stays pending, and the manifest has the reason. No file is
half-written, all other episodes are rendered, and a later try succeeds.
"""

import contextlib
import json
import time

import gymnasium
import pytest
from full_disk import file_size_limit
from parts import parametrize
from recordings import frames_in, frames_of, hashes_at, manifest_of, metadata_of
from trajectories_by_hand import write_log, write_pending_manifest

from mjrec import BlankVideo, Monitor, RenderError
from mjrec.formats.ffmpeg import ffmpeg_executable
from mjrec.formats.spans import find_trajectory, recordings_in_flight
from mjrec.formats.trajectory_file import finish_trajectory, open_trajectory
from mjrec.formats.video_metadata import metadata_path
from mjrec.rendering import finish as module
from mjrec.rendering.recordings import recordings

VIDEO = "openaigym.video.0.7.video00000{}.mp4"
FRAMES = 5


@pytest.fixture
def directory(tmp_path, painter):
    """A directory with two pending videos and its manifest."""
    directory = tmp_path / "two"
    directory.mkdir()
    for episode_id in range(2):
        # The metadata are larger than the video.
        write_log(directory, episode_id, options={"why": 3000 * "x"})
    write_pending_manifest(directory, 0, 1)
    return directory


def finish(directory, **options):
    return list(module.finish(directory, workers=1, **options))


def reasons_in(directory):
    """Return the reasons of pending videos by their names."""
    pending = manifest_of(directory)["mjrec"]["pending"]
    return {entry["video"]: entry.get("reason") for entry in pending}


def check_files_are_whole(directory):
    """Check that all files are complete, and that there are no temporary ones."""
    assert not list(directory.glob(".*"))
    for video in directory.glob("*.mp4"):
        assert len(frames_of(video)) == FRAMES
        assert len(hashes_at(video.with_suffix(".framehash"))) == FRAMES
        assert metadata_path(video).exists()
    for path in directory.glob("*.json"):
        assert json.loads(path.read_text())
    for key in recordings(directory):
        path = find_trajectory(directory, key.infix, key.number)
        assert path is not None
        with open_trajectory(path) as reader:
            assert reader.frame_count == FRAMES


def check_another_try_succeeds(directory):
    assert not [each for each in finish(directory) if each.failures]
    check_files_are_whole(directory)
    assert len(list(directory.glob("*.mp4"))) == 2
    assert reasons_in(directory) == {}


# Encoders that are killed or hang


def replace_encoder(folder, monkeypatch, *, of, instead):
    """Let one video's encoder run a shell command; all others encode."""
    program = folder / "ffmpeg"
    program.write_text(
        "#!/bin/sh\n"
        f'case "$*" in *libx264*{of}*.part*) {instead};; esac\n'
        f'exec "{ffmpeg_executable()}" "$@"\n'
    )
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))


def test_a_killed_encoder_gets_a_second_try(directory, tmp_path, monkeypatch, caplog):
    """Progress counts every frame once."""
    flag = tmp_path / "killed"
    killed = "head -c 3000 >/dev/null; echo no memory >&2; kill -9 $$"
    once = f"if mkdir {flag} 2>/dev/null; then {killed}; fi"
    replace_encoder(tmp_path, monkeypatch, of="video000000", instead=once)
    seen = []
    results = finish(directory, on_progress=seen.append)
    assert flag.exists()
    assert not [each for each in results if each.failures]
    assert "Restarting the video" in caplog.text
    assert "no memory" in caplog.text
    assert max(progress.frames_done for progress in seen) == 2 * FRAMES
    check_files_are_whole(directory)


# Takes more than five seconds: it waits twice for the timeout.
@parametrize("instead", ["exec sleep 60", "cat >/dev/null; sleep 60"])
def test_the_video_of_a_hanging_encoder_stays_pending(
    instead, directory, tmp_path, monkeypatch
):
    """The other video is rendered."""
    monkeypatch.setenv("MJREC_TIMEOUT", "2")
    replace_encoder(tmp_path, monkeypatch, of="video000000", instead=instead)
    began = time.monotonic()
    _, second = finish(directory)
    assert time.monotonic() - began < 30
    assert second.videos
    [(name, reason)] = reasons_in(directory).items()
    assert name == VIDEO.format(0)
    assert "made no progress for 2 seconds" in reason
    check_files_are_whole(directory)
    monkeypatch.delenv("IMAGEIO_FFMPEG_EXE")
    check_another_try_succeeds(directory)


# Full disks


@pytest.mark.parametrize(
    ("finished", "room"),
    [
        *((False, room) for room in (100, 4000)),
        *((True, room) for room in (30, 800, 1600, 2500, 3000)),
    ],
)
def test_a_full_disk_is_an_error_that_names_the_file(finished, room, directory):
    """The disk fills at the trajectory, hashes, video, metadata or manifest."""
    if finished:
        for recording in recordings_in_flight(directory):
            finish_trajectory(recording.path)
        assert not list(directory.glob("*.states.*"))
    with file_size_limit(room):
        failures = [str(each.failures) for each in finish(directory)]
    for failure in failures:
        assert "File too large" in failure
        assert str(directory / "openaigym.") in failure
    check_files_are_whole(directory)
    assert not list(directory.glob("*.mp4"))
    assert list(reasons_in(directory)) == [VIDEO.format(0), VIDEO.format(1)]
    check_another_try_succeeds(directory)


# With a simulation and OpenGL


@pytest.mark.parametrize("render", ["deferred", "live"])
def test_a_black_video_is_suspect_in_its_metadata_and_the_log(
    render, tmp_path, play, caplog
):
    """With `strict` it is an error too, though the video stays.

    The error comes as a live episode ends, or as the monitor closes.
    """
    size = {"width": 40, "height": 32, "max_episode_steps": 3}
    env = gymnasium.make("InvertedPendulum-v5", render_mode="rgb_array", **size)
    model = env.unwrapped.model
    model.light_active[:] = 0
    for kind in ("ambient", "diffuse", "specular"):
        getattr(model.vis.headlight, kind)[:] = 0
    for strict in (False, True):
        directory = tmp_path / str(strict)
        options = {"render": render, "strict": strict, "workers": 1}
        monitor = Monitor(env, directory, lambda _: True, **options)
        error = pytest.raises(
            BlankVideo if render == "live" else RenderError, match="frames are black"
        )
        with error if strict else contextlib.nullcontext():
            play(monitor, 1)
            monitor.close()
        monitor.close()
        assert metadata_of(directory, 0)["suspect_black"] is True
        assert len(manifest_of(directory)["videos"]) == 1
        assert len(frames_in(directory, 0)) >= 2
    assert "frames are black" in caplog.text
