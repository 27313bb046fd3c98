# SPDX-License-Identifier: Apache-2.0
"""A way to reset dm_control environments without OpenGL.

Some tasks (quadruped-escape, the rodent's bowl) create a new terrain in each reset and
upload it to the rendering context. Even checking for a context creates one. If there is
no context, the upload can be skipped, because a context that is created later starts
with the current terrain.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from dm_control.mujoco import engine

_UPLOADS = ("mjr_uploadHField", "mjr_uploadTexture", "mjr_uploadMesh")


class ContextsOnDemand:
    """A guard against contexts that resets would create only to upload to them.

    Args:
        env: an environment with dm_control's `physics`, which each reset may replace.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._is_resetting = False
        self._hooked = False
        self._replaced: list[_Contexts] = []

    @contextlib.contextmanager
    def resetting(self) -> Iterator[None]:
        """Return a context manager for resetting the environment.

        In the block, a physics without contexts has a substitute, which creates real
        contexts as soon as anything is drawn. After the block, even if it raised an
        error, the physics is as it was before.
        """
        self._is_resetting = True
        # If the reset compiles a new physics, this hook gets it in time.
        if not self._hooked and hasattr(self._env, "add_extra_hook"):
            # Composer cannot remove a hook, but this hook does nothing outside resets.
            self._env.add_extra_hook("after_compile", self._stand_in)
            self._hooked = True
        self._stand_in(self._env.physics)
        try:
            yield
        finally:
            self._is_resetting = False
            while self._replaced:
                # Composer's physics are weak references, which may have expired.
                with contextlib.suppress(ReferenceError):
                    self._replaced.pop().take_out()

    def _stand_in(self, physics: Any, _random_state: Any = None) -> None:
        is_known = self._is_resetting and isinstance(physics, engine.Physics)
        if is_known and not physics._contexts:
            physics._contexts = _Contexts(physics)
            self._replaced.append(physics._contexts)


class _Contexts:
    """A substitute for a physics's contexts, until something is drawn in them."""

    def __init__(self, physics: Any) -> None:
        self._physics = physics
        self.gl = self.mujoco = self.ptr = self

    def take_out(self) -> None:
        """Leave the physics without contexts, unless it now has real ones."""
        if self._physics._contexts is self:
            self._physics._contexts = None

    @contextlib.contextmanager
    def make_current(self) -> Iterator[_Contexts]:
        """Yield an object that calls functions."""
        yield self

    def call(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call a function in the real contexts, unless it is an upload."""
        if getattr(function, "__name__", None) in _UPLOADS:
            return None
        self.take_out()
        real = self._physics.contexts
        own = [real.mujoco.ptr if arg is self else arg for arg in args]
        with real.gl.make_current() as context:
            return context.call(function, *own, **kwargs)

    def free(self) -> None:
        """Do nothing, because there is no context."""
