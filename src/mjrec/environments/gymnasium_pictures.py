# SPDX-License-Identifier: Apache-2.0
"""Where the pictures of a Gymnasium environment come from."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import gymnasium

from ..errors import InvalidArgument
from ..simulation.inside import simulation_in

if TYPE_CHECKING:
    from ..simulation.scene_pictures import ScenePictures


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
    # An environment of ours keeps its simulation in an object of its own.
    own = getattr(env.unwrapped, "simulation", None)
    simulated = simulation_in(env) or simulation_in(own)
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
        look=lambda: Look(**_look(simulated, env, camera=camera is None)),
        camera=camera,
        height=_own_size(simulated, env, "height") if height is None else height,
        width=_own_size(simulated, env, "width") if width is None else width,
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
        with _own_context(self._env):
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
        viewer = getattr(_renderer(self._env), "viewer", None)
        if simulated is not None and viewer is not None:
            from ..simulation.gl_strings import current_gl_facts
            from ..simulation.scene_pictures import camera_label

            facts["camera"] = camera_label(simulated.model, viewer.cam)
            with _own_context(self._env):
                facts.update(current_gl_facts())
        return facts

    def close(self) -> None:
        """Do nothing: the environment closes what it draws with."""

    def _new_ones(self, frames: list[Any]) -> list[Any]:
        # A list that did not grow was emptied by a reset.
        first = self._seen if len(frames) > self._seen else 0
        self._seen = len(frames)
        return frames[first:]


def close_environment(env: gymnasium.Env[Any, Any]) -> None:
    """Close an environment, and first free what lies in its OpenGL contexts."""
    free_viewers(env)
    env.close()


def free_viewers(env: gymnasium.Env[Any, Any]) -> None:
    """Free what lies in an environment's OpenGL contexts; it is to be closed next.

    Gymnasium leaves that to the garbage collector, which frees it in whichever context
    is current then, and so blackens somebody else's pictures.
    """
    for viewer in getattr(_renderer(env), "_viewers", {}).values():
        with _current(viewer):
            viewer.con.free()
            viewer.free()


@contextlib.contextmanager
def _own_context(env: gymnasium.Env[Any, Any]) -> Iterator[None]:
    """Make the context that Gymnasium draws with current, for the block.

    Gymnasium itself does so only when it makes the context: of two environments that
    take turns, one would be drawn with the other's meshes and textures, or not at all.
    What was current before, for somebody else's pictures, is so again afterwards.
    """
    renderer = _renderer(env)
    if renderer is None:
        yield
        return
    with _current(renderer.viewer):
        yield


@contextlib.contextmanager
def _current(viewer: Any) -> Iterator[None]:
    """Make a viewer's context current, if there is a viewer; then what was before."""
    from ..simulation.gl_current import current_context_kept

    with current_context_kept():
        if viewer is not None:
            viewer.make_context_current()
        yield


def _renderer(env: gymnasium.Env[Any, Any]) -> Any:
    """Return what Gymnasium draws a MuJoCo environment with; None for others."""
    return getattr(simulation_in(env), "mujoco_renderer", None)


def _keeps_frames(env: gymnasium.Env[Any, Any]) -> bool:
    """Tell whether `render` gives all frames every time, old ones too."""
    # What gymnasium.wrappers.RenderCollection(pop_frames=False) does.
    return env.has_wrapper_attr("pop_frames") and not env.get_wrapper_attr("pop_frames")


def _own_size(simulated: Any, env: gymnasium.Env[Any, Any], name: str) -> int:
    # Gymnasium's default, for environments that do not say.
    return int(getattr(simulated, name, getattr(env.unwrapped, name, 480)))


def _look(
    simulated: Any, env: gymnasium.Env[Any, Any], *, camera: bool
) -> dict[str, Any]:
    """Return how the environment itself shows its scene, as arguments of `Look`.

    Args:
        simulated: holds the model, the data and the renderer.
        env: the same, with its wrappers.
        camera: whether the environment's own camera is wanted. Gymnasium settles it
            when it draws for the first time, and so it is made to.
    """
    renderer = getattr(simulated, "mujoco_renderer", None)
    if renderer is None:
        return {}
    if camera and renderer.viewer is None and env.render_mode == "rgb_array":
        env.render()
    look = {"max_geom": renderer.max_geom}
    viewer = renderer.viewer
    if viewer is None:
        return look
    return {**look, "camera": viewer.cam, "scene_option": viewer.vopt}
