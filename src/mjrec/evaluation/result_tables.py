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

What is read may have been written by anybody: all that is used of it is checked, no row
can be longer than `_LONGEST_LINE`, and rows go into columns, never into objects.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TextIO

import numpy as np
from numpy.typing import NDArray

from ..formats.json_fields import unreadable
from ..formats.monitor_directory import Infix, video_prefix
from ..formats.regular_files import open_regular
from .episode_results import EpisodeResult
from .plan import EvaluationPlan

_UNIT: Final = ("task", "seed", "episode")
_RESULTS: Final = (
    *(*_UNIT, "return", "length"),
    *("terminated", "truncated", "success", "failure"),
)
_TIMING: Final = (
    *(*_UNIT, "start", "seconds", "folder", "monitor"),
    *("episode_id", "trajectory", "video"),
)

# A name, a few numbers and one line of an error; csv's own limit for a field is twice
# as much.
_LONGEST_LINE: Final = 1 << 16
_LONGEST_FAILURE: Final = 2000
_MOST_ROWS: Final = 4_000_000

_WHOLE: Final = re.compile(r"[0-9]{1,18}", re.ASCII)
_NUMBER: Final = re.compile(
    r"-?([0-9]{1,40}(\.[0-9]{1,40})?(e[+-]?[0-9]{1,4})?|inf)|nan"
)
_FOLDER: Final = re.compile(r"(?!\.)[^/\0]{1,255}(/(?!\.)[^/\0]{1,255})?")
_TRUTH: Final = {"true": 1, "false": 0, "": -1}
_MEANING: Final = {1: True, 0: False, -1: None}


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


@dataclass(frozen=True, kw_only=True)
class ResultColumns:
    """The episodes of one task, in the order of the plan: by seed, then by number.

    A million of them take 70 MB. Where -1 stands, nothing is known.

    Attributes:
        task: the environment's name.
        seed: `(n,) int64`.
        episode: `(n,) int64`, the number in its run.
        total_reward: `(n,) float64`; NaN where it failed, and where that is the return.
        length: `(n,) int64`, steps.
        terminated: `(n,) int8`: 1, 0 or -1.
        truncated: `(n,) int8`, likewise.
        success: `(n,) int8`, likewise.
        start_time: `(n,) float64`, wall clock in seconds; NaN where it is not known.
        seconds: `(n,) float64`, how long it took, likewise.
        monitor: `(n,) int32`, index into `monitors`, or -1.
        episode_id: `(n,) int64`, the number in that monitor, or -1.
        failures: why, by index, of those that failed.
        places: the indices of the monitors that recorded them, by monitor directory, in
            that of the evaluation, and infix.
        videos: by index, the base names of the videos of those that get one.
    """

    task: str
    seed: NDArray[np.int64]
    episode: NDArray[np.int64]
    total_reward: NDArray[np.float64]
    length: NDArray[np.int64]
    terminated: NDArray[np.int8]
    truncated: NDArray[np.int8]
    success: NDArray[np.int8]
    start_time: NDArray[np.float64]
    seconds: NDArray[np.float64]
    monitor: NDArray[np.int32]
    episode_id: NDArray[np.int64]
    failures: dict[int, str] = field(default_factory=dict)
    places: dict[tuple[str, str], int] = field(default_factory=dict)
    videos: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.seed)

    @property
    def failed(self) -> NDArray[np.bool_]:
        """`(n,) bool`: which ones failed."""
        failed = np.zeros(len(self), dtype=np.bool_)
        failed[list(self.failures)] = True
        return failed

    @property
    def monitors(self) -> list[str]:
        """The infixes of the monitors that recorded them."""
        return [infix for _, infix in self.places]

    def video_path(self, index: int) -> str | None:
        """Return the path of an episode's video in the evaluation's directory."""
        if index not in self.videos:
            return None
        folder, _ = list(self.places)[self.monitor[index]]
        return f"{folder}/{self.videos[index]}"

    def __iter__(self) -> Iterator[EpisodeResult]:
        """Yield each episode as a result; its warnings are not in the columns."""
        monitors = self.monitors
        for index in range(len(self)):
            failure = self.failures.get(index)
            monitor = int(self.monitor[index])
            yield EpisodeResult(
                task=self.task,
                seed=int(self.seed[index]),
                episode=int(self.episode[index]),
                total_reward=None if failure else float(self.total_reward[index]),
                length=int(self.length[index]),
                terminated=_MEANING[int(self.terminated[index])],
                truncated=_MEANING[int(self.truncated[index])],
                success=_MEANING[int(self.success[index])],
                failure=failure,
                monitor=None if monitor < 0 else monitors[monitor],
                episode_id=None if monitor < 0 else int(self.episode_id[index]),
                start_time=_known(self.start_time[index]),
                seconds=_known(self.seconds[index]),
            )


def write_results_table(file: TextIO, results: Iterable[EpisodeResult]) -> None:
    """Write `results.csv`.

    Args:
        file: opened with `newline=""`.
        results: in the plan's order.
    """
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_RESULTS)
    for each in results:
        failure = each.failure
        writer.writerow(
            [
                *_unit(each),
                "" if failure is not None else _shown(each.total_reward),
                str(each.length),
                *map(_truth_text, (each.terminated, each.truncated, each.success)),
                "" if failure is None else _one_line(failure),
            ]
        )


def write_timing_table(
    file: TextIO,
    results: Iterable[EpisodeResult],
    files: Callable[[EpisodeResult], EpisodeFiles],
) -> None:
    """Write `timing.csv`; `files` tells of an episode which ones are its own."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(_TIMING)
    for each in results:
        of = files(each)
        recorded = (of.folder, each.monitor, each.episode_id) if of.folder else ()
        writer.writerow(
            [
                *_unit(each),
                *map(_shown, (each.start_time, each.seconds)),
                *(recorded or ("", "", "")),
                of.trajectory or "",
                of.video or "",
            ]
        )


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
    with unreadable(results):
        if len(plan.seeds) * plan.episodes * len(plan.tasks) > _MOST_ROWS:
            raise ValueError(f"its plan has more than {_MOST_ROWS} episodes")
        columns = {task.name: _nothing_known(task.name, plan) for task in plan.tasks}
        _read_rows(results, _RESULTS, columns, _read_result)
    if needs_timing or timing.is_file():
        with unreadable(timing):
            _read_rows(timing, _TIMING, columns, _read_timing)
    return columns


def _nothing_known(task: str, plan: EvaluationPlan) -> ResultColumns:
    count = len(plan.seeds) * plan.episodes
    return ResultColumns(
        task=task,
        seed=np.repeat(np.array(plan.seeds, np.int64), plan.episodes),
        episode=np.tile(np.arange(plan.episodes, dtype=np.int64), len(plan.seeds)),
        total_reward=np.full(count, np.nan),
        length=np.zeros(count, np.int64),
        terminated=np.full(count, -1, np.int8),
        truncated=np.full(count, -1, np.int8),
        success=np.full(count, -1, np.int8),
        start_time=np.full(count, np.nan),
        seconds=np.full(count, np.nan),
        monitor=np.full(count, -1, np.int32),
        episode_id=np.full(count, -1, np.int64),
    )


def _read_result(columns: ResultColumns, index: int, values: Sequence[str]) -> None:
    total_reward, length, terminated, truncated, success, failure = values
    if failure:
        if total_reward:
            raise ValueError("an episode that failed has no return")
        if not failure.isprintable() or len(failure) > _LONGEST_FAILURE:
            raise ValueError(f"{failure!r:.80} is not one line")
        columns.failures[index] = failure
    columns.total_reward[index] = _number(total_reward)
    columns.length[index] = _whole(length)
    columns.terminated[index] = _truth(terminated)
    columns.truncated[index] = _truth(truncated)
    columns.success[index] = _truth(success)


def _read_timing(columns: ResultColumns, index: int, values: Sequence[str]) -> None:
    start, seconds, folder, monitor, episode_id, _, video = values
    columns.start_time[index] = _number(start)
    columns.seconds[index] = _number(seconds)
    if not folder:
        if any(values[2:]):
            raise ValueError("an episode without a folder has files")
        return
    place = folder, monitor
    infix = Infix.parse(monitor)
    if infix is None or not _FOLDER.fullmatch(folder):
        raise ValueError(f"{folder!r:.80}, {monitor!r:.80} is no monitor")
    columns.monitor[index] = columns.places.setdefault(place, len(columns.places))
    columns.episode_id[index] = number = _whole(episode_id)
    if video:
        prefix = video_prefix(infix, number)
        if video not in (f"{prefix}{end}" for end in (".mp4", ".json", ".avi")):
            raise ValueError(f"{video!r:.200} is no video of its episode")
        columns.videos[index] = video


def _read_rows(
    path: Path,
    header: Sequence[str],
    columns: Mapping[str, ResultColumns],
    read: Callable[[ResultColumns, int, Sequence[str]], None],
) -> None:
    """Read a table whose rows must be exactly those of the columns."""
    with open_regular(path) as binary:
        file = io.TextIOWrapper(binary, encoding="utf-8", newline="")
        reader = csv.reader(_lines(file), strict=True)
        line = 0
        try:
            if tuple(next(reader, ())) != tuple(header):
                raise ValueError(f"its first line is not {','.join(header)}")
            units = ((of, index) for of in columns.values() for index in range(len(of)))
            for line, (of, index) in enumerate(units, start=2):
                row = next(reader, [])
                if len(row) != len(header) or reader.line_num != line:
                    raise ValueError(f"it has not one row of {len(header)} values")
                unit = [
                    _encodable(of.task),
                    str(of.seed[index]),
                    str(of.episode[index]),
                ]
                if row[:3] != unit:
                    raise ValueError(
                        f"the episode {', '.join(unit)} belongs there, not "
                        f"{', '.join(row[:3]):.80}"
                    )
                read(of, index, row[3:])
            if next(reader, None) is not None:
                line += 1
                raise ValueError("it has more episodes than the plan")
        except UnicodeDecodeError as error:
            raise ValueError(f"after line {line} it is not UTF-8 text") from error
        except (csv.Error, ValueError) as error:
            raise ValueError(f"line {line or 1}: {error}") from error


def _lines(file: TextIO) -> Iterator[str]:
    while line := file.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise ValueError("it is longer than any line of a table")
        yield line


def _unit(result: EpisodeResult) -> tuple[str, str, str]:
    return _encodable(result.task), str(result.seed), str(result.episode)


def _shown(value: float | None) -> str:
    return "" if value is None else repr(float(value))


def _known(value: np.float64) -> float | None:
    return None if np.isnan(value) else float(value)


def _truth_text(value: bool | None) -> str:
    return "" if value is None else str(bool(value)).lower()


def _one_line(text: str) -> str:
    # A failure is there also where nothing is said of it.
    shown = "".join(c if c.isprintable() else " " for c in _encodable(text))
    return " ".join(shown.split())[:_LONGEST_FAILURE] or "unknown"


def _encodable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


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
