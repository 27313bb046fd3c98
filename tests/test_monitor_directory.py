# SPDX-License-Identifier: Apache-2.0
"""Names of monitor files."""

import re
from pathlib import Path

import pytest

from mjrec.formats import monitor_directory
from mjrec.formats.monitor_directory import camera_part, episode_of, infix_of, with_part
from mjrec.results.monitor_files import MonitorFiles

VIDEO = "openaigym.video.0.1.video000027"


OF_EPISODE = [
    *(f"{VIDEO}.mp4", f"{VIDEO}.meta.json", f".{VIDEO}.mp4.0123abcd.part"),
    *(f".{VIDEO}.lock", "openaigym.trajectory.0.1.episode000027.h5"),
]
OF_MONITOR = [
    *("openaigym.episodes.0.1.jsonl", "openaigym.manifest.0.1.manifest.json"),
    *("openaigym.episode_batch.0.1.stats.json", "openaigym.results.0.1.monitor.csv"),
    *(f"openaigym.states.0.1.000000.{end}" for end in ("log", "tail", "looks")),
    *(".openaigym.0.1.lock", ".openaigym.manifest.0.1.lock"),
    ".openaigym.manifest.0.1.manifest.json.0123abcd.part",
    ".openaigym.clip.0.1.step000000137.lock",
    "openaigym.clip.0.1.step000000137.part000000",  # exists only inside logs
]
OTHERS = [
    *("openaigym.model.0123456789abcdef.zip", ".openaigym.render.3.lock", "notes"),
    *("openaigym.notes.txt", "openaigym.manifest", "openaigym..manifest.json"),
    *("mjrec.evaluation.0.1.jsonl", "openaigym.video.0.1.video27.mp4"),
    "openaigym.states.0.1.log",
]


@pytest.mark.parametrize(
    ("names", "parts"),
    [(OF_EPISODE, ("0.1", 27)), (OF_MONITOR, ("0.1", None)), (OTHERS, (None, None))],
)
def test_names_give_monitor_and_episode(names, parts):
    for name in names:
        assert (infix_of(name), episode_of(name)) == parts, name


FIRST = "openaigym.video.0.7.video000027.mp4"
CAMERAS = (
    *("side", "top-left_2", "a b", "über", "../up", "/etc", "a.b~c", "", "%41", "\n"),
    *("tiled", "draft", "full", "640x480", "x", "25fps", "meta", "video000028", "1"),
    *("camera2", "camera-draft", "plain", "annotated", "b" * 300, "\N{EARTH}" * 90),
)


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_gives_a_short_unique_file_name(name):
    """It stays in its directory, whatever the camera's name."""
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
    """A number becomes its digits; an unnamed camera gets its position."""
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
