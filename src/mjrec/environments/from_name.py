# SPDX-License-Identifier: Apache-2.0
"""From a name to an environment of whichever framework the name means.

Each framework is loaded only where one of its environments is asked for: choose the GL
backend before.
"""

from __future__ import annotations

from dataclasses import replace

from ..errors import MissingDependency, NoPictures
from .known_names import dm_control_failure
from .named_environment import EnvironmentOptions, NamedEnvironment
from .names import (
    DmControlName,
    EnvironmentName,
    GymnasiumName,
    MjcfName,
    parse_environment_name,
)


def environment_from_name(
    name: str | EnvironmentName, options: EnvironmentOptions | None = None
) -> NamedEnvironment:
    """Return the environment that `name` means.

    Where it cannot be drawn it is made without frames, and says why.

    Args:
        name: see `parse_environment_name`.
        options: how it is made; the defaults, if None.

    Raises:
        UnknownName, InvalidArgument: the name, or an option, means nothing.
        MissingDependency: the framework is not installed, or something else is not.
        EnvironmentNotMade, UnreadableFile: making it failed; the cause is kept.
    """
    if isinstance(name, str):
        name = parse_environment_name(name)
    options = options or EnvironmentOptions()
    match name:
        case GymnasiumName(env_id):
            return _gymnasium(env_id, options)
        case DmControlName():
            return _dm_control(name, options)
        case MjcfName(path):
            from .gymnasium_environments import GymnasiumEnvironment
            from .mjcf_environments import make_mjcf

            return GymnasiumEnvironment(make_mjcf(path, options))


def _gymnasium(env_id: str, options: EnvironmentOptions) -> NamedEnvironment:
    from .gymnasium_environments import GymnasiumEnvironment, make_gymnasium

    try:
        return GymnasiumEnvironment(make_gymnasium(env_id, options))
    except (NoPictures, MissingDependency) as error:
        if not options.frames or "render_mode" in options.kwargs:
            raise
        without = replace(options, frames=False)
        environment = make_gymnasium(env_id, without)
        return GymnasiumEnvironment(environment, not_drawn=error)


def _dm_control(name: DmControlName, options: EnvironmentOptions) -> NamedEnvironment:
    try:
        from .dm_control_environments import DmControlEnvironment
    except Exception as error:
        raise dm_control_failure(str(name), error) from error
    return DmControlEnvironment(name, options)
