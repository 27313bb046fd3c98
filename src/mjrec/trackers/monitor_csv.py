# SPDX-License-Identifier: Apache-2.0
"""The `monitor.csv` format, which Stable-Baselines3's tools read and plot.

::

    #{"t_start": 1700000000.0, "env_id": "Hopper-v5"}
    r,l,t
    21.5,14,0.93

`r` is the sum of the rewards, and `l` is the number of steps. `t` is the time when the
episode ended, in seconds since `t_start`, which is a wall-clock time.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from .. import json_text
from ..atomic_files import AppendOnlyFile
from ..formats.monitor_directory import FILE_PREFIX
from ..recorder.tracking import FinishedEpisode, Run, Tracker

# Stable-Baselines3 reads every file in a directory whose name ends with this.
_ENDING = "monitor.csv"


class MonitorCsvTracker(Tracker):
    """A tracker that writes files for `stable_baselines3.common.monitor.load_results`.

    Each run has its own file. Each sub-environment is a separate run, and so is each
    resumption of a recording. `load_results` reads all files in a directory and orders
    episodes by their end times. An existing file is never changed. An episode's
    complete row is on disk as soon as the episode has ended.

    Args:
        path: an existing directory or a file name. `.monitor.csv` is added to a file
            name that does not end in `monitor.csv`, and a number is added if the file
            exists: `logs/a.monitor.csv`, `logs/a.1.monitor.csv` ... None means the
            monitor directory. In a directory, the file's name is
            `openaigym.results.<infix>.monitor.csv`.
        clock: a function that returns the time in seconds since the epoch.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        clock: Callable[[], float] = time.time,
    ) -> None:
        # Absolute, because the working directory may change before the path is used.
        self._path = None if path is None else Path(path).absolute()
        self._clock = clock
        self._files: dict[Run, tuple[AppendOnlyFile, float]] = {}

    def begin(self, run: Run) -> None:
        """Create the run's file.

        Raises:
            DirectoryNotWritable: the directory cannot be created or written to.
            FileNotWritten: the disk is full.
        """
        file, t_start = AppendOnlyFile(self._names(run)), self._clock()
        self._files[run] = file, t_start
        header = json_text.dumps({"t_start": t_start, "env_id": run.env_id})
        file.append(f"#{header}\nr,l,t\n".encode())

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Write the episode's row.

        Raises:
            FileNotWritten: the disk is full; the file is unchanged.
        """
        file, t_start = self._files[run]
        seconds = round(episode.end_time - t_start, 6)
        # `repr` of NumPy's numbers would include their types.
        row = float(episode.reward), int(episode.length), float(seconds)
        file.append((",".join(map(repr, row)) + "\n").encode())

    def end(self, run: Run) -> None:
        """Close the run's file."""
        file, _ = self._files.pop(run)
        file.close()

    def _names(self, run: Run) -> Iterator[Path]:
        """Yield candidate paths for the run's file, preferred ones first."""
        path = run.directory if self._path is None else self._path
        if path == run.directory or path.is_dir():
            path /= f"{FILE_PREFIX}.results.{run.infix}.{_ENDING}"
        base = path.name.removesuffix(_ENDING).removesuffix(".")
        yield path.with_name(f"{base}.{_ENDING}" if base else _ENDING)
        for number in itertools.count(1):
            # Without a base, the name starts with the number.
            yield path.with_name(f"{base}.{number}.{_ENDING}".removeprefix("."))
