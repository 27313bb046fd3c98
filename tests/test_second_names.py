# SPDX-License-Identifier: Apache-2.0
"""Test second names of videos."""

import json
import os
import shutil
from pathlib import Path

import pytest

from mjrec import clear_monitor_files
from mjrec.formats.second_names import (
    give_all_second_names,
    give_second_names,
    take_second_names,
)
from mjrec.formats.video_metadata import finished_videos

STEM = "openaigym.video.0.7.video000027"
SIDE = f"{STEM}.side.mp4"
SECOND = "rl-video-episode-27"
ALL = [f"{SECOND}.{end}" for end in ("meta.json", "mp4", "side.meta.json", "side.mp4")]


@pytest.fixture
def video(tmp_path):
    """Write the files of an episode with two cameras, and return the first video."""
    return write_episode(tmp_path)


def write_episode(directory, **metadata):
    for name in (f"{STEM}.mp4", SIDE):
        (directory / name).write_bytes(name.encode())
    (directory / f"{STEM}.side.meta.json").write_text("{}")
    metadata = {"also_named": f"{SECOND}.mp4", "further_videos": [SIDE], **metadata}
    (directory / f"{STEM}.meta.json").write_text(json.dumps(metadata))
    return directory / f"{STEM}.mp4"


def second_names(directory):
    return sorted(p.name for p in directory.iterdir() if "openaigym" not in p.name)


@pytest.mark.parametrize("has_hard_links", [True, False])
def test_all_files_of_an_episode_have_second_names(video, monkeypatch, has_hard_links):
    """A missing link is created again."""

    def refuse(*_):
        raise OSError("no links here")

    if not has_hard_links:
        monkeypatch.setattr(Path, "hardlink_to", refuse)
    give_second_names(video)
    video.with_name(ALL[0]).unlink()
    give_all_second_names(video.parent)
    assert second_names(video.parent) == ALL
    assert video.with_name(f"{SECOND}.mp4").samefile(video)
    assert video.with_name(f"{SECOND}.mp4").is_symlink() != has_hard_links
    take_second_names(video)
    assert second_names(video.parent) == []
    give_second_names(video)
    clear_monitor_files(video.parent)
    assert list(video.parent.iterdir()) == []


def test_copies_of_links_are_still_second_names(video, tmp_path, caplog):
    """Copied second names cause no warning and can be removed."""
    give_second_names(video)
    copied = tmp_path / "copy"
    shutil.copytree(tmp_path, copied)
    give_all_second_names(copied)
    assert not caplog.records
    take_second_names(copied / video.name)
    assert second_names(copied) == []


def test_foreign_file_of_that_name_stays(video, caplog):
    mine = video.with_name(f"{SECOND}.mp4")
    mine.write_text("mine")
    give_second_names(video)
    assert f"{SECOND}.mp4 already exists" in caplog.text
    assert second_names(video.parent) == ALL
    take_second_names(video)
    clear_monitor_files(video.parent)
    assert [path.name for path in video.parent.iterdir()] == [mine.name]
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("way", ["hardlink_to", "symlink_to"])
def test_clearing_removes_links_to_videos(way, video):
    """Links with other names are kept."""
    getattr(video.with_name(f"{SECOND}.mp4"), way)(video)
    os.link(video, video.with_name("my favourite.mp4"))
    video.with_suffix(".meta.json").unlink()
    clear_monitor_files(video.parent)
    assert [path.name for path in video.parent.iterdir()] == ["my favourite.mp4"]


@pytest.mark.parametrize("name", ["../x-episode-1.mp4", "openaigym.x-episode-1.mp4", 5])
def test_invalid_second_name_is_ignored(name, tmp_path, names):
    (tmp_path / "recordings").mkdir()
    give_second_names(write_episode(tmp_path / "recordings", also_named=name))
    assert second_names(tmp_path / "recordings") == []
    assert names(tmp_path) == ["recordings"]


@pytest.mark.parametrize(
    "name",
    ["x.mp4", f"{STEM}.mp4/../x.mp4", 7, f"{STEM}.gone.mp4", f"{STEM[:-1]}8.side.mp4"],
)
def test_further_videos_are_existing_files_of_the_episode(name, tmp_path):
    (tmp_path / "x.mp4").write_text("")
    assert finished_videos(write_episode(tmp_path, further_videos=[name, SIDE])) == [
        (f"{STEM}.mp4", f"{STEM}.meta.json"),
        (SIDE, f"{STEM}.side.meta.json"),
    ]
