# SPDX-License-Identifier: Apache-2.0
"""`results.csv` and `timing.csv`: one row for each episode, in the plan's order.

`results.csv` holds what follows from the plan alone: it is the same, byte for byte,
whatever the number of workers, however often the evaluation was killed and resumed::

    task,seed,episode,return,length,terminated,truncated,success,failure

Truth is `true`, `false`, or empty where nothing is known; numbers are as Python's
`repr` writes them, so they are read back bit for bit; a failure is one line.

`timing.csv` holds what is different in every run: wall times, and which files an
episode is in. Its rows are those of the same episodes, in the same order::

    task,seed,episode,start,seconds,folder,monitor,episode_id,trajectory,video

What is read may have been written by anybody: everything is checked, no row can be
longer than `_LONGEST_LINE`, and rows go into columns, never into objects.
"""

from __future__ import annotations

import csv
import io
import math
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from ..formats.json_fields import unreadable
from ..formats.monitor_directory import Infix, trajectory_prefix, video_prefix
from ..formats.regular_files import open_regular
from .episode_results import EpisodeResult
from .plan import EvaluationPlan
from .result_columns import ResultColumns

_RESULTS = (
    *("task", "seed", "episode", "return", "length"),
    *("terminated", "truncated", "success", "failure"),
)
_TIMING = (
    *("task", "seed", "episode", "start", "seconds", "folder", "monitor"),
    *("episode_id", "trajectory", "video"),
)

# A name, a few numbers and one line of an error; csv's own limit for a field is twice
# as much.
_LONGEST_LINE = 1 << 16
_LONGEST_FAILURE = 2000
_MOST_ROWS = 4_000_000

_WHOLE = re.compile(r"[0-9]{1,18}", re.ASCII)
_NUMBER = re.compile(r"-?([0-9]{1,40}(\.[0-9]{1,40})?(e[+-]?[0-9]{1,4})?|inf)|nan")
_FOLDER = re.compile(r"(?!\.)[^/\0]{1,255}/(?!\.)[^/\0]{1,255}")
_TRUTH = {"true": 1, "false": 0, "": -1}


@dataclass(frozen=True)
class EpisodeFiles:
    """The files of an episode.

    Attributes:
        folder: its monitor directory, in that of the evaluation; None where it has no
            files.
        trajectory: the base name of its trajectory, None where it has none.
        video: that of its video, finished or pending; None where it gets none.
    """

    folder: str | None = None
    trajectory: str | None = None
    video: str | None = None


def write_results_table(file: TextIO, results: Iterable[EpisodeResult]) -> None:
    """Write `results.csv`.

    Args:
        file: opened with `newline=""`.
        results: in the plan's order.
    """
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_RESULTS)
    writer.writerows(map(_results_row, results))


def write_timing_table(
    file: TextIO,
    results: Iterable[EpisodeResult],
    files: Callable[[EpisodeResult], EpisodeFiles],
) -> None:
    """Write `timing.csv`; `files` tells of an episode which ones are its own."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_TIMING)
    writer.writerows(_timing_row(each, files(each)) for each in results)


def read_tables(
    results: Path, timing: Path, plan: EvaluationPlan, *, needs_timing: bool = False
) -> dict[str, ResultColumns]:
    """Return the episodes of each task, in the plan's order.

    Args:
        results: the path of `results.csv`.
        timing: the path of `timing.csv`. Where there is none, times and files are not
            known.
        plan: what was evaluated: exactly its episodes must be there.
        needs_timing: whether `timing.csv` must be there, too.

    Raises:
        UnreadableFile: a table is damaged or missing, or is that of another plan.
    """
    episodes = len(plan.seeds) * plan.episodes
    columns = {task.name: _Columns() for task in plan.tasks}
    with unreadable(results):
        if episodes * len(columns) > _MOST_ROWS:
            raise ValueError(f"its plan has more than {_MOST_ROWS} episodes")
        _read_rows(results, _RESULTS, plan, columns, _Columns.add_result)
    with_timing = needs_timing or timing.is_file()
    if with_timing:
        with unreadable(timing):
            _read_rows(timing, _TIMING, plan, columns, _Columns.add_timing)
    return {
        task: each.finished(task, plan, with_timing=with_timing)
        for task, each in columns.items()
    }


class _Columns:
    """The columns of a task while they are read."""

    def __init__(self) -> None:
        self.total_reward = array("d")
        self.length = array("q")
        self.terminated = array("b")
        self.truncated = array("b")
        self.success = array("b")
        self.failures: dict[int, str] = {}
        self.start_time = array("d")
        self.seconds = array("d")
        self.monitor = array("i")
        self.monitors: dict[tuple[str, str], int] = {}
        self.episode_id = array("q")
        self.has_trajectory = array("b")
        self.videos: dict[int, str] = {}

    def add_result(self, values: Sequence[str]) -> None:
        total_reward, length, terminated, truncated, success, failure = values
        if bool(failure) == bool(total_reward):
            raise ValueError("an episode has either a return or a failure")
        if failure:
            self.failures[len(self.length)] = _printable(failure)
        self.total_reward.append(_number(total_reward))
        self.length.append(_whole(length))
        self.terminated.append(_truth(terminated))
        self.truncated.append(_truth(truncated))
        self.success.append(_truth(success))

    def add_timing(self, values: Sequence[str]) -> None:
        start, seconds, folder, monitor, episode_id, trajectory, video = values
        index = len(self.start_time)
        self.start_time.append(_number(start))
        self.seconds.append(_number(seconds))
        self.monitor.append(self._monitor(folder, monitor))
        self.episode_id.append(_whole(episode_id) if episode_id else -1)
        if not monitor:
            if folder or episode_id or trajectory or video:
                raise ValueError("an episode without a monitor has files")
            self.has_trajectory.append(False)
            return
        infix = Infix.parse(monitor)
        assert infix is not None
        number = self.episode_id[-1]
        if number < 0:
            raise ValueError("an episode of a monitor has no number")
        self.has_trajectory.append(
            _is_of(trajectory, trajectory_prefix(infix, number), (".h5",))
        )
        if _is_of(video, video_prefix(infix, number), (".mp4", ".json", ".avi")):
            self.videos[index] = video

    def finished(
        self, task: str, plan: EvaluationPlan, *, with_timing: bool
    ) -> ResultColumns:
        count = len(self.length)
        if not with_timing:
            self._add_nothing_known(count)
        return ResultColumns(
            task=task,
            seed=np.repeat(np.array(plan.seeds, dtype=np.int64), plan.episodes),
            episode=np.tile(np.arange(plan.episodes, dtype=np.int64), len(plan.seeds)),
            total_reward=np.frombuffer(self.total_reward, dtype=np.float64),
            length=np.frombuffer(self.length, dtype=np.int64),
            terminated=np.frombuffer(self.terminated, dtype=np.int8),
            truncated=np.frombuffer(self.truncated, dtype=np.int8),
            success=np.frombuffer(self.success, dtype=np.int8),
            failures=self.failures,
            start_time=np.frombuffer(self.start_time, dtype=np.float64),
            seconds=np.frombuffer(self.seconds, dtype=np.float64),
            monitor=np.frombuffer(self.monitor, dtype=np.int32),
            monitors=tuple(monitor for _, monitor in self.monitors),
            folders=tuple(folder for folder, _ in self.monitors),
            episode_id=np.frombuffer(self.episode_id, dtype=np.int64),
            has_trajectory=np.frombuffer(self.has_trajectory, dtype=np.bool_),
            videos=self.videos,
        )

    def _add_nothing_known(self, count: int) -> None:
        self.start_time = array("d", [math.nan]) * count
        self.seconds = array("d", [math.nan]) * count
        self.monitor = array("i", [-1]) * count
        self.episode_id = array("q", [-1]) * count
        self.has_trajectory = array("b", [0]) * count

    def _monitor(self, folder: str, monitor: str) -> int:
        if not monitor:
            return -1
        known = folder, monitor
        if known not in self.monitors:
            if Infix.parse(monitor) is None:
                raise ValueError(f"{monitor!r:.80} is not the infix of a monitor")
            if not _FOLDER.fullmatch(folder):
                raise ValueError(f"{folder!r:.80} is not the folder of a monitor")
        return self.monitors.setdefault(known, len(self.monitors))


def _results_row(result: EpisodeResult) -> list[str]:
    return [
        *_unit(result),
        "" if result.failure is not None else _shown(result.total_reward),
        str(result.length),
        _truth_text(result.terminated),
        _truth_text(result.truncated),
        _truth_text(result.success),
        "" if result.failure is None else _one_line(result.failure),
    ]


def _timing_row(result: EpisodeResult, files: EpisodeFiles) -> list[str]:
    return [
        *_unit(result),
        _shown(result.start_time),
        _shown(result.seconds),
        files.folder or "",
        (files.folder and result.monitor) or "",
        "" if result.episode_id is None or not files.folder else str(result.episode_id),
        files.trajectory or "",
        files.video or "",
    ]


def _unit(result: EpisodeResult) -> tuple[str, str, str]:
    return _encodable(result.task), str(result.seed), str(result.episode)


def _shown(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def _truth_text(value: bool | None) -> str:
    return "" if value is None else str(bool(value)).lower()


def _one_line(text: str) -> str:
    # A failure is there also where nothing is said of it.
    shown = "".join(c if c.isprintable() else " " for c in _encodable(text))
    return " ".join(shown.split())[:_LONGEST_FAILURE] or "unknown"


def _encodable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


def _read_rows(
    path: Path,
    header: Sequence[str],
    plan: EvaluationPlan,
    columns: Mapping[str, _Columns],
    add: Callable[[_Columns, Sequence[str]], None],
) -> None:
    """Read a table whose rows must be exactly those of the plan."""
    with open_regular(path) as binary:
        file = io.TextIOWrapper(binary, encoding="utf-8", newline="")
        reader = csv.reader(_lines(file), strict=True)
        line = 0
        try:
            if tuple(next(reader, ())) != tuple(header):
                raise ValueError(f"its first line is not {','.join(header)}")
            for line, unit in enumerate(_units(plan), start=2):
                row = next(reader, None)
                if row is None:
                    raise ValueError(f"it ends before the episode {_told(unit)}")
                if len(row) != len(header) or reader.line_num != line:
                    raise ValueError(f"it has not one row of {len(header)} values")
                if tuple(row[:3]) != unit:
                    raise ValueError(
                        f"the episode {_told(unit)} belongs there, not {_told(row[:3])}"
                    )
                add(columns[unit[0]], row[3:])
            if next(reader, None) is not None:
                line += 1
                raise ValueError("it has more episodes than the plan")
        except csv.Error as error:
            raise ValueError(f"line {line}: {error}") from error
        except UnicodeDecodeError as error:
            raise ValueError(f"after line {line} it is not UTF-8 text") from error
        except ValueError as error:
            raise ValueError(f"line {line or 1}: {error}") from error


def _units(plan: EvaluationPlan) -> Iterator[tuple[str, str, str]]:
    for task in plan.tasks:
        for seed in plan.seeds:
            for episode in range(plan.episodes):
                yield task.name, str(seed), str(episode)


def _told(unit: Sequence[str]) -> str:
    return ", ".join(f"{value:.80}" for value in unit)


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise ValueError("it is longer than any line of a table")
        yield line


def _whole(text: str) -> int:
    if not _WHOLE.fullmatch(text):
        raise ValueError(f"{text!r:.80} is no whole number")
    return int(text)


def _number(text: str) -> float:
    if not text:
        return math.nan
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{text!r:.80} is no number")
    return float(text)


def _truth(text: str) -> int:
    if text not in _TRUTH:
        raise ValueError(f"{text!r:.80} is neither true nor false")
    return _TRUTH[text]


def _printable(text: str) -> str:
    if not text.isprintable() or len(text) > _LONGEST_FAILURE:
        raise ValueError(f"{text!r:.80} is not one line")
    return text


def _is_of(name: str, prefix: str, suffixes: Sequence[str]) -> bool:
    """Tell whether a file is named; it must be the one of its episode."""
    if name and not any(name == prefix + suffix for suffix in suffixes):
        raise ValueError(f"{name!r:.200} is no file of its episode")
    return bool(name)
