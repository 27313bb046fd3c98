# SPDX-License-Identifier: Apache-2.0
"""What takes over recordings that have ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from ..formats.monitor_directory import ClipPart


class Finisher(Protocol):
    """Turns ended recordings into trajectories and videos, beside the simulation."""

    def expect(self, recording: Path | None = None) -> None:
        """Get ready: a recording will come that has a video. Never waits.

        Args:
            recording: which, once it begins; others will most likely be drawn alike.
        """

    def submit(self, recording: Path) -> None:
        """Take over an ended trajectory, or a clip by its first part. Never waits."""

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Return when all that was taken over is done."""

    def stop(self) -> None:
        """Stop at once; the rest stays pending. Idempotent."""

    @property
    def failures(self) -> Mapping[str, str]:
        """Why videos could not be rendered, by the base names of the videos."""


class LaterFinisher:
    """Draws nothing; makes the trajectories when the monitor closes.

    It is a `Finisher` for runs whose videos are rendered another time, or never.

    Attributes:
        bundles: they lie in one file.
    """

    def __init__(self) -> None:
        self.bundles = False
        self.failures: Mapping[str, str] = {}
        self._waiting: list[Path] = []

    def expect(self, recording: Path | None = None) -> None:
        """Do nothing."""

    def submit(self, recording: Path) -> None:
        """Keep a trajectory in mind; clips stay as they are."""
        self._waiting.append(recording)

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Make the trajectories.

        Raises:
            Error: of the last that could not be made; the others are there.
        """
        # Not at the top: it loads h5py, which the simulation has no use for.
        from ..formats.trajectory_file import bundle_trajectories, finish_trajectories

        waiting = [each for each in self._waiting if ClipPart.parse(each.name) is None]
        self._waiting = []
        finish = bundle_trajectories if self.bundles else finish_trajectories
        failures = finish(waiting)
        self._waiting = [*failures]
        if failures:
            raise [*failures.values()][-1]

    def stop(self) -> None:
        """Do nothing."""
