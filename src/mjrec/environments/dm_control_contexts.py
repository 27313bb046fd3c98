# SPDX-License-Identifier: Apache-2.0
"""Resets of dm_control environments without OpenGL.

Some tasks (quadruped-escape, the rodent's bowl) make a new terrain in each reset and
upload it to the rendering context; asking whether there is a context makes one. Where
there is none there is nothing to upload to: a context that is made later begins with
the terrain of its time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from dm_control.mujoco import engine

_UPLOADS = ("mjr_uploadHField", "mjr_uploadTexture", "mjr_uploadMesh")


class ContextsOnDemand:
    """Keeps the resets of an environment from making a context to upload to.

    Args:
        env: an environment with dm_control's `physics`, which may be another one after
            each reset.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._is_resetting = False
        self._hooked = False
        self._replaced: list[_Contexts] = []

    @contextlib.contextmanager
    def resetting(self) -> Iterator[None]:
        """Return what to put around a reset.

        A physics without contexts has something in their place in the block, which
        makes real ones as soon as anything is drawn. Afterwards, also after an error,
        the physics is as it was.
        """
        self._is_resetting = True
        # A physics which the reset itself compiles is met in time.
        if not self._hooked and hasattr(self._env, "add_extra_hook"):
            # Composer has no way to take one out again; it does nothing but in resets.
            self._env.add_extra_hook("after_compile", self._stand_in)
            self._hooked = True
        self._stand_in(self._env.physics)
        try:
            yield
        finally:
            self._is_resetting = False
            while self._replaced:
                # Composer's are weak references to what a compilation has freed.
                with contextlib.suppress(ReferenceError):
                    self._replaced.pop().take_out()

    def _stand_in(self, physics: Any, _random_state: Any = None) -> None:
        is_known = self._is_resetting and isinstance(physics, engine.Physics)
        if is_known and not physics._contexts:
            physics._contexts = _Contexts(physics)
            self._replaced.append(physics._contexts)


class _Contexts:
    """Stands for the contexts of a physics, and for each of them, until one draws."""

    def __init__(self, physics: Any) -> None:
        self._physics = physics
        self.gl = self.mujoco = self.ptr = self

    def take_out(self) -> None:
        """Leave the physics without contexts, unless it has real ones by now."""
        if self._physics._contexts is self:
            self._physics._contexts = None

    @contextlib.contextmanager
    def make_current(self) -> Iterator[_Contexts]:
        """Give what calls functions."""
        yield self

    def call(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call what is to run where the contexts are, unless it is an upload."""
        if getattr(function, "__name__", None) in _UPLOADS:
            return None
        self.take_out()
        real = self._physics.contexts
        own = [real.mujoco.ptr if arg is self else arg for arg in args]
        with real.gl.make_current() as context:
            return context.call(function, *own, **kwargs)

    def free(self) -> None:
        """Do nothing: there is none."""
