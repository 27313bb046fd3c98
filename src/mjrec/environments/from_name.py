# SPDX-License-Identifier: Apache-2.0
"""From a name to an environment of whichever framework the name means."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from .dm_control_failures import dm_control_failure
from .episode_seeds import EpisodeSeeds
from .names import (
    DmControlName,
    EnvironmentName,
    GymnasiumName,
    MjcfName,
    parse_environment_name,
)
from .options import EnvironmentOptions
from .scenes import Scenes


@dataclass(frozen=True, kw_only=True)
class NamedEnvironment:
    """An environment, and how its episodes are run whatever its framework.

    Attributes:
        environment: a `gymnasium.Env` or a `dm_env.Environment`.
        env_id: its name in recordings.
        begin_episode: resets the environment, or a wrapper of it such as a monitor, to
            an episode's seeds and returns the first observation.
        begin_stream: resets the same, seeded with a number for all episodes that
            follow, and returns the first observation. The episode's own seeds are for
            the actions.
        next_episode: resets the same without seeding it: its randomness goes on.
        step: takes the same and an action, and returns the next observation and
            whether it is the episode's last.
        scenes: returns what is known of its pictures and its states.
        step_limit: after how many steps its episodes end.
        draws_when_made: its model depends on the seed that it was made with.
        view: `camera`, `height` and `width` as far as the monitor is to be given
            them; empty where the environment itself shows what was asked for.
    """

    environment: Any
    env_id: str
    begin_episode: Callable[[Any, EpisodeSeeds], Any]
    begin_stream: Callable[[Any, int, EpisodeSeeds], Any]
    next_episode: Callable[[Any, EpisodeSeeds], Any]
    step: Callable[[Any, Any], tuple[Any, bool]]
    scenes: Callable[[], Scenes]
    step_limit: int
    draws_when_made: bool = False
    view: dict[str, Any] = field(default_factory=dict)

    def has_deferrable_pictures(self) -> bool:
        """Tell whether what it shows can be drawn from its states."""
        scenes = self.scenes()
        return scenes.states is not None and scenes.obstacle is None


def environment_from_name(
    name: str | EnvironmentName, options: EnvironmentOptions | None = None
) -> NamedEnvironment:
    """Return the environment that `name` means.

    Frameworks are loaded only when one of their environments is asked for: choose the
    GL backend before.

    Args:
        name: see `parse_environment_name`.
        options: how it is made; the defaults, if None.

    Raises:
        UnknownName, InvalidArgument: the name, or an option, means nothing.
        NoPictures: there is nothing to record of it.
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
        case MjcfName():
            return _mjcf(name, options)


# Each of the modules imported below loads a framework, and a name asks for one.


def _gymnasium(env_id: str, options: EnvironmentOptions) -> NamedEnvironment:
    from . import gymnasium_environments as module
    from .gymnasium_scenes import gymnasium_scenes

    environment = module.make_gymnasium(env_id, options)
    return NamedEnvironment(
        environment=environment,
        env_id=_id_of(environment),
        begin_episode=module.begin_episode,
        begin_stream=module.begin_stream,
        next_episode=module.next_episode,
        step=module.step,
        scenes=lambda: gymnasium_scenes(environment),
        step_limit=_step_limit(environment),
    )


def _mjcf(name: MjcfName, options: EnvironmentOptions) -> NamedEnvironment:
    from . import gymnasium_environments as module
    from .gymnasium_scenes import gymnasium_scenes
    from .mjcf_environments import make_mjcf

    environment = make_mjcf(name.path, options)
    return NamedEnvironment(
        environment=environment,
        env_id=_id_of(environment),
        begin_episode=module.begin_episode,
        begin_stream=module.begin_stream,
        next_episode=module.next_episode,
        step=module.step,
        scenes=lambda: gymnasium_scenes(environment),
        step_limit=_step_limit(environment),
    )


def _dm_control(name: DmControlName, options: EnvironmentOptions) -> NamedEnvironment:
    try:
        from . import dm_control_environments as module
    except Exception as error:
        raise dm_control_failure(str(name), error) from error
    environment = module.make_dm_control(name.domain, name.task, options)
    from .dm_control_scenes import dm_control_scenes

    return NamedEnvironment(
        environment=environment,
        env_id=str(name),
        begin_episode=module.begin_episode,
        begin_stream=module.begin_stream,
        next_episode=module.next_episode,
        step=module.step,
        scenes=lambda: dm_control_scenes(environment),
        step_limit=module.step_limit(environment),
        draws_when_made=module.draws_when_made(environment),
        view=_dm_control_view(environment, options),
    )


def _id_of(environment: Any) -> str:
    return str(environment.spec.id)


def _step_limit(environment: Any) -> int:
    # Environments that are made from names always have one.
    return int(environment.spec.max_episode_steps)


def _dm_control_view(environment: Any, options: EnvironmentOptions) -> dict[str, Any]:
    if not options.pictures:
        return {}
    from ..simulation.cameras import default_camera, resolve_camera

    model = environment.physics.model
    if options.camera is None:
        return {"camera": default_camera(model), **options.size}
    resolve_camera(model, options.camera)
    return {"camera": options.camera, **options.size}
