# SPDX-License-Identifier: Apache-2.0
"""`mjrec list`: the recorded episodes of a directory."""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from ..evaluation.episode_results import EpisodeResult
from ..evaluation.evaluation import is_evaluation, results_in
from ..formats.monitor_directory import (
    infix_of,
    iter_monitor_files,
    recording_directories,
)
from ..formats.video_metadata import finished_videos, metadata_path
from ..results import Episode, iter_episodes
from .not_finite import name_of, not_finite_lines
from .options import AsJson
from .terminal import print_json, print_rows, printable

_Rows = Iterator[Sequence[str]]

_FIELDS = (
    *("task", "seed", "episode", "length", "reward"),
    *("terminated", "truncated", "success", "failure"),
)
_TEXTS = ("task", "monitor", "ended", "video")


def list_episodes(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    as_json: AsJson = False,
) -> int:
    """List the episodes of a monitor directory or an evaluation.

    For an evaluation, finished or not, list the task, seed, return and video of each
    episode. For a folder that only contains monitor directories, list all episodes.

    Args:
        directory: a monitor directory, an evaluation, or a folder of monitor
            directories.
        as_json: print one JSON object per episode, one per line, instead of a table.
            Each has a `directory` key if there are several directories.
    """
    not_finite: list[str] = []
    if is_evaluation(directory):
        results = results_in(directory)
        if as_json:
            _print_all(itertools.starmap(_fields_of_result, results))
        else:
            names = ("task", "seed", "episode", "steps", "return", "ended", "video")
            rows = (_row_of_result(*each, not_finite) for each in results)
            _print_table(directory, names, rows)
            _print_not_finite(not_finite)
        return 0
    for place in recording_directories(directory):
        more = {} if place == directory else {"directory": place.name}
        if as_json:
            _print_all({**more, **_fields(each)} for each in iter_episodes(place))
            continue
        if more:
            sys.stdout.write(f"{place}:\n")
        _print_monitors(place, not_finite)
    _print_not_finite(not_finite)
    return 0


def _print_all(objects: Iterable[dict[str, Any]]) -> None:
    for each in objects:
        print_json(each)


def _print_table(directory: Path, names: Sequence[str], rows: _Rows) -> None:
    if not print_rows(names, rows, left=_TEXTS):
        sys.stdout.write(f"No episodes are recorded in {directory}.\n")


def _print_not_finite(names: Sequence[str]) -> None:
    for line in not_finite_lines(names):
        sys.stdout.write(f"{line}\n")


# --- An evaluation ----------------------------------------------------------------


def _fields_of_result(result: EpisodeResult, video: Path | None) -> dict[str, Any]:
    return {
        **{name: getattr(result, name) for name in _FIELDS},
        "video": None if video is None else str(video),
        "pending": video is not None and not video.exists(),
    }


def _row_of_result(
    result: EpisodeResult, path: Path | None, not_finite: list[str]
) -> Sequence[str]:
    if not math.isfinite(result.total_reward or 0):
        not_finite.append(result.name)
    fields = _fields_of_result(result, path)
    video = Path(fields["video"]).name if fields["video"] else ""
    return (
        *(str(fields[name]) for name in ("task", "seed", "episode", "length")),
        _return(fields["reward"]),
        "failed" if fields["failure"] is not None else _end(fields["terminated"]),
        "pending" if fields["pending"] else video,
    )


def _return(reward: float | None) -> str:
    return "" if reward is None else f"{reward:.6g}"


def _end(terminated: bool | None) -> str:
    if terminated is None:
        return ""
    return "terminated" if terminated else "truncated"


# --- A monitor directory ----------------------------------------------------------


def _print_monitors(directory: Path, not_finite: list[str]) -> None:
    # The names of the videos that show exactly one completed episode.
    known: set[str] = set()
    best: list[Episode] = []
    # Sub-environments of a vector environment number their episodes separately.
    monitors = {infix_of(path.name) for path in iter_monitor_files(directory)}
    has_several = len(monitors - {None}) > 1

    def rows() -> _Rows:
        for episode in iter_episodes(directory):
            if not math.isfinite(episode.reward):
                not_finite.append(name_of(directory, episode))
            elif not best or episode.reward > best[0].reward:
                best[:] = [episode]
            further = _further_videos(episode)
            video = "pending" if episode.pending else ""
            if episode.video is not None:
                known.update([episode.video.name, *further])
                video = episode.video.name
                video += f" and {len(further)} from other cameras" * bool(further)
            yield (
                *([episode.monitor] if has_several else []),
                *(str(episode.episode_id), str(episode.length)),
                *(_return(episode.reward), _end(episode.terminated), video),
            )

    names = ("episode", "steps", "return", "ended", "video")
    _print_table(directory, ("monitor", *names) if has_several else names, rows())
    for episode in best:
        of = f" of {episode.monitor}" if has_several else ""
        what = f"episode {episode.episode_id}{of}, {_return(episode.reward)}"
        sys.stdout.write(f"Best return: {printable(what)}\n")
    # For example, clips, and videos that show all sub-environments.
    others = [path.name for path in _videos(directory) if path.name not in known]
    if others:
        sys.stdout.write("\n  ".join(["Other videos:", *others]) + "\n")


def _videos(directory: Path) -> Iterable[Path]:
    for path in iter_monitor_files(directory):
        if path.suffix == ".mp4" and metadata_path(path).exists():
            yield path


def _fields(episode: Episode) -> dict[str, Any]:
    plain = {
        name: value.name if isinstance(value, Path) else value
        for name, value in vars(episode).items()
    }
    return {**plain, "further_videos": _further_videos(episode)}


def _further_videos(episode: Episode) -> list[str]:
    """Return the names of an episode's videos from its additional cameras."""
    if episode.video is None or episode.metadata is None:
        return []
    return [name for name, _ in finished_videos(episode.video)[1:]]
