# SPDX-License-Identifier: Apache-2.0
"""Base classes for monitors, with the methods of gym's monitor."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NoReturn, Self, SupportsIndex, TypeVar

from ..environments.scenes import Scenes
from ..errors import NotPicklable, PicturesDiffer, RenderError
from ..formats.monitor_directory import infix_of
from ..recorder.endings import ExitGuard, last_error
from ..recorder.finishers import Finisher
from ..recorder.options import (
    DEFERRED,
    LIVE,
    OFF,
    WARN,
    RecorderOptions,
    RenderingChoice,
    type_of_mode,
)
from ..recorder.recorded_environment import RecordedEnvironment
from ..recorder.recorder import Recorder
from ..recorder.states import DeferredVideo
from ..recorder.stats_recorder import StatsRecorder
from ..recorder.video_recorder import VideoRecorder, declared_rate
from ..rendering.background import Background
from ..simulation.find_simulation import simulation_time
from .progress import render_progress
from .tiles import camera_frames, checked_cameras, recorded_view

logger = logging.getLogger(__name__)

T = TypeVar("T")

NO_SIMULATION = "it has no accessible MuJoCo model and data"


class MonitorBase:
    """Base class for monitors of single environments and vector environments.

    It has the methods of gym's monitor and is a context manager. Leaving the `with`
    block waits for the videos, unless an exception was raised.

    Attributes:
        allows_early_reset: whether the framework allows a reset during an episode.
    """

    allows_early_reset: ClassVar[bool]

    _options: RecorderOptions
    # One for each environment, all in one directory.
    _recorders: Sequence[Recorder]
    _guard: ExitGuard
    _reported_failures = False

    @property
    def directory(self) -> Path:
        """The absolute path of the monitor directory."""
        return self._recorders[0].directory

    def set_monitor_mode(self, mode: str | None) -> None:
        """Set the type of the episodes that start from the next reset.

        Args:
            mode: "training", "evaluation", or None for training.

        Raises:
            InvalidArgument: `mode` is anything else.
        """
        for recorder in self._recorders:
            recorder.stats_recorder.type = type_of_mode(mode)

    def get_total_steps(self) -> int:
        """Return the total number of steps, including steps in unfinished episodes."""
        return sum(each.stats_recorder.total_steps for each in self._recorders)

    def close(self, *, wait: bool = True) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Args:
            wait: whether to wait until all videos are rendered, with a progress bar on
                a terminal, otherwise with a line every 30 seconds. If False, or after
                Ctrl-C during the wait, the remaining videos stay pending, and
                `mjrec render DIR` renders them.

        Raises:
            EncoderError: a running video could not be finished; everything else is
                finished.
            RenderError: videos could not be rendered; everything else is finished, and
                their trajectories are kept.
            FileNotWritten: the disk is full; the next call will retry.
            Error: this process was forked from the process that created the monitor.
        """
        for recorder in self._recorders:
            recorder.check_process()
        try:
            if wait:
                with render_progress() as on_progress:
                    self._finish(on_progress)
        finally:
            self._guard.close()
        # Monitors of sub-environments share a finisher.
        failures = {
            name: reason
            for recorder in self._recorders
            for name, reason in recorder.run.finisher.failures.items()
            if infix_of(name) == recorder.infix
        }
        if not wait or not failures or self._reported_failures:
            return
        self._reported_failures = True
        error = RenderError(self.directory, failures)
        if self._options.on_error != WARN:
            raise error
        logger.warning("%s", error)

    def _finish(self, on_progress: Callable[[Any], None]) -> None:
        """End all episodes, and wait until all videos are rendered."""
        call_all(functools.partial(r.finish, on_progress) for r in self._recorders)

    def _note_error(self, error: BaseException) -> None:
        """Record an exception from the environment or from the user's code."""
        for recorder in self._recorders:
            recorder.note_error(error)

    def _guard_by(self, closings: Iterable[Callable[[], object]]) -> None:
        """Call all `closings` once, in `close` or when the process ends."""
        self._guard = ExitGuard(
            self,
            functools.partial(call_all, list(closings)),
            at_exit=functools.partial(_note_last_error, self._recorders),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: Any) -> Literal[False]:
        _, first, _ = exc_info
        if first is not None:
            self._note_error(first)
        try:
            # After an exception, do not wait for videos.
            self.close(wait=first is None)
        except Exception as second:
            if first is None:
                raise
            # The user needs to see the first error.
            first.add_note(f"Closing the monitor failed too: {second}")
        return False

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise NotPicklable(
            f"A {type(self).__name__} cannot be pickled or copied, because both copies "
            "would write the same files. Create it in the process that uses it, "
            "inside the function that creates the environment: "
            "lambda: mjrec.Monitor(gymnasium.make(...), directory, resume=True)."
        )


class EnvironmentMonitor(MonitorBase):
    """Base class for monitors of single environments."""

    _recorder: Recorder
    # Closed with the monitor; empty if its user closes the environment.
    _environments: list[Any]

    @property
    def recorder(self) -> Recorder:
        """The recorder that writes the files."""
        return self._recorder

    def leave_environment_open(self) -> None:
        """Make `close` keep the environment open, because it will be reused."""
        self._environments.clear()

    @property
    def infix(self) -> str:
        """The middle part of this monitor's file names."""
        return self._recorder.infix

    @property
    def episode_id(self) -> int:
        """The number of the next episode; it increases at each reset, as in gym."""
        return self._recorder.episode_id

    @property
    def stats_recorder(self) -> StatsRecorder:
        """The recorder for steps and rewards."""
        return self._recorder.stats_recorder

    @property
    def video_recorder(self) -> VideoRecorder | DeferredVideo | None:
        """The running episode's video recorder, which may be disabled.

        It is None before the first reset.
        """
        return self._recorder.video_recorder

    def get_episode_rewards(self) -> list[float]:
        """Return the sum of rewards for each complete episode."""
        return list(self._recorder.stats_recorder.episode_rewards)

    def get_episode_lengths(self) -> list[int]:
        """Return the number of steps in each complete episode."""
        return list(self._recorder.stats_recorder.episode_lengths)

    def model_changed(self) -> None:
        """Declare that a texture, height field or mesh changed during an episode.

        Other visible changes, and all changes at a reset, are detected automatically.
        The next recorded frame shows the change. Changes to physical constants (masses,
        damping) are then also stored in the trajectory, for replays.
        """
        self._recorder.model_changed()

    def forget_frames(self) -> None:
        """Make the next episode look like the first episode of a new environment.

        Gymnasium places its free camera at the first frame, and infinite planes and
        tracking cameras depend on the previous frame. So an episode can look different
        depending on whether it is the first or the tenth. Call this between two
        episodes. It does not affect live frames.
        """
        self._recorder.forget_frames()

    def _reset_by(self, reset: Callable[[], T]) -> T:
        """Call the function that resets the environment, and record any exception."""
        try:
            with self._recorder.resetting():
                return reset()
        except BaseException as error:
            self._recorder.note_error(error)
            raise

    def _open(
        self,
        env: Any,
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        scenes: Callable[..., Scenes],
        view: Mapping[str, Any],
        close_environment: Callable[[Any], None],
        rendering: Callable[[Path], Finisher] | None = None,
        **subject: Any,
    ) -> None:
        """Open the directory and take over the environment.

        Args:
            env: the environment.
            directory: the monitor directory.
            options: the monitor's options.
            scenes: a function that returns the scenes for a camera and a size.
            view: the requested `camera` (or cameras), `height` and `width`.
            close_environment: a function that closes `env`.
            rendering: a function that creates the finisher that renders videos; if
                None, the monitor has its own background finisher.
            **subject: `env_id` and other arguments of `RecordedEnvironment`.
        """
        camera, size = view.get("camera"), {k: view.get(k) for k in ("height", "width")}
        cameras = checked_cameras(camera, tiled=options.tiled)
        known, *further = [scenes(camera=each, **size) for each in cameras]
        clip_states = None
        if options.has_clips:
            # Clips overlap with episodes, and a state source allows only one reader.
            clip_states = scenes(camera=cameras[0], **size).states
        sources = [each.frames for each in (known, *further)]
        choice = rendering_choice(
            options.render,
            known,
            subject["env_id"],
            no_simulation=getattr(env, "no_simulation", NO_SIMULATION),
        )
        if choice.mode != DEFERRED or options.workers == 0:
            rendering = None
        elif rendering is None:
            rendering = functools.partial(
                Background, workers=options.workers, strict=options.strict
            )
        self._options = options
        self._recorder = Recorder(
            directory,
            env=RecordedEnvironment(
                clock=functools.partial(simulation_time, env),
                declared=functools.partial(declared_rate, env),
                rendering=choice,
                states=known.states,
                clip_states=clip_states,
                environment=known.environment,
                random_state=known.random_state,
                view={**recorded_view(camera, size), **known.own_view},
                **camera_frames(cameras, sources, tiled=options.tiled),
                **subject,
            ),
            options=options,
            finisher=rendering,
        )
        self._recorders = [self._recorder]
        states = [each for each in (known.states, clip_states) if each is not None]
        environments = self._environments = [env]
        self._guard_by(
            [
                self._recorder.close,
                *(each.close for each in states),
                lambda: call_all(
                    functools.partial(close_environment, each) for each in environments
                ),
            ]
        )

    def _begin(
        self, *, seed: Any = None, options: Any = None, observation: Any = None
    ) -> None:
        """Record that the environment has been reset."""
        self._recorder.reset(seed=seed, options=options, observation=observation)
        video = self._recorder.video_recorder
        if isinstance(video, VideoRecorder) and video.enabled:
            # Rendering has loaded OpenGL by now, which shuts itself down at exit.
            self._guard.run_first_at_exit()


def rendering_choice(
    asked: str | None,
    scenes: Scenes,
    env_id: str,
    *,
    no_simulation: str = NO_SIMULATION,
) -> RenderingChoice:
    """Return whether an environment's frames are rendered live, later, or not at all.

    Args:
        asked: `"deferred"`, `"live"`, `"off"`, or None. None means deferred if the
            states are known to determine the frames, otherwise live.
        scenes: the facts known about the environment's rendering.
        env_id: the environment's name, for messages.
        no_simulation: the reason to give if the environment has no states.

    Raises:
        PicturesDiffer: deferred was requested, but the states do not determine the
            frames.
    """
    if asked in (LIVE, OFF):
        return RenderingChoice(mode=str(asked), is_forced=True)
    obstacle = no_simulation if scenes.states is None else scenes.obstacle
    if obstacle is None:
        logger.info("The videos of %s are rendered from recorded states.", env_id)
        return RenderingChoice(mode=DEFERRED, is_forced=asked == DEFERRED)
    if asked == DEFERRED:
        raise PicturesDiffer(
            f'render="deferred" was requested, but the frames of {env_id} cannot be '
            f'reproduced from its recorded state: {obstacle}. Use render="live" (or '
            "None, to choose automatically)."
        )
    logger.info("The videos of %s are rendered live: %s.", env_id, obstacle)
    return RenderingChoice(mode=LIVE, reason=obstacle)


def call_all(calls: Iterable[Callable[[], object]]) -> None:
    """Call all functions, even if some raise an exception; then raise the first one."""
    first: BaseException | None = None
    for call in calls:
        try:
            call()
        except BaseException as error:
            first = first or error
    if first is not None:
        raise first


def _note_last_error(recorders: Sequence[Recorder]) -> None:
    error = last_error()
    if error is not None:
        for recorder in recorders:
            recorder.note_error(error)
