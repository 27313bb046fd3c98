# SPDX-License-Identifier: Apache-2.0
"""The videos of a monitor directory: those that are pending, or recorded ones again."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

from ..annotation import check_annotation
from ..engines.work import Engine
from ..errors import InvalidArgument
from ..formats.monitor_directory import iter_monitor_files, where_recordings_are
from ..formats.spans import is_in_flight
from ..machine import usable_cpus
from ..simulation.model_trust import trusting_models
from .engine_jobs import do_on_engine, given_engine
from .finish import bring_up_to_date, do_jobs
from .jobs import Outcome, Variant, VideoJob
from .progress import Progress
from .recordings import RecordingKey, key_of, parts_of, recordings
from .recovery import recover
from .shared_pool import check_workers
from .views import View

_SHOWN = 20

_OnProgress = Callable[[Progress], object]


@dataclass(frozen=True, kw_only=True)
class RenderedVideos:
    """What became of the videos that were to be rendered, by the names of files.

    Attributes:
        directory: where they are.
        videos: those that were rendered, each with the number of its frames.
        trajectories: of episodes without a video, which got their final form.
        failures: why videos could not be rendered.
        blank: what videos that were rendered do not show, where `strict` asked.
        elsewhere: those that another process is rendering.
    """

    directory: Path
    videos: Mapping[str, int] = field(default_factory=dict)
    trajectories: Sequence[str] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
    blank: Mapping[str, str] = field(default_factory=dict)
    elsewhere: Sequence[str] = ()

    @classmethod
    def of(cls, outcomes: Iterable[Outcome], directory: Path) -> Self:
        """Return what outcomes come to.

        Args:
            outcomes: what `iter_rendered_videos` yields.
            directory: where the videos are, if there are no outcomes that say it.
        """
        videos: dict[str, int] = {}
        blank: dict[str, str] = {}
        failures: dict[str, str] = {}
        trajectories, elsewhere = [], []
        for outcome in outcomes:
            directory = outcome.directory
            if outcome.is_video:
                names = (outcome.name, *outcome.further_videos)
                videos.update(dict.fromkeys(names, outcome.frame_count))
                if outcome.failure is not None:
                    blank[outcome.blank_video or outcome.name] = outcome.failure
            elif outcome.failure is not None:
                failures[outcome.name] = outcome.failure
            elif outcome.is_elsewhere:
                elsewhere.append(outcome.name)
            else:
                trajectories.append(outcome.name)
        return cls(
            directory=directory,
            videos=videos,
            trajectories=tuple(trajectories),
            failures=failures,
            blank=blank,
            elsewhere=tuple(elsewhere),
        )

    @property
    def is_empty(self) -> bool:
        """Whether there was nothing to do."""
        return not (self.videos or self.trajectories or self.failures or self.elsewhere)


def render_videos(
    target: str | os.PathLike[str],
    *,
    episode: int | None = None,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
    max_fps: float | Fraction | None = None,
    quality: str | None = None,
    fps: float | Fraction | None = None,
    annotate: bool | None = None,
    out: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    strict: bool = False,
    trust_models: bool = False,
    engine: Engine | str | None = None,
    on_progress: _OnProgress | None = None,
) -> RenderedVideos:
    """Render the pending videos of a directory, or recorded episodes again.

    If nothing is to be other than recorded, the videos that are not there yet are
    rendered, as they were to be; where none is pending, nothing is done. Several of
    these calls, in any processes, share the work of a directory. Else (`camera`,
    `height`, `width`, `max_fps`, `quality`, `fps`, `annotate`, `out`) recorded episodes
    are rendered once more, into new files beside the originals, which nothing changes.

    A video that cannot be rendered stops no other; the result says why. Ctrl-C, or what
    else is raised, leaves what is finished.

    Args:
        target: a monitor directory; or a trajectory or video in one, for that episode
            only.
        episode: its number; all recorded ones, if None.
        camera: as of `mjrec.render`; as recorded, if None. So with all of these.
        height: in pixels.
        width: likewise.
        max_fps: the most frames per second of simulated time; every n-th recorded
            frame is drawn, and the last.
        quality: `"full"` or `"draft"`.
        fps: frames per second written into the file; selects nothing.
        annotate: whether episode, step, time and return are written on the frames.
        out: the file to write, for one episode; its ending says which kind.
        workers: how many processes draw; one for each CPU that is free, if None. Where
            `engine` is a name, how many it has.
        strict: whether a video that shows nothing (black, of one colour, or without any
            movement) is among the `blank`; it is kept.
        trust_models: load compiled models also where another user, or another machine,
            has written them. A crafted one can do anything to whoever loads it. Until
            the end of the call this holds for the whole process.
        engine: where it is done, instead of processes of this one: an engine, or
            `"local"`, `"ray"` or `"slurm"`. Each video is drawn by one worker. All
            workers see the directory under the same name.
        on_progress: called with how far it is: after every frame, or with an engine
            after every video.

    Returns:
        What became of each.

    Raises:
        InvalidArgument: there are no such recordings, or an argument cannot be.
        MissingDependency: what the engine, or writing on frames, needs is not there.
        UnreadableFile: a manifest is damaged.
        Error: the engine cannot do any work.
    """
    variant = Variant(
        view=View(
            camera=camera,
            height=height,
            width=width,
            quality=quality,
        ),
        max_fps=max_fps,
        fps=fps,
        annotate=annotate,
    )
    outcomes = iter_rendered_videos(
        Path(target),
        variant,
        episode=episode,
        out=None if out is None else Path(out),
        workers=workers,
        strict=strict,
        trust_models=trust_models,
        engine=engine,
        on_progress=on_progress,
    )
    path = Path(target)
    return RenderedVideos.of(outcomes, path if path.is_dir() else path.parent)


def iter_rendered_videos(
    target: Path,
    variant: Variant,
    *,
    episode: int | None = None,
    out: Path | None = None,
    workers: int | None = None,
    strict: bool = False,
    trust_models: bool = False,
    engine: Engine | str | None = None,
    on_progress: _OnProgress | None = None,
) -> Iterator[Outcome]:
    """Do what `render_videos` does, and yield what became of each as it is over.

    What is asked for is checked before anything is begun, and before this returns.

    Args:
        target: as of `render_videos`, and so with all others.
        variant: what is to be other.
        episode: see there.
        out: likewise.
        workers: likewise.
        strict: likewise.
        trust_models: likewise.
        engine: likewise.
        on_progress: likewise.

    Raises:
        Error: as `render_videos`.
    """
    check_workers(workers)
    if variant.annotate:
        check_annotation()
    given = given_engine(engine, workers)
    directory, keys = _recordings_of(target, episode)
    is_pending = variant == Variant() and out is None
    if is_pending:
        jobs = _pending_jobs(target, keys, strict=strict)
    else:
        workers = workers or usable_cpus()
        jobs = _variant_jobs(target, keys, variant, out, strict=strict)
    tell = on_progress or (lambda _: None)
    outcomes = (
        do_jobs(jobs, directory, workers=workers, on_progress=tell)
        if given is None
        else do_on_engine(given, jobs, on_progress=tell)
    )
    if is_pending:
        outcomes = itertools.chain(outcomes, _afterwards(directory, target, episode))
    return _trusting(outcomes) if trust_models else outcomes


def _afterwards(
    directory: Path, target: Path, episode: int | None
) -> Iterator[Outcome]:
    """Bring the directory up to date, and yield what stands in the way.

    Of a whole directory, what killed monitors left is put in order too.
    """
    bring_up_to_date(directory)
    if target.is_dir() and episode is None:
        for file in recover(directory).failures:
            yield Outcome(name=file.name, directory=directory, failure=file.what)


def _trusting(outcomes: Iterator[Outcome]) -> Iterator[Outcome]:
    with trusting_models():
        yield from outcomes


def _recordings_of(
    target: Path, episode: int | None
) -> tuple[Path, list[RecordingKey]]:
    """Return a directory and those of its episodes and clips that were asked for.

    Raises:
        InvalidArgument: there are none.
    """
    if not target.exists() and not is_in_flight(target):
        raise InvalidArgument(f"There is no directory or file {target}.")
    if not target.is_dir():
        key = key_of(target.name)
        return target.parent, [] if key is None else [key]
    if not any(iter_monitor_files(target)):
        raise InvalidArgument(
            f"{target} holds no recordings. {where_recordings_are(target)}"
        )
    keys = recordings(target)
    if episode is None:
        return target, keys
    chosen = [key for key in keys if key.number == episode and not key.is_clip]
    if not chosen:
        numbers = sorted({key.number for key in keys if not key.is_clip})
        listed = ", ".join(map(str, numbers[:_SHOWN])) or "none"
        raise InvalidArgument(
            f"{target} has no recorded states of episode {episode}. It has those of "
            f"{listed}{' ...' * (len(numbers) > _SHOWN)}."
        )
    return target, chosen


def _pending_jobs(
    target: Path, keys: Sequence[RecordingKey], *, strict: bool
) -> list[VideoJob]:
    """Return the jobs that finish recordings.

    Raises:
        InvalidArgument: the target is a file of no recording.
    """
    if target.is_dir():
        return [VideoJob.finishing(target, key, strict=strict) for key in keys]
    if not keys:
        raise InvalidArgument(
            f"No video of {target.name} is pending: no recording has such a name. To "
            "render it again, say what is to be other (camera, size, max_fps, quality, "
            "fps, annotate) or where to write it (out, --out)."
        )
    return [VideoJob.finishing(target.parent, key, strict=strict) for key in keys]


def _variant_jobs(
    target: Path,
    keys: Iterable[RecordingKey],
    variant: Variant,
    out: Path | None,
    *,
    strict: bool,
) -> list[VideoJob]:
    """Return the jobs that render episodes another way.

    Raises:
        InvalidArgument: there are no trajectories; or `out` stands for several, or is
            the name of an original.
    """
    directory = target if target.is_dir() else target.parent
    if target.suffix == ".h5" and directory != target:
        # Whatever its name is otherwise.
        names = [target.name]
    else:
        episodes = [key for key in keys if not key.is_clip]
        names = [path.name for key in episodes for path in parts_of(directory, key)]
    if not names:
        raise InvalidArgument(
            f"There are no recorded states of {target}, from which it could be "
            "rendered again."
        )
    if out is not None:
        if len(names) > 1:
            raise InvalidArgument(
                f"{out} is one file, and several episodes were asked for: choose one."
            )
        # By whatever ending: the metadata would have the original's name.
        name = out.with_suffix(".mp4").name
        key = key_of(name)
        if key is not None and name == key.video_name:
            raise InvalidArgument(
                f"{out} is the name of a recorded video, which shows what its "
                "recording saw. Choose another name."
            )
    return [
        VideoJob(
            directory=directory,
            recording=name,
            strict=strict,
            variant=variant,
            video=out or directory / variant.name_for(name),
        )
        for name in names
    ]
