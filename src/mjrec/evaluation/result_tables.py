# SPDX-License-Identifier: Apache-2.0
"""`results.csv` and `timing.csv`: one row per episode, in the plan's order.

`results.csv` depends only on the plan and the installed packages. It is byte-identical
for any number of workers, no matter how often the evaluation was killed and resumed::

    task,seed,episode,return,length,terminated,truncated,success,failure

Booleans are written as `true` or `false`, or left empty if unknown. Numbers are written
with Python's `repr`, so reading them yields exactly the same values. The text of a
failure is a single line.

`timing.csv` contains the values that differ between runs: wall-clock times and the
files of each episode. It has one row for each row of `results.csv`, in the same order::

    task,seed,episode,start,seconds,folder,monitor,episode_id,trajectory,video

The files are untrusted: all values are checked before use, lines must be shorter than
`_LONGEST_LINE`, and rows are read into arrays instead of one object per row.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np
from numpy.typing import NDArray

from ..formats.json_fields import unreadable
from ..formats.monitor_directory import is_infix, video_prefix
from ..formats.regular_files import open_regular
from .episode_results import EpisodeResult
from .plan import EvaluationPlan

_UNIT: Final = ("task", "seed", "episode")
_TRUTHS: Final = ("terminated", "truncated", "success")
_RESULTS: Final = (*_UNIT, "return", "length", *_TRUTHS, "failure")
_TIMING: Final = (
    *(*_UNIT, "start", "seconds", "folder", "monitor"),
    *("episode_id", "trajectory", "video"),
)

# Enough for a name, a few numbers and one line of an error. The csv module's own limit
# for a single field is twice as large.
_LONGEST_LINE: Final = 1 << 16
_LONGEST_FAILURE: Final = 2000
_MOST_ROWS: Final = 4_000_000
_ROWS_AT_ONCE: Final = 4096

_WHOLE: Final = re.compile(r"[0-9]{1,18}", re.ASCII)
_NUMBER: Final = re.compile(
    r"-?([0-9]{1,40}(\.[0-9]{1,40})?(e[+-]?[0-9]{1,4})?|inf)|nan"
)
_FOLDER: Final = re.compile(r"(?!\.)[^/\0]{1,255}(/(?!\.)[^/\0]{1,255})?")
_TRUTH: Final = {"true": 1, "false": 0, "": -1}
_MEANING: Final = {1: True, 0: False, -1: None}
_TIMES: Final = ("start_time", "seconds")


@dataclass(frozen=True)
class EpisodeFiles:
    """An episode's files.

    Attributes:
        folder: path of the monitor directory, relative to the evaluation's directory;
            None if the episode has no files.
        trajectory: base name of the trajectory; None if the episode has no trajectory.
        video: base name of the finished or pending video; None if the episode has no
            video.
    """

    folder: str | None = None
    trajectory: str | None = None
    video: str | None = None


# The dtype of one episode. -1 and NaN mean unknown.
ROW: Final = np.dtype(
    [
        *(("seed", "<i8"), ("episode", "<i8"), ("total_reward", "<f8")),
        *(("length", "<i8"), ("terminated", "i1"), ("truncated", "i1")),
        *(("success", "i1"), ("start_time", "<f8"), ("seconds", "<f8")),
        *(("monitor", "<i4"), ("episode_id", "<i8")),
    ]
)


@dataclass(frozen=True, kw_only=True)
class TaskResults:
    """The episodes of one task, in the plan's order: by seed, then by number.

    A million episodes take 70 MB of memory.

    Attributes:
        task: the environment's name.
        rows: array of shape `(n,)` and dtype `ROW`, with the fields of `EpisodeResult`.
            `total_reward` is NaN if the episode failed or if its return is NaN. Truth
            values are 1, 0 or -1 (unknown). `monitor` is an index into `monitors`.
        failures: reasons why episodes failed, keyed by the index of the episode.
        places: the index of each monitor that recorded episodes, keyed by the monitor
            directory (relative to the evaluation's directory) and the infix.
        videos: base names of videos, keyed by the index of the episode.
    """

    task: str
    rows: NDArray[np.void]
    failures: dict[int, str] = field(default_factory=dict)
    places: dict[tuple[str, str], int] = field(default_factory=dict)
    videos: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """Whether each episode failed, with shape `(n,)`."""
        failed = np.zeros(len(self), dtype=np.bool_)
        failed[list(self.failures)] = True
        return failed

    @property
    def monitors(self) -> list[str]:
        """The infixes of the monitors that recorded the episodes."""
        return [infix for _, infix in self.places]

    def video_path(self, index: int) -> str | None:
        """Return the path of an episode's video, or None if there is no video.

        The path is relative to the evaluation's directory.
        """
        if index not in self.videos:
            return None
        folder, _ = list(self.places)[self.rows["monitor"][index]]
        return f"{folder}/{self.videos[index]}"

    def __iter__(self) -> Iterator[EpisodeResult]:
        """Yield the result of each episode, without its warnings."""
        monitors, names = self.monitors, ROW.names or ()
        for index, values in enumerate(self._rows_in_python()):
            row = dict(zip(names, values, strict=True))
            failure, monitor = self.failures.get(index), row["monitor"]
            row |= {name: _MEANING[row[name]] for name in _TRUTHS}
            row |= {name: None for name in _TIMES if math.isnan(row[name])}
            row["monitor"] = None if monitor < 0 else monitors[monitor]
            if failure:
                row["total_reward"] = None
            if monitor < 0:
                row["episode_id"] = None
            yield EpisodeResult(task=self.task, failure=failure, **row)

    def _rows_in_python(self) -> Iterator[tuple[Any, ...]]:
        for start in range(0, len(self), _ROWS_AT_ONCE):
            yield from self.rows[start : start + _ROWS_AT_ONCE].tolist()


def write_results_table(file: TextIO, results: Iterable[EpisodeResult]) -> None:
    """Write `results.csv`.

    Args:
        file: the file, opened with `newline=""`.
        results: all episodes, in the plan's order.
    """
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_RESULTS)
    for each in results:
        truths = [_truth_text(getattr(each, name)) for name in _TRUTHS]
        failure = "" if each.failure is None else _one_line(each.failure)
        total = "" if failure else _shown(each.total_reward)
        writer.writerow([*_unit(each), total, each.length, *truths, failure])


def write_timing_table(
    file: TextIO,
    results: Iterable[EpisodeResult],
    files: Callable[[EpisodeResult], EpisodeFiles],
) -> None:
    """Write `timing.csv`.

    Args:
        file: the file, opened with `newline=""`.
        results: all episodes, in the plan's order.
        files: a function that returns an episode's files.
    """
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_TIMING)
    for each in results:
        of = files(each)
        recorded = (of.folder, each.monitor, each.episode_id) if of.folder else [""] * 3
        times = map(_shown, (each.start_time, each.seconds))
        files_of_it = (of.trajectory or "", of.video or "")
        writer.writerow([*_unit(each), *times, *recorded, *files_of_it])


def read_tables(
    results: Path, timing: Path, plan: EvaluationPlan, *, needs_timing: bool = False
) -> dict[str, TaskResults]:
    """Read the episodes of each task, in the plan's order.

    Args:
        results: the path of `results.csv`.
        timing: the path of `timing.csv`. If the file is missing, times and files are
            unknown.
        plan: the plan of the evaluation. The tables must contain exactly the episodes
            in the plan.
        needs_timing: whether `timing.csv` must also exist.

    Raises:
        UnreadableFile: a table is damaged or missing, or belongs to a different plan.
    """
    with unreadable(results):
        if len(plan.seeds) * plan.episodes * len(plan.tasks) > _MOST_ROWS:
            raise ValueError(f"its plan has more than {_MOST_ROWS} episodes")
        columns = {task.name: _nothing_known(task.name, plan) for task in plan.tasks}
        _read_rows(results, _RESULTS, columns, _read_result)
    if needs_timing or timing.is_file():
        with unreadable(timing):
            _read_rows(timing, _TIMING, columns, _read_timing)
    return columns


def _nothing_known(task: str, plan: EvaluationPlan) -> TaskResults:
    rows = np.zeros(len(plan.seeds) * plan.episodes, ROW)
    rows["seed"] = np.repeat(np.array(plan.seeds, np.int64), plan.episodes)
    rows["episode"] = np.tile(np.arange(plan.episodes), len(plan.seeds))
    for name in (*_TRUTHS, "monitor", "episode_id"):
        rows[name] = -1
    for name in ("total_reward", *_TIMES):
        rows[name] = np.nan
    return TaskResults(task=task, rows=rows)


def _read_result(of: TaskResults, index: int, values: Sequence[str]) -> None:
    total_reward, length, *truths, failure = values
    if failure:
        if total_reward:
            raise ValueError("a failed episode must not have a return")
        if not failure.isprintable() or len(failure) > _LONGEST_FAILURE:
            raise ValueError(f"{failure!r:.80} is not a single line")
        of.failures[index] = failure
    row = of.rows[index]
    row["total_reward"], row["length"] = _number(total_reward), _whole(length)
    for name, text in zip(_TRUTHS, truths, strict=True):
        row[name] = _truth(text)


def _read_timing(of: TaskResults, index: int, values: Sequence[str]) -> None:
    start, seconds, folder, monitor, episode_id, _, video = values
    row = of.rows[index]
    row["start_time"], row["seconds"] = _number(start), _number(seconds)
    if not folder:
        if any(values[2:]):
            raise ValueError("an episode without a folder must not have files")
        return
    place = folder, monitor
    if not is_infix(monitor) or not _FOLDER.fullmatch(folder):
        raise ValueError(f"{monitor!r:.80} in {folder!r:.80} is not a monitor")
    row["monitor"] = of.places.setdefault(place, len(of.places))
    row["episode_id"] = number = _whole(episode_id)
    if video:
        prefix = video_prefix(monitor, number)
        if video not in (f"{prefix}{end}" for end in (".mp4", ".json", ".avi")):
            raise ValueError(f"{video!r:.200} is not a video of its episode")
        of.videos[index] = video


def _read_rows(
    path: Path,
    header: Sequence[str],
    columns: Mapping[str, TaskResults],
    read: Callable[[TaskResults, int, Sequence[str]], None],
) -> None:
    """Read a table whose rows must match the episodes of `columns` exactly."""
    with open_regular(path) as binary:
        file = io.TextIOWrapper(binary, encoding="utf-8", newline="")
        reader = csv.reader(_lines(file), strict=True)
        line = 0
        try:
            if tuple(next(reader, ())) != tuple(header):
                raise ValueError(f"the first line is not {','.join(header)}")
            units = ((of, index) for of in columns.values() for index in range(len(of)))
            for line, (of, index) in enumerate(units, start=2):
                row = next(reader, [])
                if len(row) != len(header) or reader.line_num != line:
                    raise ValueError(f"the line is not a row with {len(header)} values")
                unit = [_encodable(of.task), *map(str, of.rows[index].item()[:2])]
                if row[:3] != unit:
                    raise ValueError(
                        f"the episode should be {', '.join(unit)}, but it is "
                        f"{', '.join(row[:3]):.80}"
                    )
                read(of, index, row[3:])
            if next(reader, None) is not None:
                line += 1
                raise ValueError("the table has more episodes than the plan")
        except UnicodeDecodeError as error:
            raise ValueError(f"the text after line {line} is not UTF-8") from error
        except (csv.Error, ValueError) as error:
            raise ValueError(f"line {line or 1}: {error}") from error


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise ValueError("the line is too long")
        yield line


def _unit(result: EpisodeResult) -> tuple[str, str, str]:
    return _encodable(result.task), str(result.seed), str(result.episode)


def _shown(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def _truth_text(value: bool | None) -> str:
    return "" if value is None else str(bool(value)).lower()


def _one_line(text: str) -> str:
    # A failed episode must have a reason, even if the error has no message.
    shown = "".join(c if c.isprintable() else " " for c in _encodable(text))
    return " ".join(shown.split())[:_LONGEST_FAILURE] or "unknown"


def _encodable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


def _whole(text: str) -> int:
    if not _WHOLE.fullmatch(text):
        raise ValueError(f"{text!r:.80} is not a whole number")
    return int(text)


def _number(text: str) -> float:
    if not text:
        return math.nan
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{text!r:.80} is not a number")
    return float(text)


def _truth(text: str) -> int:
    if text not in _TRUTH:
        raise ValueError(f"{text!r:.80} is neither true nor false")
    return _TRUTH[text]
