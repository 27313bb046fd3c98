# SPDX-License-Identifier: Apache-2.0
"""Gymnasium environments that are created by id, with the requested frames."""

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
from .gymnasium_scenes import gymnasium_scenes
from .known_names import newest_versions
from .named_environment import EnvironmentOptions, NamedEnvironment, Step
from .names import working_directory_importable
from .scenes import Scenes

# The render mode for videos, then the one for text recordings.
_PREFERRED_MODES = ("rgb_array", "ansi")

# For each family of Gymnasium's own environments, the extra that installs pygame.
_PYGAME_EXTRAS = {
    "gymnasium.envs.box2d": "box2d",
    "gymnasium.envs.classic_control": "classic-control",
    "gymnasium.envs.toy_text": "toy-text",
}

# Arguments with which a user chooses the view.
_VIEW_ARGUMENTS = ("camera_name", "camera_id", "default_camera_config")


def make_gymnasium(env_id: str, options: EnvironmentOptions) -> gymnasium.Env[Any, Any]:
    """Call `gymnasium.make` to create an environment that is ready for recording.

    If frames are requested, the render mode is `rgb_array`, or `ansi` if the
    environment has only text. A MuJoCo environment shows its model's tracking camera if
    there is one and no other view was requested. The default camera of Gymnasium 1.4
    does not move, so the robot leaves its frame. The environment's own time limit is
    lowered to `max_steps`. Without one, the limit is `max_steps`, or 1000 steps by
    default.

    Args:
        env_id: the id, in a form that `gymnasium.make` accepts: `HalfCheetah-v5`,
            `HalfCheetah` (the latest version) or `module:Id` (the module is imported
            first).
        options: the options; `kwargs` are passed to `gymnasium.make`.

    Raises:
        UnknownName: the id, camera or render mode does not exist.
        InvalidArgument: a camera or size is given, but the environment accepts none.
        NoPictures: the environment has no output that can be recorded.
        MissingDependency: a dependency is not installed.
        EnvironmentNotMade: creating the environment failed for another reason, which is
            chained.
    """
    # The module in `module:Id` may be in the working directory, like a policy's.
    here = working_directory_importable() if ":" in env_id else contextlib.nullcontext()
    with here:
        spec = registered_spec(env_id)
        with _failures_of(spec.id):
            return make_registered(spec, options)


class GymnasiumEnvironment(NamedEnvironment):
    """A Gymnasium environment.

    Args:
        environment: an environment from `make_gymnasium` or `make_mjcf`.
        not_drawn: why the environment was created without frames although frames were
            requested.
    """

    def __init__(
        self, environment: gymnasium.Env[Any, Any], *, not_drawn: Error | None = None
    ) -> None:
        # Environments created from names always have a spec and a limit.
        spec: Any = environment.spec
        self.environment, self.not_drawn = environment, not_drawn
        self.env_id, self.step_limit = spec.id, spec.max_episode_steps

    def begin(self, around: Any, seeds: EpisodeSeeds, seed: int | None) -> Any:
        """Reset, and return the first observation.

        This also seeds the action space, because a policy may sample from it.
        """
        around.action_space.seed(seeds.actions)
        return around.reset(seed=seed)[0]

    def step(self, around: Any, action: Any) -> Step:
        """Take a step, and return its result."""
        return Step(*around.step(action)[:4])

    def scenes(self) -> Scenes:
        """Return how to record the environment's states and draw its frames."""
        return gymnasium_scenes(self.environment)


def make_registered(
    spec: registration.EnvSpec, options: EnvironmentOptions
) -> gymnasium.Env[Any, Any]:
    """Create the environment of a spec, without converting the errors of its code."""
    kwargs = dict(options.kwargs)
    # This is gymnasium.make's value for no limit.
    kwargs["max_episode_steps"] = options.limit(_own_limit(spec, kwargs)) or -1
    if not options.frames:
        return gymnasium.make(spec.id, **kwargs)
    kwargs["render_mode"] = _render_mode(spec, kwargs)
    for name in options.size:
        if name in kwargs:
            raise InvalidArgument(
                f"The {name} of the frames is given twice: as {options.size[name]} and "
                f"among the environment's own arguments as {kwargs[name]!r}."
            )
    try:
        env = gymnasium.make(spec.id, **{**kwargs, **options.size})
    except TypeError as error:
        unknown = (f"unexpected keyword argument {name!r}" for name in options.size)
        if not any(text in str(error) for text in unknown):
            raise
        raise InvalidArgument(
            f"{spec.id} takes no size, because it chooses its own frame size. "
            "Only MuJoCo environments take a size."
        ) from error
    try:
        if env.render_mode is None:
            raise _not_drawn(spec.id, "it ignored render_mode")
        _choose_camera(env, spec.id, kwargs, options.camera)
    except BaseException:
        env.close()
        raise
    return env


def _own_limit(spec: registration.EnvSpec, kwargs: Mapping[str, Any]) -> int | None:
    # This is gymnasium.make's own argument for the limit; -1 means no limit.
    limit = kwargs.get("max_episode_steps", spec.max_episode_steps)
    if limit in (None, -1):
        return None
    if isinstance(limit, bool) or not isinstance(limit, int) or limit < 1:
        raise InvalidArgument(
            "max_episode_steps must be a positive whole number, or -1 for no limit, "
            f"not {limit!r}."
        )
    return limit


def registered_spec(env_id: str) -> registration.EnvSpec:
    """Import the module in `module:Id`, and return an id's spec in the registry."""
    module, colon, name = env_id.rpartition(":")
    if colon:
        try:
            importlib.import_module(module)
        except Exception as error:
            raise EnvironmentNotMade(
                env_id,
                f"importing the module {module!r} raised {_what_was_raised(error)}",
                hint="It must be installed, or be in the working directory.",
            ) from error
    newest = newest_versions(registration.registry)
    spec = registration.registry.get(newest.get(name, name))
    if spec is None:
        raise UnknownName(
            "Gymnasium environment",
            name,
            registration.registry,
            hint="If a package registers its environments on import, put its name "
            "before a colon (gymnasium_robotics:FetchReach-v4). Other names are "
            "dm_control/<domain>-<task> and paths of MJCF files.",
        )
    return spec


@contextlib.contextmanager
def _failures_of(env_id: str) -> Iterator[None]:
    """Convert exceptions raised by third-party code to our own errors."""
    try:
        yield
    except Error:
        raise
    except gymnasium.error.DependencyNotInstalled as error:
        commands = re.findall(r"`([^`]*pip install[^`]*)`", str(error))
        if not commands:
            raise EnvironmentNotMade(env_id, error) from error
        package = getattr(error.__cause__, "name", None) or "a package"
        install = " && ".join(commands)
        raise MissingDependency(package, purpose=env_id, install=install) from error
    except Exception as error:
        raise EnvironmentNotMade(env_id, _what_was_raised(error)) from error


def _what_was_raised(error: Exception) -> str:
    if str(error):
        return f"{type(error).__name__}: {error}"
    # A bare assertion has no message, so include its location.
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {place.filename}, line {place.lineno}"


def _render_mode(spec: registration.EnvSpec, kwargs: Mapping[str, Any]) -> str:
    creator: Any = spec.entry_point
    if creator is None:
        raise EnvironmentNotMade(spec.id, "only its vectorized form is registered")
    if isinstance(creator, str):
        creator = registration.load_env_creator(creator)
    # A function has no metadata, and in a wrapper class it is a property.
    metadata = getattr(creator, "metadata", None)
    modes = metadata.get("render_modes") if isinstance(metadata, dict) else None
    if "render_mode" in kwargs:
        mode = kwargs["render_mode"]
        if mode in (None, "human"):
            raise _not_drawn(spec.id, f"render_mode={mode!r} was requested")
        # Gymnasium itself collects frames from `rgb_array` for `rgb_array_list`.
        if modes is not None and str(mode).removesuffix("_list") not in modes:
            raise UnknownName(f"{spec.id} render mode", mode, modes)
    else:
        # If the modes are unknown, request frames.
        there = _PREFERRED_MODES if modes is None else modes
        mode = next((each for each in _PREFERRED_MODES if each in there), None)
        if mode is None:
            raise _not_drawn(spec.id, f"its render modes are {modes}")
    family = str(getattr(creator, "__module__", "")).rpartition(".")[0]
    if family in _PYGAME_EXTRAS and str(mode).startswith("rgb_array"):
        _check_pygame(spec.id, _PYGAME_EXTRAS[family], has_text="ansi" in (modes or ()))
    return str(mode)


def _not_drawn(env_id: str, why: str) -> NoPictures:
    return NoPictures(
        f"{env_id} cannot be recorded: {why}, but a video needs "
        '"rgb_array", and a text recording "ansi". Record it without videos (schedule '
        '"none"), or choose another environment.'
    )


def _check_pygame(env_id: str, extra: str, *, has_text: bool) -> None:
    """Raise an error now if pygame is missing, instead of at the first frame."""
    if importlib.util.find_spec("pygame") is None:
        text_instead = ' (or record its text: --env-kwargs \'{"render_mode": "ansi"}\')'
        raise MissingDependency(
            "pygame",
            purpose=f"Drawing {env_id}",
            install=f'pip install "gymnasium[{extra}]"{text_instead * has_text}',
        )


def _choose_camera(
    env: gymnasium.Env[Any, Any],
    env_id: str,
    kwargs: Mapping[str, Any],
    asked: str | int | None,
) -> None:
    """Set a MuJoCo environment's camera to the requested or the tracking camera.

    The camera is set on the renderer, because Gymnasium-Robotics' environments accept
    no camera argument.
    """
    chosen = [name for name in _VIEW_ARGUMENTS if name in kwargs]
    if asked is None and chosen:
        return
    if chosen:
        raise InvalidArgument(
            f"The camera is given twice: as {asked!r} and among the environment's own "
            f"arguments as {chosen[0]}={kwargs[chosen[0]]!r}."
        )
    simulated = simulation_in(env)
    renderer = getattr(simulated, "mujoco_renderer", None)
    if renderer is None:
        if asked is not None:
            raise InvalidArgument(
                f"{env_id} has no cameras to choose from: it is not a MuJoCo "
                "environment."
            )
        return
    # Not imported at the top: an environment without MuJoCo must not load it.
    from ..simulation import cameras

    # If an environment shows one of its model's cameras, that was its own choice.
    # Before 1.4, Gymnasium followed the robot.
    if asked is None and renderer.camera_id == cameras.FREE_CAMERA:
        asked = cameras.tracking_camera(simulated.model)
    if asked is not None:
        resolved = cameras.resolve_camera(simulated.model, asked)
        renderer.camera_id = resolved.fixedcamid
