# SPDX-License-Identifier: Apache-2.0
"""What becomes of the trajectories of episodes that are over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

from ..errors import Error
from ..formats.in_flight import is_in_flight

_NO_FAILURES: Mapping[str, str] = MappingProxyType({})


class Rendering(Protocol):
    """Whoever turns ended trajectories into videos, beside the simulation."""

    def expect(self) -> None:
        """Get ready: a trajectory will come that has a video. Never waits."""

    def submit(self, trajectory: Path) -> None:
        """Take over an ended trajectory, or a clip by its first part. Never waits."""

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Return when all that was taken over is done."""

    def stop(self) -> None:
        """Stop at once; what is not done stays pending. Idempotent."""

    @property
    def failures(self) -> Mapping[str, str]:
        """Why videos could not be rendered, by the base names of the videos."""


class EndedTrajectories:
    """Hands ended trajectories to whoever renders, or keeps them until the end.

    Args:
        rendering: whoever renders; None where nothing is to be rendered now.
        finish_log: gives the recording of an ended episode its final form, where
            nothing renders.
    """

    def __init__(
        self, rendering: Rendering | None, finish_log: Callable[[Path], object]
    ) -> None:
        self._rendering = rendering
        self._finish_log = finish_log
        self._unfinished: list[Path] = []

    @property
    def failures(self) -> Mapping[str, str]:
        """Why videos could not be rendered, by the base names of the videos."""
        return _NO_FAILURES if self._rendering is None else self._rendering.failures

    def expect(self) -> None:
        """Let whoever renders get ready for a video. Never waits."""
        if self._rendering is not None:
            self._rendering.expect()

    def add(self, trajectory: Path) -> None:
        """Take over the recording of an episode that is over. Never waits."""
        if self._rendering is not None:
            self._rendering.submit(trajectory)
        else:
            self._unfinished.append(trajectory)

    def add_clip(self, first_part: Path) -> None:
        """Take over the parts of a video that is counted in steps. Never waits.

        They stay as they are until it is rendered, by whomever.

        Args:
            first_part: the first of them.
        """
        if self._rendering is not None:
            self._rendering.submit(first_part)

    def wait(self, on_progress: Callable[[Any], None]) -> None:
        """Return when whoever renders is done; at once where nobody does."""
        if self._rendering is not None:
            self._rendering.wait(on_progress)

    def stop(self) -> None:
        """Let nobody render any more; idempotent."""
        if self._rendering is not None:
            self._rendering.stop()

    def finish(self) -> None:
        """Give those that nobody has finished their final form.

        Raises:
            Error: of the first that could not be; the others are finished all the same.
        """
        failed: list[Error] = []
        for _ in range(len(self._unfinished)):
            trajectory = self._unfinished.pop(0)
            try:
                if is_in_flight(trajectory):
                    self._finish_log(trajectory)
            except Error as error:
                failed.append(error)
                self._unfinished.append(trajectory)
        if failed:
            raise failed[0]
