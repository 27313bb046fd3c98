# SPDX-License-Identifier: Apache-2.0
"""The individual sub-environments in a vector environment.

Sub-environments that are objects in this process are in the vector environment's list.
All others are visible only from outside, as slots in the inputs and outputs of the
vector environment.
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
# Gymnasium's string form of a wrapped environment that has a spec.
_WITH_SPEC = re.compile(r"(?:<\w+)+<([\w./:-]+)>+")


def autoreset_mode(env: VectorEnv) -> str:
    """Return the autoreset mode: `DISABLED`, `NEXT_STEP` or `SAME_STEP`.

    Raises:
        InvalidArgument: the vector environment does not declare its mode.
    """
    mode = (env.metadata or {}).get("autoreset_mode")
    # Gymnasium 1.0 has no modes: its vector environments reset in the step after the
    # end.
    known = getattr(gymnasium.vector, "AutoresetMode", None)
    if known is not None and isinstance(mode, known):
        return str(mode.name)
    own = (gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv)
    if known is None and isinstance(env.unwrapped, own):
        return NEXT_STEP
    raise InvalidArgument(
        f"The autoreset mode of {type(env.unwrapped).__name__} is unknown: "
        f'metadata["autoreset_mode"] is {mode!r}, but must be a '
        "gymnasium.vector.AutoresetMode (in Gymnasium 1.1 or later). Set it, for "
        'example env.metadata["autoreset_mode"] = '
        "gymnasium.vector.AutoresetMode.NEXT_STEP, or put Monitor around each of the "
        "environments, inside the functions that create them, with resume=True."
    )


def environments_inside(env: VectorEnv) -> list[Env] | None:
    """Return a vector environment's own list of sub-environments.

    The result is None if they are not objects in this process.
    """
    envs = getattr(env.unwrapped, "envs", None)
    if not isinstance(envs, list) or not envs or len(envs) != env.num_envs:
        return None
    return envs if all(isinstance(each, gymnasium.Env) for each in envs) else None


def common_env_id(envs: Sequence[Env]) -> str:
    """Return the common name of sub-environments that are objects in this process.

    Raises:
        InvalidArgument: the sub-environments have different names.
    """
    ids = {None if each.spec is None else each.spec.id for each in envs}
    if len(ids) > 1:
        names = ", ".join(sorted(str(name) for name in ids))
        raise InvalidArgument(
            f"The sub-environments have different names: {names}. All results in one "
            "directory must belong to one environment. Set a common name with env_id=, "
            "or put Monitor around each of them, with separate directories."
        )
    return env_id_of(envs[0])


class Frames:
    """The frames of a vector environment, which is rendered only once per step."""

    def __init__(self, env: VectorEnv) -> None:
        self._env = env
        self._frames: Sequence[Any] | None = None

    def forget(self) -> None:
        """Drop the cached frames after the environment has changed."""
        self._frames = None

    def of(self, index: int) -> Any:
        """Return a sub-environment's current frame, or the list of its frames.

        Raises:
            InvalidArgument: `render()` does not return a frame for each
                sub-environment.
        """
        if self._frames is None:
            frames: Any = self._env.render()
            count = self._env.num_envs
            there = len(frames) if hasattr(frames, "__len__") else repr(frames)
            if there != count:
                raise InvalidArgument(
                    f"render() of {type(self._env.unwrapped).__name__} must return a "
                    f"frame for each of its {count} sub-environments, but returned "
                    f"{there}. Record without videos (video_callable=False), or put "
                    "Monitor around each environment, inside the functions that create "
                    "them."
                )
            self._frames = frames
        return self._frames[index]


class SubEnvironment(Env):
    """A stand-in for a sub-environment that is visible only from outside.

    Its monitor receives the inputs and outputs of the vector environment, and calls
    only `render`.
    """

    control_timestep: Callable[[], float] | None = None
    # The reason why states cannot be recorded.
    no_simulation = UNSEEN

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
        """Return the current frame, or the list of frames since the last call."""
        return self._frames.of(self._index)

    def close(self) -> None:
        """Do nothing: the vector environment's monitor closes it."""


def slots_outside(env: VectorEnv, frames: Frames) -> list[SubEnvironment]:
    """Return stand-ins for sub-environments that are visible only from outside."""
    return [
        SubEnvironment(env, frames, index, timestep=timestep)
        for index, timestep in enumerate(_timesteps(env))
    ]


def check_outside(env: VectorEnv, asked: str | None, view: Mapping[str, Any]) -> None:
    """Check that no option requires sub-environments that are objects in this process.

    Args:
        env: the vector environment.
        asked: the requested rendering mode.
        view: `camera`, `height` and `width`.

    Raises:
        InvalidArgument: a camera or size was requested.
        PicturesDiffer: deferred rendering was requested.
    """
    name = type(env.unwrapped).__name__
    chosen = [name for name, value in view.items() if value is not None]
    if chosen:
        raise InvalidArgument(
            f"{', '.join(chosen)} cannot be chosen for {name}: {UNSEEN}, so their view "
            "is fixed. Create them with the camera and size for the videos, or: "
            f"{way_out(env)}"
        )
    if asked == DEFERRED:
        raise PicturesDiffer(
            f'render="deferred" was requested, but the states of {name} cannot be '
            f'recorded: {UNSEEN}. {way_out(env)} Or use render="live" (or None).'
        )


def env_id_outside(env: VectorEnv) -> str:
    """Return the name of sub-environments that are visible only from outside."""
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
        "The vector environment has no spec, so its name is unknown and the recordings "
        'say %s. To set the name, use Monitor(..., env_id="...").',
        unknown,
    )
    return unknown


def way_out(env: VectorEnv) -> str:
    """Return advice on how to record the states and all frames."""
    if is_async(env):
        return (
            "Put Monitor around each of them, inside the functions that create them: "
            "AsyncVectorEnv([lambda: mjrec.Monitor(gymnasium.make(...), directory, "
            "resume=True), ...])."
        )
    return (
        "If they can be created one by one (gymnasium.make_vec(..., "
        'vectorization_mode="sync"), or a Monitor inside each of the functions that '
        "create them), everything can be recorded."
    )


def is_async(env: VectorEnv) -> bool:
    """Return whether the innermost environment is an AsyncVectorEnv."""
    return isinstance(env.unwrapped, gymnasium.vector.AsyncVectorEnv)


def _timesteps(env: VectorEnv) -> Sequence[float | None]:
    """Return each sub-environment's seconds per step; None if unknown."""
    base: Any = env.unwrapped
    # Requesting a missing attribute from another process would end that process.
    if is_async(env) and all(
        all(base.call("has_wrapper_attr", name)) for name in ("model", "data", "dt")
    ):
        return [float(dt) for dt in base.call("dt")]
    return [None] * env.num_envs


def info_of(infos: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Return one sub-environment's values from a step's `infos`."""
    return {
        name: values[index]
        for name, values in infos.items()
        if not name.startswith("_")
        and not isinstance(values, Mapping)
        and (mask := infos.get(f"_{name}")) is not None
        and mask[index]
    }
