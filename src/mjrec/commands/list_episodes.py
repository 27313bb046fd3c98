# SPDX-License-Identifier: Apache-2.0
"""`mjrec list`: the recorded episodes of a directory."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

import rich.box
import rich.console
import rich.markup
import rich.table
import tyro

from .. import json_text
from ..errors import UnreadableFile
from ..evaluation.results_files import ReadResults, is_evaluation, read_results
from ..formats.monitor_directory import iter_monitor_files, monitor_directories_in
from ..formats.video_metadata import finished_videos, metadata_path
from ..results import Episode, iter_episodes
from .help_text import flowing_help
from .terminal import printable, result_console


@flowing_help
def list_episodes(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """List the recorded episodes of an evaluation, or of a monitor directory.

    Of an evaluation that is finished: task, seed, return and video of each. Of another
    directory that has no episodes of its own, those of the monitor directories in it.

    Args:
        directory: the evaluation's, the monitors', or one that holds some of these.
        as_json: print one JSON object a line and episode, instead of a table; it says
            `directory` where there are several.
    """
    console = result_console()
    results = _results_of(directory)
    if results is not None:
        if as_json:
            _print_json(_fields_of_results(results))
        else:
            console.print(_table_of_results(results))
        return 0
    places = _monitor_directories(directory)
    for place in places:
        more = {} if place == directory else {"directory": place.name}
        if as_json:
            _print_json({**more, **_fields(each)} for each in iter_episodes(place))
            continue
        if more:
            _print_lines(console, f"{place}:")
        _print_table(console, place)
    return 0


def _print_json(objects: Iterable[dict[str, Any]]) -> None:
    for each in objects:
        sys.stdout.write(json_text.dumps(each) + "\n")


def _print_lines(console: rich.console.Console, *lines: str) -> None:
    # Names must survive copying, so no line is folded.
    text = "\n".join(lines)
    console.print(text, highlight=False, markup=False, soft_wrap=True)


def _table(texts: Iterable[str], numbers: Iterable[str]) -> rich.table.Table:
    table = rich.table.Table(
        box=rich.box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    for name in texts:
        table.add_column(name, overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right")
    for name in ("ended", "video"):
        table.add_column(name, overflow="fold")
    return table


# --- An evaluation ----------------------------------------------------------------


def _results_of(directory: Path) -> ReadResults | None:
    """Return the results of an evaluation; None where there are none yet."""
    if not is_evaluation(directory):
        return None
    try:
        return read_results(directory)
    except UnreadableFile:
        return None


def _fields_of_results(results: ReadResults) -> Iterator[dict[str, Any]]:
    for task, columns in results.columns.items():
        for index, result in enumerate(columns):
            video = columns.video_path(index)
            path = None if video is None else results.directory / video
            yield {
                "task": task,
                "seed": result.seed,
                "episode": result.episode,
                "length": result.length,
                "reward": result.total_reward,
                "terminated": result.terminated,
                "truncated": result.truncated,
                "success": result.success,
                "failure": result.failure,
                "video": None if path is None else str(path),
                "pending": path is not None and not path.exists(),
            }


def _table_of_results(results: ReadResults) -> rich.table.Table:
    table = _table(["task"], ["seed", "episode", "steps", "return"])
    for each in _fields_of_results(results):
        ended = _end(each["terminated"])
        if each["failure"] is not None:
            ended = "failed"
        video = Path(each["video"]).name if each["video"] else ""
        cells = (
            *(each["task"], str(each["seed"]), str(each["episode"])),
            *(str(each["length"]), _return(each["reward"]), ended),
            "pending" if each["pending"] else video,
        )
        table.add_row(*(rich.markup.escape(printable(cell)) for cell in cells))
    return table


def _return(reward: float | None) -> str:
    return "" if reward is None else f"{reward:.6g}"


def _end(terminated: bool | None) -> str:
    if terminated is None:
        return ""
    return "terminated" if terminated else "truncated"


# --- A monitor directory ----------------------------------------------------------


def _monitor_directories(directory: Path) -> list[Path]:
    """Return the directory itself, or those in it that have what it has not."""
    if not directory.is_dir() or any(iter_monitor_files(directory)):
        return [directory]
    return monitor_directories_in(directory) or [directory]


def _print_table(console: rich.console.Console, directory: Path) -> None:
    table = _table([], ["episode", "steps", "return"])
    # The names of the videos that are of a completed episode alone.
    known: set[str] = set()
    for episode in iter_episodes(directory):
        video = "pending" if episode.pending else ""
        if episode.video is not None:
            further = _further_videos(episode)
            known.update([episode.video.name, *further])
            video = episode.video.name
            video += f" and {len(further)} of further cameras" if further else ""
        table.add_row(
            str(episode.episode_id),
            str(episode.length),
            _return(episode.reward),
            _end(episode.terminated),
            rich.markup.escape(video),
        )
    if table.row_count:
        console.print(table)
    else:
        _print_lines(console, f"No episode is recorded in {directory}.")
    # Such as those that are counted in steps, or show all sub-environments.
    others = [
        path.name
        for path in iter_monitor_files(directory)
        if path.suffix == ".mp4"
        and path.name not in known
        and metadata_path(path).exists()
    ]
    if others:
        _print_lines(console, "Other videos:", *(f"  {name}" for name in others))


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
