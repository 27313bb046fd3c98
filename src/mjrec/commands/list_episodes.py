# SPDX-License-Identifier: Apache-2.0
"""`mjrec list`: the recorded episodes of a directory."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated

import rich.box
import rich.console
import rich.markup
import rich.table
import tyro

from .. import json_text
from ..formats.monitor_directory import iter_monitor_files
from ..formats.video_metadata import finished_videos, metadata_path
from ..results import Episode, iter_episodes
from .help_text import flowing_help
from .terminal import result_console

__all__ = ["episode_table", "list_episodes"]


@flowing_help
def list_episodes(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """List the recorded episodes of a monitor directory.

    Args:
        directory: the monitor directory.
        as_json: print one JSON object a line and episode, instead of a table.
    """
    episodes = iter_episodes(directory)
    if as_json:
        for episode in episodes:
            sys.stdout.write(json_text.dumps(_fields(episode)) + "\n")
        return 0
    console = result_console()
    shown: list[Episode] = []
    console.print(episode_table(_kept(episodes, shown)))
    others = _other_videos(directory, shown)
    if others:
        # Names must survive copying, so no line is folded.
        lines = ["Other videos:", *(f"  {name}" for name in others)]
        console.print("\n".join(lines), highlight=False, markup=False, soft_wrap=True)
    return 0


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
