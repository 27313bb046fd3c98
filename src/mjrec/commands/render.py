# SPDX-License-Identifier: Apache-2.0
"""`mjrec render`: the videos of recorded episodes, now or once more."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Literal

import rich.console
import tyro

from .. import json_text
from ..annotation import check_annotation
from ..errors import InvalidArgument
from ..formats.monitor_directory import iter_monitor_files, monitor_directories_in
from ..monitors.progress import render_progress
from ..rendering.jobs import RenderedVideos
from ..rendering.render_videos import iter_rendered_videos
from ..rendering.views import Variant, View
from .counted import counted
from .engine_options import NO_ENGINE, EngineOptions
from .help_text import flowing_help
from .view_options import camera_of, size_of

_FAILED = 1
_INTERRUPTED = 130


@flowing_help
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
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    engine_options: Annotated[
        tyro.conf.OmitArgPrefixes[EngineOptions], tyro.conf.arg(name="engine")
    ] = NO_ENGINE,
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
        episode: its number; all recorded ones, if it is not given.
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
    variant = Variant(
        view=View(
            camera=camera_of(camera), height=height, width=width, quality=quality
        ),
        max_fps=max_fps,
        fps=fps,
        annotate=_annotation(annotate, no_annotate),
    )
    if pending and (variant != Variant() or out is not None):
        raise InvalidArgument(
            "--pending renders videos as they were to be. To render an episode another "
            "way, leave it out."
        )
    engine = engine_options.chosen(workers)
    console = rich.console.Console(quiet=as_json)
    with render_progress(console) as on_progress:
        results = itertools.chain.from_iterable(
            iter_rendered_videos(
                place,
                variant,
                episode=episode,
                out=out,
                workers=workers if engine is None else None,
                strict=strict,
                trust_models=trust_models,
                engine=engine,
                on_progress=on_progress,
            )
            for place in _places(target, episode)
        )
        done, is_interrupted = _collect(results, console)
    report = RenderedVideos.joined(done, target if target.is_dir() else target.parent)
    nothing = report.is_empty and not is_interrupted
    if nothing and (episode is not None or not target.is_dir()):
        raise InvalidArgument(
            f"No video of {_what(target, episode)} is pending. To render it again, say "
            "what is to be other (--camera, --size, --max-fps, --quality, --fps, "
            "--annotate) or where to write it (--out)."
        )
    if as_json:
        _print_json(report, is_interrupted=is_interrupted)
    else:
        _print_summary(report, console, is_interrupted=is_interrupted)
    if is_interrupted:
        return _INTERRUPTED
    return _FAILED if report.failures or report.blank else 0


def _places(target: Path, episode: int | None) -> list[Path]:
    """Return what is named; of an evaluation the monitor directories in it."""
    if episode is not None or not target.is_dir() or any(iter_monitor_files(target)):
        return [target]
    return monitor_directories_in(target) or [target]


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
            for name, count in result.videos.items():
                _print(console, f"{name}: {counted(count, 'frame')}")
    except KeyboardInterrupt:
        return done, True
    return done, False


def _annotation(annotate: bool, no_annotate: bool) -> bool | None:
    """Return what is asked for; None is as recorded.

    Raises:
        InvalidArgument: both are.
        MissingDependency: there is no Pillow to write with.
    """
    if annotate and no_annotate:
        raise InvalidArgument("Give one of --annotate and --no-annotate, or neither.")
    if annotate:
        check_annotation()
    return annotate if annotate or no_annotate else None


def _what(target: Path, episode: int | None) -> str:
    return target.name if episode is None else f"episode {episode}"


def _print_summary(
    report: RenderedVideos, console: rich.console.Console, *, is_interrupted: bool
) -> None:
    shown = report.directory.absolute()
    if is_interrupted:
        _print(console, "Interrupted. What is not done stays as it was.")
    elif report.is_empty:
        _print(console, f"Nothing is pending in {shown}.")
    if report.videos:
        _print(
            console, f"{counted(len(report.videos), 'video')} rendered, in\n  {shown}"
        )
    if report.elsewhere:
        what = counted(len(report.elsewhere), "video")
        _print(console, f"{what} left to another process, which is rendering now.")
    _print_reasons("could not be rendered:", report.failures, console)
    _print_reasons("rendered, with nothing to be seen:", report.blank, console)


def _print_reasons(
    what: str, failures: Mapping[str, str], console: rich.console.Console
) -> None:
    if failures:
        _print(console, f"{counted(len(failures), 'video')} {what}")
    for reason in dict.fromkeys(failures.values()):
        names = [name for name, why in failures.items() if why == reason]
        _print(console, "\n".join(f"  {name}" for name in names))
        _print(console, "\n".join(f"    {line}" for line in reason.splitlines()))


def _print_json(report: RenderedVideos, *, is_interrupted: bool) -> None:
    content = {
        "directory": str(report.directory.absolute()),
        "videos": [
            {"name": n, "frame_count": count} for n, count in report.videos.items()
        ],
        "failures": report.failures,
        "blank": report.blank,
        "elsewhere": report.elsewhere,
        "interrupted": is_interrupted,
    }
    sys.stdout.write(json_text.dumps(content) + "\n")


def _print(console: rich.console.Console, text: str) -> None:
    # Names must survive copying, so no line is folded.
    console.print(text, highlight=False, markup=False, soft_wrap=True)
