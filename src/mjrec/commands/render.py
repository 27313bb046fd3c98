# SPDX-License-Identifier: Apache-2.0
"""`mjrec render`: the videos of recorded episodes, now or once more."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import rich.console
import tyro

from .. import json_text
from ..annotation import check_annotation
from ..errors import InvalidArgument
from ..formats.monitor_directory import iter_monitor_files
from ..formats.trajectory_file import find_trajectory
from ..machine import usable_cpus
from ..monitors.render_progress import RenderProgress
from ..rendering.again import Variant, render_again
from ..rendering.cpu_slots import check_workers
from ..rendering.finishing import finish_pending
from ..rendering.outcomes import Outcome
from ..rendering.pending import EpisodeKey, RecordingKey, key_of, recordings
from ..rendering.views import View
from ..simulation.model_trust import trusting_all_models
from .counted import counted
from .help_text import flowing_help
from .view_options import camera_of, size_of

__all__ = ["render"]

_FAILED = 1
_INTERRUPTED = 130
_SHOWN = 20


@dataclass(kw_only=True)
class _Report:
    """What came of it."""

    directory: Path
    # Each with the number of its frames.
    videos: dict[str, int] = field(default_factory=dict)
    trajectories: list[str] = field(default_factory=list)
    # Those that are there, and show nothing.
    blank: dict[str, str] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    elsewhere: list[str] = field(default_factory=list)
    interrupted: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether there was nothing to do."""
        done = self.videos or self.trajectories or self.failures or self.elsewhere
        return not (done or self.interrupted)

    def add(self, outcome: Outcome) -> None:
        """Add what became of one."""
        self.directory = outcome.directory
        if outcome.is_video:
            self.videos[outcome.name] = outcome.frame_count
            further = dict.fromkeys(outcome.further_videos, outcome.frame_count)
            self.videos.update(further)
            if outcome.failure is not None:
                self.blank[outcome.blank_video or outcome.name] = outcome.failure
        elif outcome.failure is not None:
            self.failures[outcome.name] = outcome.failure
        elif outcome.is_elsewhere:
            self.elsewhere.append(outcome.name)
        else:
            self.trajectories.append(outcome.name)

    @property
    def exit_status(self) -> int:
        """The command's."""
        if self.interrupted:
            return _INTERRUPTED
        return _FAILED if self.failures or self.blank else 0


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
        target: a monitor directory; or a trajectory or video in one, for that episode
            only.
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
            given.
        strict: fail where a video shows nothing: black, of one colour, or without any
            movement; it is kept.
        trust_models: load compiled models also where another user, or another machine,
            has written them, as is needed where their sources are not there. A crafted
            one can do anything to whoever loads it.
        as_json: print one JSON object at the end, and nothing else.
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
    is_again = variant != Variant() or out is not None
    if pending and is_again:
        raise InvalidArgument(
            "--pending renders videos as they were to be. To render an episode another "
            "way, leave it out."
        )
    check_workers(workers)
    directory, keys = _episodes(target, episode)
    console = rich.console.Console(quiet=as_json)
    trust = trusting_all_models() if trust_models else contextlib.nullcontext()
    with trust, RenderProgress(console) as progress:
        if is_again:
            outcomes = render_again(
                _trajectories(target, keys),
                variant,
                workers=workers or usable_cpus(),
                out=out,
                strict=strict,
                on_progress=progress.show,
            )
        else:
            outcomes = finish_pending(
                directory,
                keys,
                workers=workers,
                strict=strict,
                on_progress=progress.show,
            )
        report = _collect(outcomes, directory, console)
    if report.is_empty and (episode is not None or not target.is_dir()):
        raise InvalidArgument(
            f"No video of {_what(target, episode)} is pending. To render it again, say "
            "what is to be other (--camera, --size, --max-fps, --quality, --fps, "
            "--annotate) or where to write it (--out)."
        )
    if as_json:
        _print_json(report)
    else:
        _print_summary(report, console)
    return report.exit_status


def _episodes(target: Path, episode: int | None) -> tuple[Path, list[RecordingKey]]:
    """Return a directory and those of its episodes and clips that were asked for.

    Raises:
        InvalidArgument: there are none.
    """
    if not target.exists():
        raise InvalidArgument(f"There is no directory or file {target}.")
    if not target.is_dir():
        key = key_of(target.name)
        return target.parent, [] if key is None else [key]
    if not any(iter_monitor_files(target)):
        raise InvalidArgument(
            f"{target} holds no recordings. `mjrec record ENV --out {target}` makes "
            "some."
        )
    keys = recordings(target)
    if episode is None:
        return target, keys
    of_episodes = [key for key in keys if isinstance(key, EpisodeKey)]
    chosen: list[RecordingKey] = [
        key for key in of_episodes if key.episode_id == episode
    ]
    if not chosen:
        numbers = sorted({key.episode_id for key in of_episodes})
        listed = ", ".join(map(str, numbers[:_SHOWN])) or "none"
        raise InvalidArgument(
            f"{target} has no recorded states of {_what(target, episode)}. It has "
            f"those of {listed}{' ...' * (len(numbers) > _SHOWN)}."
        )
    return target, chosen


def _trajectories(target: Path, keys: Iterable[RecordingKey]) -> list[Path]:
    """Return the trajectories that were asked for.

    Raises:
        InvalidArgument: there are none.
    """
    if not target.is_dir() and target.suffix in (".log", ".h5"):
        # Whatever its name is otherwise.
        return [target]
    directory = target if target.is_dir() else target.parent
    found = (
        find_trajectory(directory, key.infix, key.episode_id)
        for key in keys
        if isinstance(key, EpisodeKey)
    )
    trajectories = [path for path in found if path is not None]
    if not trajectories:
        raise InvalidArgument(
            f"There are no recorded states of {target}, from which it could be "
            "rendered again."
        )
    return trajectories


def _collect(
    outcomes: Iterable[Outcome], directory: Path, console: rich.console.Console
) -> _Report:
    """Return what became of all, having said so of each video."""
    report = _Report(directory=directory)
    try:
        for outcome in outcomes:
            report.add(outcome)
            if outcome.is_video:
                frames = counted(outcome.frame_count, "frame")
                for name in (outcome.name, *outcome.further_videos):
                    _print(console, f"{name}: {frames}")
    except KeyboardInterrupt:
        report.interrupted = True
    return report


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


def _print_summary(report: _Report, console: rich.console.Console) -> None:
    shown = report.directory.absolute()
    if report.interrupted:
        _print(console, "Interrupted. What is not done stays as it was.")
    if report.is_empty:
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


def _print_json(report: _Report) -> None:
    content = {
        "directory": str(report.directory.absolute()),
        "videos": [
            {"name": n, "frame_count": count} for n, count in report.videos.items()
        ],
        "failures": report.failures,
        "blank": report.blank,
        "elsewhere": report.elsewhere,
        "interrupted": report.interrupted,
    }
    sys.stdout.write(json_text.dumps(content) + "\n")


def _print(console: rich.console.Console, text: str) -> None:
    # Names must survive copying, so no line is folded.
    console.print(text, highlight=False, markup=False, soft_wrap=True)
