# SPDX-License-Identifier: Apache-2.0
"""A trajectory becomes a video with everything that belongs to it."""

from __future__ import annotations

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import pytest
from recordings import frames_of
from trajectories_by_hand import Painter, grey, write_finished, write_log

from mjrec import BlankVideo, InvalidFrame, Monitor, NoPictures, UnreadableFile
from mjrec.formats.video_metadata import metadata_path
from mjrec.rendering.videos import render_video, video_path
from mjrec.rendering.views import View

STEM = "openaigym.video.0.7.video000000"


def metadata_of(video: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(metadata_path(video).read_text())
    return content


def shown(video: Path) -> list[int]:
    """Return which frames a video shows."""
    return [round((float(frame.mean()) - 10) / 20) for frame in frames_of(video)]


def rate_of(video: Path) -> Fraction:
    with av.open(str(video)) as container:
        rate = container.streams.video[0].average_rate
        assert rate is not None
        return rate


@pytest.mark.parametrize("write", [write_log, write_finished])
def test_every_frame_is_in_the_video(
    write: Callable[..., Path], tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """In order, at the rate of the steps; hashes and metadata are beside it."""
    trajectory = write(tmp_path, steps=5)
    before = names(tmp_path)
    file = render_video(trajectory, workers=Painter())
    assert file is not None
    assert shown(file.path) == [0, 1, 2, 3, 4, 5]
    assert rate_of(file.path) == 20
    assert names(tmp_path) == [
        *before,
        *(f"{STEM}.{end}" for end in ("framehash", "meta.json", "mp4")),
    ]


def test_metadata_says_what_a_live_video_says(
    tmp_path: Path, corridor: Any, play: Callable[..., None]
) -> None:
    """With the same keys, and a few of its own."""
    with Monitor(corridor, tmp_path / "live", lambda _: True) as monitor:
        play(monitor, 1)
    [live_file] = (tmp_path / "live").glob("*.meta.json")
    live = json.loads(live_file.read_text())
    file = render_video(write_finished(tmp_path), workers=Painter())
    assert file is not None
    deferred = metadata_of(file.path)
    assert set(live) - {"recording_reason"} <= set(deferred)
    assert set(deferred) - set(live) <= {"rendered_with", "camera", "gl_renderer"}


def test_metadata_is_of_the_episode_and_of_the_pictures(tmp_path: Path) -> None:
    """Facts of the trajectory, of the workers and of the file."""
    file = render_video(write_finished(tmp_path, steps=4), workers=Painter())
    assert file is not None
    metadata = metadata_of(file.path)
    expected = {
        "episode_id": 0,
        "complete": True,
        "truncated": True,
        "length": 4,
        "reward": 2.0,
        "seed": 5,
        "recording": "deferred",
        "pictures": "scene",
        "camera": "side",
        "quality": "full",
        "gl_renderer": "a painter",
        "fps": "20",
        "timestep": "1/20",
        "playback_speed": 1.0,
        "stride": 1,
        "frame_count": 5,
        "frame_steps": [[0, 4]],
        "height": 16,
        "file_sha256": file.file_sha256,
    }
    assert {key: metadata[key] for key in expected} == expected
    assert "reason" not in metadata
    assert metadata["versions"] == {"mjrec": "0"}
    assert "numpy" in metadata["rendered_with"]


def test_a_stride_keeps_real_time(tmp_path: Path) -> None:
    """Every second step at 20 steps a second is a video of 10 frames a second."""
    trajectory = write_finished(tmp_path, steps=5, stride=2)
    file = render_video(trajectory, workers=Painter())
    assert file is not None
    metadata = metadata_of(file.path)
    assert rate_of(file.path) == 10
    assert metadata["stride"] == 2
    assert metadata["frame_steps"] == [[0, 4], [5, 5]]
    assert metadata["playback_speed"] == 1.0


def test_the_rate_asked_for_counts(tmp_path: Path) -> None:
    """At the recording or now; it is written into the file and selects nothing."""
    trajectory = write_log(tmp_path, fps="5/2")
    for asked, expected in ((None, Fraction(5, 2)), (50, 50)):
        file = render_video(trajectory, workers=Painter(), fps=asked)
        assert file is not None
        assert rate_of(file.path) == expected
        assert shown(file.path) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("max_fps", "frames", "fps"),
    [(20, [0, 1, 2, 3, 4, 5], 20), (19, [0, 2, 4, 5], 10), (1, [0, 5], 1)],
)
def test_max_fps_leaves_frames_out(
    max_fps: float, frames: list[int], fps: int, tmp_path: Path
) -> None:
    """All but every n-th and the last, and playback stays real time."""
    file = render_video(
        write_finished(tmp_path, steps=5), workers=Painter(), max_fps=max_fps
    )
    assert file is not None
    assert shown(file.path) == frames
    assert metadata_of(file.path)["playback_speed"] == 1.0
    assert rate_of(file.path) == fps


def test_another_view_is_asked_of_the_workers_and_told(tmp_path: Path) -> None:
    """The metadata has the camera and the quality that were asked for."""
    painter = Painter()
    view = View(camera="front", quality="draft")
    out = tmp_path / "front.mp4"
    file = render_video(write_finished(tmp_path), workers=painter, view=view, out=out)
    assert file is not None
    assert file.path == out
    assert painter.asked[0][2] == view
    metadata = metadata_of(out)
    assert (metadata["camera"], metadata["quality"]) == ("front", "draft")
    assert not (tmp_path / f"{STEM}.mp4").exists()


def test_an_episode_of_a_killed_process_says_so(tmp_path: Path) -> None:
    """Its length and reward are those of what was recorded."""
    file = render_video(write_log(tmp_path, steps=3, ended=False), workers=Painter())
    assert file is not None
    metadata = metadata_of(file.path)
    assert metadata["complete"] is False
    assert metadata["reason"] == "killed"
    assert (metadata["length"], metadata["reward"]) == (3, 1.5)


def test_frames_that_broke_off_are_marked(tmp_path: Path) -> None:
    """The frames before are a video; the reason is in the metadata."""
    file = render_video(
        write_log(tmp_path, broken_reason="a marker"), workers=Painter()
    )
    assert file is not None
    metadata = metadata_of(file.path)
    assert metadata["broken"] is True
    assert metadata["broken_reason"] == "a marker"


def test_frames_that_broke_off_at_once_leave_metadata_only(tmp_path: Path) -> None:
    """There is nothing to wait for any more."""
    trajectory = write_log(tmp_path, frames=False, broken_reason="a marker")
    assert render_video(trajectory, workers=Painter()) is None
    metadata = metadata_of(tmp_path / f"{STEM}.mp4")
    assert metadata["empty"] is True
    assert metadata["broken"] is True


def test_no_frames_is_an_error_with_its_reason(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """And leaves nothing."""
    trajectory = write_log(tmp_path, frames=False, refusal="a plugin draws")
    before = names(tmp_path)
    with pytest.raises(NoPictures, match="a plugin draws"):
        render_video(trajectory, workers=Painter())
    assert names(tmp_path) == before


@pytest.mark.parametrize(
    "name",
    [
        *("../x.mp4", "/x.mp4", "x.mp4", f"{STEM}.meta.json", STEM[:-1] + "1.mp4"),
        *(f"{STEM}.side.mp4", 5, None),
    ],
)
def test_a_trajectory_writes_no_video_but_its_own(name: Any, tmp_path: Path) -> None:
    """What a file says it is to be called may come from anybody."""
    directory = tmp_path / "recordings"
    directory.mkdir()
    trajectory = write_log(directory, video=None)
    with pytest.raises(UnreadableFile, match="own episode"):
        video_path(trajectory, {"video": {"name": name}})


class _Failing(Painter):
    """Draws two frames, and then one that is none."""

    def frames(self, *arguments: Any) -> Any:
        yield from list(super().frames(*arguments))[:2]
        yield None


@pytest.mark.parametrize("interrupt", [False, True])
def test_a_failure_leaves_what_was_there(
    interrupt: bool, tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """The video of before stays, with its metadata, and nothing half-done."""
    trajectory = write_finished(tmp_path)
    before = render_video(trajectory, workers=Painter())
    assert before is not None
    files = {path: path.read_bytes() for path in tmp_path.iterdir()}

    def interruption() -> None:
        raise KeyboardInterrupt

    if interrupt:
        with pytest.raises(KeyboardInterrupt):
            render_video(trajectory, workers=Painter(), on_frame=interruption)
    else:
        with pytest.raises(InvalidFrame):
            render_video(trajectory, workers=_Failing())
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == files


def test_frames_are_counted(tmp_path: Path) -> None:
    """For whoever shows how far it is."""
    calls: list[int] = []
    render_video(
        write_finished(tmp_path),
        workers=Painter(),
        on_frame=lambda: calls.append(grey(0)),
    )
    assert len(calls) == 5


def test_a_video_that_shows_nothing_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """In its metadata and in the log."""
    file = render_video(write_finished(tmp_path), workers=Painter(plain=True))
    assert file is not None
    assert metadata_of(file.path)["suspect_constant"] is True
    assert f"{STEM}.mp4 may show nothing: all 5 frames are of a single" in caplog.text


def test_with_strict_that_is_an_error(
    tmp_path: Path, names: Callable[[Path], list[str]]
) -> None:
    """The video and its metadata are kept."""
    trajectory = write_finished(tmp_path)
    with pytest.raises(BlankVideo, match="single colour"):
        render_video(trajectory, workers=Painter(plain=True), strict=True)
    assert len(frames_of(tmp_path / f"{STEM}.mp4")) == 5
    assert metadata_of(tmp_path / f"{STEM}.mp4")["suspect_constant"] is True
    out = tmp_path / "other.mp4"
    assert render_video(trajectory, workers=Painter(), out=out, strict=True) is not None
    assert not {"suspect_black", "suspect_constant"} & set(metadata_of(out))
