# SPDX-License-Identifier: Apache-2.0
"""Creation of environments of any framework by name.

A framework is loaded only when one of its environments is created, so choose the OpenGL
backend before that.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..errors import MissingDependency, NoPictures
from .known_names import dm_control_failure
from .named_environment import EnvironmentOptions, NamedEnvironment
from .names import parse_environment_name


def environment_from_name(
    text: str, options: EnvironmentOptions | None = None
) -> NamedEnvironment:
    """Create the environment with the given name.

    If drawing is impossible, it has no frames, and `not_drawn` gives the reason.

    Args:
        text: see `parse_environment_name`.
        options: the options; None for the defaults.

    Raises:
        UnknownName, InvalidArgument: the name or an option is invalid.
        MissingDependency: the framework or another dependency is not installed.
        EnvironmentNotMade, UnreadableFile: creating the environment failed; the cause
            is chained.
    """
    name = parse_environment_name(text)
    options = options or EnvironmentOptions()
    if name.framework == "dm_control":
        try:
            from .dm_control_environments import DmControlEnvironment
        except Exception as error:
            raise dm_control_failure(text, error) from error
        return DmControlEnvironment(text, options)
    from .gymnasium_environments import GymnasiumEnvironment, make_gymnasium

    if name.framework == "mjcf":
        from .mjcf_environments import make_mjcf

        return GymnasiumEnvironment(make_mjcf(Path(name.text), options))
    try:
        return GymnasiumEnvironment(make_gymnasium(text, options))
    except (NoPictures, MissingDependency) as error:
        if not options.frames or "render_mode" in options.kwargs:
            raise
        without = replace(options, frames=False)
        return GymnasiumEnvironment(make_gymnasium(text, without), not_drawn=error)
