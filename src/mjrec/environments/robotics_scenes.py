# SPDX-License-Identifier: Apache-2.0
"""What Gymnasium-Robotics' environments do before a picture is drawn.

The package is not imported: its environments exist only where it is loaded.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from .scenes import is_defined_by

_MAZES = "gymnasium_robotics.envs.maze"

# Environments whose `render` is that of an environment inside them: the module, the
# function, and the attribute with what is inside.
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

_ROBOT_ENV = "gymnasium_robotics.envs.robot_env"


def drawn_part(base: Any) -> Any:
    """Return the environment that a maze or a kitchen shows; others show themselves.

    Args:
        base: an environment without its wrappers.
    """
    render = getattr(type(base), "render", None)
    for module, function, attribute in _DELEGATING:
        if is_defined_by(render, module, function):
            return getattr(base, attribute)
    return base


def has_known_render(drawn: Any) -> bool:
    """Tell whether an environment shows itself as Gymnasium-Robotics' robots do."""
    render = getattr(type(drawn), "render", None)
    return is_defined_by(render, _ROBOT_ENV, "MujocoRobotEnv.render")


def picture_moment(drawn: Any) -> Callable[[Callable[[], None]], None] | None:
    """Return what makes the moment at which an environment draws itself.

    Fetch's and the hand's environments move their goal's markers, and call
    `mj_forward`, in each `render`; so a picture changes what happens afterwards. What
    is returned calls `render` with something else in the place of what draws, and puts
    the simulation back afterwards: the picture is the one that `render` gives, and the
    episode is the one that nobody looked at.

    Args:
        drawn: an environment without its wrappers.

    Returns:
        A function that calls its argument in that moment; None where there is no such
        moment, because drawing the environment changes nothing.
    """
    callback = getattr(type(drawn), "_render_callback", None)
    if not has_known_render(drawn) or is_defined_by(
        callback, _ROBOT_ENV, "BaseRobotEnv._render_callback"
    ):
        return None
    # Loaded where there is a simulation, and so mujoco, already.
    from ..simulation.replay import PreservedState

    simulation = PreservedState()

    def at_picture(capture: Callable[[], None]) -> None:
        with (
            simulation.around(drawn.model, drawn.data),
            _drawing_instead(drawn.mujoco_renderer, capture),
        ):
            drawn.render()

    return at_picture


@contextlib.contextmanager
def _drawing_instead(renderer: Any, capture: Callable[[], None]) -> Iterator[None]:
    """Let `renderer.render` call `capture`, for the block, and draw nothing."""
    # On the object, where it hides the class's own until it is deleted.
    renderer.render = lambda *_args, **_kwargs: capture()
    try:
        yield
    finally:
        del renderer.render
