# SPDX-License-Identifier: Apache-2.0
"""Which names in a directory are monitors' files, and what they say."""

import re
from pathlib import Path

import pytest

from mjrec.formats.monitor_directory import (
    camera_part,
    episode_of,
    further_parts,
    infix_of,
    is_second_name,
    iter_monitor_files,
    names_in,
    tiled_name,
    where_recordings_are,
    with_part,
)
from mjrec.results.monitor_files import MonitorFiles

VISIBLE = {
    "openaigym.manifest.0.1.manifest.json": ("0.1", None),
    "openaigym.episode_batch.0.1.stats.json": ("0.1", None),
    "openaigym.episodes.0.1.jsonl": ("0.1", None),
    "openaigym.video.0.1.video000027.mp4": ("0.1", 27),
    "openaigym.video.0.1.video000027.meta.json": ("0.1", 27),
    "openaigym.trajectory.0.1.episode000027.h5": ("0.1", 27),
    **{
        f"openaigym.states.0.1.000000.{end}": ("0.1", None)
        for end in ("log", "tail", "looks")
    },
    "openaigym.model.0123456789abcdef.zip": (None, None),
    "openaigym.results.0.1.monitor.csv": ("0.1", None),
}
HIDDEN = {
    ".openaigym.0.1.lock": ("0.1", None),
    ".openaigym.manifest.0.1.lock": ("0.1", None),
    ".openaigym.render.3.lock": (None, None),
    ".openaigym.clip.0.1.step000000137.lock": ("0.1", None),
    ".openaigym.video.0.1.video000027.lock": ("0.1", 27),
    ".openaigym.video.0.1.video000027.mp4.0123abcd.part": ("0.1", 27),
    ".openaigym.manifest.0.1.manifest.json.0123abcd.part": ("0.1", None),
}
# A part of a clip is only ever in a log.
NO_FILE = {"openaigym.clip.0.1.step000000137.part000000": ("0.1", None)}
FOREIGN = dict.fromkeys(
    (
        "openaigym.notes.txt",
        "openaigym.manifest",
        "openaigym..manifest.json",
        "mjrec.evaluation.0.1.jsonl",
        "openaigym.video.0.1.video27.mp4",
        "openaigym.states.0.1.log",
        "notes",
    ),
    (None, None),
)
NAMES = {**VISIBLE, **HIDDEN, **NO_FILE, **FOREIGN}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_says_monitor_and_episode(name):
    """As far as it has them; others' names say nothing."""
    assert (infix_of(name), episode_of(name)) == NAMES[name]


def test_monitor_files_are_listed_by_name(tmp_path):
    """Hidden ones if asked for; no other files, no directories."""
    for name in NAMES:
        (tmp_path / name).touch()
    (tmp_path / "openaigym.manifest.1.1.manifest.json").mkdir()
    links = [f"openaigym.manifest.{n}.1.manifest.json" for n in range(2, 6)]
    for name, target in zip(links, ["notes", "gone", ".", links[3]], strict=True):
        (tmp_path / name).symlink_to(target)
    listed = [path.name for path in iter_monitor_files(tmp_path)]
    # A link counts where it leads to a file.
    assert listed == sorted([*VISIBLE, links[0]])
    (tmp_path / links[0]).unlink()
    listed = [path.name for path in iter_monitor_files(tmp_path, hidden=True)]
    assert listed == sorted([*VISIBLE, *HIDDEN])
    assert set(names_in(tmp_path)) >= set(NAMES)
    assert list(iter_monitor_files(tmp_path / "missing")) == []


def test_a_wrong_directory_names_the_folders_with_recordings(tmp_path):
    """An evaluation has one for each task; some are named."""
    assert "mjrec record ENV --out" in where_recordings_are(tmp_path)
    for number in range(7):
        folder = tmp_path / f"task{number}"
        folder.mkdir()
        (folder / "openaigym.episodes.0.1.jsonl").touch()
    assert where_recordings_are(tmp_path) == (
        "Its folders do (task0, task1, task2, task3, task4 and 2 more): name one of "
        "them."
    )


# What a camera is called

FIRST = "openaigym.video.0.7.video000027.mp4"
CAMERAS = (
    *("side", "top-left_2", "a b", "über", "../up", "/etc", "a.b~c", "", "%41", "\n"),
    *("tiled", "draft", "full", "640x480", "x", "25fps", "meta", "video000028", "1"),
    *("camera2", "camera-draft", "plain", "annotated", "b" * 300, "\N{EARTH}" * 90),
)


@pytest.mark.parametrize("name", CAMERAS)
def test_a_name_stays_in_its_directory_and_is_short(name):
    """However the model calls its camera; it is no first video's."""
    file = with_part(FIRST, camera_part(name))
    assert (infix_of(file), episode_of(file)) == ("0.7", 27)
    assert MonitorFiles("0.7", [Path(file)]).videos == {}
    assert re.fullmatch(r"[A-Za-z0-9_%-]{1,90}", camera_part(name))
    hidden = f".{with_part(FIRST, camera_part(name))}.framehash.12345678.part"
    assert len(hidden) < 255


def test_each_name_gives_another_part():
    """None is taken for another one, or for another part of a name."""
    assert camera_part("a b/ü.~") == "a%20b%2F%C3%BC%2E%7E"
    assert tiled_name(FIRST) == "openaigym.video.0.7.video000027.tiled.mp4"
    parts = [camera_part(name) for name in CAMERAS]
    assert len(set(parts)) == len(parts)
    taken = {"tiled", "draft", "full", "640x480", "25fps", "meta", "plain", "annotated"}
    assert not taken & set(parts)


def test_further_cameras_never_share_a_name():
    """Numbers are their digits, nameless ones are called by their place."""
    cameras = ["a", "side", {"distance": 1}, 1, "1", "side", "1-2", "camera3", "a"]
    assert further_parts(cameras) == [
        *("side", "camera3", "1", "1-2", "side-2", "1-2-2", "camera-camera3", "a")
    ]


def test_gymnasiums_names_are_second_names():
    """With any prefix that is portable; others may come from a file of anybody's."""
    for name in ("rl-video-episode-27.mp4", "a-step-0.mp4", "_.x-1-episode-3.mp4"):
        assert is_second_name(name)
    for name in (
        *("openaigym-episode-1.mp4", "../rl-video-episode-27.mp4", ".x-episode-1.mp4"),
        *("rl-video-27.mp4", "a-episode-1.mp4\n", "a-episode-1.sh", "-episode-1.mp4"),
        *("a/b-episode-1.mp4", f"{'a' * 200}-episode-1.mp4", f"a-step-{'1' * 99}.mp4"),
        *("ü-episode-1.mp4", "a-episode-\N{ARABIC-INDIC DIGIT ONE}.mp4", ""),
    ):
        assert not is_second_name(name)
