# SPDX-License-Identifier: Apache-2.0
"""Test the names of monitor files."""

import re
from pathlib import Path

import pytest

from mjrec.formats import monitor_directory
from mjrec.formats.monitor_directory import camera_part, episode_of, infix_of, with_part
from mjrec.results.monitor_files import MonitorFiles

FIRST = "openaigym.video.0.7.video000027.mp4"
CAMERAS = (
    *("side", "top-left_2", "a b", "über", "../up", "/etc", "a.b~c", "", "%41", "\n"),
    *("tiled", "draft", "full", "640x480", "x", "25fps", "meta", "video000028", "1"),
    *("camera2", "camera-draft", "plain", "annotated", "b" * 300, "\N{EARTH}" * 90),
)


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_gives_a_short_unique_file_name(name):
    """The file is in the monitor's directory whatever the camera's name contains."""
    part = camera_part(name)
    file = with_part(FIRST, part)
    assert (infix_of(file), episode_of(file)) == ("0.7", 27)
    assert MonitorFiles("0.7", [Path(file)]).videos == {}
    assert re.fullmatch(r"[A-Za-z0-9_%-]{1,90}", part)
    assert len(f".{file}.framehash.12345678.part") < 255
    assert [other for other in CAMERAS if camera_part(other) == part] == [name]
    taken = ("tiled", "draft", "full", "640x480", "25fps", "meta", "plain", "annotated")
    assert part not in taken


def test_further_cameras_never_share_a_name():
    """A number is used as it is, and an unnamed camera is named by its position."""
    assert camera_part("a b/ü.~") == "a%20b%2F%C3%BC%2E%7E"
    cameras = ["a", "side", {"distance": 1}, 1, "1", "side", "1-2", "camera3", "a"]
    assert monitor_directory.further_parts(cameras) == [
        *("side", "camera3", "1", "1-2", "side-2", "1-2-2", "camera-camera3", "a")
    ]


def test_second_names_are_portable_gymnasium_names():
    is_second_name = monitor_directory.is_second_name
    for name in ("rl-video-episode-27.mp4", "a-step-0.mp4", "_.x-1-episode-3.mp4"):
        assert is_second_name(name)
    for name in (
        *("openaigym-episode-1.mp4", "../rl-video-episode-27.mp4", ".x-episode-1.mp4"),
        *("rl-video-27.mp4", "a-episode-1.mp4\n", "a-episode-1.sh", "-episode-1.mp4"),
        *("a/b-episode-1.mp4", f"{'a' * 200}-episode-1.mp4", f"a-step-{'1' * 99}.mp4"),
        *("ü-episode-1.mp4", "a-episode-\N{ARABIC-INDIC DIGIT ONE}.mp4", ""),
    ):
        assert not is_second_name(name)
