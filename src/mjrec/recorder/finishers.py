# SPDX-License-Identifier: Apache-2.0
"""Finishers, which process recordings that have ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from ..formats.monitor_directory import clip_step


class Finisher(Protocol):
    """Turns ended recordings into trajectories and videos while the simulation runs."""

    def expect(self, recording: Path | None = None) -> None:
        """Prepare for a recording that will have a video. Never waits.

        Args:
            recording: the recording, once it has begun. Later recordings will most
                likely be drawn the same way.
        """

    def submit(self, recording: Path) -> None:
        """Accept the trajectory of an ended episode, or the first part of a clip.

        Never waits.
        """

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Wait until all submitted recordings are finished."""

    def stop(self) -> None:
        """Stop immediately and leave unfinished recordings pending. Idempotent."""

    @property
    def failures(self) -> Mapping[str, str]:
        """Reasons why videos could not be rendered, keyed by the videos' base names."""


class LaterFinisher:
    """A finisher that draws nothing and writes trajectories when the monitor closes.

    It is used for runs whose videos are rendered later or never.

    Attributes:
        bundles: whether all trajectories are written to a single file.
    """

    def __init__(self) -> None:
        self.bundles = False
        self.failures: Mapping[str, str] = {}
        self._waiting: list[Path] = []

    def expect(self, recording: Path | None = None) -> None:
        """Do nothing."""

    def submit(self, recording: Path) -> None:
        """Queue a trajectory. Clips are left unchanged."""
        self._waiting.append(recording)

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Write the queued trajectories.

        Raises:
            Error: a trajectory could not be written. If several trajectories failed,
                this is the last error. All other trajectories are written.
        """
        # Imported here because it loads h5py, which the simulation does not need.
        from ..formats.trajectory_file import bundle_trajectories, finish_trajectories

        waiting = [each for each in self._waiting if clip_step(each.name) is None]
        self._waiting = []
        finish = bundle_trajectories if self.bundles else finish_trajectories
        failures = finish(waiting)
        self._waiting = [*failures]
        if failures:
            raise [*failures.values()][-1]

    def stop(self) -> None:
        """Do nothing."""
