# SPDX-License-Identifier: Apache-2.0
"""`mjrec render`: render pending videos, or rerender recorded episodes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal

import rich.console
import tyro

from ..annotation import check_annotation
from ..errors import InvalidArgument
from ..evaluation.episode_results import recorded_results
from ..evaluation.evaluation import is_evaluation
from ..formats.monitor_directory import recording_directories
from ..monitors.progress import render_progress
from ..plain_text import counted
from ..rendering.jobs import RenderedVideos, Variant, View
from ..rendering.render_videos import iter_rendered_videos
from .not_finite import not_finite_in, not_finite_lines
from .options import NO_ENGINE, AsJson, Engine, camera_of, size_of
from .terminal import FAILED, INTERRUPTED, names_by, print_json, print_lines


def render(
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR|FILE")],
    /,
    *,
    episode: int | None = None,
    camera: str | None = None,
    size: str | None = None,
    quality: Literal["full", "draft"] | None = None,
    workers: int | None = None,
    out: Path | None = None,
    max_fps: float | None = None,
    fps: float | None = None,
    annotate: bool = False,
    no_annotate: bool = False,
    pending: bool = False,
    strict: bool = False,
    trust_models: bool = False,
    as_json: AsJson = False,
    engine_options: Engine = NO_ENGINE,
) -> int:
    """Render pending videos, or rerender recorded episodes.

    Without options, all pending videos in the directory are rendered as planned.
    Several such commands can run on one directory and share the work.

    With an option that changes the video (such as --camera, --size, --quality or
    --out), recorded episodes are rendered again, into new files next to the originals:
    openaigym.video.<...>.video000027.side.mp4. For an episode with several cameras, the
    result is one video: from --camera if given, otherwise from the first camera, or
    tiled if it was recorded tiled.

    Args:
        target: a monitor directory or an evaluation; or one of their trajectories or
            videos, to render only that episode.
        episode: number of the episode. Default: all recorded ones. In an evaluation,
            the episode with that number for every task and seed is rendered.
        camera: name or number, or a free camera as JSON, such as '{"distance": 3,
            "azimuth": 90, "elevation": -20, "lookat": [0, 0, 1]}'. Default: as
            recorded, like the options below.
        size: WIDTHxHEIGHT in pixels.
        quality: full (the model's own settings) or draft (several times faster).
        workers: processes that render. Default: one per free CPU. With --engine, the
            number of engine workers.
        out: the file to write, for one episode. Its suffix determines the format.
        max_fps: maximum frames per second of simulated time: every n-th recorded frame
            and the last one are drawn.
        fps: frames per second written into the file. It does not select frames.
        annotate: write episode, step, time and return on the frames.
        no_annotate: leave out the recorded captions.
        pending: render only the pending videos. This is the default.
        strict: fail if a video shows nothing (black, one color, no movement). The
            video is kept.
        trust_models: load compiled models that another user or machine wrote. Needed
            if their sources are missing. A crafted model can run any code, so
            use it only if you trust the author.
        as_json: print one JSON object at the end, and nothing else.
        engine_options: where to run the work, if not in this command's own processes.
    """
    height, width = size_of(size)
    if annotate and no_annotate:
        raise InvalidArgument("Give either --annotate or --no-annotate, not both.")
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
            "--pending renders videos as planned. To render an episode differently, "
            "omit --pending."
        )
    places, number = _places(target, episode)
    if out is not None and len(places) > 1:
        raise InvalidArgument(
            f"--out is for one episode, but {target} has several. Give a trajectory "
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
            f"No video of {what} is pending. To render it again, specify what should "
            "change (--camera, --size, --max-fps, --quality, --fps, --annotate) or "
            "where to write it (--out)."
        )
    not_finite = not_finite_in(directory)
    if as_json:
        of_returns = {"not_finite": len(not_finite)}
        print_json({**_fields(report, is_interrupted), **of_returns})
    else:
        print_lines(console, _summary(report, is_interrupted))
        print_lines(console, not_finite_lines(not_finite))
    if is_interrupted:
        return INTERRUPTED
    return FAILED if report.failures or report.blank else 0


def _places(target: Path, episode: int | None) -> tuple[list[Path], int | None]:
    """Return the directories or recordings to render, and the episode number in each.

    For an evaluation, these are its monitor directories or, if an episode is given,
    that episode's trajectories.

    Raises:
        InvalidArgument: the evaluation has no such episode.
    """
    if episode is not None and is_evaluation(target):
        found = list(_trajectories(target, episode))
        if not found:
            raise InvalidArgument(
                f"No episode {episode} is recorded in {target}. To list the episodes: "
                f"mjrec list {target}"
            )
        return found, None
    return ([target] if episode is not None else recording_directories(target)), episode


def _trajectories(directory: Path, episode: int) -> Iterator[Path]:
    for folder, result in recorded_results(directory):
        if result.episode == episode and (key := result.key):
            yield folder / f"{key.name}.h5"


def _collect(
    results: Iterable[RenderedVideos], console: rich.console.Console
) -> tuple[list[RenderedVideos], bool]:
    """Print each finished video, and collect the results.

    Returns:
        The results, and whether Ctrl-C interrupted the rendering.
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
        yield "Interrupted. Videos that are not finished stay pending."
    elif report.is_empty:
        yield f"Nothing is pending in {shown}."
    if report.videos:
        yield f"{counted(len(report.videos), 'video')} rendered, in"
        yield f"  {shown}"
    if report.elsewhere:
        what = counted(len(report.elsewhere), "video")
        yield f"{what} being rendered by another process."
    yield from _reasons("could not be rendered:", report.failures)
    yield from _reasons("rendered, but blank:", report.blank)


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
