# SPDX-License-Identifier: Apache-2.0
"""The states of a Gymnasium environment, and whether they determine its frames."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from ..errors import InvalidArgument
from ..simulation.find_simulation import simulation_in
from .gymnasium_frames import EnvironmentFrames
from .scenes import (
    NoFrameSource,
    Scenes,
    class_name,
    generator_state,
    has_own_method,
    is_defined_by,
    plain_arguments,
    render_override,
)
from .wrapping import around_gymnasium

if TYPE_CHECKING:
    from ..simulation.capture import Capture
    from ..simulation.model_sources import AuthoredModel
    from .viewer_scene import ViewerScene

_RENDERING = "gymnasium.envs.mujoco.mujoco_rendering"
_RENDERER = (_RENDERING, "MujocoRenderer.render")

# A package in Gymnasium-Robotics. It is not imported here, because its environments
# exist only if it is already loaded.
_MAZES = "gymnasium_robotics.envs.maze"

# Environments whose `render` calls the method of an inner environment: the module, the
# function, and the attribute that holds the inner environment.
_DELEGATING = (
    (f"{_MAZES}.point_maze", "PointMazeEnv.render", "point_env"),
    (f"{_MAZES}.ant_maze_v3", "AntMazeEnv.render", "ant_env"),
    (f"{_MAZES}.ant_maze_v4", "AntMazeEnv.render", "ant_env"),
    (f"{_MAZES}.ant_maze_v5", "AntMazeEnv.render", "ant_env"),
    (
        "gymnasium_robotics.envs.franka_kitchen.kitchen_env",
        "KitchenEnv.render",
        "robot_env",
    ),
)

_ANOTHER_VIEW = (
    "with camera, height or width, the frames differ from those of render(), and are "
    "drawn from recorded states, never live. Pass these to the environment "
    "(camera_name=, height=, width=), or leave out render="
)

_ROBOT_ENV = "gymnasium_robotics.envs.robot_env"
# The functions that draw only the simulation.
_DRAWING = (
    ("gymnasium.envs.mujoco.mujoco_env", "MujocoEnv.render"),
    (_ROBOT_ENV, "MujocoRobotEnv.render"),
)

# Wrappers whose `render` passes on the frame unchanged. RecordVideo does so for single
# frames; array conversion changes the array type, not the values.
_PASSING_ON = (
    ("gymnasium.core", "Wrapper.render"),
    ("gymnasium.wrappers.common", "OrderEnforcing.render"),
    ("gymnasium.wrappers.common", "PassiveEnvChecker.render"),
    ("gymnasium.wrappers.rendering", "RecordVideo.render"),
    ("gymnasium.wrappers.array_conversion", "ArrayConversion.render"),
)


def gymnasium_scenes(
    env: gymnasium.Env[Any, Any],
    *,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
) -> Scenes:
    """Return how to record the states of a Gymnasium environment.

    Without a camera, height or width, the frames are those of `env.render()`, and
    anything that overrides `render` is an obstacle. If any of these is given, the
    frames show only the scene, without anything drawn on top by a wrapper, and there
    are no live frames.

    Args:
        env: the environment, as the user wrapped it.
        camera: a name, a number or an `MjvCamera`; None for the camera that the
            environment itself shows.
        height: height in pixels; None for the environment's own.
        width: width in pixels; None for the environment's own.

    Raises:
        UnknownName: the model has no such camera.
        InvalidArgument: the camera's number or the size is invalid, or a camera or size
            is given although the environment has no MuJoCo simulation.
    """
    view = {"camera": camera, "height": height, "width": width}
    own_view = any(asked is not None for asked in view.values())
    base: Any = env.unwrapped
    # Our own environments describe themselves.
    own = getattr(type(base), "mjrec_scenes", None)
    scenes = own(base, **view) if own else _scenes(env, base, view)
    if own_view and scenes.states is None:
        raise InvalidArgument(
            "camera, height and width require a MuJoCo environment, but "
            f"{env} has no MuJoCo model and data. Create the environment itself with "
            "the camera and size that the videos should have."
        )
    obstacle = None if own_view else _override_above(env) or scenes.obstacle
    environment = scenes.environment
    if environment is not None:
        environment = {**environment, **around_gymnasium(env)}
    return dataclasses.replace(
        scenes,
        obstacle=obstacle,
        environment=environment,
        frames=NoFrameSource(_ANOTHER_VIEW) if own_view else EnvironmentFrames(env),
        own_view=_own_view(env),
    )


def _own_view(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    shown = drawn_part(env.unwrapped)
    chosen = getattr(getattr(shown, "mujoco_renderer", shown), "camera_id", None)
    if chosen is None and has_own_scenes(shown):
        chosen = shown.camera
    is_named = isinstance(chosen, int | str) and chosen != -1
    return {"own_camera": chosen} if is_named else {}


def set_own_camera(env: gymnasium.Env[Any, Any], camera: int | str) -> None:
    """Set an environment's own camera to a recorded `own_camera`."""
    shown = drawn_part(env.unwrapped)
    if has_own_scenes(shown):
        shown.camera = camera
    elif (renderer := getattr(shown, "mujoco_renderer", None)) is not None:
        renderer.camera_id = camera


def has_own_scenes(base: Any) -> bool:
    """Return whether an environment is one of our own, which define `mjrec_scenes`."""
    return hasattr(type(base), "mjrec_scenes")


def drawn_part(base: Any) -> Any:
    """Return the inner environment that a maze or kitchen shows, or `base` itself.

    Args:
        base: an environment without its wrappers.
    """
    render = getattr(type(base), "render", None)
    for module, function, attribute in _DELEGATING:
        if is_defined_by(render, module, function):
            return getattr(base, attribute)
    return base


def _scenes(env: gymnasium.Env[Any, Any], base: Any, view: dict[str, Any]) -> Scenes:
    shown = drawn_part(base)
    simulated = shown if simulation_in(shown) is shown else simulation_in(env)
    return Scenes(
        states=None if simulated is None else _states(simulated, view),
        obstacle=_obstacle(base, shown),
        environment=_environment(base),
        random_state=lambda: random_state(base),
    )


def _override_above(env: gymnasium.Env[Any, Any]) -> str | None:
    """Return the reason why a wrapper changes the environment's frames, or None."""
    mode = env.render_mode
    while isinstance(env, gymnasium.Wrapper):
        override = render_override("wrapper", env, _PASSING_ON)
        if override is not None:
            return override
        env = env.env
    return _wrong_mode(mode)


def _obstacle(base: Any, shown: Any) -> str | None:
    """Return why an environment's frames show more than the simulation, or None.

    Args:
        base: the environment without its wrappers.
        shown: the inner environment that is drawn.
    """
    delegating = [(module, function) for module, function, _ in _DELEGATING]
    override = render_override("environment", base, [*delegating, *_DRAWING])
    override = override or render_override("environment", shown, _DRAWING)
    if override is not None:
        return override
    renderer = getattr(shown, "mujoco_renderer", None)
    return _wrong_mode(shown.render_mode) or _foreign_renderer(renderer)


def _wrong_mode(mode: str | None) -> str | None:
    if mode in (None, "rgb_array"):
        return None
    return (
        f"its render_mode is {mode!r}, but only frames of 'rgb_array' can be drawn "
        "from states"
    )


def _foreign_renderer(renderer: Any) -> str | None:
    kind = type(renderer)
    own = is_defined_by(getattr(kind, "render", None), *_RENDERER)
    if own and kind.__module__ == _RENDERING and not has_own_method(renderer, "render"):
        return None
    return f"the renderer {class_name(kind)} is not Gymnasium's own"


def _states(simulated: Any, view: dict[str, Any]) -> Capture:
    # Imported only here, where mujoco is already loaded. Its import chooses an OpenGL
    # backend, which must not happen for an environment without MuJoCo.
    from ..simulation.capture import Capture
    from .viewer_scene import ViewerScene

    scene = ViewerScene(simulated, **view)
    own_view = any(asked is not None for asked in view.values())
    return Capture(
        lambda: (simulated.model, simulated.data),
        view=scene,
        forget=scene.forget,
        at_frame=_at_frame(simulated, scene),
        authored=lambda: _authored(simulated),
        obstacle=(lambda: None) if own_view else scene.obstacle,
        is_unmoved=None if frame_moment(simulated) else scene.is_unmoved,
    )


def _at_frame(
    simulated: Any, scene: ViewerScene
) -> Callable[[Callable[[], None]], None]:
    moment = frame_moment(simulated)
    if moment is None:
        return scene.at_frame
    return lambda capture: moment(lambda: scene.at_frame(capture))


def _is_robot(drawn: Any) -> bool:
    """Return whether an environment renders like Gymnasium-Robotics' robots."""
    render = getattr(type(drawn), "render", None)
    return is_defined_by(render, _ROBOT_ENV, "MujocoRobotEnv.render")


def frame_moment(drawn: Any) -> Callable[[Callable[[], None]], None] | None:
    """Return a function that captures an environment's state at the moment of drawing.

    The Fetch and hand environments move their goal markers and call `mj_forward` in
    each `render`, so a frame affects the rest of the episode. The returned function
    calls `render`, replacing only the drawing itself, and then restores the simulation.
    So the frame is the same as a frame from `render`, and the episode is the same as
    without rendering.

    Args:
        drawn: an environment without its wrappers.

    Returns:
        A function that calls its argument at that moment, or None if drawing the
        environment changes nothing.
    """
    callback = getattr(type(drawn), "_render_callback", None)
    if not _is_robot(drawn) or is_defined_by(
        callback, _ROBOT_ENV, "BaseRobotEnv._render_callback"
    ):
        return None
    # Imported only here, where mujoco is already loaded.
    from ..simulation.states import PreservedState

    simulation = PreservedState()

    def at_frame(capture: Callable[[], None]) -> None:
        with (
            simulation.around(drawn.model, drawn.data),
            _drawing_instead(drawn.mujoco_renderer, capture),
        ):
            drawn.render()

    return at_frame


@contextlib.contextmanager
def _drawing_instead(renderer: Any, capture: Callable[[], None]) -> Iterator[None]:
    """Make `renderer.render` call `capture` inside the block, and draw nothing."""
    # The instance's attribute hides the class's method until the attribute is deleted.
    renderer.render = lambda *_args, **_kwargs: capture()
    try:
        yield
    finally:
        del renderer.render


def _authored(simulated: Any) -> AuthoredModel | None:
    from ..simulation.model_sources import authored_from_file

    path = getattr(simulated, "fullpath", None)
    return None if path is None else authored_from_file(Path(path))


def _environment(base: gymnasium.Env[Any, Any]) -> dict[str, Any] | None:
    # Only the innermost environment has its own spec; wrappers copy it.
    if base.spec is None:
        return None
    return {
        "framework": "gymnasium",
        "id": base.spec.id,
        "kwargs": plain_arguments(base.spec.kwargs),
    }


def random_state(base: Any) -> Any:
    """Return the generator states of an environment and its inner environment.

    Args:
        base: an environment without its wrappers.
    """
    shown = drawn_part(base)
    # Gymnasium's public property would create a generator.
    own = generator_state(base._np_random)
    if shown is base:
        return own
    return {"env": own, "inner": generator_state(shown._np_random)}
