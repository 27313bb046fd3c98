# SPDX-License-Identifier: Apache-2.0
"""Where the frames of a Gymnasium environment come from."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import gymnasium

from ..errors import InvalidArgument
from ..simulation.find_simulation import simulation_in
from .scenes import NoFrameSource, simulation_below

_ANOTHER_VIEW = (
    "camera, height and width ask for another frame than render() gives, which is "
    "drawn from recorded states and never live. Make the environment with them "
    "(camera_name=, height=, width=), or leave render= out"
)


def gymnasium_frames(
    env: gymnasium.Env[Any, Any],
    *,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
) -> EnvironmentFrames | NoFrameSource:
    """Return the source of an environment's live frames, which is `env.render()`.

    Args:
        env: the environment as the user wrapped it.
        camera: a name or number, or an `MjvCamera`; None is the one that the
            environment itself shows.
        height: in pixels; None is the environment's own.
        width: likewise.

    With one of the three there are no live frames: workers draw from states.

    Raises:
        UnknownName: the model has no such camera.
        InvalidArgument: camera, height or width for what is no MuJoCo environment.
    """
    if camera is None and height is None and width is None:
        return EnvironmentFrames(env)
    simulated = simulation_below(env)
    if simulated is None:
        raise InvalidArgument(
            "camera, height and width choose among the frames of a MuJoCo "
            f"environment, and {env} has no MuJoCo model and data. Make the "
            "environment itself with the camera and size that the videos are to have."
        )
    if camera is not None:
        # Loaded where there is a simulation, and so mujoco, already: importing mujoco
        # settles its OpenGL backend, which is not ours to do for a CartPole.
        from ..simulation.cameras import resolve_camera

        resolve_camera(simulated.model, camera)
    return NoFrameSource(_ANOTHER_VIEW)


class EnvironmentFrames:
    """The frames that `env.render()` gives.

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
        """Return the frame of this moment, or the list of those not seen yet."""
        with _own_context(self._env):
            rendered: Any = self._env.render()
        if self._keeps_frames and isinstance(rendered, list):
            return self._new_ones(rendered)
        return rendered

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its frames."""
        facts: dict[str, Any] = {"pictures": "env.render", "quality": "full"}
        own_facts = getattr(self._env.unwrapped, "frame_facts", None)
        if own_facts is not None:
            # An environment of ours knows better than a look from outside.
            return {**facts, **own_facts()}
        simulated = simulation_in(self._env)
        viewer = getattr(_renderer(self._env), "viewer", None)
        if simulated is not None and viewer is not None:
            from ..simulation.cameras import camera_label
            from ..simulation.gl_context import current_gl_facts

            facts["camera"] = camera_label(simulated.model, viewer.cam)
            with _own_context(self._env):
                facts.update(current_gl_facts())
        return facts

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
    is current then, and so blackens another viewer's frames.
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
    The context that was current before is current again afterwards.
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
    from ..simulation.gl_context import context_kept

    with context_kept():
        if viewer is not None:
            viewer.make_context_current()
        yield


def _renderer(env: gymnasium.Env[Any, Any]) -> Any:
    """Return what Gymnasium draws a MuJoCo environment with; None for others."""
    return getattr(simulation_in(env), "mujoco_renderer", None)


def _keeps_frames(env: gymnasium.Env[Any, Any]) -> bool:
    """Return whether `render` gives all frames every time, old ones too."""
    # What gymnasium.wrappers.RenderCollection(pop_frames=False) does.
    return env.has_wrapper_attr("pop_frames") and not env.get_wrapper_attr("pop_frames")
