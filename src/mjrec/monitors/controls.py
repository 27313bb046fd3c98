# SPDX-License-Identifier: Apache-2.0
"""What every monitor has beside the environment's own interface: gym's names."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

from ..recorder.declared_rate import declared_rate
from ..recorder.exit_guard import ExitGuard
from ..recorder.recorder import EpisodePictures, Recorder, RecorderOptions
from ..recorder.stats_recorder import StatsRecorder
from ..recorder.video_recorder import VideoRecorder
from ..simulation.inside import simulation_time

__all__ = ["MonitorControls"]


class MonitorControls:
    """The part of a monitor that does not depend on the framework.

    Attributes:
        allows_early_reset: whether the framework's contract allows a reset in
            mid-episode.
    """

    allows_early_reset: ClassVar[bool]

    _recorder: Recorder
    _guard: ExitGuard

    @property
    def directory(self) -> Path:
        """The monitor directory, absolute."""
        return self._recorder.directory

    @property
    def infix(self) -> str:
        """What the names of this monitor's files have in the middle."""
        return self._recorder.infix

    @property
    def episode_id(self) -> int:
        """The number of the next episode; it rises at each reset, as in gym."""
        return self._recorder.episode_id

    @property
    def stats_recorder(self) -> StatsRecorder:
        """Counts steps and rewards."""
        return self._recorder.stats_recorder

    @property
    def video_recorder(self) -> VideoRecorder | None:
        """Records the running episode (or not); None before the first reset."""
        return self._recorder.video_recorder

    def set_monitor_mode(self, mode: str | None) -> None:
        """Set the type of the episodes from the next reset on.

        Args:
            mode: "training", "evaluation", or None for training.

        Raises:
            InvalidArgument: it is something else.
        """
        self._recorder.set_mode(mode)

    def get_total_steps(self) -> int:
        """Return the number of all steps, those of unfinished episodes too."""
        return self._recorder.stats_recorder.total_steps

    def get_episode_rewards(self) -> list[float]:
        """Return the sum of rewards of each complete episode."""
        return list(self._recorder.stats_recorder.episode_rewards)

    def get_episode_lengths(self) -> list[int]:
        """Return the steps of each complete episode."""
        return list(self._recorder.stats_recorder.episode_lengths)

    def close(self) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Raises:
            EncoderError: the running video could not be finished; all else is.
            FileNotWritten: the disk is full; the next call tries again.
        """
        self._guard.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: Any) -> Literal[False]:
        _, first, _ = exc_info
        try:
            self.close()
        except Exception as second:
            if first is None:
                raise
            # What went wrong first is what the user needs to see.
            first.add_note(f"Closing the monitor failed too: {second}")
        return False

    def _start(
        self,
        env: Any,
        directory: str | os.PathLike[str],
        *,
        env_id: str,
        pictures: EpisodePictures,
        options: RecorderOptions,
        close_environment: Callable[[Any], None],
    ) -> None:
        """Open the directory; from here on the environment is this monitor's."""
        self._recorder = Recorder(
            directory,
            env_id=env_id,
            pictures=pictures,
            options=options,
            clock=functools.partial(simulation_time, env),
            declared=functools.partial(declared_rate, env),
        )
        self._guard = ExitGuard(
            self,
            functools.partial(
                _close,
                self._recorder,
                pictures,
                functools.partial(close_environment, env),
            ),
        )

    def _begin(self, *, seed: Any = None, options: Any = None) -> None:
        """Record that the environment has been reset."""
        self._recorder.reset(seed=seed, options=options)
        if self._recorder.video_recorder and self._recorder.video_recorder.enabled:
            # Drawing has loaded OpenGL by now, which tears itself down at exit.
            self._guard.run_first_at_exit()


def _close(
    recorder: Recorder, pictures: EpisodePictures, close_environment: Callable[[], None]
) -> None:
    try:
        recorder.close()
    finally:
        pictures.close()
        close_environment()
