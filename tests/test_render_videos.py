# SPDX-License-Identifier: Apache-2.0
"""The library's form of `mjrec render`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from parts import parametrize
from recordings import frames_of
from trajectories_by_hand import (
    INFIX,
    Painter,
    write_finished,
    write_log,
    write_pending_manifest,
)

import mjrec
from mjrec import InvalidArgument, LocalEngine, UnknownName, render_videos
from mjrec.rendering import again, shared_pool
from mjrec.rendering.again import Variant
from mjrec.rendering.directory_videos import RenderedVideos
from mjrec.rendering.pending import EpisodeKey, claim
from mjrec.rendering.progress import Progress
from mjrec.rendering.views import View

VIDEO = "openaigym.video.0.7.video000000"


@pytest.fixture
def painter(monkeypatch: pytest.MonkeyPatch) -> Painter:
    """Draw without processes and without OpenGL."""
    painter = Painter()

    class InWith:
        def __init__(self, count: int) -> None: ...
        def __enter__(self) -> Painter:
            return painter

        def __exit__(self, *error: object) -> None: ...

    monkeypatch.setattr(shared_pool, "WorkerPool", lambda count: painter)
    monkeypatch.setattr(again, "WorkerPool", InWith)
    return painter


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Record two episodes of which the videos are pending."""
    environment = gymnasium.make("InvertedPendulum-v5", width=40, height=32)
    directory = tmp_path / "run"
    with mjrec.Monitor(
        environment, directory, lambda _: True, workers=0, quality="draft"
    ) as monitor:
        for _ in range(2):
            monitor.reset(seed=0)
            while not monitor.step(environment.action_space.low)[2]:
                pass
    return directory


def test_pending_videos_are_made_once(tmp_path: Path, painter: Painter) -> None:
    """The result says what became of each; a second call has nothing to do."""
    write_finished(tmp_path, 0)
    write_finished(tmp_path, 1).write_bytes(b"torn")
    write_log(tmp_path, 2, video=None)
    write_finished(tmp_path, 3)
    write_pending_manifest(tmp_path, 0, 1, 3)
    lock = claim(tmp_path, EpisodeKey(INFIX, 3))
    assert lock is not None
    rendered = render_videos(str(tmp_path))
    lock.release()
    assert rendered.directory == tmp_path
    assert rendered.videos == {f"{VIDEO}.mp4": 5}
    assert rendered.trajectories == ("openaigym.trajectory.0.7.episode000002.h5",)
    assert list(rendered.failures) == ["openaigym.video.0.7.video000001.mp4"]
    assert rendered.elsewhere == ("openaigym.video.0.7.video000003.mp4",)
    assert not rendered.is_empty
    assert render_videos(tmp_path, episode=0) == RenderedVideos(directory=tmp_path)


@parametrize("engine", [None, "local", LocalEngine(1)])
def test_every_engine_makes_them(run: Path, engine: Any) -> None:
    """By its name, or as it is given; and another view beside the original."""
    rendered = render_videos(run, engine=engine)
    assert len(rendered.videos) == 2
    for name, frames in rendered.videos.items():
        assert len(frames_of(run / name)) == frames
    assert render_videos(run, engine=engine).is_empty
    out = run.parent / "other.mp4"
    other = render_videos(
        run, episode=1, camera=-1, height=24, width=24, out=out, engine=engine
    )
    assert list(other.videos) == ["other.mp4"]
    assert other.directory == run.parent
    assert frames_of(out)[0].shape == (24, 24, 3)


def test_a_camera_without_a_name_is_a_short_part_of_one(
    tmp_path: Path, painter: Painter
) -> None:
    """One that is otherwise has another."""
    write_finished(tmp_path)
    near, far = (
        {"type": 0, "distance": distance, "lookat": [0.0, 0.0, 1.0], "elevation": -5}
        for distance in (2, 9)
    )
    names = [*render_videos(tmp_path, camera=near).videos]
    names += render_videos(tmp_path, camera=far).videos
    assert len(set(names)) == 2
    assert all(name.startswith(f"{VIDEO}.camera-") for name in names)
    assert painter.asked[-1][2] == View(camera={**far, "distance": 9.0})
    given = Variant(view=View(camera=dict(reversed(near.items()))))
    assert (
        given.name_for(tmp_path / "openaigym.trajectory.0.7.episode000000.h5")
        == (names[0])
    )


def test_what_shows_nothing_is_told_where_asked(
    tmp_path: Path, painter: Painter
) -> None:
    """The video is there."""
    painter.plain = True
    write_finished(tmp_path)
    rendered = render_videos(tmp_path, strict=True)
    assert list(rendered.blank) == list(rendered.videos) == [f"{VIDEO}.mp4"]
    assert rendered.failures == {}


def test_progress_is_told(tmp_path: Path, painter: Painter) -> None:
    """After every frame."""
    write_finished(tmp_path)
    seen: list[Progress] = []
    render_videos(tmp_path, on_progress=seen.append)
    assert seen[-1] == Progress(videos_done=1, videos=1, frames_done=5, frames=5)


def test_ctrl_c_leaves_what_is_finished(tmp_path: Path, painter: Painter) -> None:
    """And nothing half-done."""
    for number in (0, 1):
        write_finished(tmp_path, number)

    def interrupt(progress: Progress) -> None:
        if progress.frames_done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_videos(tmp_path, on_progress=interrupt)
    assert [path.name for path in tmp_path.glob("*.mp4")] == [f"{VIDEO}.mp4"]
    assert list(render_videos(tmp_path).videos) == [
        "openaigym.video.0.7.video000001.mp4"
    ]


def test_models_are_trusted_during_the_call_only(
    tmp_path: Path, painter: Painter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it is interrupted."""
    monkeypatch.delenv("MJREC_TRUST_MODELS", raising=False)
    write_finished(tmp_path)
    seen: list[str | None] = []

    def look(progress: Progress) -> None:
        seen.append(os.environ.get("MJREC_TRUST_MODELS"))
        if progress.frames_done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_videos(tmp_path, trust_models=True, on_progress=look)
    assert set(seen) == {"1"}
    assert "MJREC_TRUST_MODELS" not in os.environ


WRONG: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"episode": 4}, InvalidArgument, "It has those of 0"),
    ({"workers": 0}, InvalidArgument, "workers"),
    ({"height": -1}, InvalidArgument, "height"),
    ({"quality": "low"}, UnknownName, "draft"),
    ({"max_fps": 0}, InvalidArgument, "fps"),
    ({"camera": 1.5}, InvalidArgument, "A camera is a name"),
    ({"camera": {"zoom": 1}}, UnknownName, "distance"),
    ({"out": f"{VIDEO}.mp4"}, InvalidArgument, "name of a recorded video"),
    ({"engine": "spark"}, UnknownName, "slurm"),
    ({"engine": 3}, InvalidArgument, r"mjrec\.LocalEngine\(\)"),
    ({"engine": LocalEngine(1), "workers": 2}, InvalidArgument, "of its own"),
    ({"engine": "local", "workers": 0}, InvalidArgument, "workers"),
    ({"engine": "local", "out": f"{VIDEO}.mp4"}, InvalidArgument, "recorded video"),
]


@pytest.mark.parametrize(("options", "kind", "words"), WRONG)
def test_what_cannot_be_is_one_clear_error(
    tmp_path: Path, options: dict[str, Any], kind: type[Exception], words: str
) -> None:
    """And nothing is written."""
    write_finished(tmp_path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(kind, match=words):
        render_videos(tmp_path, **options)
    assert sorted(tmp_path.iterdir()) == before


def test_what_is_no_recording_is_said(tmp_path: Path) -> None:
    """A directory without any, a path to nothing, and a file of another name."""
    with pytest.raises(InvalidArgument, match="holds no recordings"):
        render_videos(tmp_path)
    with pytest.raises(InvalidArgument, match="no directory or file"):
        render_videos(tmp_path / "missing")
    copy = write_finished(tmp_path).rename(tmp_path / "copy.h5")
    with pytest.raises(InvalidArgument, match="no recording has such a name"):
        render_videos(copy)
