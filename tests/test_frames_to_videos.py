# SPDX-License-Identifier: Apache-2.0
"""`save_video` against Gymnasium's contract."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

import mjrec
from mjrec.errors import DirectoryNotWritable, InvalidArgument, UnknownName
from mjrec.frames import Frame

LEVELS = 6


def shade(number: int) -> Frame:
    return np.full((16, 16, 3), 20 + LEVELS * number, np.uint8)


def shades(count: int) -> list[Frame]:
    return [shade(number) for number in range(count)]


def shown(path: Path) -> list[int]:
    """Return the numbers of the shades that a video shows."""
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="gray") for frame in container.decode()]
    return [round((frame.mean() - 20) / LEVELS) for frame in frames]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def never(number: int) -> bool:
    return False


def always(number: int) -> bool:
    return True


@pytest.mark.parametrize("episode", [0, 1, 2, 8, 999, 1000])
def test_the_default_is_the_capped_cubic_schedule(tmp_path: Path, episode: int) -> None:
    """Without triggers: cubes and thousands, under Gymnasium's name, every frame."""
    mjrec.save_video(shades(30), tmp_path, fps=30, episode_index=episode)
    due = episode in (0, 1, 8, 1000)
    assert names(tmp_path) == [f"rl-video-episode-{episode}.mp4"] * due
    for path in tmp_path.iterdir():
        assert shown(path) == list(range(30))


def test_the_episode_trigger_gets_the_episodes_number(tmp_path: Path) -> None:
    """A trigger of one's own replaces the schedule; its truth counts."""
    asked: list[int] = []
    mjrec.save_video(
        shades(3),
        tmp_path / "new" / "folder",
        lambda number: asked.append(number) or 1,
        fps=30,
        episode_index=7,
        name_prefix="mine",
    )
    assert asked == [7]
    assert shown(tmp_path / "new" / "folder" / "mine-episode-7.mp4") == [0, 1, 2]


def test_step_videos_begin_at_their_step_and_leave_out_the_reset(
    tmp_path: Path,
) -> None:
    """Frame 1 is that of step_starting_index; videos may overlap; no episode video."""
    asked: list[int] = []

    def trigger(step: int) -> bool:
        asked.append(step)
        return step in (100, 103)

    mjrec.save_video(
        shades(8), tmp_path, step_trigger=trigger, step_starting_index=100, fps=30
    )
    assert asked == [100, 101, 102, 103, 104, 105, 106]
    assert names(tmp_path) == ["rl-video-step-100.mp4", "rl-video-step-103.mp4"]
    assert shown(tmp_path / "rl-video-step-100.mp4") == [1, 2, 3, 4, 5, 6, 7]
    assert shown(tmp_path / "rl-video-step-103.mp4") == [4, 5, 6, 7]


def reused(count: int, made: list[int]) -> Iterator[Frame]:
    """Yield one buffer again and again, and note the frames that are made."""
    buffer = shade(0)
    for number in range(count):
        made.append(number)
        buffer[:] = shade(number)
        yield buffer


@pytest.mark.parametrize("kind", ["list", "array", "generator"])
def test_both_triggers_may_be_used(tmp_path: Path, kind: str) -> None:
    """Videos end after `video_length` frames, or with the last one."""
    frames: Any = {"list": shades(8), "array": np.array(shades(8))}.get(kind)
    frames = reused(8, []) if frames is None else frames
    mjrec.save_video(
        frames, tmp_path, always, lambda step: step in (1, 5), video_length=3, fps=30
    )
    assert shown(tmp_path / "rl-video-episode-0.mp4") == [0, 1, 2]
    assert shown(tmp_path / "rl-video-step-1.mp4") == [2, 3, 4]
    assert shown(tmp_path / "rl-video-step-5.mp4") == [6, 7]


@pytest.mark.parametrize(("length", "count"), [(3, 3), (None, 9), (50, 9)])
def test_a_generator_is_streamed_and_read_no_further_than_needed(
    tmp_path: Path, length: int | None, count: int
) -> None:
    """Only the asked-for frames are made."""
    made: list[int] = []
    mjrec.save_video(reused(9, made), tmp_path, always, video_length=length, fps=30)
    assert made == shown(tmp_path / "rl-video-episode-0.mp4") == [*range(count)]


def test_nothing_is_read_when_no_video_is_due(tmp_path: Path) -> None:
    """A trigger that says no leaves a generator untouched."""
    made: list[int] = []
    mjrec.save_video(reused(3, made), tmp_path, never, fps=30)
    assert made == names(tmp_path) == []


def test_no_frames_no_file(tmp_path: Path) -> None:
    """An empty episode, and one with the reset's frame only and a step trigger."""
    mjrec.save_video([], tmp_path, always, always, fps=30)
    mjrec.save_video(shades(1), tmp_path, step_trigger=always, fps=30)
    assert names(tmp_path) == []


def test_the_frames_before_an_error_are_kept(tmp_path: Path) -> None:
    """What the generator raises goes through, and the video holds what came before."""

    def frames() -> Iterator[Frame]:
        yield from shades(4)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        mjrec.save_video(frames(), tmp_path, fps=30)
    assert shown(tmp_path / "rl-video-episode-0.mp4") == [0, 1, 2, 3]


def test_further_options_are_the_writers(tmp_path: Path) -> None:
    """The options frame_hashes, crf and the rest reach the writer."""
    mjrec.save_video(shades(2), tmp_path, fps=30, frame_hashes=True, crf=30)
    stem = "rl-video-episode-0"
    assert names(tmp_path) == [f"{stem}.framehash", f"{stem}.mp4"]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({}, InvalidArgument, "needs fps"),
        ({"fps": 0}, InvalidArgument, "fps must be"),
        ({"fps": 30, "duration": 0.1}, UnknownName, r"'duration'.*fps.*crf"),
        *(
            ({"fps": 30, "video_length": length}, InvalidArgument, "video_length")
            for length in (0, -1, True, 2.5)
        ),
    ],
)
def test_options_are_checked_first(
    tmp_path: Path, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    """Before the folder is made."""
    with pytest.raises(error, match=message):
        mjrec.save_video(shades(2), tmp_path / "videos", **options)
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    """A file is in the way."""
    (tmp_path / "file").touch()
    with pytest.raises(DirectoryNotWritable, match="file"):
        mjrec.save_video(shades(2), tmp_path / "file", fps=30)
