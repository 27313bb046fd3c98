# SPDX-License-Identifier: Apache-2.0
"""`mjrec render`: what it says, and how it ends. `test_render_videos` has the rest."""

import json
import subprocess
import sys

import gymnasium
import pytest
from recordings import frames_of, manifest_of
from trajectories_by_hand import (
    INFIX,
    write_finished,
    write_log,
    write_pending_manifest,
)

from mjrec import Monitor, clear_monitor_files
from mjrec.commands import main
from mjrec.rendering.jobs import RecordingKey, Variant, View
from mjrec.rendering.recordings import claim
from mjrec.rendering.render_videos import name_of_variant
from terminals import on_terminal

VIDEO = "openaigym.video.0.7.video000000"


@pytest.fixture
def mjrec(capsys):
    """Run the command; returns the exit status and what it printed."""
    return lambda *rest: (main(["render", *map(str, rest)]), *capsys.readouterr())


def content_of(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def test_pending_videos_are_rendered(tmp_path, mjrec, painter):
    """Each is told when it is there, and where they are at the end."""
    write_finished(tmp_path, 0)
    write_log(tmp_path, 1)
    write_pending_manifest(tmp_path, 0, 1)
    status, out, _ = mjrec(tmp_path)
    assert status == 0
    assert out.splitlines() == [
        "openaigym.video.0.7.video000000.mp4: 5 frames",
        "openaigym.video.0.7.video000001.mp4: 5 frames",
        "2 videos rendered, in",
        f"  {tmp_path}",
    ]
    for again in ((), ("--pending",)):
        status, out, _ = mjrec(tmp_path, *again)
        assert (status, out) == (0, f"Nothing is pending in {tmp_path}.\n")
    status, _, err = mjrec(tmp_path, "--episode", 1)
    assert status == 1
    assert "--camera" in err


def test_what_is_not_rendered_is_listed_with_its_reason(tmp_path, mjrec, painter):
    """The others are; the exit status tells, and so does one JSON object."""
    for episode_id in (0, 1):
        write_finished(tmp_path, episode_id).write_bytes(b"torn")
    write_finished(tmp_path, 2)
    write_finished(tmp_path, 3, frames=False)
    write_finished(tmp_path, 4)
    lock = claim(tmp_path, RecordingKey(INFIX, 4))
    status, out, _ = mjrec(tmp_path)
    assert status == 1
    assert "1 video rendered" in out
    assert "1 video being rendered by another process" in out
    assert "3 videos could not be rendered:" in out
    assert "nothing to draw frames from" in out
    lock.release()
    status, out, _ = mjrec(tmp_path, "--json")
    assert status == 1
    report = json.loads(out)
    assert report["directory"] == str(tmp_path)
    name = "openaigym.video.0.7.video000004.mp4"
    assert report["videos"] == [{"name": name, "frame_count": 5}]
    assert len(report["failures"]) == 3
    assert (report["elsewhere"], report["interrupted"]) == ([], False)


def test_one_episode_can_be_finished_or_shown_another_way(tmp_path, mjrec, painter):
    """By its number, its trajectory, or the video's name, which one sees and copies."""
    trajectories = [write_finished(tmp_path, k) for k in range(3)]
    assert mjrec(tmp_path, "--episode", 1)[0] == 0
    assert mjrec(trajectories[2])[0] == 0
    rendered = {path.name[-10:] for path in tmp_path.glob("*.mp4")}
    assert rendered == {"000001.mp4", "000002.mp4"}
    [video, _] = sorted(tmp_path.glob("*.mp4"))
    assert mjrec(video, "--camera", "side")[0] == 0
    assert video.with_suffix(".side.mp4").exists()


def test_another_view_is_a_new_file_beside_the_original(tmp_path, mjrec, painter):
    """Nothing that is there changes, and readers do not take it for the original."""
    write_finished(tmp_path)
    write_pending_manifest(tmp_path, 0)
    mjrec(tmp_path)
    before = content_of(tmp_path)
    status, out, _ = mjrec(
        *(tmp_path, "--episode", 0, "--camera", "top view", "--size", "64x32"),
        *("--quality", "draft", "--max-fps", 10, "--fps", 29.97),
    )
    name = f"{VIDEO}.top%20view.64x32.draft.max10fps.29%2E97fps"
    assert status == 0
    assert f"{name}.mp4: 3 frames" in out
    after = content_of(tmp_path)
    said = json.loads(after[f"{name}.meta.json"])
    assert (said["camera"], said["quality"]) == ("top view", "draft")
    assert {key: after[key] for key in before} == before
    assert set(after) - set(before) == {
        f"{name}.{end}" for end in ("mp4", "framehash", "meta.json")
    }
    assert painter.asked[-1][1:] == (
        [0, 2, 4],
        View(camera="top view", height=32, width=64, quality="draft"),
    )
    clear_monitor_files(tmp_path)
    assert not list(tmp_path.iterdir())


def test_every_variant_has_a_name_of_its_own():
    """Also where a camera is called as a quality, a size or a rate would be."""
    cameras = ["side", 0, "draft", "64x32", "x32", "max10fps", "10fps", "camera-draft"]
    variants = [
        *(Variant(view=View(camera=camera)) for camera in cameras),
        Variant(view=View(quality="draft")),
        Variant(view=View(width=64, height=32)),
        Variant(view=View(height=32)),
        Variant(max_fps=10),
        Variant(fps=10),
    ]
    path = "openaigym.trajectory.0.7.episode000000.h5"
    names = {name_of_variant(path, variant) for variant in variants}
    assert len(names) == len(variants)
    assert f"{VIDEO}.camera-draft.mp4" in names
    assert f"{VIDEO}.side.mp4" in names


@pytest.mark.parametrize("name", ["trajectory.0.7.episode000000.h5", "copy.h5"])
def test_out_names_the_file(name, tmp_path, mjrec, painter):
    """As recorded if nothing else is said, whatever the trajectory is called."""
    trajectory = write_finished(tmp_path).rename(tmp_path / name)
    before = {path.name for path in tmp_path.iterdir()}
    out = tmp_path / "elsewhere" / "mine.mp4"
    out.parent.mkdir()
    status, printed, _ = mjrec(trajectory, "--out", out)
    assert status == 0
    assert str(out.parent) in printed
    assert len(frames_of(out)) == 5
    assert {path.name for path in tmp_path.iterdir()} == {*before, "elsewhere"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pending", "--camera", "side"], "--pending"),
        (["--size", "64"], "WIDTHxHEIGHT"),
        (["--size", "0x64"], "width"),
        (["--fps", "-1"], "fps"),
        (["--out", "x.mp4"], "several episodes"),
        (["--out", f"{VIDEO}.mkv", "--episode", "0"], "original video"),
        (["--out", "x.txt", "--episode", "0"], "must end in"),
        (["--out", "/no/such/directory/x.mp4", "--episode", "0"], "/no/such/directory"),
        (["--engine", "local", "--engine-option", "partition"], "KEY=VALUE"),
    ],
)
def test_what_cannot_be_is_one_clear_error(
    arguments, message, tmp_path, mjrec, painter, monkeypatch
):
    """And nothing is written."""
    monkeypatch.chdir(tmp_path)
    for episode_id in (0, 1):
        write_finished(tmp_path, episode_id)
    before = content_of(tmp_path)
    status, out, err = mjrec(tmp_path, *arguments)
    assert status == 1
    assert message in out + err
    assert content_of(tmp_path) == before


def test_ctrl_c_keeps_what_is_done(tmp_path, mjrec, painter):
    """The exit status is the shells', and nothing half-done stays."""
    for episode_id in (0, 1):
        write_finished(tmp_path, episode_id)

    def interrupt(trajectory, *_):
        if "000001" in trajectory.name:
            raise KeyboardInterrupt

    painter.breaks_at = interrupt
    status, out, _ = mjrec(tmp_path)
    assert status == 130
    assert "Interrupted." in out
    assert (tmp_path / f"{VIDEO}.mp4").exists()
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("again_at", [(), ("--fps", "30")])
def test_strict_fails_where_nothing_is_to_be_seen(again_at, tmp_path, mjrec, painter):
    """The videos are there, also in the manifest, and none is pending any more."""
    painter.plain = True
    write_finished(tmp_path, 0)
    write_pending_manifest(tmp_path, 0)
    status, out, _ = mjrec(tmp_path, "--strict", *again_at)
    assert status == 1
    assert "1 video rendered, but blank:" in out
    assert "all 5 frames are a single colour" in out
    assert len(list(tmp_path.glob("*.mp4"))) == 1
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == bool(again_at)


def test_an_engine_says_what_this_process_would(tmp_path, mjrec):
    """Of what cannot be rendered too; nothing of it stays in the directory."""
    write_finished(tmp_path, 0, frames=False)
    write_log(tmp_path, 1, video=None)
    alone = mjrec(tmp_path, "--json")
    (tmp_path / "openaigym.trajectory.0.7.episode000001.h5").unlink()
    write_log(tmp_path, 1, video=None)
    assert mjrec(tmp_path, "--engine", "local", "--workers", 1, "--json") == alone
    assert list(json.loads(alone[1])["failures"]) == [f"{VIDEO}.mp4"]
    assert not list(tmp_path.glob(".*"))


@pytest.mark.thorough
def test_a_terminal_shows_a_bar_and_a_recording_becomes_a_video(tmp_path, play):
    """With workers and OpenGL; two commands at once share the work."""
    env = gymnasium.make("InvertedPendulum-v5", max_episode_steps=3)
    directory = tmp_path / "run"
    small = {"width": 40, "height": 32, "workers": 0, "quality": "draft"}
    with Monitor(env, directory, lambda _: True, **small) as monitor:
        play(monitor, 3, seed=0)
    command = [sys.executable, "-m", "mjrec", "render", str(directory)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as second:
        status, shown = on_terminal(command)
        other, _ = second.communicate()
    assert (status, second.returncode) == (0, 0)
    assert "/12 frames" in shown
    videos = sorted(directory.glob("*.mp4"))
    assert [len(frames_of(video)) for video in videos] == [4, 4, 4]
    # Each by one of the two.
    rendered = [line for line in (shown + other).splitlines() if ".mp4: 4 fra" in line]
    assert len(rendered) == 3
    manifest = manifest_of(directory)
    assert len(manifest["videos"]) == 3
    assert manifest["mjrec"]["pending"] == []
    assert not list(directory.glob(".*"))
