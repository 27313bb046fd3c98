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
    pending = manifest_of(directory)["mjrec"]["pending"]
    return {entry["video"]: entry.get("reason") for entry in pending}


def check_nothing_is_half(directory):
    """Whatever has a final name is whole, and nothing else is there."""
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


def test_a_killed_encoder_gets_a_second_try(two, tmp_path, monkeypatch, caplog):
    """In mid-video; every frame is in the file once, and each is told once."""
    flag = tmp_path / "killed"
    killed = "head -c 3000 >/dev/null; echo no memory >&2; kill -9 $$"
    once = f"if mkdir {flag} 2>/dev/null; then {killed}; fi"
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
    _, second = finish(two)
    assert time.monotonic() - began < 30
    assert second.videos
    # The manifest says why.
    [(name, reason)] = reasons_in(two).items()
    assert name == VIDEO.format(0)
    assert "made no progress for 2 seconds" in reason
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


# The whole way, with a simulation and OpenGL


@pytest.mark.parametrize("render", ["deferred", "live"])
def test_a_dark_scene_is_suspect_whichever_way_it_is_drawn(
    render, tmp_path, play, caplog
):
    """The metadata says so, and the log warns; with `strict` it is an error.

    Drawn live as its episode ends, else as the monitor closes. The video is there.
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
