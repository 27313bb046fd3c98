# SPDX-License-Identifier: Apache-2.0
"""Rendering by the workers of an engine, from the side of whoever hands it out.

One job for each recording. This process opens no trajectory and draws nothing; it may
be killed at any time, and what its workers have finished stays.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..engines.choice import engine_from
from ..engines.work import Engine, Job, Work
from ..errors import InvalidArgument
from ..simulation.model_trust import stored_models
from .again import Variant, videos_of_variant
from .finishing import bring_up_to_date, note_failure
from .outcomes import Outcome
from .pending import RecordingKey, may_be_left
from .progress import Progress
from .video_jobs import again_job, environ_for_drawing, finishing_job, outcome_of

_WORKER = "mjrec.rendering.video_jobs:VideoWorker"

_OnProgress = Callable[[Progress], object]


def given_engine(engine: Engine | str | None, workers: int | None) -> Engine | None:
    """Return the engine that a caller names or gives; None where there is none.

    Args:
        engine: an engine, or the name of one.
        workers: how many it is to have, where it is a name.

    Raises:
        UnknownName: there is no engine of that name.
        InvalidArgument: `engine` is none, or `workers` is no number of workers, or
            contradicts an engine, which has its own.
        MissingDependency: what the engine needs is not installed.
    """
    if engine is None:
        return None
    if isinstance(engine, str):
        return engine_from(engine, workers=workers)
    if not callable(getattr(engine, "begin", None)):
        raise InvalidArgument(
            "engine is an engine, such as mjrec.LocalEngine(), or the name of one, got "
            f"{engine!r}."
        )
    if workers is not None:
        raise InvalidArgument(
            f"workers={workers} and engine={engine!r} were given, and an engine has "
            "workers of its own: say there how many."
        )
    return engine


def finish_on_engine(
    engine: Engine,
    directory: Path,
    keys: Iterable[RecordingKey],
    *,
    strict: bool = False,
    on_progress: _OnProgress = lambda _: None,
) -> Iterator[Outcome]:
    """Do what `finish_pending` does, by the workers of an engine.

    Outcomes come in the order in which they are over.

    Args:
        engine: whose workers.
        directory: the monitor directory, which all of them see.
        keys: which episodes and clips.
        strict: whether a video that shows nothing is a failure.
        on_progress: called when a recording is over.

    Raises:
        UnreadableFile: a manifest is damaged.
        Error: the engine cannot do any work.
    """
    by_key = {
        f"video/{key.told_name}": key for key in keys if may_be_left(directory, key)
    }
    jobs = {
        job: finishing_job(directory, key, strict=strict) for job, key in by_key.items()
    }
    nothing = {
        job: Outcome(name=key.told_name, directory=directory)
        for job, key in by_key.items()
    }
    for _, outcome in _done(engine, [directory], jobs, nothing, on_progress):
        if outcome.failure is not None and not outcome.is_video:
            # Where the worker has died, it could not.
            note_failure(directory, outcome.name, outcome.failure)
        yield replace(outcome, directory=directory)
    bring_up_to_date(directory)


def render_again_on_engine(
    engine: Engine,
    trajectories: Iterable[Path],
    variant: Variant,
    *,
    out: Path | None = None,
    strict: bool = False,
    on_progress: _OnProgress = lambda _: None,
) -> Iterator[Outcome]:
    """Do what `render_again` does, by the workers of an engine.

    Outcomes come in the order in which they are over.

    Args:
        engine: whose workers.
        trajectories: of the episodes, in directories that all workers see.
        variant: what is to be other.
        out: as of `render_again`; all workers see its directory.
        strict: whether a video that shows nothing is a failure, though it is there.
        on_progress: called when a video is over.

    Raises:
        InvalidArgument: as `render_again`.
        Error: the engine cannot do any work.
    """
    paths = list(trajectories)
    videos = videos_of_variant(paths, variant, out)
    jobs: dict[str, Mapping[str, Any]] = {}
    nothing: dict[str, Outcome] = {}
    for path, video in zip(paths, videos, strict=True):
        job = f"video/{video.name}"
        jobs[job] = again_job(path, variant, video, strict=strict)
        nothing[job] = Outcome(name=video.name, directory=video.parent)
    directories = list(dict.fromkeys(path.parent for path in paths))
    for _, outcome in _done(engine, directories, jobs, nothing, on_progress):
        yield outcome


def _done(
    engine: Engine,
    directories: Sequence[Path],
    jobs: Mapping[str, Mapping[str, Any]],
    nothing: Mapping[str, Outcome],
    on_progress: _OnProgress,
) -> Iterator[tuple[str, Outcome]]:
    """Yield what became of jobs, each with its key, but those with nothing to do."""
    if not jobs:
        return
    now = Progress(videos=len(jobs), frames=None)
    on_progress(now)
    work = Work(
        entry=_WORKER,
        # Workers elsewhere may have another home, and no list of this user's models.
        settings={"models": stored_models(directories)},
        environ=environ_for_drawing(),
        shared_directory=directories[0].absolute(),
    )
    with engine.begin(work) as run:
        for key, arguments in jobs.items():
            run.submit(Job(key=key, arguments=arguments))
        for done in run.results():
            # Without patience there is always one.
            assert done is not None
            outcome = outcome_of(done, nothing[done.key])
            now = _counted(now, outcome)
            on_progress(now)
            if outcome is not None:
                yield done.key, outcome


def _counted(now: Progress, outcome: Outcome | None) -> Progress:
    """Count a recording that is over, which was taken for one video."""
    if outcome is None or outcome.is_trajectory:
        return replace(now, videos=now.videos - 1)
    videos = 1 + len(outcome.further_videos)
    return replace(
        now,
        videos=now.videos - 1 + videos,
        videos_done=now.videos_done + videos,
        frames_done=now.frames_done + videos * outcome.frame_count,
    )
