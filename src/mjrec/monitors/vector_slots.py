# SPDX-License-Identifier: Apache-2.0
"""The sub-environments of a vector environment, one by one.

Those that are objects in this process are found in the vector environment's list. All
others are seen from outside only: each is a slot of what goes into the vector
environment and comes out of it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium

from ..errors import InvalidArgument, PicturesDiffer
from ..recorder.options import DEFERRED
from .gymnasium_monitor import env_id_of

logger = logging.getLogger(__name__)

VectorEnv = gymnasium.vector.VectorEnv[Any, Any, Any]
Env = gymnasium.Env[Any, Any]

# The names of the members of Gymnasium's AutoresetMode.
NEXT_STEP, SAME_STEP = "NEXT_STEP", "SAME_STEP"

UNSEEN = "its sub-environments are not objects in this process"
# How Gymnasium writes an environment that has a spec, under its wrappers.
_WITH_SPEC = re.compile(r"(?:<\w+)+<([\w./:-]+)>+")


def autoreset_mode(env: VectorEnv) -> str:
    """Return when sub-environments are reset: `DISABLED`, `NEXT_STEP` or `SAME_STEP`.

    Raises:
        InvalidArgument: the vector environment does not say.
    """
    mode = (env.metadata or {}).get("autoreset_mode")
    # Gymnasium 1.0 has no such thing: its own reset in the step after the end.
    known = getattr(gymnasium.vector, "AutoresetMode", None)
    if known is not None and isinstance(mode, known):
        return str(mode.name)
    own = (gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv)
    if known is None and isinstance(env.unwrapped, own):
        return NEXT_STEP
    raise InvalidArgument(
        f"When {type(env.unwrapped).__name__} resets its sub-environments is not "
        f'known: metadata["autoreset_mode"] is {mode!r}, and must be a '
        "gymnasium.vector.AutoresetMode (of Gymnasium 1.1 or later). Set it, for "
        'example env.metadata["autoreset_mode"] = '
        "gymnasium.vector.AutoresetMode.NEXT_STEP, or put Monitor around each of the "
        "environments, inside the functions that make them, with resume=True."
    )


def environments_inside(env: VectorEnv) -> list[Env] | None:
    """Return the list of a vector environment's sub-environments.

    It is the vector environment's own list. None where they are elsewhere, or nowhere.
    """
    envs = getattr(env.unwrapped, "envs", None)
    if not isinstance(envs, list) or not envs or len(envs) != env.num_envs:
        return None
    return envs if all(isinstance(each, gymnasium.Env) for each in envs) else None


def common_env_id(envs: Sequence[Env]) -> str:
    """Return the name of sub-environments that are objects in this process.

    Raises:
        InvalidArgument: they have several.
    """
    ids = {None if each.spec is None else each.spec.id for each in envs}
    if len(ids) > 1:
        names = ", ".join(sorted(str(name) for name in ids))
        raise InvalidArgument(
            f"The sub-environments are not all of one name: {names}. Results in one "
            "directory belong to one environment: give env_id= a name for them all, or "
            "put Monitor around each of them, with a directory of its own."
        )
    return env_id_of(envs[0])


class Frames:
    """What a vector environment's `render()` gives, asked once for each moment."""

    def __init__(self, env: VectorEnv) -> None:
        self._env = env
        self._frames: Sequence[Any] | None = None

    def forget(self) -> None:
        """Take note that the environment has gone on."""
        self._frames = None

    def of(self, index: int) -> Any:
        """Return the frame of a sub-environment now, or the list of its frames.

        Raises:
            InvalidArgument: there is not one for each sub-environment.
        """
        if self._frames is None:
            frames: Any = self._env.render()
            count = self._env.num_envs
            there = len(frames) if hasattr(frames, "__len__") else repr(frames)
            if there != count:
                raise InvalidArgument(
                    f"render() of {type(self._env.unwrapped).__name__} must give a "
                    f"frame for each of its {count} sub-environments, and gave "
                    f"{there}. Record without videos (video_callable=False), or put "
                    "Monitor around each environment, inside the functions that make "
                    "them."
                )
            self._frames = frames
        return self._frames[index]


class SubEnvironment(Env):
    """A sub-environment that is seen from outside, as if it stood alone.

    Its monitor gets what the vector environment was given and returned, and calls
    only `render`.
    """

    control_timestep: Callable[[], float] | None = None

    def __init__(
        self, env: VectorEnv, frames: Frames, index: int, *, timestep: float | None
    ) -> None:
        mode = autoreset_mode(env)
        self.metadata = {**env.metadata, "semantics.autoreset": mode == SAME_STEP}
        self.resets_in_next_step = mode == NEXT_STEP
        self.render_mode = env.render_mode
        self._frames = frames
        self._index = index
        if timestep:
            self.control_timestep = lambda: timestep

    def render(self) -> Any:
        """Return the frame of this moment, or the list of those since the last."""
        return self._frames.of(self._index)

    def close(self) -> None:
        """Do nothing: the vector environment is closed by its own monitor."""


def slots_outside(env: VectorEnv, frames: Frames) -> list[SubEnvironment]:
    """Return the sub-environments of one that can be seen from outside only."""
    return [
        SubEnvironment(env, frames, index, timestep=timestep)
        for index, timestep in enumerate(_timesteps(env))
    ]


def check_outside(env: VectorEnv, asked: str | None, view: Mapping[str, Any]) -> None:
    """Check that nothing is asked for that cannot be had from outside.

    Args:
        env: the vector environment.
        asked: when frames are to be drawn.
        view: `camera`, `height` and `width`.

    Raises:
        InvalidArgument: the view was to be another.
        PicturesDiffer: rendering was to be deferred.
    """
    name = type(env.unwrapped).__name__
    chosen = [name for name, value in view.items() if value is not None]
    if chosen:
        raise InvalidArgument(
            f"{', '.join(chosen)} cannot be chosen for {name}: {UNSEEN}, and show what "
            "they show. Make them with the camera and size that the videos are to "
            f"have, or: {way_out(env)}"
        )
    if asked == DEFERRED:
        raise PicturesDiffer(
            f'render="deferred" was asked for, and the states of {name} cannot be '
            f'recorded: {UNSEEN}. {way_out(env)} Or use render="live" (or None).'
        )


def env_id_outside(env: VectorEnv) -> str:
    """Return the name of sub-environments that can be seen from outside only."""
    if env.spec is not None:
        return env.spec.id
    if is_async(env):
        base: Any = env.unwrapped
        matches = [_WITH_SPEC.fullmatch(text) for text in base.call("__str__")]
        names = {match and match[1] for match in matches}
        if len(names) == 1 and (name := names.pop()) is not None:
            return str(name)
    unknown = f"(unknown:{type(env.unwrapped).__name__})"
    logger.warning(
        "The vector environment has no spec, so the recordings cannot name it; they "
        'say %s. Give Monitor(..., env_id="...") to name it.',
        unknown,
    )
    return unknown


def way_out(env: VectorEnv) -> str:
    """Return how states, and all frames, can be recorded all the same."""
    if is_async(env):
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


def is_async(env: VectorEnv) -> bool:
    """Return whether there is an AsyncVectorEnv below all wrappers."""
    return isinstance(env.unwrapped, gymnasium.vector.AsyncVectorEnv)


def _timesteps(env: VectorEnv) -> Sequence[float | None]:
    """Return the seconds of a step of each sub-environment, as far as they can say."""
    base: Any = env.unwrapped
    # In another process there is no asking for what may be missing: the process ends.
    if is_async(env) and all(
        all(base.call("has_wrapper_attr", name)) for name in ("model", "data", "dt")
    ):
        return [float(dt) for dt in base.call("dt")]
    return [None] * env.num_envs


def info_of(infos: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Return what a step's `infos` say of one sub-environment, values only."""
    return {
        name: values[index]
        for name, values in infos.items()
        if not name.startswith("_")
        and not isinstance(values, Mapping)
        and (mask := infos.get(f"_{name}")) is not None
        and mask[index]
    }
