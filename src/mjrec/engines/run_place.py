# SPDX-License-Identifier: Apache-2.0
"""Where runs keep their folders in a shared directory, and what dead drivers left."""

from __future__ import annotations

import contextlib
import logging
import secrets
import shutil
import time
from pathlib import Path

from ..child_python import said_in
from ..errors import DirectoryNotWritable
from .driver_sign import is_surely_dead
from .hosting import HostedWork
from .job_folder import JobFolder, Pace
from .slurm_jobs import JobRequest, cluster_jobs
from .work import WORK_FOLDER

logger = logging.getLogger(__name__)

_FOLDER_PREFIX = "slurm."


class EarlierRun:
    """What a driver that was killed has left in the same shared directory.

    Args:
        folder: of that run.
        request: of this one, which is not used up.
        pace: of this one.
    """

    def __init__(self, folder: JobFolder, request: JobRequest, pace: Pace) -> None:
        self._folder = folder
        self._sign = folder.sign()
        self._seen = time.monotonic()
        self._patience = 3 * pace.beat_s
        facts = said_in(self._sign) if self._sign else {}
        self._jobs = cluster_jobs(facts.get("cluster", ""), folder, request, pace)
        self._is_stopped = False
        self._is_alive = False

    def look(self) -> None:
        """End its Slurm jobs, once it is clear that its driver is dead."""
        if self._is_stopped or self._is_alive:
            return
        sign = self._folder.sign()
        if sign != self._sign:
            # Somebody else's, who works in the same directory.
            self._is_alive = True
        elif is_surely_dead(sign) or time.monotonic() - self._seen > self._patience:
            self._is_stopped = True
            logger.info("The run in %s has no driver, and is ended.", self._folder.path)
            self._folder.stop()
            waiting = self._jobs.states(self._folder.submitted())
            self._jobs.end([n for n, state in waiting.items() if state.is_waiting])

    def tidy_up(self) -> None:
        """Remove its folder, if nothing of it runs any more."""
        if self._is_stopped:
            submitted = self._folder.submitted()
            states = self._jobs.states(submitted)
            if all(n in states and states[n].is_over for n in submitted):
                shutil.rmtree(self._folder.path, ignore_errors=True)


class RunPlace:
    """Where runs keep their folders, in a shared directory."""

    def __init__(self, shared: Path) -> None:
        self._shared = shared.absolute()
        self._runs = self._shared / WORK_FOLDER
        self._made = not self._shared.exists()
        self._name = f"{_FOLDER_PREFIX}{secrets.token_hex(4)}"

    def make(self, hosted: HostedWork, payload: bytes | None) -> JobFolder:
        """Return the folder of a new run.

        Raises:
            DirectoryNotWritable: it cannot be made.
        """
        try:
            return JobFolder.make(self._runs / self._name, hosted, payload)
        except OSError as error:
            raise DirectoryNotWritable(self._shared, error.strerror) from error

    def others(self) -> list[JobFolder]:
        """Return the folders of other runs."""
        return [
            folder
            for path in sorted(self._runs.glob(f"{_FOLDER_PREFIX}*"))
            if path.name != self._name and (folder := JobFolder(path)).sign()
        ]

    def tidy_up(self, *, keep: bool) -> None:
        """Remove the run's folder, but for its logs where they are kept.

        What this run has made above it goes with it, where nothing else is there.
        """
        folder = JobFolder(self._runs / self._name)
        if keep:
            for path in folder.path.iterdir():
                if path == folder.logs:
                    continue
                if path.is_dir():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink(missing_ok=True)
            logger.warning("What Slurm jobs have said is in %s.", folder.logs)
        else:
            shutil.rmtree(folder.path, ignore_errors=True)
        with contextlib.suppress(OSError):
            self._runs.rmdir()
            if self._made:
                self._shared.rmdir()
