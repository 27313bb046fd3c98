# SPDX-License-Identifier: Apache-2.0
"""The monitor for Gymnasium's vector environments."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from ..environments.gymnasium_frames import close_environment, free_viewers
from ..errors import Error, ResetNeeded, ResetNotAllowed
from ..formats.monitor_directory import infix_of, iter_monitor_files
from ..recorder.opening import made_directory
from ..recorder.options import RecorderOptions
from ..rendering.background import Background, Share
from .base import MonitorBase, call_all
from .gymnasium_monitor import GymnasiumMonitor
from .tiles import TiledVideo, has_videos, vector_tiles
from .vector_slots import (
    SAME_STEP,
    UNSEEN,
    Env,
    Frames,
    VectorEnv,
    autoreset_mode,
    check_outside,
    common_env_id,
    env_id_outside,
    environments_inside,
    info_of,
    is_async,
    slots_outside,
    way_out,
)

logger = logging.getLogger(__name__)

# Total size of the tails of all sub-environments' row logs, in bytes.
_TAILS = 4 << 20


class VectorMonitor(MonitorBase, gymnasium.vector.VectorWrapper):
    """A monitor for a Gymnasium vector environment. Create it with `mjrec.Monitor`.

    Each sub-environment has its own monitor, with its own infix, statistics, schedule,
    numbering and manifest, all in one directory.

    Sub-environments that are objects in this process (`SyncVectorEnv`, even inside
    vector wrappers) are recorded like single environments: every frame of every episode
    in every autoreset mode, rendered from states if possible. Rewards and actions are
    those of the sub-environment, not of vector wrappers.

    Other sub-environments (`AsyncVectorEnv`, vectorized simulators) are recorded from
    outside: frames are rendered live, with `render()`, and trajectories have no states.
    If such an environment resets itself in the step that ends an episode (SAME_STEP),
    the last frame is missing, and the metadata says `final_frame: missing`. To avoid
    this, put a Monitor inside the functions that create the environments.

    A reset during an episode is allowed unless `allow_early_reset=False`, because
    sub-environments end their episodes at different times. Interrupted episodes are not
    included in the statistics.

    `tiled=True` adds a video of all sub-environments side by side,
    `....video000027.tiled.mp4`, for the scheduled episodes of the first
    sub-environment. It is rendered live and needs `render_mode="rgb_array"`. In the
    SAME_STEP mode, its last frame shows the first sub-environment after the reset, and
    its metadata says `final_frame: missing`.

    After `close`, calls go straight to the closed environment, and nothing is recorded.

    Attributes:
        monitors: the monitors of the sub-environments, in order.
    """

    allows_early_reset = True

    def __init__(
        self,
        env: VectorEnv,
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        env_id: str | None = None,
        **view: Any,
    ) -> None:
        super().__init__(env)
        self._mode = autoreset_mode(env)
        self._options = options
        self._had_error = False
        self._frames = Frames(env)
        inside = environments_inside(env)
        self._is_inside = inside is not None
        if inside is None:
            check_outside(env, options.render, view)
        envs: Sequence[Env] = inside or slots_outside(env, self._frames)
        tiles = vector_tiles(envs, options, view)
        if self._mode == SAME_STEP and has_videos(options):
            _warn_of_missing_frames(env, inside is None, tiles is not None)
        env_id = env_id or (common_env_id(envs) if inside else env_id_outside(env))
        shared = None
        if options.workers != 0:
            shared = Background(
                directory, workers=options.workers, strict=options.strict
            )
        # Closes a sub-environment, but does nothing until all of them have monitors.
        closing: dict[str, Callable[[Env], None]] = {"by": lambda env: None}
        self.monitors: tuple[GymnasiumMonitor, ...] = _all_or_none(
            directory,
            [
                functools.partial(
                    GymnasiumMonitor,
                    each,
                    directory,
                    _options_of(index, len(envs), options, view),
                    **view,
                    env_id=env_id,
                    env_index=index,
                    rendering=None if shared is None else lambda _: Share(shared),
                    close_environment=lambda env: closing["by"](env),
                )
                for index, each in enumerate(envs)
            ],
        )
        closing["by"] = close_environment
        self._recorders = [monitor._recorder for monitor in self.monitors]
        self._shared = shared
        self._tiled = None
        # Options that `close` passes on to the environment's own `close`.
        self._closing: dict[str, Any] = {}
        options_of_close = self._closing
        closings: list[Callable[[], object]] = []
        if tiles is not None:
            self._tiled = TiledVideo(self.monitors[0].recorder, tiles)
            # Closed first, because the first monitor's manifest lists its videos.
            closings.append(self._tiled.close)
        if shared is not None:
            # Before the monitors, so that their manifests list all rendered videos.
            closings.append(shared.stop)
        # The vector environment itself closes its sub-environments.
        closings.append(lambda: closing.update(by=free_viewers))
        closings += [monitor._guard.close for monitor in self.monitors]
        if inside is not None:
            originals = list(inside)
            closings.append(lambda: inside.__setitem__(slice(None), originals))
            inside[:] = self.monitors
        closings.append(lambda: env.close(**options_of_close))
        self._guard_by(closings)

    def get_episode_rewards(self) -> list[list[float]]:
        """Return the sum of rewards of each complete episode, by sub-environment."""
        return [monitor.get_episode_rewards() for monitor in self.monitors]

    def get_episode_lengths(self) -> list[list[int]]:
        """Return the number of steps of each complete episode, by sub-environment."""
        return [monitor.get_episode_lengths() for monitor in self.monitors]

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment, or the sub-environments that `options` select.

        Raises:
            ResetNotAllowed: an episode is running and `allow_early_reset=False` was
                given. Nothing was reset.
        """
        if self._is_closed:
            return self._env_reset(seed, options)
        which = _reset_indices(options, self.num_envs)
        self._check_reset(which)
        tiled = self._tiled if 0 in which else None
        if tiled is not None:
            tiled.take_last()
        with self._noting_errors():
            reset = self._reset_inside if self._is_inside else self._reset_slots
            result = reset(which, seed, options)
        self._had_error = False
        if tiled is not None and tiled.after_reset():
            # Rendering has loaded OpenGL by now, which shuts itself down at exit.
            self._guard.run_first_at_exit()
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environment and record the result.

        Raises:
            ResetNeeded: there has been no reset yet, or a sub-environment has not been
                reset since its episode ended.
        """
        if self._is_closed:
            return self.env.step(actions)
        with self._noting_errors():
            # Monitors inside the vector environment record on their own.
            step = self.env.step if self._is_inside else self._step_slots
            result: tuple[Any, Any, Any, Any, dict[str, Any]] = step(actions)
        if self._tiled is not None:
            _, _, terminations, truncations, _ = result
            if self._tiled.after_step(
                terminated=bool(terminations[0]), truncated=bool(truncations[0])
            ):
                self._guard.run_first_at_exit()
        return result

    def close(self, *, wait: bool = True, **options: Any) -> None:
        """Finish the recordings, then close the environment. Idempotent.

        Args:
            wait: see `GymnasiumMonitor.close`.
            **options: options of the environment's own `close`, such as `timeout` and
                `terminate` of `AsyncVectorEnv`.

        Raises:
            Error: see `GymnasiumMonitor.close`.
        """
        self._closing.update(options)
        super().close(wait=wait)

    def __del__(self) -> None:
        # Gymnasium 1.0 would call `close`, which waits. Use the guard instead.
        pass

    @property
    def _is_closed(self) -> bool:
        return all(recorder.closed for recorder in self._recorders)

    def _finish(self, on_progress: Callable[[Any], None]) -> None:
        if self._is_closed:
            return
        if self._tiled is not None:
            self._tiled.take_last()
        with contextlib.ExitStack() as waiting:
            if self._shared is not None:
                waiting.enter_context(self._shared.waiting_at_the_end(on_progress))
            call_all(recorder.finish for recorder in self._recorders)

    def _env_reset(self, seed: Any, options: Any) -> tuple[Any, dict[str, Any]]:
        result: tuple[Any, dict[str, Any]] = self.env.reset(seed=seed, options=options)
        return result

    def _reset_inside(
        self, which: list[int], seed: Any, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        result = self._env_reset(seed, options)
        if any(self._recorders[index].done is None for index in which):
            raise Error(
                f"{type(self.env.unwrapped).__name__} was reset without resetting the "
                "environments in its list `envs`, so nothing could be recorded. Put "
                "Monitor around each of them, inside the functions that create them, "
                "with resume=True."
            )
        return result

    def _reset_slots(
        self, which: list[int], seed: Any, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        slots = {i: slot for i, slot in self._open_slots().items() if i in which}
        # Copied, because the reset removes the mask from the original.
        noted = options and {k: v for k, v in options.items() if k != "reset_mask"}
        for slot in slots.values():
            slot._recorder.before_reset()
        result = self._env_reset(seed, options)
        self._frames.forget()
        observations = self._split(result[0])
        call_all(
            functools.partial(
                slot._begin,
                seed=_seed_of(self.env, index, seed),
                options=noted,
                observation=observations[index],
            )
            for index, slot in slots.items()
        )
        return result

    def _step_slots(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        slots = self._open_slots()
        each = list(gymnasium.vector.utils.iterate(self.env.action_space, actions))
        begins = {i for i, slot in slots.items() if slot._before_step(each[i])}
        result = self.env.step(actions)
        self._frames.forget()
        observations, rewards, terminations, truncations, infos = result
        firsts = lasts = self._split(observations)
        of_lasts: Any = infos
        if self._mode == SAME_STEP:
            lasts = infos.get("final_obs", firsts)
            of_lasts = infos.get("final_info", infos)
        ends = np.logical_or(terminations, truncations)
        last_infos = {
            i: info_of(of_lasts, i) for i in slots if ends[i] and i not in begins
        }

        def record(index: int, slot: GymnasiumMonitor) -> None:
            if index in begins:
                slot._begin(observation=firsts[index])
                return
            slot._record(
                lasts[index] if ends[index] else firsts[index],
                rewards[index],
                bool(terminations[index]),
                bool(truncations[index]),
                last_infos.get(index, {}),
                firsts[index],
            )

        call_all(functools.partial(record, *each) for each in slots.items())
        if self._options.episode_info and not {"episode", "_episode"} & infos.keys():
            _add_episode_info(infos, last_infos, ends)
        return result

    def _open_slots(self) -> dict[int, GymnasiumMonitor]:
        each = enumerate(self.monitors)
        return {i: slot for i, slot in each if not slot._recorder.closed}

    def _split(self, observations: Any) -> Sequence[Any]:
        if not self._options.observations:
            return [None] * self.num_envs
        space = self.env.observation_space
        return list(gymnasium.vector.utils.iterate(space, observations))

    def _check_reset(self, which: list[int]) -> None:
        """Check before the reset that all of these resets are allowed."""
        if self._options.allow_early_reset or self._had_error:
            return
        stats = [recorder.stats_recorder for recorder in self._recorders]
        running = [i for i in which if stats[i].done is False and stats[i].steps]
        if running:
            raise ResetNotAllowed(
                f"reset() was called, but the episodes of the sub-environments "
                f"{running} are not over. Select the ones to reset with "
                'options={"reset_mask": ...}, or use allow_early_reset=True; the '
                "statistics then do not include these episodes."
            )

    @contextlib.contextmanager
    def _noting_errors(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self._note_error(error)
            raise

    def _note_error(self, error: BaseException) -> None:
        # Rejected calls have not changed anything.
        if isinstance(error, ResetNeeded | ResetNotAllowed):
            return
        self._had_error = True
        super()._note_error(error)
        if self._tiled is not None:
            self._tiled.note_error(error)


def _reset_indices(options: Mapping[str, Any] | None, count: int) -> list[int]:
    """Return the sub-environments that a reset with these options will reset.

    Call this before the reset, which removes the mask from the options.
    """
    mask = None if options is None else options.get("reset_mask")
    if mask is None or np.shape(mask) != (count,):
        # If the mask is invalid, the vector environment will raise an error.
        return list(range(count))
    return [int(index) for index in np.flatnonzero(mask)]


def _seed_of(env: VectorEnv, index: int, seed: Any) -> Any:
    if isinstance(seed, list | tuple):
        return seed[index]
    if isinstance(seed, int) and is_async(env):
        return seed + index
    # All sub-environments share one generator, seeded by the vector environment.
    return seed


def _add_episode_info(
    infos: dict[str, Any], last_infos: Mapping[int, Mapping[str, Any]], ends: Any
) -> None:
    """Add the info that Gymnasium's own wrapper would add about ended episodes."""
    if not last_infos:
        return
    zeros = {"r": 0.0, "l": 0, "t": 0.0}
    infos["episode"] = {
        name: np.array(
            [
                last_infos[i]["episode"][name] if i in last_infos else zero
                for i in range(len(ends))
            ]
        )
        for name, zero in zeros.items()
    }
    infos["_episode"] = np.isin(np.arange(len(ends)), list(last_infos))


def _options_of(
    index: int, count: int, options: RecorderOptions, view: Mapping[str, Any]
) -> RecorderOptions:
    """Return the options of one sub-environment's monitor.

    The first monitor opens the directory as requested, and the others join it.
    """
    changed: dict[str, Any] = {
        # With several cameras, each sub-environment has its own tiled video.
        "tiled": options.tiled and isinstance(view.get("camera"), list | tuple),
        "tail_bytes": min(options.tail_bytes, _TAILS // count),
    }
    if index > 0:
        changed |= {"force": False, "resume": options.resume or True}
    if options.name_prefix is not None:
        # With the same prefix, all monitors would use the same file names.
        changed["name_prefix"] = f"{options.name_prefix}-env-{index}"
    return dataclasses.replace(options, **changed)


def _all_or_none(
    directory: str | os.PathLike[str], opens: Iterable[Callable[[], GymnasiumMonitor]]
) -> tuple[GymnasiumMonitor, ...]:
    """Return the monitors that the functions open. If one fails, undo everything.

    This removes their files and the directories created for them.
    """
    path = Path(directory).absolute()
    opened: list[GymnasiumMonitor] = []
    with made_directory(path):
        try:
            for open_one in opens:
                opened.append(open_one())
        except BaseException:
            for monitor in opened:
                # The user needs to see the first error.
                with contextlib.suppress(Exception):
                    monitor._guard.close()
            infixes = {monitor.infix for monitor in opened}
            for file in iter_monitor_files(path, hidden=True):
                if infix_of(file.name) in infixes:
                    file.unlink(missing_ok=True)
            raise
    return tuple(opened)


def _warn_of_missing_frames(env: VectorEnv, is_outside: bool, is_tiled: bool) -> None:
    if is_outside:
        logger.warning(
            "The last frame of each episode is missing in its video: %s resets its "
            "sub-environments in the step that ends an episode (SAME_STEP), and %s. %s",
            type(env.unwrapped).__name__,
            UNSEEN,
            way_out(env),
        )
    if is_tiled:
        logger.warning(
            "The last frame of each tiled video shows the first sub-environment, and "
            "any others whose episode has ended, after the reset. With SAME_STEP, all "
            "sub-environments can be rendered together only then."
        )
