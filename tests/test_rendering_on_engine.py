# SPDX-License-Identifier: Apache-2.0
"""Rendering by an engine's workers gives what rendering here gives."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import gymnasium
import h5py
import numpy as np
import pytest
from trajectories_by_hand import (
    INFIX,
    Painter,
    write_finished,
    write_log,
    write_pending_manifest,
)

from mjrec import GLError, LocalEngine, Monitor
from mjrec.engines.work import Job, JobOutcome, Work
from mjrec.formats.in_flight import recordings_in_flight
from mjrec.formats.locks import Lock
from mjrec.formats.monitor_directory import Infix
from mjrec.rendering import shared_pool, video_jobs
from mjrec.rendering.again import Variant, render_again
from mjrec.rendering.finishing import finish_pending
from mjrec.rendering.on_engine import finish_on_engine, render_again_on_engine
from mjrec.rendering.outcomes import Outcome
from mjrec.rendering.pending import (
    EpisodeKey,
    claim,
    key_of,
    may_be_left,
    recorded_episodes,
    recordings,
)
from mjrec.rendering.progress import Progress
from mjrec.rendering.recorded_clips import ClipKey
from mjrec.rendering.video_jobs import VideoWorker, again_job, finishing_job
from mjrec.rendering.views import View
from mjrec.simulation.model_trust import note_models

VIDEO = "openaigym.video.0.7.video000000"
DIED = "Its worker died, which was try 3 of 3: it was killed by SIGKILL."


class Here:
    """An engine whose one worker is this process, and dies at some of the jobs.

    Args:
        dies: parts of the keys of these jobs.
    """

    def __init__(self, *dies: str) -> None:
        self.dies = dies
        self.works: list[Work] = []
        self.jobs: list[Job] = []
        self.is_cancelled = False
        self.workers = 1
        self.unfinished = 0

    def begin(self, work: Work) -> Self:
        self.works.append(work)
        return self

    def submit(self, job: Job) -> None:
        self.jobs.append(job)

    def results(self, *, patience_s: float | None = None) -> Iterator[JobOutcome]:
        worker = VideoWorker()
        for job in self.jobs:
            arguments = json.loads(json.dumps(job.arguments))
            value: Mapping[str, Any] | None = None
            failure = DIED if any(name in job.key for name in self.dies) else None
            if failure is None:
                value = json.loads(json.dumps(worker(arguments)))
            yield JobOutcome(key=job.key, value=value, failure=failure)
        worker.close()

    def cancel(self) -> None:
        self.is_cancelled = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.cancel()


@pytest.fixture
def painter(monkeypatch: pytest.MonkeyPatch) -> Painter:
    """Draw without processes and without OpenGL."""
    painter = Painter()
    for module in (shared_pool, video_jobs):
        monkeypatch.setattr(module, "WorkerPool", lambda count: painter)
    return painter


def finish(engine: Any, directory: Path, **options: Any) -> list[Outcome]:
    keys = recordings(directory)
    return list(finish_on_engine(engine, directory, keys, **options))


def content_of(directory: Path) -> dict[str, Any]:
    """Return what each file holds; of trajectories the arrays and what they say."""
    return {
        path.name: _of_hdf5(path) if path.suffix == ".h5" else path.read_bytes()
        for path in directory.iterdir()
    }


def _of_hdf5(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def note(name: str, item: Any) -> None:
        said = {key: np.asarray(value).tolist() for key, value in item.attrs.items()}
        rows = item[()].tobytes() if isinstance(item, h5py.Dataset) else None
        found[name] = (said, rows)

    with h5py.File(path) as file:
        note("/", file)
        file.visititems(note)
    return found


def record(directory: Path) -> None:
    """Record a clip, and episodes by two cameras; interrupted, so that all are logs."""
    small: dict[str, Any] = {"height": 32, "width": 40, "quality": "draft"}
    for options in (
        {"step_trigger": lambda step: step == 2, "video_length": 5},
        {"video_callable": lambda _: True, "camera": ["track", -1]},
    ):
        environment = gymnasium.make("HalfCheetah-v5", max_episode_steps=3)
        with (
            suppress(RuntimeError),
            Monitor(
                environment, directory, resume=True, workers=0, **small, **options
            ) as monitor,
        ):
            for _ in range(3):
                monitor.reset(seed=0)
                for _ in range(3):
                    monitor.step(np.ones(6))
            raise RuntimeError


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("recorded") / "run"
    record(directory)
    return directory


def copy_of(recorded: Path, place: Path) -> Path:
    return shutil.copytree(recorded, place)


def logs_in(directory: Path) -> list[Path]:
    """Return what its episodes in flight will become."""
    paths = (recording.path for recording in recordings_in_flight(directory))
    return sorted(path for path in paths if path.suffix == ".h5")


@pytest.mark.thorough
def test_two_workers_make_the_files_that_this_process_makes(
    recorded: Path, tmp_path: Path
) -> None:
    """Byte for byte: videos, metadata, frame hashes, manifests, trajectories."""
    here, there = (copy_of(recorded, tmp_path / name) for name in ("here", "there"))
    assert len(logs_in(here)) == 3
    own = list(finish_pending(here, recordings(here), workers=1))
    assert len(own) == 4
    others = finish(LocalEngine(2), there)
    assert {each.name: each.further_videos for each in others} == {
        each.name: each.further_videos for each in own
    }
    assert len(list(there.glob("*.mp4"))) == 7
    assert content_of(there) == content_of(here)
    assert finish(LocalEngine(2), there) == []


@pytest.mark.thorough
def test_another_view_is_the_same_file_too(recorded: Path, tmp_path: Path) -> None:
    """With all that can be other."""
    here, there = (copy_of(recorded, tmp_path / name) for name in ("here", "there"))
    variant = Variant(
        view=View(
            camera={"type": 0, "distance": 5.0}, height=24, width=32, quality="draft"
        ),
        max_fps=Fraction(30000, 1001),
        fps=12.5,
    )
    list(render_again(logs_in(here), variant, workers=1))
    outcomes = list(render_again_on_engine(LocalEngine(2), logs_in(there), variant))
    assert [each.failure for each in outcomes] == [None] * 3
    assert len(list(there.glob("*.12%2E5fps.mp4"))) == 3
    assert content_of(there) == content_of(here)


@pytest.mark.parametrize(
    "variant",
    [
        Variant(),
        Variant(view=View(camera=-1, height=2), max_fps=29.97, annotate=False),
        Variant(view=View(camera={"lookat": [0, 0, 1]}), fps=Fraction(24000, 1001)),
    ],
)
def test_what_is_to_be_other_survives_the_way(variant: Variant) -> None:
    """Exactly, and what became of it as well."""
    said = json.loads(json.dumps(variant.as_json()))
    assert Variant.from_json(said).as_json() == variant.as_json()
    outcome = Outcome(
        name="v.mp4", directory=Path("d"), is_video=True, further_videos=("v.side.mp4",)
    )
    assert Outcome.from_json(json.loads(json.dumps(outcome.as_json()))) == outcome


@pytest.mark.parametrize("key", [EpisodeKey(INFIX, 12), ClipKey(Infix(3, "a.b"), 4000)])
def test_a_recording_is_told_by_a_name(key: EpisodeKey | ClipKey) -> None:
    """Which says all of it."""
    assert key_of(key.told_name) == key


def test_progress_counts_videos_as_they_come(tmp_path: Path, painter: Painter) -> None:
    """Each recording is taken for a video until it is over; frames are not known."""
    write_finished(tmp_path, 0)
    write_finished(tmp_path, 1, frames=False)
    write_log(tmp_path, 2, video=None)
    seen: list[Progress] = []
    outcomes = finish(Here(), tmp_path, on_progress=seen.append)
    assert len(outcomes) == 3
    assert seen == [
        Progress(videos=3, frames=None),
        Progress(videos=3, videos_done=1, frames_done=5, frames=None),
        Progress(videos=3, videos_done=2, frames_done=5, frames=None),
        Progress(videos=2, videos_done=2, frames_done=5, frames=None),
    ]


def test_a_job_whose_workers_die_is_that_videos_failure(
    tmp_path: Path, painter: Painter
) -> None:
    """The manifest says so, and the rest goes on."""
    for number in (0, 1):
        write_finished(tmp_path, number)
    manifest = write_pending_manifest(tmp_path, 0, 1)
    first, second = finish(Here("video000000"), tmp_path)
    assert (first.name, first.failure) == (f"{VIDEO}.mp4", DIED)
    assert second.is_video
    content = json.loads(manifest.read_text())["mjrec"]
    [pending] = content["pending"]
    assert pending["reason"] == DIED


def test_what_is_done_is_no_job(tmp_path: Path, painter: Painter) -> None:
    """Without a look into any trajectory; and without a job there is no run."""
    for number in (0, 1):
        write_finished(tmp_path, number)
    finish(Here(), tmp_path)
    trajectories = sorted(tmp_path.glob("*.h5"))
    trajectories[0].write_bytes(b"torn")
    assert not may_be_left(tmp_path, EpisodeKey(INFIX, 0))
    engine = Here()
    assert finish(engine, tmp_path) == []
    assert engine.works == []


def test_what_an_earlier_run_left_undone_is_done(
    tmp_path: Path, painter: Painter
) -> None:
    """Manifests are true at the end, though there was nothing to render."""
    write_finished(tmp_path)
    finish(Here(), tmp_path)
    manifest = write_pending_manifest(tmp_path, 0)
    assert finish(Here(), tmp_path) == []
    content = json.loads(manifest.read_text())
    assert [video for video, _ in content["videos"]] == [f"{VIDEO}.mp4"]
    assert content["mjrec"]["pending"] == []


def test_a_job_done_twice_is_done_once(tmp_path: Path, painter: Painter) -> None:
    """The second time there is nothing to do, and no file is touched."""
    write_finished(tmp_path)
    job = finishing_job(tmp_path, EpisodeKey(INFIX, 0))
    first = VideoWorker()(job)
    before = content_of(tmp_path)
    assert first["outcome"]["is_video"]
    assert VideoWorker()(job) == {"outcome": None}
    assert content_of(tmp_path) == before


def test_what_another_worker_is_at_is_left_to_it(
    tmp_path: Path, painter: Painter
) -> None:
    """Such as one that was taken for dead."""
    write_finished(tmp_path)
    lock = claim(tmp_path, EpisodeKey(INFIX, 0))
    assert isinstance(lock, Lock)
    [outcome] = finish(Here(), tmp_path)
    lock.release()
    assert outcome.is_elsewhere
    [outcome] = finish(Here(), tmp_path)
    assert outcome.is_video


def test_two_workers_may_render_the_same_again(
    tmp_path: Path, painter: Painter
) -> None:
    """Whoever comes second puts the same file in its place."""
    trajectory = write_finished(tmp_path)
    job = again_job(trajectory, Variant(fps=30), tmp_path / "x.mp4")
    VideoWorker()(job)
    before = content_of(tmp_path)
    VideoWorker()(job)
    assert content_of(tmp_path) == before


@pytest.mark.parametrize("is_again", [False, True])
def test_a_worker_that_cannot_draw_tries_once(
    tmp_path: Path, painter: Painter, monkeypatch: pytest.MonkeyPatch, is_again: bool
) -> None:
    """And says of each video why it is not there."""
    tries: list[Path] = []

    def fail(trajectory: Path, *rest: object) -> None:
        tries.append(trajectory)
        raise GLError("nothing renders here")

    monkeypatch.setattr(painter, "frames", fail)
    paths = [write_finished(tmp_path, number) for number in range(3)]
    outcomes = (
        list(render_again_on_engine(Here(), paths, Variant(fps=30)))
        if is_again
        else finish(Here(), tmp_path)
    )
    assert [each.failure for each in outcomes] == ["nothing renders here"] * 3
    assert len(tries) == 1


def test_one_worker_serves_several_directories(
    tmp_path: Path, painter: Painter
) -> None:
    """One after the other, and back."""
    worker = VideoWorker()
    for name, number in (("a", 0), ("b", 0), ("a", 1)):
        (tmp_path / name).mkdir(exist_ok=True)
        write_finished(tmp_path / name, number)
        [*_, key] = recorded_episodes(tmp_path / name)
        assert worker(finishing_job(tmp_path / name, key))["outcome"]["is_video"]
    worker.close()
    assert len(list(tmp_path.glob("*/*.mp4"))) == 3


def test_workers_get_what_rendering_needs(
    tmp_path: Path, painter: Painter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One thread each, this user's models and trust, and where all see files."""
    monkeypatch.setenv("MJREC_TRUST_MODELS", "1")
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    monkeypatch.chdir(tmp_path)
    write_finished(tmp_path)
    digest = "0123456789abcdef" * 4
    note_models([digest, digest[::-1]])
    (tmp_path / f"openaigym.model.{digest[:16]}.mjb.gz").touch()
    engine = Here()
    finish(engine, Path())
    [work] = engine.works
    assert work.environ == {"LP_NUM_THREADS": "1", "MJREC_TRUST_MODELS": "1"}
    assert work.settings == {"models": [digest]}
    assert work.shared_directory == tmp_path
    assert engine.jobs[0].arguments["directory"] == str(tmp_path)


def test_who_stops_listening_ends_the_run(tmp_path: Path, painter: Painter) -> None:
    """As Ctrl-C does; what is finished stays."""
    for number in (0, 1):
        write_finished(tmp_path, number)
    engine = Here()

    def interrupt(progress: Progress) -> None:
        if progress.videos_done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        finish(engine, tmp_path, on_progress=interrupt)
    assert engine.is_cancelled
    assert [path.name for path in tmp_path.glob("*.mp4")] == [f"{VIDEO}.mp4"]
    assert os.environ.get("MJREC_TRUST_MODELS") is None
