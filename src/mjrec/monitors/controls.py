# SPDX-License-Identifier: Apache-2.0
"""What every monitor has beside the environment's own interface: gym's names."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from ..environments.scenes import Scenes
from ..recorder.declared_rate import declared_rate
from ..recorder.deferred_video import DeferredVideo
from ..recorder.endings import last_error
from ..recorder.exit_guard import ExitGuard
from ..recorder.finisher import Finisher
from ..recorder.options import DEFERRED, RecorderOptions
from ..recorder.recorder import Recorder
from ..recorder.stats_recorder import StatsRecorder
from ..recorder.subject import Subject
from ..recorder.video_recorder import VideoRecorder
from ..rendering.render_service import RenderService
from ..simulation.inside import simulation_time
from .cameras import CameraPictures
from .lifetime import MonitorLifetime
from .rendering_choice import rendering_choice
from .waiting import waiting_display

logger = logging.getLogger(__name__)

T = TypeVar("T")


class MonitorControls(MonitorLifetime):
    """The part of a monitor that does not depend on the framework.

    Attributes:
        allows_early_reset: whether the framework's contract allows a reset in
            mid-episode.
    """

    allows_early_reset: ClassVar[bool]

    _recorder: Recorder
    _guard: ExitGuard
    _options: RecorderOptions

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
    def video_recorder(self) -> VideoRecorder | DeferredVideo | None:
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

    def model_changed(self) -> None:
        """Say that a texture, a height field or a mesh was changed in mid-episode.

        All else that a picture depends on is noticed by itself, and at every reset
        everything is. The next recorded frame shows the change; what only the physics
        depend on (masses, damping) is then in the trajectory too, for replays.
        """
        self._recorder.model_changed()

    def forget_pictures(self) -> None:
        """Let the next episode look as if it were the environment's first.

        Gymnasium places its free camera at the first picture, and infinite planes and
        tracking cameras go by the picture before: an episode looks other as the tenth
        than as the first. After this call, between two episodes, the next is shown as
        by an environment that has just been made. Where pictures are drawn live it
        changes nothing.
        """
        self._recorder.forget_pictures()

    def close(self, *, wait: bool = True) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Args:
            wait: whether to wait, with a progress bar on a terminal, until all videos
                are rendered; else what is not rendered yet is left pending, and
                `mjrec render DIR` makes it. Ctrl-C while it waits is the same.

        Raises:
            EncoderError: the running video could not be finished; all else is.
            RenderError: videos could not be rendered; all else is done, and their
                trajectories are kept.
            FileNotWritten: the disk is full; the next call tries again.
        """
        try:
            if wait:
                with waiting_display() as on_progress:
                    self._recorder.finish(on_progress)
        finally:
            self._guard.close()
        if wait:
            self._raise_failures()

    def _note_error(self, error: BaseException) -> None:
        self._recorder.note_error(error)

    def _reset_by(self, reset: Callable[[], T]) -> T:
        """Return what the environment's reset returns; note it where it raises."""
        recorder = self._recorder
        recorder.before_reset()
        try:
            with recorder.resetting():
                return reset()
        except BaseException as error:
            recorder.note_error(error)
            raise

    def _failures(self) -> Mapping[str, str]:
        return self._recorder.failures()

    def _start(
        self,
        env: Any,
        directory: str | os.PathLike[str],
        *,
        env_id: str,
        view: CameraPictures,
        scenes: Scenes,
        options: RecorderOptions,
        close_environment: Callable[[Any], None],
        clip_scenes: Scenes | None,
        env_index: int | None = None,
        rendering: Callable[[Path], Finisher] | None = None,
    ) -> None:
        """Open the directory; from here on the environment is this monitor's.

        What renders is made by `rendering`, or is a service of this monitor's own.
        `clip_scenes` are `scenes` once more, for videos that are counted in steps;
        None without any.
        """
        choice = rendering_choice(options.render, scenes, env_id)
        self._open(
            directory,
            Subject(
                env_id=env_id,
                env_index=env_index,
                pictures=view.pictures,
                further_pictures=view.further,
                cameras=view.cameras,
                clock=functools.partial(simulation_time, env),
                declared=functools.partial(declared_rate, env),
                rendering=choice,
                states=scenes.states,
                clip_states=None if clip_scenes is None else clip_scenes.states,
                environment=scenes.environment,
                random_state=scenes.random_state,
            ),
            options=options,
            rendering=rendering or _rendering(options),
            close_environment=functools.partial(close_environment, env),
        )

    def _open(
        self,
        directory: str | os.PathLike[str],
        subject: Subject,
        *,
        options: RecorderOptions,
        rendering: Callable[[Path], Finisher] | None,
        close_environment: Callable[[], None],
    ) -> None:
        self._options = options
        self._recorder = Recorder(
            directory,
            subject=subject,
            options=options,
            finisher=rendering if subject.rendering.mode == DEFERRED else None,
        )
        self._guard = ExitGuard(
            self,
            functools.partial(
                _close,
                self._recorder,
                (subject.states, subject.clip_states),
                close_environment,
            ),
            at_exit=functools.partial(_note_last_error, self._recorder),
        )

    def _begin(
        self, *, seed: Any = None, options: Any = None, observation: Any = None
    ) -> None:
        """Record that the environment has been reset."""
        self._recorder.reset(seed=seed, options=options, observation=observation)
        video = self._recorder.video_recorder
        if isinstance(video, VideoRecorder) and video.enabled:
            # Drawing has loaded OpenGL by now, which tears itself down at exit.
            self._guard.run_first_at_exit()


def _rendering(options: RecorderOptions) -> Callable[[Path], Finisher] | None:
    if options.workers == 0:
        return None
    return functools.partial(
        RenderService, workers=options.workers, strict=options.strict
    )


def _note_last_error(recorder: Recorder) -> None:
    error = last_error()
    if error is not None:
        recorder.note_error(error)


def _close(
    recorder: Recorder,
    acquired: tuple[Any, ...],
    close_environment: Callable[[], None],
) -> None:
    try:
        recorder.close()
    finally:
        for each in acquired:
            if each is not None:
                each.close()
        close_environment()
