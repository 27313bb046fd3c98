# SPDX-License-Identifier: Apache-2.0
"""`mjrec render`: what it says, and how it ends. `test_render_videos` has the rest."""

import json

import pytest
from recordings import frames_of, manifest_of
from trajectories_by_hand import (
    INFIX,
    write_finished,
    write_log,
    write_pending_manifest,
)

from mjrec import clear_monitor_files
from mjrec.commands import main
from mjrec.rendering.jobs import RecordingKey, Variant, View
from mjrec.rendering.recordings import claim
from mjrec.rendering.render_videos import name_of_variant

VIDEO = "openaigym.video.0.7.video000000"

pytestmark = pytest.mark.usefixtures("painter")


@pytest.fixture
def mjrec(capsys):
    """Run the command; returns the exit status and what it printed."""
    return lambda *rest: (main(["render", *map(str, rest)]), *capsys.readouterr())


def content_of(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def test_pending_videos_are_rendered(tmp_path, mjrec):
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
    status, out, _ = mjrec(tmp_path, "--pending")
    assert (status, out) == (0, f"Nothing is pending in {tmp_path}.\n")
    status, _, err = mjrec(tmp_path, "--episode", 1)
    assert status == 1
    assert "--camera" in err


def test_what_is_not_rendered_is_listed_with_its_reason(tmp_path, mjrec):
    """The others are; the exit status tells, and so does one JSON object."""
    write_finished(tmp_path, 0).write_bytes(b"torn")
    write_finished(tmp_path, 1, frames=False)
    write_finished(tmp_path, 2)
    write_finished(tmp_path, 3)
    lock = claim(tmp_path, RecordingKey(INFIX, 3))
    status, out, _ = mjrec(tmp_path)
    assert status == 1
    assert "1 video rendered" in out
    assert "1 video being rendered by another process" in out
    assert "2 videos could not be rendered:" in out
    assert "nothing to draw frames from" in out
    lock.release()
    status, out, _ = mjrec(tmp_path, "--json")
    assert status == 1
    report = json.loads(out)
    assert report["directory"] == str(tmp_path)
    name = "openaigym.video.0.7.video000003.mp4"
    assert report["videos"] == [{"name": name, "frame_count": 5}]
    assert len(report["failures"]) == 2
    assert (report["elsewhere"], report["interrupted"]) == ([], False)
    _, out, _ = mjrec(tmp_path, "--engine", "local", "--workers", 1, "--json")
    assert json.loads(out)["failures"] == report["failures"]


def test_one_episode_can_be_finished_or_shown_another_way(tmp_path, mjrec):
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
    view = ("--camera", "top view", "--size", "64x32", "--quality", "draft")
    rates = ("--max-fps", 10, "--fps", 29.97)
    status, out, _ = mjrec(tmp_path, "--episode", 0, *view, *rates)
    name = f"{VIDEO}.top%20view.64x32.draft.max10fps.29%2E97fps"
    assert status == 0
    assert f"{name}.mp4: 3 frames" in out
    after = content_of(tmp_path)
    said = json.loads(after[f"{name}.meta.json"])
    assert (said["camera"], said["quality"]) == ("top view", "draft")
    assert {key: after[key] for key in before} == before
    new = {f"{name}.{end}" for end in ("mp4", "framehash", "meta.json")}
    assert set(after) - set(before) == new
    expected = View(camera="top view", height=32, width=64, quality="draft")
    assert painter.asked[-1][1:] == ([0, 2, 4], expected)
    clear_monitor_files(tmp_path)
    assert not list(tmp_path.iterdir())


def test_every_variant_has_a_name_of_its_own():
    """Also where a camera is called as a quality, a size or a rate would be."""
    cameras = ["side", 0, "draft", "64x32", "max10fps", "10fps", "camera-draft"]
    views = [View(quality="draft"), View(width=64, height=32)]
    views += [View(camera=camera) for camera in cameras]
    variants = [*(Variant(view=view) for view in views), Variant(max_fps=10)]
    variants.append(Variant(fps=10))
    path = "openaigym.trajectory.0.7.episode000000.h5"
    names = {name_of_variant(path, variant) for variant in variants}
    assert len(names) == len(variants)
    assert {f"{VIDEO}.camera-draft.mp4", f"{VIDEO}.side.mp4"} < names


def test_out_names_the_file(tmp_path, mjrec):
    """As recorded if nothing else is said, whatever the trajectory is called."""
    trajectory = write_finished(tmp_path).rename(tmp_path / "copy.h5")
    out = tmp_path / "elsewhere" / "mine.mp4"
    out.parent.mkdir()
    status, printed, _ = mjrec(trajectory, "--out", out)
    assert status == 0
    assert str(out.parent) in printed
    assert len(frames_of(out)) == 5
    assert {path.name for path in tmp_path.glob("*.*")} == {"copy.h5"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pending", "--camera", "side"], "--pending"),
        (["--size", "64"], "WIDTHxHEIGHT"),
        (["--fps", "-1"], "fps"),
        (["--out", "x.mp4"], "several episodes"),
        (["--out", f"{VIDEO}.mkv", "--episode", "0"], "original video"),
        (["--out", "x.txt", "--episode", "0"], "must end in"),
        (["--out", "/no/such/directory/x.mp4", "--episode", "0"], "/no/such/directory"),
        (["--engine", "local", "--engine-option", "partition"], "KEY=VALUE"),
    ],
)
def test_what_cannot_be_is_one_clear_error(
    arguments, message, tmp_path, mjrec, monkeypatch
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


def test_ctrl_c_is_status_130(tmp_path, mjrec, painter):
    """What is done stays, and nothing half-done."""
    for episode_id in (0, 1):
        write_finished(tmp_path, episode_id)

    def interrupt(trajectory, *_):
        if "000001" in trajectory.name:
            raise KeyboardInterrupt

    painter.breaks_at = interrupt
    status, out, _ = mjrec(tmp_path)
    assert status == 130
    assert "Interrupted." in out
    assert [path.name for path in tmp_path.glob("*.mp4")] == [f"{VIDEO}.mp4"]
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
    assert "all 5 frames are a single color" in out
    assert len(list(tmp_path.glob("*.mp4"))) == 1
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == bool(again_at)
