# SPDX-License-Identifier: Apache-2.0
"""The monitor of Gymnasium's vector environments."""

from __future__ import annotations

import functools
import logging
import operator
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium

from ..environments.gymnasium_pictures import gymnasium_pictures
from ..errors import ResetNeeded, ResetNotAllowed
from ..recorder.endings import last_error
from ..recorder.exit_guard import ExitGuard
from ..recorder.options import RecorderOptions
from .controls import MonitorControls
from .lifetime import MonitorLifetime
from .vector_inside import InsideRecording, environments_inside
from .vector_modes import autoreset_mode, reset_indices
from .vector_outside import OutsideRecording
from .vector_pictures import OutsidePictures, TilePictures, VectorFrames
from .vector_recording import VectorRecording, for_each
from .vector_tiles import TiledVideo, check_tiled, wants_tiles
from .waiting import waiting_display

logger = logging.getLogger(__name__)

_VectorEnv = gymnasium.vector.VectorEnv[Any, Any, Any]


class VectorMonitor(
    MonitorLifetime,
    gymnasium.vector.VectorWrapper,
):
    """Records a Gymnasium vector environment; `mjrec.Monitor` makes one and says how.

    Every sub-environment has a monitor of its own, with its own infix, statistics,
    schedule, numbering and manifest, all in one directory.

    Where the sub-environments are objects in this process (`SyncVectorEnv`, also
    below vector wrappers), each is recorded as an environment of its own: every frame
    of every episode in every autoreset mode, rendered from states where that can be.
    Rewards and actions are those of the sub-environment, not of vector wrappers.

    All others (`AsyncVectorEnv`, environments that are vectorised by themselves) are
    recorded by what goes into them and comes out: pictures are drawn live, through
    `render()`, and trajectories hold no states. Where such an environment resets
    itself in the step that ends an episode (SAME_STEP), nobody outside sees the last
    frame: the metadata says `final_frame: missing`. With a Monitor inside the
    environment functions, instead of this one, all is as for one environment.

    A reset in mid-episode is allowed unless `allow_early_reset=False`: sub-environments
    end their episodes at different times. What it cuts off is no part of the
    statistics.

    With `tiled=True` there is also a video of all sub-environments side by side,
    `....video000027.tiled.mp4`, for each episode of the first that its schedule
    chooses. It is drawn live, and so needs `render_mode="rgb_array"`; it is among the
    videos of the first. In the SAME_STEP mode its last frame shows the first
    sub-environment after the reset, and its metadata says `final_frame: missing`.

    After `close` nothing is recorded: calls go straight to the environment, which is
    closed.
    """

    allows_early_reset = True

    def __init__(
        self,
        env: _VectorEnv,
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        camera: Any = None,
        height: int | None = None,
        width: int | None = None,
        env_id: str | None = None,
    ) -> None:
        super().__init__(env)
        mode = autoreset_mode(env)
        view = {"camera": camera, "height": height, "width": width}
        envs = environments_inside(env)
        frames = VectorFrames(env)
        tiles = _tiles(env, envs, frames, view) if wants_tiles(options) else None
        if tiles is not None:
            check_tiled(tiles)
        recording: VectorRecording
        if envs is not None:
            recording = InsideRecording(
                env, envs, directory, options, view=view, env_id=env_id
            )
        else:
            recording = OutsideRecording(
                env, mode, directory, options, frames=frames, view=view, env_id=env_id
            )
        self._options = options
        self._had_error = False
        self._recording = recording
        self._tiled = None
        if tiles is not None:
            self._tiled = TiledVideo(
                recording.monitors[0],
                tiles,
                options,
                clock=recording.clock,
                declared=recording.declared,
            )
        # What `close` passes on to the environment's own.
        self._closing: dict[str, Any] = {}
        self._guard = ExitGuard(
            self,
            functools.partial(_close, recording, self._tiled, env, self._closing),
            at_exit=functools.partial(_note_last_error, recording),
        )

    @property
    def monitors(self) -> tuple[MonitorControls, ...]:
        """The monitors of the sub-environments, in their order."""
        return self._recording.monitors

    @property
    def directory(self) -> Path:
        """The monitor directory, absolute."""
        return self.monitors[0].directory

    def set_monitor_mode(self, mode: str | None) -> None:
        """Set the type of the episodes from the next resets on.

        Args:
            mode: "training", "evaluation", or None for training.

        Raises:
            InvalidArgument: it is something else.
        """
        for monitor in self.monitors:
            monitor.set_monitor_mode(mode)

    def get_total_steps(self) -> int:
        """Return the number of all steps of all sub-environments."""
        return sum(monitor.get_total_steps() for monitor in self.monitors)

    def get_episode_rewards(self) -> list[list[float]]:
        """Return, by sub-environment, the sum of rewards of each complete episode."""
        return [monitor.get_episode_rewards() for monitor in self.monitors]

    def get_episode_lengths(self) -> list[list[int]]:
        """Return, by sub-environment, the steps of each complete episode."""
        return [monitor.get_episode_lengths() for monitor in self.monitors]

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, or what its options choose of it.

        Raises:
            ResetNotAllowed: in mid-episode, with `allow_early_reset=False`. Nothing has
                been reset then.
        """
        if self._is_closed:
            return self._reset_unrecorded(seed, options)
        which = reset_indices(options, self.num_envs)
        self._check_reset(which)
        tiled = self._tiled if 0 in which else None
        if tiled is not None:
            tiled.take_last()
        try:
            result = self._recording.reset(which, seed=seed, options=options)
        except BaseException as error:
            self._note_error(error)
            raise
        self._had_error = False
        if tiled is not None:
            tiled.after_reset()
            self._run_first_at_exit(tiled)
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environment and record what happened.

        Raises:
            ResetNeeded: before the first reset, or of sub-environments whose episodes
                are over, where nothing resets them by itself.
        """
        if self._is_closed:
            return self.env.step(actions)
        try:
            result = self._recording.step(actions)
        except BaseException as error:
            self._note_error(error)
            raise
        if self._tiled is not None:
            _, _, terminations, truncations, _ = result
            self._tiled.after_step(
                terminated=bool(terminations[0]), truncated=bool(truncations[0])
            )
            self._run_first_at_exit(self._tiled)
        return result

    def close(self, *, wait: bool = True, **options: Any) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Args:
            wait: whether to wait, with a progress bar on a terminal, until all videos
                are rendered; else what is not rendered yet is left pending, and
                `mjrec render DIR` makes it. Ctrl-C while it waits is the same.
            **options: of the environment's own `close`: `timeout` and `terminate` of
                `AsyncVectorEnv`.

        Raises:
            EncoderError: a running video could not be finished; all else is.
            RenderError: videos could not be rendered; all else is done, and their
                trajectories are kept.
            FileNotWritten: the disk is full; the next call tries again.
        """
        self._closing.update(options)
        try:
            if wait and not self._is_closed:
                if self._tiled is not None:
                    self._tiled.take_last()
                with waiting_display() as on_progress:
                    self._recording.finish(on_progress)
        finally:
            self._guard.close()
        if wait:
            self._raise_failures()

    def __del__(self) -> None:
        # Gymnasium 1.0 would call `close`, which waits; the guard sees to the end.
        pass

    @property
    def _is_closed(self) -> bool:
        return all(monitor._recorder.closed for monitor in self.monitors)

    def _reset_unrecorded(self, seed: Any, options: Any) -> tuple[Any, dict[str, Any]]:
        result: tuple[Any, dict[str, Any]] = self.env.reset(seed=seed, options=options)
        return result

    def _check_reset(self, which: list[int]) -> None:
        """Check before anything is reset that all may be."""
        if self._options.allow_early_reset or self._had_error:
            return
        running = [
            index
            for index in which
            if self.monitors[index].stats_recorder.done is False
            and self.monitors[index].stats_recorder.steps
        ]
        if running:
            raise ResetNotAllowed(
                f"reset() was called, and the episodes of the sub-environments "
                f"{running} are not over. Choose those to be reset with "
                'options={"reset_mask": ...}, or allow it with allow_early_reset=True; '
                "the episodes are then no part of the statistics."
            )

    def _note_error(self, error: BaseException) -> None:
        # Calls that were not allowed have changed nothing.
        if isinstance(error, ResetNeeded | ResetNotAllowed):
            return
        self._had_error = True
        self._recording.note_error(error)
        if self._tiled is not None:
            self._tiled.note_error(error)

    def _run_first_at_exit(self, tiled: TiledVideo) -> None:
        if tiled.is_recording:
            # Drawing has loaded OpenGL by now, which tears itself down at exit.
            self._guard.run_first_at_exit()

    def _failures(self) -> Mapping[str, str]:
        return self._recording.failures()


def _tiles(
    env: _VectorEnv,
    envs: list[gymnasium.Env[Any, Any]] | None,
    frames: VectorFrames,
    view: Mapping[str, Any],
) -> TilePictures:
    if envs is None:
        count = env.num_envs
        return TilePictures([OutsidePictures(frames, i) for i in range(count)])
    camera = view["camera"]
    if isinstance(camera, list | tuple) and camera:
        view = {**view, "camera": camera[0]}
    return TilePictures([gymnasium_pictures(each, **view) for each in envs])


def _note_last_error(recording: VectorRecording) -> None:
    error = last_error()
    if error is not None:
        recording.note_error(error)


def _close(
    recording: VectorRecording,
    tiled: TiledVideo | None,
    env: _VectorEnv,
    options: Mapping[str, Any],
) -> None:
    parts: list[Callable[[], object]] = [
        recording.close,
        recording.restore,
        functools.partial(env.close, **options),
    ]
    if tiled is not None:
        # Its videos stand in the manifest of the first.
        parts.insert(0, tiled.close)
    for_each(operator.methodcaller("__call__"), parts)
