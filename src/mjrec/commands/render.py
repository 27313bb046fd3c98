# SPDX-License-Identifier: Apache-2.0
"""`mjrec render`: the videos of recorded episodes, now or once more."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal

import rich.console
import tyro

from ..annotation import check_annotation
from ..errors import InvalidArgument
from ..evaluation.chunk_results import recorded_results
from ..evaluation.evaluation import is_evaluation
from ..formats.monitor_directory import (
    Infix,
    recording_directories,
    trajectory_prefix,
)
from ..monitors.progress import render_progress
from ..rendering.jobs import RenderedVideos
from ..rendering.render_videos import iter_rendered_videos
from ..rendering.views import Variant, View
from .options import NO_ENGINE, AsJson, Engine, camera_of, size_of
from .terminal import counted, names_by, print_json, print_lines

_FAILED = 1
_INTERRUPTED = 130


def render(
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR|FILE")],
    /,
    *,
    pending: bool = False,
    episode: int | None = None,
    camera: str | None = None,
    size: str | None = None,
    max_fps: float | None = None,
    quality: Literal["full", "draft"] | None = None,
    fps: float | None = None,
    annotate: bool = False,
    no_annotate: bool = False,
    out: Path | None = None,
    workers: int | None = None,
    strict: bool = False,
    trust_models: bool = False,
    as_json: AsJson = False,
    engine_options: Engine = NO_ENGINE,
) -> int:
    """Render the pending videos of a directory, or recorded episodes again.

    Without an option that asks for something other than recorded, the videos that are
    not there yet are rendered, as they were to be. Several of these commands on one
    directory share the work. With one (--camera, --size, --max-fps, --quality, --fps,
    --annotate, --no-annotate, --out) recorded episodes are rendered once more, into new
    files beside the originals, which nothing changes:
    openaigym.video.<...>.video000027.side.mp4. Of an episode that was recorded with
    several cameras that is one video: of --camera, or of the first one, or of all side
    by side where it was recorded so.

    Args:
        target: a monitor directory, or that of an evaluation; or a trajectory or video
            in one, for that episode only.
        pending: render the pending videos, which is also what is done without any
            option.
        episode: its number; all recorded ones, if it is not given. Of an evaluation the
            one of this number in each task and seed.
        camera: name or number; as recorded, if it is not given. So with all of these.
        size: WIDTHxHEIGHT in pixels.
        max_fps: the most frames per second of simulated time; every n-th recorded
            frame is drawn, and the last.
        quality: full, the model's own settings, or draft, several times faster.
        fps: frames per second written into the file; selects nothing.
        annotate: write episode, step, time and return on the frames.
        no_annotate: leave the frames without that, where it was recorded so.
        out: the file to write, for one episode; its ending says which kind.
        workers: how many processes draw; one for each CPU that is free, if it is not
            given. With --engine, how many workers it has.
        strict: fail where a video shows nothing: black, of one colour, or without any
            movement; it is kept.
        trust_models: load compiled models also where another user, or another machine,
            has written them, as is needed where their sources are not there. A crafted
            one can do anything to whoever loads it.
        as_json: print one JSON object at the end, and nothing else.
        engine_options: where it is done, in place of processes of this command.
    """
    height, width = size_of(size)
    if annotate and no_annotate:
        raise InvalidArgument("Give one of --annotate and --no-annotate, or neither.")
    if annotate:
        check_annotation()
    variant = Variant(
        view=View(
            camera=camera_of(camera), height=height, width=width, quality=quality
        ),
        max_fps=max_fps,
        fps=fps,
        annotate=annotate if annotate or no_annotate else None,
    )
    if pending and (variant != Variant() or out is not None):
        raise InvalidArgument(
            "--pending renders videos as they were to be. To render an episode another "
            "way, leave it out."
        )
    places, number = _places(target, episode)
    if out is not None and len(places) > 1:
        raise InvalidArgument(
            f"--out is for one episode, and {target} has several: name its trajectory "
            "(openaigym.trajectory.*.h5)."
        )
    engine = engine_options.chosen(workers)
    console = rich.console.Console(quiet=as_json)
    with render_progress(console) as on_progress:
        results = itertools.chain.from_iterable(
            iter_rendered_videos(
                place,
                variant,
                episode=number,
                out=out,
                workers=workers if engine is None else None,
                strict=strict,
                trust_models=trust_models,
                engine=engine,
                on_progress=on_progress,
            )
            for place in places
        )
        done, is_interrupted = _collect(results, console)
    directory = target if target.is_dir() else target.parent
    report = RenderedVideos.joined(done, directory)
    nothing = report.is_empty and not is_interrupted
    if nothing and (episode is not None or not target.is_dir()):
        what = target.name if episode is None else f"episode {episode}"
        raise InvalidArgument(
            f"No video of {what} is pending. To render it again, say what is to be "
            "other (--camera, --size, --max-fps, --quality, --fps, --annotate) or "
            "where to write it (--out)."
        )
    if as_json:
        print_json(_fields(report, is_interrupted))
    else:
        print_lines(console, _summary(report, is_interrupted))
    if is_interrupted:
        return _INTERRUPTED
    return _FAILED if report.failures or report.blank else 0


def _places(target: Path, episode: int | None) -> tuple[list[Path], int | None]:
    """Return the directories, or recordings, that are named, and which episode of each.

    Those of an evaluation are the monitor directories in it or, of one number, the
    trajectories.
    """
    if episode is not None and is_evaluation(target):
        found = list(_trajectories(target, episode))
        if not found:
            raise InvalidArgument(
                f"No episode {episode} is recorded in {target}. To see which are: "
                f"mjrec list {target}"
            )
        return found, None
    return ([target] if episode is not None else recording_directories(target)), episode


def _trajectories(directory: Path, episode: int) -> Iterator[Path]:
    for folder, result in recorded_results(directory):
        infix = Infix.parse(result.monitor or "")
        if result.episode == episode and infix and result.episode_id is not None:
            yield folder / f"{trajectory_prefix(infix, result.episode_id)}.h5"


def _collect(
    results: Iterable[RenderedVideos], console: rich.console.Console
) -> tuple[list[RenderedVideos], bool]:
    """Say of each video that it is there; return all results.

    Returns:
        That, and whether Ctrl-C came before the end.
    """
    done = []
    try:
        for result in results:
            done.append(result)
            videos = result.videos.items()
            print_lines(
                console, (f"{name}: {counted(n, 'frame')}" for name, n in videos)
            )
    except KeyboardInterrupt:
        return done, True
    return done, False


def _summary(report: RenderedVideos, is_interrupted: bool) -> Iterator[str]:
    shown = report.directory.absolute()
    if is_interrupted:
        yield "Interrupted. What is not done stays as it was."
    elif report.is_empty:
        yield f"Nothing is pending in {shown}."
    if report.videos:
        yield f"{counted(len(report.videos), 'video')} rendered, in"
        yield f"  {shown}"
    if report.elsewhere:
        what = counted(len(report.elsewhere), "video")
        yield f"{what} left to another process, which is rendering now."
    yield from _reasons("could not be rendered:", report.failures)
    yield from _reasons("rendered, with nothing to be seen:", report.blank)


def _reasons(what: str, failures: Mapping[str, str]) -> Iterator[str]:
    if failures:
        yield f"{counted(len(failures), 'video')} {what}"
    for reason, names in names_by(failures).items():
        yield from (f"  {name}" for name in names)
        yield from (f"    {line}" for line in reason.splitlines())


def _fields(report: RenderedVideos, is_interrupted: bool) -> dict[str, object]:
    videos = report.videos.items()
    return {
        "directory": str(report.directory.absolute()),
        "videos": [{"name": name, "frame_count": count} for name, count in videos],
        "failures": report.failures,
        "blank": report.blank,
        "elsewhere": report.elsewhere,
        "interrupted": is_interrupted,
    }
