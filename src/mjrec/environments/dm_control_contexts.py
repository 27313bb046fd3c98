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
        self._replaced: list[tuple[Any, _Contexts]] = []

    @contextlib.contextmanager
    def resetting(self) -> Iterator[None]:
        """Return what to put around a reset.

        A physics without contexts has something in their place in the block, which
        makes real ones as soon as anything is drawn. Afterwards, also after an error,
        the physics is as it was.
        """
        self._is_resetting = True
        self._hook()
        self._stand_in(self._env.physics)
        try:
            yield
        finally:
            self._is_resetting = False
            self._take_out()

    def _hook(self) -> None:
        """See to it that a physics which the reset itself compiles is met in time."""
        add_extra_hook = getattr(self._env, "add_extra_hook", None)
        if add_extra_hook is not None and not self._hooked:
            # Composer has no way to take one out again; it does nothing but in resets.
            add_extra_hook("after_compile", self._compiled)
            self._hooked = True

    def _compiled(self, physics: Any, _random_state: Any) -> None:
        if self._is_resetting:
            self._stand_in(physics)

    def _stand_in(self, physics: Any) -> None:
        if isinstance(physics, engine.Physics) and not physics._contexts:
            contexts = _Contexts(physics)
            self._replaced.append((physics, contexts))
            physics._contexts = contexts

    def _take_out(self) -> None:
        while self._replaced:
            physics, contexts = self._replaced.pop()
            # Composer's are weak references to what a compilation has freed.
            with contextlib.suppress(ReferenceError):
                contexts.take_out(physics)


class _Contexts:
    """Stands for the contexts of a physics until something is drawn."""

    def __init__(self, physics: Any) -> None:
        self._physics = physics
        self.gl = _GL(self)
        self.mujoco = _Mujoco(self)

    def real(self) -> Any:
        """Return the physics' own contexts, made now if there were none."""
        self.take_out(self._physics)
        return self._physics.contexts

    def take_out(self, physics: Any) -> None:
        """Leave the physics without contexts, unless it has real ones by now."""
        if physics._contexts is self:
            physics._contexts = None

    def call(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call what is to run where the contexts are, unless it is an upload."""
        if getattr(function, "__name__", None) in _UPLOADS:
            return None
        real = self.real()
        own = [real.mujoco.ptr if arg is self.mujoco else arg for arg in args]
        with real.gl.make_current() as context:
            return context.call(function, *own, **kwargs)


class _GL:
    """Stands for the OpenGL context."""

    def __init__(self, contexts: _Contexts) -> None:
        self._contexts = contexts

    @contextlib.contextmanager
    def make_current(self) -> Iterator[_Contexts]:
        """Give what calls functions."""
        yield self._contexts

    def free(self) -> None:
        """Do nothing: there is none."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._contexts.real().gl, name)


class _Mujoco:
    """Stands for MuJoCo's context, and for what it calls `ptr`."""

    def __init__(self, contexts: _Contexts) -> None:
        self._contexts = contexts

    @property
    def ptr(self) -> _Mujoco:
        """Return what stands for the context among the arguments of a call."""
        return self

    def free(self) -> None:
        """Do nothing: there is none."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._contexts.real().mujoco, name)
