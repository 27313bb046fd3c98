# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environments by their ids, with the pictures that were asked for."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import re
import traceback
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
from gymnasium.envs import registration

from ..errors import (
    EnvironmentNotMade,
    Error,
    InvalidArgument,
    MissingDependency,
    NoPictures,
    UnknownName,
)
from ..simulation.find_simulation import simulation_in
from .episode_seeds import EpisodeSeeds
from .options import EnvironmentOptions
from .working_directory import working_directory_importable

# What records as a video, before what records as text.
_PREFERRED_MODES = ("rgb_array", "ansi")

# The extra that draws each family of Gymnasium's own environments, by pygame.
_PYGAME_EXTRAS = {
    "gymnasium.envs.box2d": "box2d",
    "gymnasium.envs.classic_control": "classic-control",
    "gymnasium.envs.toy_text": "toy-text",
}

# Arguments with which a person has chosen the view.
_VIEW_ARGUMENTS = ("camera_name", "camera_id", "default_camera_config")


def make_gymnasium(env_id: str, options: EnvironmentOptions) -> gymnasium.Env[Any, Any]:
    """Return what `gymnasium.make` makes of an id, ready to be recorded.

    With pictures the render mode is `rgb_array`, or `ansi` where the environment has
    only text. A MuJoCo environment shows its model's tracking camera where there is
    one and nothing else was asked for, because the default camera of Gymnasium 1.4
    stays where it is and the robot leaves the picture. The environment's own time
    limit is lowered to `max_steps`, or is 1000 steps where it has none.

    Args:
        env_id: as `gymnasium.make` takes it: `HalfCheetah-v5`, `HalfCheetah` (the
            latest version) or `module:Id` (the module is imported first).
        options: `kwargs` go to `gymnasium.make`.

    Raises:
        UnknownName: there is no such id, camera or render mode.
        InvalidArgument: a camera or size for an environment that takes none.
        NoPictures: the environment draws nothing that can be recorded.
        MissingDependency: something that it needs is not installed.
        EnvironmentNotMade: making it failed otherwise; the cause is kept.
    """
    # The module of `module:Id` may lie in the working directory, as a policy's may.
    here = working_directory_importable() if ":" in env_id else contextlib.nullcontext()
    with here:
        return _make_known(_spec(env_id), options)


def begin_episode(env: gymnasium.Env[Any, Any], seeds: EpisodeSeeds) -> Any:
    """Reset the environment, or a wrapper of it, to an episode's seeds.

    Its action space is seeded too, for policies that sample from it.

    Returns:
        The first observation.
    """
    env.action_space.seed(seeds.actions)
    observation, _ = env.reset(seed=seeds.environment)
    return observation


def begin_stream(env: gymnasium.Env[Any, Any], seed: int, seeds: EpisodeSeeds) -> Any:
    """Reset the environment, seeded for all episodes that follow.

    Args:
        env: the environment, or a wrapper of it.
        seed: of the environment's randomness from here on.
        seeds: of this episode; only the action space takes one.

    Returns:
        The first observation.
    """
    env.action_space.seed(seeds.actions)
    observation, _ = env.reset(seed=seed)
    return observation


def next_episode(env: gymnasium.Env[Any, Any], seeds: EpisodeSeeds) -> Any:
    """Reset the environment, whose randomness goes on where it is.

    Args:
        env: the environment, or a wrapper of it.
        seeds: of this episode; only the action space takes one.

    Returns:
        The first observation.
    """
    env.action_space.seed(seeds.actions)
    observation, _ = env.reset()
    return observation


def step(env: gymnasium.Env[Any, Any], action: Any) -> tuple[Any, bool]:
    """Return the next observation, and whether it is the episode's last."""
    observation, _, terminated, truncated, _ = env.step(action)
    return observation, bool(terminated or truncated)


def _make_known(
    spec: registration.EnvSpec, options: EnvironmentOptions
) -> gymnasium.Env[Any, Any]:
    kwargs = dict(options.kwargs)
    kwargs["max_episode_steps"] = options.limit(_own_limit(spec, kwargs))
    if not options.pictures:
        return _make(spec, kwargs)
    kwargs["render_mode"] = _render_mode(spec, kwargs)
    return _make_drawn(spec, kwargs, options)


def _own_limit(spec: registration.EnvSpec, kwargs: Mapping[str, Any]) -> int | None:
    # gymnasium.make's own word for the limit, -1 for none.
    limit = kwargs.get("max_episode_steps", spec.max_episode_steps)
    if limit in (None, -1):
        return None
    if isinstance(limit, bool) or not isinstance(limit, int) or limit < 1:
        raise InvalidArgument(
            "max_episode_steps must be a positive whole number, or -1 for no limit, "
            f"got {limit!r}."
        )
    return limit


def _spec(env_id: str) -> registration.EnvSpec:
    module, colon, name = env_id.rpartition(":")
    if colon:
        _import_registering_module(module, env_id)
    spec = registration.registry.get(name) or _latest_version(name)
    if spec is None:
        raise UnknownName(
            "Gymnasium environment",
            name,
            registration.registry,
            hint="A package that registers its environments when it is imported is "
            "named before a colon (gymnasium_robotics:FetchReach-v4); other names are "
            "dm_control/<domain>-<task> and paths of MJCF files.",
        )
    return spec


def _import_registering_module(module: str, env_id: str) -> None:
    try:
        importlib.import_module(module)
    except Exception as error:
        raise EnvironmentNotMade(
            env_id,
            f"importing the module {module!r} gave {_what_was_raised(error)}",
            hint="It must be installed, or lie in the working directory.",
        ) from error


def _latest_version(name: str) -> registration.EnvSpec | None:
    try:
        namespace, base, version = registration.parse_env_id(name)
    except gymnasium.error.Error:
        return None
    if version is not None:
        return None
    latest = registration.find_highest_version(namespace, base)
    return registration.registry.get(registration.get_env_id(namespace, base, latest))


def _make(
    spec: registration.EnvSpec, kwargs: Mapping[str, Any]
) -> gymnasium.Env[Any, Any]:
    with _failures_of(spec.id):
        return gymnasium.make(spec.id, **kwargs)


@contextlib.contextmanager
def _failures_of(env_id: str) -> Iterator[None]:
    """Turn whatever third-party code raises into one error of ours."""
    try:
        yield
    except Error:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        raise _missing_dependency(env_id, error) from error
    except Exception as error:
        raise EnvironmentNotMade(env_id, _what_was_raised(error)) from error


def _missing_dependency(env_id: str, error: Exception) -> Error:
    commands = re.findall(r"`([^`]*pip install[^`]*)`", str(error))
    if not commands:
        return EnvironmentNotMade(env_id, error)
    package = getattr(error.__cause__, "name", None) or "a package"
    return MissingDependency(package, purpose=env_id, install=" && ".join(commands))


def _what_was_raised(error: Exception) -> str:
    if str(error):
        return f"{type(error).__name__}: {error}"
    # A bare assertion says nothing but where it stands.
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {place.filename}, line {place.lineno}"


def _render_mode(spec: registration.EnvSpec, kwargs: Mapping[str, Any]) -> str:
    with _failures_of(spec.id):
        creator = _creator(spec)
    modes = _render_modes(creator)
    mode = _chosen_mode(spec.id, modes, kwargs)
    _check_pygame(spec.id, creator, mode, modes)
    return mode


def _creator(spec: registration.EnvSpec) -> Any:
    if isinstance(spec.entry_point, str):
        return registration.load_env_creator(spec.entry_point)
    if spec.entry_point is None:
        raise EnvironmentNotMade(spec.id, "only its vectorised form is registered")
    return spec.entry_point


def _render_modes(creator: Any) -> list[str] | None:
    """Return the modes that a creator declares; None for one that says nothing."""
    metadata = getattr(creator, "metadata", None)
    # A function has none, and on a wrapper's class it is a property.
    if not isinstance(metadata, dict):
        return None
    return list(metadata.get("render_modes") or [])


def _chosen_mode(
    env_id: str, modes: list[str] | None, kwargs: Mapping[str, Any]
) -> str:
    if "render_mode" in kwargs:
        return _checked_mode(env_id, modes, kwargs["render_mode"])
    if modes is None:
        return _PREFERRED_MODES[0]
    for mode in _PREFERRED_MODES:
        if mode in modes:
            return mode
    raise _no_pictures(env_id, f"its render modes are {modes}")


def _checked_mode(env_id: str, modes: list[str] | None, mode: Any) -> str:
    if mode in (None, "human"):
        raise _no_pictures(env_id, f"render_mode={mode!r} was asked for")
    # Gymnasium itself collects the pictures of `rgb_array` into `rgb_array_list`.
    if modes is not None and str(mode).removesuffix("_list") not in modes:
        raise UnknownName(f"render mode of {env_id}", mode, modes)
    return str(mode)


def _no_pictures(env_id: str, why: str) -> NoPictures:
    return NoPictures(
        f"There is nothing to record of {env_id}: {why}, and a video needs "
        '"rgb_array", a text recording "ansi". Record it without videos (schedule '
        '"none"), or choose another environment.'
    )


def _check_pygame(
    env_id: str, creator: Any, mode: str, modes: list[str] | None
) -> None:
    """Say before the first episode what would fail at its first picture."""
    family = str(getattr(creator, "__module__", "")).rpartition(".")[0]
    extra = _PYGAME_EXTRAS.get(family)
    drawn = mode.startswith("rgb_array")
    if extra is None or not drawn or importlib.util.find_spec("pygame") is not None:
        return
    text_instead = (
        ' (or record its text: --env-kwargs \'{"render_mode": "ansi"}\')'
        if "ansi" in (modes or [])
        else ""
    )
    raise MissingDependency(
        "pygame",
        purpose=f"Drawing {env_id}",
        install=f'pip install "gymnasium[{extra}]"{text_instead}',
    )


def _make_drawn(
    spec: registration.EnvSpec, kwargs: dict[str, Any], options: EnvironmentOptions
) -> gymnasium.Env[Any, Any]:
    env = _make_sized(spec, kwargs, options.size)
    try:
        if env.render_mode is None:
            raise _no_pictures(spec.id, "it took no render mode")
        camera = _camera(env, spec.id, kwargs, options.camera)
    except BaseException:
        env.close()
        raise
    if camera is None:
        return env
    return _make_with_camera(spec, {**kwargs, **options.size}, env, camera)


def _make_sized(
    spec: registration.EnvSpec, kwargs: dict[str, Any], size: dict[str, int]
) -> gymnasium.Env[Any, Any]:
    for name in size:
        if name in kwargs:
            raise InvalidArgument(
                f"The {name} of the pictures is given twice: as {size[name]} and "
                f"among the environment's own arguments as {kwargs[name]!r}."
            )
    try:
        return _make(spec, {**kwargs, **size})
    except EnvironmentNotMade as error:
        if not _refuses(error, size):
            raise
        raise InvalidArgument(
            f"{spec.id} takes no size: its pictures have the size that it chooses. "
            "Only MuJoCo environments can be given one."
        ) from error.__cause__


def _refuses(error: EnvironmentNotMade, arguments: Mapping[str, Any]) -> bool:
    """Tell whether making failed because an argument is not known."""
    return isinstance(error.__cause__, TypeError) and any(
        f"unexpected keyword argument {name!r}" in str(error) for name in arguments
    )


def _camera(
    env: gymnasium.Env[Any, Any],
    env_id: str,
    kwargs: Mapping[str, Any],
    asked: str | int | None,
) -> str | int | None:
    """Return the camera that the environment is to be given; None for none."""
    chosen = [name for name in _VIEW_ARGUMENTS if name in kwargs]
    if asked is None and chosen:
        return None
    if chosen:
        raise InvalidArgument(
            f"The camera is given twice: as {asked!r} and among the environment's own "
            f"arguments as {chosen[0]}={kwargs[chosen[0]]!r}."
        )
    simulated = _simulated(env)
    if simulated is not None:
        return _camera_of_model(simulated, asked)
    if asked is not None:
        raise InvalidArgument(
            f"{env_id} has no cameras to choose from: it is not a MuJoCo environment."
        )
    return None


def _camera_of_model(simulated: Any, asked: str | int | None) -> str | int | None:
    cameras = _cameras()
    if asked is not None:
        cameras.resolve_camera(simulated.model, asked)
        return asked
    # An environment that shows one of its model's cameras has made its own choice, and
    # Gymnasium before 1.4 has followed the robot.
    if getattr(simulated.mujoco_renderer, "camera_id", None) != cameras.FREE_CAMERA:
        return None
    tracking: str | int | None = cameras.tracking_camera(simulated.model)
    return tracking


def _make_with_camera(
    spec: registration.EnvSpec,
    kwargs: dict[str, Any],
    env: gymnasium.Env[Any, Any],
    camera: str | int,
) -> gymnasium.Env[Any, Any]:
    """Return `env` with another camera, made anew where it takes one.

    Made so, its spec says what it shows.
    """
    argument = "camera_name" if isinstance(camera, str) else "camera_id"
    try:
        with_camera = _make(spec, {**kwargs, argument: camera})
    except EnvironmentNotMade as error:
        # Gymnasium-Robotics' environments take none, and their renderer has one.
        if _refuses(error, {argument: camera}):
            _set_camera(_simulated(env), camera)
            return env
        env.close()
        raise
    except BaseException:
        env.close()
        raise
    env.close()
    return with_camera


def _set_camera(simulated: Any, camera: str | int) -> None:
    resolved = _cameras().resolve_camera(simulated.model, camera)
    simulated.mujoco_renderer.camera_id = resolved.fixedcamid


def _simulated(env: gymnasium.Env[Any, Any]) -> Any:
    """Return the object inside `env` with MuJoCo's model and Gymnasium's renderer."""
    simulation = simulation_in(env)
    return simulation if hasattr(simulation, "mujoco_renderer") else None


def _cameras() -> Any:
    # Not imported above, because a Gymnasium environment that has no use for MuJoCo
    # must not load it.
    from ..simulation import cameras

    return cameras
