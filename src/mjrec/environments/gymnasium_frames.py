# SPDX-License-Identifier: Apache-2.0
"""The sources of a Gymnasium environment's frames."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

import gymnasium

from ..simulation.find_simulation import simulation_in


class EnvironmentFrames:
    """The frames that `env.render()` returns.

    Args:
        env: the environment, as the user wrapped it.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env = env
        # gymnasium.wrappers.RenderCollection(pop_frames=False) returns all frames every
        # time, including old ones.
        has_frames = env.has_wrapper_attr("pop_frames")
        self._keeps_frames = has_frames and not env.get_wrapper_attr("pop_frames")
        self._seen = 0

    @property
    def render_mode(self) -> str | None:
        """The environment's render mode."""
        return self._env.render_mode

    def render(self) -> Any:
        """Return the current frame, or a list of the frames not yet returned."""
        with _own_context(self._env):
            rendered: Any = self._env.render()
        if self._keeps_frames and isinstance(rendered, list):
            # If the list did not grow, a reset has emptied it.
            first = self._seen if len(rendered) > self._seen else 0
            self._seen = len(rendered)
            return rendered[first:]
        return rendered

    def facts(self) -> dict[str, Any]:
        """Return the facts about the frames for a video's metadata."""
        facts: dict[str, Any] = {"pictures": "env.render", "quality": "full"}
        own_facts = getattr(self._env.unwrapped, "frame_facts", None)
        if own_facts is not None:
            # Our own environments have facts that cannot be determined from outside.
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


def close_environment(env: gymnasium.Env[Any, Any]) -> None:
    """Free everything in an environment's OpenGL contexts, and then close it."""
    free_viewers(env)
    env.close()


def free_viewers(env: gymnasium.Env[Any, Any]) -> None:
    """Free everything in an environment's OpenGL contexts, just before it is closed.

    Gymnasium leaves this to the garbage collector, which frees objects in whichever
    context is then current. As a result, another viewer's frames turn black.
    """
    for viewer in getattr(_renderer(env), "_viewers", {}).values():
        with _current(viewer):
            viewer.con.free()
            viewer.free()


def _own_context(env: gymnasium.Env[Any, Any]) -> AbstractContextManager[None]:
    """Return a context manager for drawing in Gymnasium's OpenGL context.

    Gymnasium makes its context current only when creating it. If two environments
    alternated, one would be drawn with the other's meshes and textures, or not at all.
    The previous context is current again after the block.
    """
    renderer = _renderer(env)
    return contextlib.nullcontext() if renderer is None else _current(renderer.viewer)


@contextlib.contextmanager
def _current(viewer: Any) -> Iterator[None]:
    """Make a viewer's context, if any, current inside the block."""
    from ..simulation.gl_context import collection_paused, context_kept

    with context_kept(), collection_paused():
        if viewer is not None:
            viewer.make_context_current()
        yield


def _renderer(env: gymnasium.Env[Any, Any]) -> Any:
    """Return Gymnasium's renderer for a MuJoCo environment, or None for other types."""
    return getattr(simulation_in(env), "mujoco_renderer", None)
