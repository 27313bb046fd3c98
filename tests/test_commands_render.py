# SPDX-License-Identifier: Apache-2.0
"""Test the output and exit status of `mjrec render`."""

import functools
import json

import pytest
from recordings import frames_of, manifest_of
from trajectories_by_hand import write_finished, write_log, write_pending_manifest

from mjrec import clear_monitor_files
from mjrec.rendering.jobs import RecordingKey, Variant, View
from mjrec.rendering.recordings import claim
from mjrec.rendering.render_videos import name_of_variant

VIDEO = "openaigym.video.0.7.video000000"

pytestmark = pytest.mark.usefixtures("painter")


@pytest.fixture
def render(command):
    return functools.partial(command, "render")


def content_of(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def test_pending_videos_are_rendered_and_listed(tmp_path, render):
    write_finished(tmp_path, 0)
    write_log(tmp_path, 1)
    write_pending_manifest(tmp_path, 0, 1)
    assert render(tmp_path).out.splitlines() == [
        "openaigym.video.0.7.video000000.mp4: 5 frames",
        "openaigym.video.0.7.video000001.mp4: 5 frames",
        "2 videos rendered, in",
        f"  {tmp_path}",
    ]
    assert render(tmp_path, "--pending").out == f"Nothing is pending in {tmp_path}.\n"
    assert "--camera" in render(tmp_path, "--episode", 1, status=1).err


def test_failures_are_listed_with_reasons_as_text_and_as_json(tmp_path, render):
    write_finished(tmp_path, 0).write_bytes(b"torn")
    write_finished(tmp_path, 1, frames=False)
    write_finished(tmp_path, 2)
    write_finished(tmp_path, 3)
    lock = claim(tmp_path, RecordingKey("0.7", 3))
    out = render(tmp_path, status=1).out
    assert "1 video rendered" in out
    assert "1 video being rendered by another process" in out
    assert "2 videos could not be rendered:" in out
    assert "nothing to draw frames from" in out
    lock.release()
    report = json.loads(render(tmp_path, "--json", status=1).out)
    assert report["directory"] == str(tmp_path)
    name = "openaigym.video.0.7.video000003.mp4"
    assert report["videos"] == [{"name": name, "frame_count": 5}]
    assert len(report["failures"]) == 2
    assert (report["elsewhere"], report["interrupted"]) == ([], False)
    local = ("--engine", "local", "--workers", 1, "--json")
    out = render(tmp_path, *local, status=1).out
    assert json.loads(out)["failures"] == report["failures"]


def test_episode_is_selected_by_number_trajectory_or_video(tmp_path, render):
    trajectories = [write_finished(tmp_path, k) for k in range(3)]
    render(tmp_path, "--episode", 1)
    render(trajectories[2])
    rendered = {path.name[-10:] for path in tmp_path.glob("*.mp4")}
    assert rendered == {"000001.mp4", "000002.mp4"}
    [video, _] = sorted(tmp_path.glob("*.mp4"))
    render(video, "--camera", "side")
    assert video.with_suffix(".side.mp4").exists()


def test_another_view_makes_new_files_and_changes_none(tmp_path, render, painter):
    write_finished(tmp_path)
    write_pending_manifest(tmp_path, 0)
    render(tmp_path)
    before = content_of(tmp_path)
    view = ("--camera", "top view", "--size", "64x32", "--quality", "draft")
    rates = ("--max-fps", 10, "--fps", 29.97)
    out = render(tmp_path, "--episode", 0, *view, *rates).out
    name = f"{VIDEO}.top%20view.64x32.draft.max10fps.29%2E97fps"
    assert f"{name}.mp4: 3 frames" in out
    after = content_of(tmp_path)
    metadata = json.loads(after[f"{name}.meta.json"])
    assert (metadata["camera"], metadata["quality"]) == ("top view", "draft")
    assert {key: after[key] for key in before} == before
    new = {f"{name}.{end}" for end in ("mp4", "framehash", "meta.json")}
    assert set(after) - set(before) == new
    expected = View(camera="top view", height=32, width=64, quality="draft")
    assert painter.asked[-1][1:] == ([0, 2, 4], expected)
    clear_monitor_files(tmp_path)
    assert not list(tmp_path.iterdir())


def test_variants_have_distinct_names():
    """Names are distinct even if a camera is named like a quality, size or rate."""
    cameras = ["side", 0, "draft", "64x32", "max10fps", "10fps", "camera-draft"]
    views = [View(quality="draft"), View(width=64, height=32)]
    views += [View(camera=camera) for camera in cameras]
    variants = [*(Variant(view=view) for view in views), Variant(max_fps=10)]
    variants.append(Variant(fps=10))
    path = "openaigym.trajectory.0.7.episode000000.h5"
    names = {name_of_variant(path, variant) for variant in variants}
    assert len(names) == len(variants)
    assert {f"{VIDEO}.camera-draft.mp4", f"{VIDEO}.side.mp4"} < names


def test_out_names_the_video_of_a_renamed_trajectory(tmp_path, render):
    trajectory = write_finished(tmp_path).rename(tmp_path / "copy.h5")
    out = tmp_path / "elsewhere" / "mine.mp4"
    out.parent.mkdir()
    assert str(out.parent) in render(trajectory, "--out", out).out
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
def test_bad_input_writes_nothing(arguments, message, tmp_path, render, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for episode_id in (0, 1):
        write_finished(tmp_path, episode_id)
    before = content_of(tmp_path)
    assert message in "".join(render(tmp_path, *arguments, status=1))
    assert content_of(tmp_path) == before


def test_ctrl_c_keeps_finished_videos_and_is_status_130(tmp_path, render, painter):
    for episode_id in (0, 1):
        write_finished(tmp_path, episode_id)

    def interrupt(trajectory, *_):
        if "000001" in trajectory.name:
            raise KeyboardInterrupt

    painter.breaks_at = interrupt
    assert "Interrupted." in render(tmp_path, status=130).out
    assert [path.name for path in tmp_path.glob("*.mp4")] == [f"{VIDEO}.mp4"]
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("rates", [(), ("--fps", "30")])
def test_strict_fails_after_rendering_blank_videos(rates, tmp_path, render, painter):
    painter.plain = True
    write_finished(tmp_path, 0)
    write_pending_manifest(tmp_path, 0)
    out = render(tmp_path, "--strict", *rates, status=1).out
    assert "1 video rendered, but blank:" in out
    assert "all 5 frames are a single color" in out
    assert len(list(tmp_path.glob("*.mp4"))) == 1
    assert len(manifest_of(tmp_path)["mjrec"]["pending"]) == bool(rates)
