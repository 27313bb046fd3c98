# SPDX-License-Identifier: Apache-2.0
"""Where the pictures of a Gymnasium environment come from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

from ..errors import InvalidArgument
from ..simulation.inside import simulation_in

if TYPE_CHECKING:
    from ..simulation.scene_pictures import ScenePictures

__all__ = ["EnvironmentPictures", "gymnasium_pictures"]


def gymnasium_pictures(
    env: gymnasium.Env[Any, Any],
    *,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
) -> EnvironmentPictures | ScenePictures:
    """Return the source of an environment's pictures.

    Args:
        env: the environment as the user wrapped it.
        camera: a name or number, or an `MjvCamera`; None is the one that the
            environment itself shows.
        height: in pixels; None is the environment's own.
        width: likewise.

    With none of the three the pictures are those of `env.render()`. With one of them
    they are drawn from the live model and data by a renderer of our own; what wrappers
    draw on top of `env.render()` is then not in them.

    Raises:
        InvalidArgument: camera, height or width for what is no MuJoCo environment.
    """
    if camera is None and height is None and width is None:
        return EnvironmentPictures(env)
    simulated = simulation_in(env)
    if simulated is None:
        raise InvalidArgument(
            "camera, height and width choose among the pictures of a MuJoCo "
            f"environment, and {env} has no MuJoCo model and data. Make the "
            "environment itself with the camera and size that the videos are to have."
        )
    # Loaded where there is a simulation, and so mujoco, already: importing mujoco
    # settles its OpenGL backend, which is not ours to do for a CartPole.
    from ..simulation.scene_pictures import Look, ScenePictures

    return ScenePictures(
        lambda: (simulated.model, simulated.data),
        look=lambda: Look(**_look(simulated, env)),
        camera=camera,
        height=_own_size(simulated, "height") if height is None else height,
        width=_own_size(simulated, "width") if width is None else width,
    )


class EnvironmentPictures:
    """The pictures that `env.render()` gives.

    Args:
        env: the environment as the user wrapped it.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env = env
        self._keeps_frames = _keeps_frames(env)
        self._seen = 0

    @property
    def render_mode(self) -> str | None:
        """The environment's render mode."""
        return self._env.render_mode

    def render(self) -> Any:
        """Return the picture of this moment, or the list of those not seen yet."""
        rendered: Any = self._env.render()
        if self._keeps_frames and isinstance(rendered, list):
            return self._new_ones(rendered)
        return rendered

    def begin_episode(self) -> None:
        """Do nothing: what draws knows of every reset."""

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its pictures."""
        facts: dict[str, Any] = {"pictures": "env.render", "quality": "full"}
        own_facts = getattr(self._env.unwrapped, "picture_facts", None)
        if own_facts is not None:
            # An environment of ours knows better than a look from outside.
            return {**facts, **own_facts()}
        simulated = simulation_in(self._env)
        renderer = getattr(simulated, "mujoco_renderer", None)
        viewer = getattr(renderer, "viewer", None)
        if simulated is not None and viewer is not None:
            from ..simulation.gl_strings import current_gl_strings
            from ..simulation.scene_pictures import camera_label

            facts["camera"] = camera_label(simulated.model, viewer.cam)
            # The viewer's context stays current on the thread that drew.
            facts.update(current_gl_strings())
        return facts

    def close(self) -> None:
        """Do nothing: the environment closes what it draws with."""

    def _new_ones(self, frames: list[Any]) -> list[Any]:
        # A list that did not grow was emptied by a reset.
        first = self._seen if len(frames) > self._seen else 0
        self._seen = len(frames)
        return frames[first:]


def _keeps_frames(env: gymnasium.Env[Any, Any]) -> bool:
    """Tell whether `render` gives all frames every time, old ones too."""
    # What gymnasium.wrappers.RenderCollection(pop_frames=False) does.
    return env.has_wrapper_attr("pop_frames") and not env.get_wrapper_attr("pop_frames")


def _own_size(simulated: Any, name: str) -> int:
    # Gymnasium's default, for environments that do not say.
    return int(getattr(simulated, name, 480))


def _look(simulated: Any, env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return how the environment itself shows its scene, as arguments of `Look`."""
    renderer = getattr(simulated, "mujoco_renderer", None)
    if renderer is None:
        return {}
    if getattr(renderer, "viewer", None) is None and env.render_mode == "rgb_array":
        # Gymnasium settles its camera when it draws for the first time.
        env.render()
    viewer = getattr(renderer, "viewer", None)
    if viewer is None:
        return {}
    return {
        "camera": viewer.cam,
        "scene_option": viewer.vopt,
        "max_geom": renderer.max_geom,
    }
