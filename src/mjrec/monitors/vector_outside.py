# SPDX-License-Identifier: Apache-2.0
"""Recording sub-environments that can only be seen from outside."""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import gymnasium
import numpy as np

from ..errors import InvalidArgument, PicturesDiffer
from ..rates import rate_from_timestep
from ..recorder.declared_rate import declared_rate
from ..recorder.options import DEFERRED, LIVE, OFF, RecorderOptions, RenderingChoice
from ..recorder.subject import Subject
from .controls import MonitorControls
from .success import success_in
from .vector_modes import NEXT_STEP, SAME_STEP
from .vector_pictures import OutsidePictures, VectorFrames
from .vector_recording import (
    VectorRecording,
    for_each,
    opened_together,
    options_of,
)

logger = logging.getLogger(__name__)

_VectorEnv = gymnasium.vector.VectorEnv[Any, Any, Any]

_UNSEEN = "its sub-environments are not objects in this process"
# How Gymnasium writes an environment that has a spec, under its wrappers.
_WITH_SPEC = re.compile(r"(?:<\w+)+<([\w./:-]+)>+")


class OutsideMonitor(MonitorControls):
    """The monitor of one sub-environment that is told of it by a `VectorMonitor`."""

    allows_early_reset = True

    def __init__(
        self,
        directory: str | os.PathLike[str],
        subject: Subject,
        options: RecorderOptions,
    ) -> None:
        self._open(
            directory,
            subject,
            options=options,
            rendering=None,
            close_environment=_nothing,
        )


class OutsideRecording(VectorRecording):
    """Records what goes into a vector environment, and what comes out of it.

    Args:
        env: the vector environment.
        mode: its autoreset mode.
        directory: the monitor directory.
        options: what was asked for.
        frames: the pictures.
        view: `camera`, `height` and `width`, which cannot be chosen from here.
        env_id: the name of the sub-environments; None is that of the spec.

    Raises:
        InvalidArgument: the view was to be another.
        PicturesDiffer: rendering was to be deferred.
    """

    def __init__(
        self,
        env: _VectorEnv,
        mode: str,
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        frames: VectorFrames,
        view: Mapping[str, Any],
        env_id: str | None,
    ) -> None:
        self._env = env
        self._mode = mode
        self._frames = frames
        self._observations = options.observations
        self._has_warned = False
        self._episode_info = options.episode_info
        self._began = np.zeros(env.num_envs)
        _check_view(env, view)
        choice = _rendering_choice(env, options.render)
        env_id = env_id or _env_id(env)
        rates = _rates(env)
        with opened_together(directory) as monitors:
            for index, rate in enumerate(rates):
                subject = Subject(
                    env_id=env_id,
                    env_index=index,
                    pictures=OutsidePictures(frames, index),
                    clock=_no_clock,
                    declared=_Once(env, rate),
                    rendering=choice,
                )
                monitors.append(
                    OutsideMonitor(directory, subject, options_of(index, options))
                )
        if choice.reason is not None:
            logger.info(
                "The videos of %s are drawn live: %s. To have states recorded: %s",
                env_id,
                choice.reason,
                _way_out(env),
            )
        super().__init__(monitors, declared=_Once(env, rates[0]))

    def reset(
        self, which: list[int], *, seed: Any, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the vector environment, and record that."""
        open_ones = [i for i in which if not self.monitors[i]._recorder.closed]
        # A copy: the mask is taken out of the original.
        noted = _without_mask(options)
        for index in open_ones:
            self.monitors[index]._recorder.before_reset()
        result: tuple[Any, dict[str, Any]]
        result = self._env.reset(seed=seed, options=options)
        self._frames.forget()
        self._began[which] = time.perf_counter()
        observations = self._each_observation(result[0])
        for_each(
            lambda index: self.monitors[index]._begin(
                seed=self._seed_of(index, seed),
                options=noted,
                observation=observations[index],
            ),
            open_ones,
        )
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the vector environment, and record what happened."""
        resetting = self._before_step(actions)
        result = self._env.step(actions)
        self._frames.forget()
        step = _Step(
            *result, self._each_observation(result[0]), self._mode == SAME_STEP
        )
        for_each(
            lambda index: self._record(index, step, is_reset=index in resetting),
            self._open_indices(),
        )
        if self._episode_info:
            self._add_episode_info(step)
        return result

    def _add_episode_info(self, step: _Step) -> None:
        """Say of the episodes that are over what Gymnasium's own wrapper says."""
        ends = np.array([step.is_end(index) for index in range(len(self.monitors))])
        if not ends.any() or "episode" in step.infos or "_episode" in step.infos:
            return
        took = np.round(time.perf_counter() - self._began, 6)
        last = [_last_episode(monitor) for monitor in self.monitors]
        step.infos["episode"] = {
            "r": np.where(ends, [reward for reward, _ in last], 0.0),
            "l": np.where(ends, [length for _, length in last], 0),
            "t": np.where(ends, took, 0.0),
        }
        step.infos["_episode"] = ends
        if step.resets_itself:
            self._began[ends] = time.perf_counter()

    def _open_indices(self) -> list[int]:
        return [
            index
            for index, monitor in enumerate(self.monitors)
            if not monitor._recorder.closed
        ]

    def _before_step(self, actions: Any) -> set[int]:
        """Note the actions; return for which sub-environments the step is a reset."""
        each_action = gymnasium.vector.utils.iterate(self._env.action_space, actions)
        resetting = set()
        for index, action in enumerate(each_action):
            recorder = self.monitors[index]._recorder
            if recorder.closed:
                continue
            if self._mode == NEXT_STEP and recorder.done:
                recorder.before_reset()
                resetting.add(index)
            else:
                recorder.before_step(action)
        return resetting

    def _record(self, index: int, step: _Step, *, is_reset: bool) -> None:
        monitor = self.monitors[index]
        if is_reset:
            self._began[index] = time.perf_counter()
            monitor._begin(observation=step.observations[index])
            return
        done = step.is_end(index)
        resets_itself = done and step.resets_itself
        monitor._recorder.step(
            step.rewards[index],
            terminated=bool(step.terminations[index]),
            truncated=bool(step.truncations[index]),
            picture=not resets_itself,
            observation=step.last_observation(index),
            success=success_in(step.info(index)) if done else None,
        )
        if resets_itself:
            self._warn_of_missing_frames(monitor)
            monitor._recorder.before_reset()
            monitor._begin(observation=step.observations[index])

    def _warn_of_missing_frames(self, monitor: MonitorControls) -> None:
        video = monitor.video_recorder
        if self._has_warned or video is None or not video.enabled:
            return
        self._has_warned = True
        logger.warning(
            "The last frame of each episode is missing in its video: %s resets its "
            "sub-environments in the step that ends an episode (SAME_STEP), and %s. %s",
            type(self._env.unwrapped).__name__,
            _UNSEEN,
            _way_out(self._env),
        )

    def _each_observation(self, observations: Any) -> list[Any]:
        if not self._observations:
            return [None] * len(self.monitors)
        space = self._env.observation_space
        return list(gymnasium.vector.utils.iterate(space, observations))

    def _seed_of(self, index: int, seed: Any) -> Any:
        if isinstance(seed, list | tuple):
            return seed[index]
        if isinstance(seed, int) and _async_in(self._env) is not None:
            return seed + index
        # One generator for all: it is the vector environment's seed.
        return seed


class _Step:
    """What a step of a vector environment returned, by sub-environment."""

    def __init__(
        self,
        observations: Any,
        rewards: Any,
        terminations: Any,
        truncations: Any,
        infos: dict[str, Any],
        each_observation: list[Any],
        resets_itself: bool,
    ) -> None:
        del observations
        self.rewards = rewards
        self.terminations = terminations
        self.truncations = truncations
        self.observations = each_observation
        self.resets_itself = resets_itself
        self.infos = infos

    def is_end(self, index: int) -> bool:
        return bool(self.terminations[index] or self.truncations[index])

    def last_observation(self, index: int) -> Any:
        """Return the observation that belongs to the episode of the step."""
        if self.resets_itself and self.is_end(index):
            final = self.infos.get("final_obs")
            return self.observations[index] if final is None else final[index]
        return self.observations[index]

    def info(self, index: int) -> dict[str, Any]:
        """Return what the step said of one sub-environment, values of it only."""
        infos: Any = self.infos
        if self.resets_itself and isinstance(infos.get("final_info"), Mapping):
            infos = infos["final_info"]
        return {
            name: values[index]
            for name, values in infos.items()
            if _is_said(infos, name, index) and not isinstance(values, Mapping)
        }


def _last_episode(monitor: MonitorControls) -> tuple[float, int]:
    """Return reward and length of the last episode that is over; zeros before it."""
    stats = monitor.stats_recorder
    if not stats.episode_lengths:
        return 0.0, 0
    return stats.episode_rewards[-1], stats.episode_lengths[-1]


def _is_said(infos: Mapping[str, Any], name: str, index: int) -> bool:
    """Tell whether an info is one of this sub-environment."""
    mask = infos.get(f"_{name}")
    return not name.startswith("_") and mask is not None and bool(mask[index])


class _Once:
    """The rate to take where no time can be measured, asked for once."""

    def __init__(self, env: _VectorEnv, rate: Fraction | None) -> None:
        self._env = env
        self._rate = rate

    def __call__(self) -> Fraction:
        if self._rate is None:
            self._rate = declared_rate(self._env)
        return self._rate


def _check_view(env: _VectorEnv, view: Mapping[str, Any]) -> None:
    chosen = [name for name, value in view.items() if value is not None]
    if chosen:
        raise InvalidArgument(
            f"{', '.join(chosen)} cannot be chosen for {type(env.unwrapped).__name__}: "
            f"{_UNSEEN}, and show what they show. Make them with the camera and size "
            f"that the videos are to have, or: {_way_out(env)}"
        )


def _rendering_choice(env: _VectorEnv, asked: str | None) -> RenderingChoice:
    if asked == DEFERRED:
        raise PicturesDiffer(
            'render="deferred" was asked for, and the states of '
            f"{type(env.unwrapped).__name__} cannot be recorded: {_UNSEEN}. "
            f'{_way_out(env)} Or use render="live" (or None).'
        )
    if asked is None:
        return RenderingChoice(mode=LIVE, reason=_UNSEEN)
    return RenderingChoice(mode=OFF if asked == OFF else LIVE, is_forced=True)


def _way_out(env: _VectorEnv) -> str:
    """Return how states, and all frames, can be recorded all the same."""
    if _async_in(env) is not None:
        return (
            "Put Monitor around each of them, inside the functions that make them: "
            "AsyncVectorEnv([lambda: mjrec.Monitor(gymnasium.make(...), directory, "
            "resume=True), ...])."
        )
    return (
        "Where they can be made one by one (gymnasium.make_vec(..., "
        'vectorization_mode="sync"), or a Monitor inside each of the functions that '
        "make them), everything can be recorded."
    )


def _async_in(env: _VectorEnv) -> gymnasium.vector.AsyncVectorEnv | None:
    """Return the AsyncVectorEnv below all wrappers; None for others."""
    base: Any = env.unwrapped
    return base if isinstance(base, gymnasium.vector.AsyncVectorEnv) else None


def _env_id(env: _VectorEnv) -> str:
    if env.spec is not None:
        return env.spec.id
    base = _async_in(env)
    if base is not None:
        told = {
            match[1] if (match := _WITH_SPEC.fullmatch(text)) else None
            for text in base.call("__str__")
        }
        if len(told) == 1 and (env_id := told.pop()) is not None:
            return env_id
    unknown = f"(unknown:{type(env.unwrapped).__name__})"
    logger.warning(
        "The vector environment has no spec, so the recordings cannot name it; they "
        'say %s. Give Monitor(..., env_id="...") to name it.',
        unknown,
    )
    return unknown


def _rates(env: _VectorEnv) -> list[Fraction | None]:
    """Return the steps per second of each sub-environment, as far as they can say."""
    # In another process there is no asking for what may be missing: the process ends.
    base = _async_in(env)
    if base is not None and all(
        all(base.call("has_wrapper_attr", name)) for name in ("model", "data", "dt")
    ):
        steps = base.call("dt")
        return [rate_from_timestep(float(dt)) if dt else None for dt in steps]
    return [None] * env.num_envs


def _without_mask(options: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if options is None:
        return None
    return {name: value for name, value in options.items() if name != "reset_mask"}


def _no_clock() -> None:
    """Return None: there is no simulated time to be seen."""


def _nothing() -> None:
    """Do nothing: the vector environment is closed by its own monitor."""
