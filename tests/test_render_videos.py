# SPDX-License-Identifier: Apache-2.0
"""`mjrec.render_videos`: pending videos and other views, here or on an engine."""

import dataclasses
import json
import os
import shutil
from concurrent.futures import Executor, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import gymnasium
import pytest
from parts import parametrize
from recordings import frames_of, manifest_of
from trajectories_by_hand import (
    INFIX,
    write_finished,
    write_log,
    write_pending_manifest,
)

from mjrec import (
    GLError,
    InvalidArgument,
    LocalEngine,
    Monitor,
    UnknownName,
    render_videos,
)
from mjrec.formats.json_fields import from_json, to_json
from mjrec.rendering.finish import VideoWorker
from mjrec.rendering.jobs import (
    Progress,
    RecordingKey,
    RenderedVideos,
    Variant,
    VideoJob,
    View,
)
from mjrec.rendering.recordings import claim
from mjrec.rendering.render_videos import name_of_variant
from mjrec.simulation.model_trust import note_models

VIDEO = "openaigym.video.0.7.video000000"
DIED = "Its worker died on try 3 of 3: it was killed by SIGKILL."


class InlineExecutor(Executor):
    """An executor whose only worker is this process.

    Args:
        dies: the worker dies at jobs whose key contains this.
    """

    def __init__(self, dies=None):
        self.dies = dies
        self.jobs = []
        self._thread = ThreadPoolExecutor(1)
        self._worker = VideoWorker()

    def submit(self, fn, /, *args, **kwargs):
        place, job = json.loads(json.dumps(args))
        self.work = json.loads(Path(place, "work.json").read_bytes())
        Path(place, "begun").touch()
        self.jobs.append(job)
        return self._thread.submit(self._do, job)

    def _do(self, job):
        if self.dies and self.dies in job["key"]:
            return {"died": "was killed by SIGKILL.", "begun": True}
        return {"value": json.loads(json.dumps(self._worker(job["arguments"])))}


@pytest.fixture(params=[None, InlineExecutor], ids=["here", "engine"])
def engine(request):
    return request.param and InlineExecutor()


def test_pending_videos_are_rendered_once(tmp_path, painter, engine):
    """The result lists videos, trajectories, failures and those of others."""
    write_finished(tmp_path, 0)
    write_finished(tmp_path, 1).write_bytes(b"torn")
    write_log(tmp_path, 2, video=None)
    write_finished(tmp_path, 3)
    write_pending_manifest(tmp_path, 0, 1, 3)
    lock = claim(tmp_path, RecordingKey(INFIX, 3))
    rendered = render_videos(str(tmp_path), engine=engine)
    lock.release()
    assert rendered.directory == tmp_path
    assert rendered.videos == {f"{VIDEO}.mp4": 5}
    assert rendered.trajectories == ("openaigym.trajectory.0.7.episode000002.h5",)
    assert list(rendered.failures) == ["openaigym.video.0.7.video000001.mp4"]
    assert rendered.elsewhere == ("openaigym.video.0.7.video000003.mp4",)
    assert not rendered.is_empty
    nothing = RenderedVideos(directory=tmp_path)
    assert (
        render_videos(tmp_path, episode=0, engine=engine and InlineExecutor())
        == nothing
    )


@parametrize("given", [None, "local", LocalEngine(2)])
def test_every_engine_writes_the_same_files(tmp_path, play, given):
    """Another view is written beside the original."""
    run, here = tmp_path / "run", tmp_path / "here"
    small = {"width": 40, "height": 32, "max_episode_steps": 3}
    env = gymnasium.make("InvertedPendulum-v5", **small)
    with Monitor(env, run, lambda _: True, workers=0, quality="draft") as monitor:
        play(monitor, 2, seed=0)
    shutil.copytree(run, here)
    rendered = render_videos(run, engine=given)
    assert len(rendered.videos) == 2
    assert rendered.videos == render_videos(here, workers=1).videos
    assert contents(run) == contents(here)
    for name, frames in rendered.videos.items():
        assert len(frames_of(run / name)) == frames
    assert render_videos(run, engine=given).is_empty
    out = tmp_path / "other.mp4"
    view = {"camera": -1, "height": 24, "width": 24}
    other = render_videos(run, episode=1, **view, out=out, engine=given)
    assert (list(other.videos), other.directory) == (["other.mp4"], tmp_path)
    assert frames_of(out)[0].shape == (24, 24, 3)


def contents(directory):
    """Return the content of each file but HDF5, which contains times."""
    files = [path for path in directory.iterdir() if path.suffix != ".h5"]
    return {path.name: path.read_bytes() for path in files}


def test_every_field_of_a_variant_is_in_its_name_and_reaches_workers(tmp_path):
    views = [
        {"camera": "side"},
        {"camera": {"type": 0, "distance": 5.0}},
        *({"height": 32}, {"width": 32}, {"quality": "draft"}),
    ]
    others = [{"max_fps": Fraction(30000, 1001)}, {"fps": 12.5}, {"annotate": True}]
    parts = (*dataclasses.fields(View), *dataclasses.fields(Variant))
    tried = {name for each in [*views, *others] for name in each}
    assert {each.name for each in parts} == {*tried, "view"}
    variants = [Variant(**each) for each in others]
    variants += [Variant(view=View(**view)) for view in views]
    names = {name_of_variant(f"{VIDEO}.h5", each) for each in variants}
    assert len(names) == len(variants)
    for each in variants:
        job = VideoJob(directory=tmp_path, recording="a", variant=each)
        assert from_json(VideoJob, json.loads(json.dumps(to_json(job)))) == job


@pytest.mark.parametrize("options", [{}, {"fps": 30}], ids=["pending", "another way"])
def test_without_opengl_one_try_fails_all_videos(tmp_path, painter, engine, options):

    def fail(*_):
        raise GLError("nothing renders here")

    painter.breaks_at = fail
    logs = [write_log(tmp_path, number) for number in range(3)]
    rendered = render_videos(tmp_path, engine=engine, **options)
    assert list(rendered.failures.values()) == ["nothing renders here"] * 3
    assert len(painter.asked) == 1
    # Pending ones are finished all the same.
    assert [log.exists() for log in logs] == [not options] * 3


@pytest.mark.parametrize("options", [{}, {"max_fps": 10}])
def test_ctrl_c_keeps_finished_videos_and_ends_trust(tmp_path, painter, options):
    """Models are trusted during the call only."""
    for number in (0, 1):
        write_finished(tmp_path, number)
    seen = []

    def interrupt(progress):
        seen.append((progress, os.environ.get("MJREC_TRUST_MODELS")))
        if progress.videos_done and progress.frames_done > 4:
            raise KeyboardInterrupt

    trusted = {"trust_models": True, **options}
    with pytest.raises(KeyboardInterrupt):
        render_videos(tmp_path, on_progress=interrupt, **trusted)
    assert [path.name[:31] for path in tmp_path.glob("*.mp4")] == [VIDEO]
    assert {trust for _, trust in seen if _.frames_done} == {"1"}
    assert "MJREC_TRUST_MODELS" not in os.environ
    seen.clear()
    rest = render_videos(
        tmp_path, episode=1, on_progress=lambda now: seen.append((now, None)), **options
    )
    assert len(rest.videos) == 1
    frames = 3 if options else 5
    assert seen[-1][0] == Progress(
        videos_done=1, videos=1, frames_done=frames, frames=frames
    )


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"episode": 4}, InvalidArgument, "Available: 0"),
        ({"workers": 0}, InvalidArgument, "workers"),
        ({"height": -1}, InvalidArgument, "height"),
        ({"quality": "low"}, UnknownName, "draft"),
        ({"max_fps": 0}, InvalidArgument, "fps"),
        ({"camera": 1.5}, InvalidArgument, "A camera must be a name"),
        ({"camera": {"zoom": 1}}, UnknownName, "distance"),
        ({"out": f"{VIDEO}.mp4"}, InvalidArgument, "original video"),
        ({"engine": "spark"}, UnknownName, "slurm"),
        ({"engine": 3}, InvalidArgument, r"mjrec\.LocalEngine\(\)"),
        ({"engine": LocalEngine(1), "workers": 2}, InvalidArgument, "its own workers"),
    ],
)
def test_wrong_arguments_are_an_error_and_write_nothing(
    tmp_path, names, options, kind, message
):
    write_finished(tmp_path)
    before = names(tmp_path)
    with pytest.raises(kind, match=message):
        render_videos(tmp_path, **options)
    assert names(tmp_path) == before


def test_anything_but_a_recording_is_an_error(tmp_path):
    with pytest.raises(InvalidArgument, match="contains no recordings"):
        render_videos(tmp_path)
    with pytest.raises(InvalidArgument, match="does not exist"):
        render_videos(tmp_path / "missing")
    copy = write_finished(tmp_path).rename(tmp_path / "copy.h5")
    with pytest.raises(InvalidArgument, match="no recording has that name"):
        render_videos(copy)


# On an engine


def test_progress_of_an_engine_counts_finished_videos(tmp_path, painter):
    """Each recording counts as a video until it is finished; frames are unknown."""
    write_finished(tmp_path, 0)
    write_finished(tmp_path, 1, frames=False)
    write_log(tmp_path, 2, video=None)
    seen = []
    render_videos(tmp_path, engine=InlineExecutor(), on_progress=seen.append)
    counts = [(now.videos, now.videos_done, now.frames_done) for now in seen]
    assert counts == [(3, 0, 0), (3, 1, 5), (3, 2, 5), (2, 2, 5)]
    assert {now.frames for now in seen} == {None}


def test_a_job_whose_workers_die_fails_its_video_only(tmp_path, painter):
    """The manifest has the reason."""
    for number in (0, 1):
        write_finished(tmp_path, number)
    write_pending_manifest(tmp_path, 0, 1)
    rendered = render_videos(tmp_path, engine=InlineExecutor("video000000"))
    assert rendered.failures == {f"{VIDEO}.mp4": DIED}
    assert len(rendered.videos) == 1
    [pending] = manifest_of(tmp_path)["mjrec"]["pending"]
    assert pending["reason"] == DIED


def test_workers_get_environment_models_and_an_absolute_path(
    tmp_path, painter, monkeypatch
):
    monkeypatch.setenv("MJREC_TRUST_MODELS", "1")
    monkeypatch.delenv("LP_NUM_THREADS", raising=False)
    monkeypatch.chdir(tmp_path)
    write_finished(tmp_path)
    digest = "0123456789abcdef" * 4
    note_models([digest, digest[::-1]])
    (tmp_path / f"openaigym.model.{digest[:16]}.mjb.gz").touch()
    engine = InlineExecutor()
    render_videos(Path(), engine=engine)
    environ = {"LP_NUM_THREADS": "0", "MJREC_TRUST_MODELS": "1"}
    assert engine.work["environ"] == environ
    assert engine.work["settings"] == {"models": [digest]}
    assert engine.jobs[0]["arguments"]["directory"] == str(tmp_path)
