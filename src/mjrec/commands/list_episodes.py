# SPDX-License-Identifier: Apache-2.0
"""`mjrec list`: the recorded episodes of a directory."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated

import rich.box
import rich.console
import rich.markup
import rich.table
import tyro

from .. import json_text
from ..formats.monitor_directory import iter_monitor_files, monitor_directories_in
from ..formats.video_metadata import finished_videos, metadata_path
from ..results import Episode, iter_episodes
from .help_text import flowing_help
from .terminal import result_console


@flowing_help
def list_episodes(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """List the recorded episodes of a monitor directory.

    Of a directory that has none of its own, such as an evaluation's, those of the
    monitor directories in it.

    Args:
        directory: the monitor directory, or one that holds some.
        as_json: print one JSON object a line and episode, instead of a table; it says
            `directory` where there are several.
    """
    places = _monitor_directories(directory)
    if as_json:
        for place in places:
            _print_json(place, {} if place == directory else {"directory": place.name})
        return 0
    console = result_console()
    for place in places:
        if place != directory:
            _print_lines(console, f"{place}:")
        _print_table(console, place)
    return 0


def _monitor_directories(directory: Path) -> list[Path]:
    """Return the directory itself, or those in it that have what it has not."""
    if not directory.is_dir() or any(iter_monitor_files(directory)):
        return [directory]
    return monitor_directories_in(directory) or [directory]


def _print_json(directory: Path, more: Mapping[str, object]) -> None:
    for episode in iter_episodes(directory):
        sys.stdout.write(json_text.dumps({**more, **_fields(episode)}) + "\n")


def _print_table(console: rich.console.Console, directory: Path) -> None:
    shown: list[Episode] = []
    table = episode_table(_kept(iter_episodes(directory), shown))
    if table.row_count:
        console.print(table)
    else:
        _print_lines(console, f"No episode is recorded in {directory}.")
    others = _other_videos(directory, shown)
    if others:
        _print_lines(console, "Other videos:", *(f"  {name}" for name in others))


def _print_lines(console: rich.console.Console, *lines: str) -> None:
    # Names must survive copying, so no line is folded.
    text = "\n".join(lines)
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def episode_table(episodes: Iterator[Episode]) -> rich.table.Table:
    """Return a table with a row for each episode."""
    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    for name in ("episode", "steps", "return"):
        table.add_column(name, justify="right")
    for name in ("ended", "video"):
        table.add_column(name, overflow="fold")
    for episode in episodes:
        table.add_row(
            str(episode.episode_id),
            str(episode.length),
            f"{episode.reward:.6g}",
            _end(episode),
            _video(episode),
        )
    return table


def _kept(episodes: Iterator[Episode], seen: list[Episode]) -> Iterator[Episode]:
    """Yield episodes, and keep those that have a video."""
    for episode in episodes:
        if episode.video is not None:
            seen.append(episode)
        yield episode


def _other_videos(directory: Path, episodes: Iterable[Episode]) -> list[str]:
    """Return the names of finished videos that are of no completed episode alone.

    Such as those that are counted in steps, or show all sub-environments.
    """
    known = {
        name
        for episode in episodes
        if episode.video is not None
        for name in (episode.video.name, *_further_videos(episode))
    }
    return [
        path.name
        for path in iter_monitor_files(directory)
        if path.suffix == ".mp4"
        and path.name not in known
        and metadata_path(path).exists()
    ]


def _video(episode: Episode) -> str:
    if episode.video is not None:
        further = len(_further_videos(episode))
        more = f" and {further} of further cameras" if further else ""
        return rich.markup.escape(episode.video.name) + more
    return "pending" if episode.pending else ""


def _end(episode: Episode) -> str:
    if episode.terminated is None:
        return ""
    return "terminated" if episode.terminated else "truncated"


def _fields(episode: Episode) -> dict[str, object]:
    fields = {f.name: getattr(episode, f.name) for f in dataclasses.fields(episode)}
    plain = {
        name: value.name if isinstance(value, Path) else value
        for name, value in fields.items()
    }
    return {**plain, "further_videos": _further_videos(episode)}


def _further_videos(episode: Episode) -> list[str]:
    """Return the names of the videos of an episode's further cameras."""
    if episode.video is None or episode.metadata is None:
        return []
    return [name for name, _ in finished_videos(episode.video)[1:]]
