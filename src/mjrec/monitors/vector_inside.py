# SPDX-License-Identifier: Apache-2.0
"""Recording sub-environments that are objects in this process."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium

from ..environments.gymnasium_pictures import close_environment, free_viewers
from ..errors import Error, InvalidArgument
from ..recorder.declared_rate import declared_rate
from ..recorder.options import RecorderOptions
from ..rendering.background import Background
from ..simulation.inside import simulation_time
from .gymnasium_monitor import GymnasiumMonitor, env_id_of
from .vector_recording import VectorRecording, opened_together, options_of

_Env = gymnasium.Env[Any, Any]


def environments_inside(
    env: gymnasium.vector.VectorEnv[Any, Any, Any],
) -> list[_Env] | None:
    """Return the list of a vector environment's sub-environments.

    It is the vector environment's own list. None where they are elsewhere, or nowhere.
    """
    envs = getattr(env.unwrapped, "envs", None)
    if not isinstance(envs, list) or not envs or len(envs) != env.num_envs:
        return None
    return envs if all(isinstance(each, gymnasium.Env) for each in envs) else None


class InsideRecording(VectorRecording):
    """Puts a `GymnasiumMonitor` in the place of each sub-environment.

    So every episode is recorded as that of an environment of its own, whoever resets
    it and when.

    Args:
        env: the vector environment.
        envs: its list of sub-environments.
        directory: the monitor directory.
        options: what was asked for.
        view: `camera`, `height` and `width`.
        env_id: the name of the sub-environments; None is that of their specs.
    """

    def __init__(
        self,
        env: gymnasium.vector.VectorEnv[Any, Any, Any],
        envs: list[_Env],
        directory: str | os.PathLike[str],
        options: RecorderOptions,
        *,
        view: Mapping[str, Any],
        env_id: str | None,
    ) -> None:
        self._env = env
        self._envs = envs
        self._originals = list(envs)
        self._closing = _Closing()
        shared = None
        if options.workers != 0:
            shared = Background(
                directory, workers=options.workers, strict=options.strict
            )
        env_id = env_id or _common_env_id(envs)
        # A tiled video of several cameras is each sub-environment's own.
        tiled = options.tiled and isinstance(view["camera"], list | tuple)
        options = dataclasses.replace(options, tiled=tiled)
        monitored: list[_Env] = []
        with opened_together(directory) as monitors:
            self._closing.how = _leave_open
            for index, each in enumerate(envs):
                monitor = GymnasiumMonitor(
                    each,
                    directory,
                    options_of(index, options),
                    **view,
                    env_id=env_id,
                    env_index=index,
                    rendering=None if shared is None else lambda _: shared.share(),
                    close_environment=self._closing,
                )
                monitors.append(monitor)
                monitored.append(monitor)
        self._closing.how = close_environment
        super().__init__(
            monitors,
            shared=shared,
            clock=functools.partial(simulation_time, envs[0]),
            declared=functools.partial(declared_rate, envs[0]),
        )
        envs[:] = monitored

    def reset(
        self, which: list[int], *, seed: Any, options: dict[str, Any] | None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the vector environment; the monitors inside it record that."""
        result: tuple[Any, dict[str, Any]]
        result = self._env.reset(seed=seed, options=options)
        if any(self.monitors[index]._recorder.done is None for index in which):
            raise Error(
                f"{type(self._env.unwrapped).__name__} was reset, and did not reset "
                "the environments in its list `envs`, so that nothing could be "
                "recorded. Put Monitor around each of them, inside the functions that "
                "make them, with resume=True."
            )
        return result

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the vector environment; the monitors inside it record that."""
        return self._env.step(actions)

    def close(self) -> None:
        """Finish the recordings; the environments are closed by the vector's own."""
        self._closing.how = free_viewers
        super().close()

    def restore(self) -> None:
        """Put the sub-environments back into their list."""
        self._envs[:] = self._originals


class _Closing:
    """Closes a sub-environment where nobody else does: its monitor calls this.

    Attributes:
        how: what is called.
    """

    how: Callable[[_Env], None]

    def __call__(self, env: _Env) -> None:
        self.how(env)


def _leave_open(env: _Env) -> None:
    """Do nothing."""


def _common_env_id(envs: list[_Env]) -> str:
    ids = {None if each.spec is None else each.spec.id for each in envs}
    if len(ids) > 1:
        names = ", ".join(sorted(str(name) for name in ids))
        raise InvalidArgument(
            f"The sub-environments are not all of one name: {names}. Results in one "
            "directory belong to one environment: give env_id= a name for them all, or "
            "put Monitor around each of them, with a directory of its own."
        )
    return env_id_of(envs[0])
