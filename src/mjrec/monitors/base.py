# SPDX-License-Identifier: Apache-2.0
"""What every monitor has beside the environment's own interface: gym's names."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, NoReturn, Self, SupportsIndex

from ..environments.scenes import Scenes
from ..errors import NotPicklable, PicturesDiffer, RenderError
from ..recorder.ending_reasons import last_error
from ..recorder.exit_guard import ExitGuard
from ..recorder.finishers import Finisher
from ..recorder.options import (
    DEFERRED,
    LIVE,
    OFF,
    WARN,
    RecorderOptions,
    RenderingChoice,
)
from ..recorder.recorded_environment import RecordedEnvironment
from ..recorder.recorder import Recorder
from ..recorder.states import DeferredVideo
from ..recorder.stats_recorder import StatsRecorder
from ..recorder.video_recorder import VideoRecorder, declared_rate
from ..rendering.background import Background
from ..simulation.find_simulation import simulation_time
from .progress import render_progress

logger = logging.getLogger(__name__)

NO_SIMULATION = "it has no MuJoCo model and data that can be seen"


class MonitorBase:
    """Gym's names, and one way to close: of one environment or of several.

    A context manager that waits for its videos unless it is left by an exception.

    Attributes:
        allows_early_reset: whether the framework's contract allows a reset in
            mid-episode.
    """

    allows_early_reset: ClassVar[bool]

    _options: RecorderOptions
    # One for each environment, all in one directory.
    _recorders: Sequence[Recorder]
    _guard: ExitGuard
    _reported_failures = False

    @property
    def directory(self) -> Path:
        """The monitor directory, absolute."""
        return self._recorders[0].directory

    def set_monitor_mode(self, mode: str | None) -> None:
        """Set the type of the episodes from the next resets on.

        Args:
            mode: "training", "evaluation", or None for training.

        Raises:
            InvalidArgument: it is something else.
        """
        for recorder in self._recorders:
            recorder.set_mode(mode)

    def get_total_steps(self) -> int:
        """Return the number of all steps, those of unfinished episodes too."""
        return sum(each.stats_recorder.total_steps for each in self._recorders)

    def close(self, *, wait: bool = True) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Args:
            wait: whether to wait, with a progress bar on a terminal, until all videos
                are rendered; else what is not rendered yet is left pending, and
                `mjrec render DIR` makes it. Ctrl-C while it waits is the same.

        Raises:
            EncoderError: a running video could not be finished; all else is.
            RenderError: videos could not be rendered; all else is done, and their
                trajectories are kept.
            FileNotWritten: the disk is full; the next call tries again.
            Error: in a process forked from the one that made the monitor.
        """
        for recorder in self._recorders:
            recorder.check_process()
        try:
            if wait:
                with render_progress() as on_progress:
                    self._finish(on_progress)
        finally:
            self._guard.close()
        failures: dict[str, str] = {}
        for recorder in self._recorders:
            failures.update(recorder.failures())
        if not wait or not failures or self._reported_failures:
            return
        self._reported_failures = True
        error = RenderError(self.directory, failures)
        if self._options.on_error != WARN:
            raise error
        logger.warning("%s", error)

    def _finish(self, on_progress: Callable[[Any], None]) -> None:
        """End all episodes, then wait until all videos are rendered."""
        call_all(functools.partial(r.finish, on_progress) for r in self._recorders)

    def _note_error(self, error: BaseException) -> None:
        """Note that the environment, or its user, has raised."""
        for recorder in self._recorders:
            recorder.note_error(error)

    def _guard_by(self, closings: Iterable[Callable[[], object]]) -> None:
        """Call all of `closings` once, whatever comes first: `close` or the end."""
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
            # Leaving by an exception waits for no videos.
            self.close(wait=first is None)
        except Exception as second:
            if first is None:
                raise
            # What went wrong first is what the user needs to see.
            first.add_note(f"Closing the monitor failed too: {second}")
        return False

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise NotPicklable(
            f"A {type(self).__name__} cannot be pickled or copied: it writes files, "
            "and two would write the same ones. Make it in the process that uses it, "
            "inside the function that makes the environment: "
            "lambda: mjrec.Monitor(gymnasium.make(...), directory, resume=True)."
        )


class EnvironmentMonitor(MonitorBase):
    """What all monitors of one environment have."""

    _recorder: Recorder
    # Closed with the monitor; empty where its user closes it.
    _environments: list[Any]

    @property
    def recorder(self) -> Recorder:
        """What writes the files."""
        return self._recorder

    def leave_environment_open(self) -> None:
        """Let `close` end the recording only: the environment is used again."""
        self._environments.clear()

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

    def get_episode_rewards(self) -> list[float]:
        """Return the sum of rewards of each complete episode."""
        return list(self._recorder.stats_recorder.episode_rewards)

    def get_episode_lengths(self) -> list[int]:
        """Return the steps of each complete episode."""
        return list(self._recorder.stats_recorder.episode_lengths)

    def model_changed(self) -> None:
        """Report that a texture, height field or mesh changed during an episode.

        All other changes that a frame shows are found without this, and at a reset all
        are. The next recorded frame shows the change. Physical constants (masses,
        damping) then go into the trajectory too, for replays.
        """
        self._recorder.model_changed()

    def forget_frames(self) -> None:
        """Make the next episode look as in a fresh environment.

        Gymnasium places its free camera at the first frame; infinite planes and
        tracking cameras depend on the frame before. So an episode can look different as
        the tenth than as the first. Call this between two episodes. It has no effect on
        live frames.
        """
        self._recorder.forget_frames()

    @contextlib.contextmanager
    def _resetting(self) -> Iterator[None]:
        """Put this around the environment's reset, which is noted where it raises."""
        try:
            with self._recorder.resetting():
                yield
        except BaseException as error:
            self._recorder.note_error(error)
            raise

    def _open(
        self,
        env: Any,
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        scenes: Callable[[], Scenes],
        close_environment: Callable[[Any], None],
        no_simulation: str = NO_SIMULATION,
        rendering: Callable[[Path], Finisher] | None = None,
        **subject: Any,
    ) -> None:
        """Open the directory; from here on the environment is this monitor's.

        Args:
            env: the environment.
            directory: where the recordings go.
            options: what was asked for.
            scenes: returns how states are recorded, for one reader.
            close_environment: closes `env`.
            no_simulation: why there are no states, where there are none.
            rendering: makes what renders; a service of this monitor's own if None.
            **subject: `env_id` and others of `RecordedEnvironment`.
        """
        known = scenes()
        # Clips run beside episodes, and a source of states has one reader only.
        clip_states = scenes().states if options.has_clips else None
        choice = rendering_choice(
            options.render, known, subject["env_id"], no_simulation=no_simulation
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
                functools.partial(_close_each, close_environment, environments),
            ]
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


def rendering_choice(
    asked: str | None,
    scenes: Scenes,
    env_id: str,
    *,
    no_simulation: str = NO_SIMULATION,
) -> RenderingChoice:
    """Return when the frames of an environment are drawn.

    Args:
        asked: `"deferred"`, `"live"`, `"off"`, or None for deferred where it is known
            that the frames follow from the states, else live.
        scenes: what is known of the environment.
        env_id: its name, for messages.
        no_simulation: why there are no states, where there are none.

    Raises:
        PicturesDiffer: deferred was asked for, and the frames do not follow.
    """
    if asked in (LIVE, OFF):
        return RenderingChoice(mode=str(asked), is_forced=True)
    obstacle = no_simulation if scenes.states is None else scenes.obstacle
    if obstacle is None:
        logger.info("The videos of %s are rendered from recorded states.", env_id)
        return RenderingChoice(mode=DEFERRED, is_forced=asked == DEFERRED)
    if asked == DEFERRED:
        raise PicturesDiffer(
            f'render="deferred" was asked for, and what {env_id} shows cannot be made '
            f'from its recorded state: {obstacle}. Use render="live" (or None, which '
            "chooses)."
        )
    logger.info("The videos of %s are drawn live: %s.", env_id, obstacle)
    return RenderingChoice(mode=LIVE, reason=obstacle)


def call_all(calls: Iterable[Callable[[], object]]) -> None:
    """Call all, also where one raises; then raise what the first has raised."""
    first: BaseException | None = None
    for call in calls:
        try:
            call()
        except BaseException as error:
            first = first or error
    if first is not None:
        raise first


def _close_each(close: Callable[[Any], None], environments: Iterable[Any]) -> None:
    for environment in environments:
        close(environment)


def _note_last_error(recorders: Sequence[Recorder]) -> None:
    error = last_error()
    if error is not None:
        for recorder in recorders:
            recorder.note_error(error)
