# SPDX-License-Identifier: Apache-2.0
"""Creation of an environment of any framework from its name.

A framework is loaded only when one of its environments is created. So choose the GL
backend first.
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
    """Create the environment with the given name.

    If it cannot be drawn, it is created without frames, and `not_drawn` says why.

    Args:
        name: see `parse_environment_name`.
        options: the options; None for the defaults.

    Raises:
        UnknownName, InvalidArgument: the name or an option is invalid.
        MissingDependency: the framework or another dependency is not installed.
        EnvironmentNotMade, UnreadableFile: creating the environment failed; the cause
            is chained.
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
