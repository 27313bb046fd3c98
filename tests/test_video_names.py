# SPDX-License-Identifier: Apache-2.0
"""Whatever a camera is called, its video has a name of its own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mjrec.formats.monitor_directory import episode_of, infix_of
from mjrec.formats.video_names import (
    camera_part,
    further_parts,
    is_second_name,
    tiled_name,
    with_part,
)
from mjrec.results.monitor_files import MonitorFiles

FIRST = "openaigym.video.0.7.video000027.mp4"
NAMES = (
    *("side", "top-left_2", "a b", "über", "../up", "/etc", "a.b~c", "", "%41", "\n"),
    *("tiled", "draft", "full", "640x480", "x", "25fps", "meta", "video000028", "1"),
    *("camera2", "camera-draft", "plain", "annotated", "b" * 300, "\N{EARTH}" * 90),
)


@pytest.mark.parametrize("name", NAMES)
def test_a_name_stays_in_its_directory_and_is_short(name: str) -> None:
    """However the model calls its camera; it is no first video's."""
    file = with_part(FIRST, camera_part(name))
    assert (infix_of(file), episode_of(file)) == ("0.7", 27)
    assert MonitorFiles("0.7", [Path(file)]).videos == {}
    assert re.fullmatch(r"[A-Za-z0-9_%-]{1,90}", camera_part(name))
    hidden = f".{with_part(FIRST, camera_part(name))}.framehash.12345678.part"
    assert len(hidden) < 255


def test_each_name_gives_another_part() -> None:
    """None is taken for another one, or for another part of a name."""
    assert camera_part("a b/ü.~") == "a%20b%2F%C3%BC%2E%7E"
    assert tiled_name(FIRST) == "openaigym.video.0.7.video000027.tiled.mp4"
    parts = [camera_part(name) for name in NAMES]
    assert len(set(parts)) == len(parts)
    taken = {"tiled", "draft", "full", "640x480", "25fps", "meta", "plain", "annotated"}
    assert not taken & set(parts)


def test_further_cameras_never_share_a_name() -> None:
    """Numbers are their digits, nameless ones are called by their place."""
    cameras = ["a", "side", {"distance": 1}, 1, "1", "side", "1-2", "camera3", "a"]
    assert further_parts(cameras) == [
        *("side", "camera3", "1", "1-2", "side-2", "1-2-2", "camera-camera3", "a")
    ]


def test_gymnasiums_names_are_second_names() -> None:
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
