# SPDX-License-Identifier: Apache-2.0
"""The states of a dm_control environment, and the frames drawn from them."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from operator import attrgetter
from typing import Any

import numpy as np
from dm_control._render import base
from dm_control.mujoco import engine, wrapper

from ..frames import check_size
from ..simulation.cameras import (
    FREE_CAMERA,
    camera_label,
    raw_data,
    raw_model,
    resolve_camera,
)
from ..simulation.capture import Capture
from ..simulation.gl_context import collection_paused, context_kept, current_gl_facts
from ..simulation.model_sources import AuthoredModel
from ..simulation.view import SceneView, option_without_rangefinder, place_free_camera
from .scenes import (
    NoFrameSource,
    Scenes,
    generator_state,
    plain_arguments,
    render_override,
)
from .wrapping import around_dm_env

_UPLOADS = ("mjr_uploadHField", "mjr_uploadTexture", "mjr_uploadMesh")


class ContextsOnDemand:
    """A guard that prevents resets from creating contexts only for terrain uploads.

    Some tasks (quadruped-escape, the rodent's bowl) create a new terrain in each reset
    and upload it to the rendering context. Even checking for a context creates one. If
    there is none, the upload can be skipped, because a context that is created later
    starts with the current terrain.

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

        Inside the block, a physics without contexts gets a stand-in, which creates real
        contexts as soon as anything is drawn. After the block, the physics is restored,
        even if an error was raised.
        """
        self._is_resetting = True
        # If the reset compiles a new physics, this hook receives it in time.
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
                # Composer's physics is a weak reference, which may have expired.
                with contextlib.suppress(ReferenceError):
                    self._replaced.pop().take_out()

    def _stand_in(self, physics: Any, _random_state: Any = None) -> None:
        is_known = self._is_resetting and isinstance(physics, engine.Physics)
        if is_known and not physics._contexts:
            physics._contexts = _Contexts(physics)
            self._replaced.append(physics._contexts)


class _Contexts:
    """A stand-in for the contexts of a physics, until something is drawn in them."""

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


_SUITE = "dm_control/"
# The attribute of a suite task that stores the other arguments of `suite.load`.
MADE_WITH = "_mjrec_made_with"

# Read at every captured step. The result is dm_control's object for one model.
_DATA = attrgetter("physics.data")

# The limit for frames that `physics.render()` does not draw.
_MAX_GEOM = 10000


_NOT_BY_PHYSICS = (
    "physics.render() cannot use an MjvCamera or draw frames larger than the "
    "model's offscreen buffer; such frames are drawn from recorded states, never live. "
    "Leave out render="
)

_PHYSICS = ("dm_control.mujoco.engine", "Physics.render")

# The default size of `physics.render()`.
_HEIGHT, _WIDTH = 240, 320


def dm_control_scenes(
    env: Any,
    *,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
    env_id: str | None = None,
) -> Scenes:
    """Return how to record the states of a dm_control environment.

    The frames are those of `physics.render()`. Frames that it cannot draw, because they
    are larger than the model's offscreen buffer or use an `MjvCamera`, are rendered
    separately from the same scene, never live.

    Args:
        env: an environment with dm_control's `physics`.
        camera: a name, a number or an `MjvCamera`; None for dm_control's default, the
            free camera.
        height: height in pixels; None for dm_control's default, 240.
        width: width in pixels; None for dm_control's default, 320.
        env_id: `dm_control/<domain>-<task>` for a task of the suite.

    Raises:
        UnknownName: the model has no such camera.
        InvalidArgument: the camera's number or the size is invalid.
    """
    height, width = check_size(
        _HEIGHT if height is None else height, _WIDTH if width is None else width
    )
    by_physics = _drawn_by_physics(env.physics, camera, height, width)
    scene = _PhysicsScene(
        env,
        camera=FREE_CAMERA if camera is None else camera,
        size=(height, width),
        by_physics=by_physics,
    )
    return Scenes(
        states=Capture(
            lambda: (raw_model(env.physics.model), raw_data(env.physics.data)),
            view=scene,
            at_frame=scene.at_frame,
            resetting=ContextsOnDemand(env).resetting,
            authored=lambda: _authored(env),
            is_unmoved=scene.is_unmoved,
        ),
        obstacle=(
            render_override("physics", env.physics, [_PHYSICS]) if by_physics else None
        ),
        environment=_environment(env, env_id),
        random_state=lambda: generator_state(generator_of(env)),
        frames=(
            PhysicsFrames(env, camera=camera, height=height, width=width)
            if by_physics
            else NoFrameSource(_NOT_BY_PHYSICS)
        ),
    )


def generator_of(env: Any) -> Any:
    """Return an environment's random number generator, or None."""
    # The suite's tasks use the first attribute, and composer's environments the second.
    for holder, name in ((getattr(env, "task", None), "random"), (env, "random_state")):
        found = getattr(holder, name, None)
        if isinstance(found, np.random.RandomState):
            return found
    return None


class PhysicsFrames:
    """The frames that `physics.render()` returns.

    Args:
        env: the environment; its physics may be replaced between calls.
        camera: a name or number; None for the free camera.
        height: height in pixels.
        width: width in pixels.
    """

    render_mode = "rgb_array"

    def __init__(self, env: Any, *, camera: Any, height: int, width: int) -> None:
        self._env = env
        self._camera = -1 if camera is None else camera
        self._height = height
        self._width = width

    def render(self) -> Any:
        """Return the current frame, `(height, width, 3) uint8`."""
        physics = self._env.physics
        with _own_context(physics):
            return physics.render(
                height=self._height, width=self._width, camera_id=self._camera
            )

    def facts(self) -> dict[str, Any]:
        """Return the facts about the frames for a video's metadata."""
        physics = self._env.physics
        facts: dict[str, Any] = {
            "pictures": "env.render",
            "quality": "full",
            "camera": camera_label(raw_model(physics.model), self._camera),
        }
        with _own_context(physics) as context:
            facts.update(context.call(current_gl_facts))
        return facts


@contextlib.contextmanager
def _own_context(physics: Any) -> Iterator[Any]:
    """Make the context that dm_control draws with current, and yield its executor.

    dm_control remembers which context it last made current. If another library has
    since changed the current context, dm_control would draw without one. Its context
    must not stay current either: when a `mujoco.Renderer` is closed or collected, it
    frees those objects in the current context that have the same numbers as its own. In
    both cases, `physics.render()` would return arbitrary memory.
    """
    with context_kept(or_none=True), collection_paused():
        gl = physics.contexts.gl
        with gl.make_current() as context:
            context.call(gl._platform_make_current)
            yield context
        # dm_control makes its context current again when it next draws.
        base._CURRENT_THREAD_FOR_CONTEXT.pop(id(gl), None)
        base._CURRENT_CONTEXT_FOR_THREAD.pop(gl.thread, None)


class _PhysicsScene:
    """The scene shown by `physics.render()`.

    Args:
        env: the environment; its physics may be replaced between calls.
        camera: a name, a number or an `MjvCamera`.
        size: `(height, width)` in pixels.
        by_physics: whether `physics.render()` can draw such frames.
    """

    def __init__(
        self, env: Any, *, camera: Any, size: tuple[int, int], by_physics: bool
    ) -> None:
        self._env = env
        self._camera = camera
        self._size = size
        self._by_physics = by_physics
        self._option = option_without_rangefinder()
        # The data from when the view was last requested.
        self._data: Any = None
        # Whether the camera has been placed since then.
        self._is_placed = False
        self._start(env.physics.model)

    def __call__(self) -> SceneView:
        """Return the view, which `at_frame` keeps up to date from now on."""
        model = self._env.physics.model
        if raw_model(model) is not self._model:
            self._start(model)
        self._data = _DATA(self._env)
        self._is_placed = False
        return self._view

    def at_frame(self, capture: Callable[[], None]) -> None:
        """Call `capture` with the view of the current frame."""
        if self._camera == FREE_CAMERA:
            # The free camera's pose depends on the model's fields.
            place_free_camera(self._model, self._view.camera)
        self._is_placed = True
        capture()

    def is_unmoved(self) -> bool:
        """Check quickly whether the view is known to be unchanged since the last frame.

        Changes to the model, the camera and the option are not checked for. The result
        is True if the simulation is the same as when the view was last requested.
        """
        return self._is_placed and _DATA(self._env) is self._data

    def _start(self, model: Any) -> None:
        self._model = raw_model(model)
        height, width = self._size
        self._view = SceneView(
            camera=resolve_camera(self._model, self._camera),
            option=self._option,
            # Only a dm_control scene reveals the number of geoms that dm_control chose.
            max_geom=wrapper.MjvScene(model).maxgeom if self._by_physics else _MAX_GEOM,
            # Each `physics.render()` creates a new scene.
            fresh=self._by_physics,
            height=height,
            width=width,
            label=camera_label(self._model, self._camera),
        )


def _drawn_by_physics(physics: Any, camera: Any, height: int, width: int) -> bool:
    """Return whether `physics.render()` can draw frames with this camera and size."""
    buffer = physics.model.vis.global_
    named = camera is None or isinstance(camera, str | int)
    return bool(named and height <= buffer.offheight and width <= buffer.offwidth)


def _authored(env: Any) -> AuthoredModel | None:
    """Return the MJCF compiled by composer or the suite, or None if unknown."""
    task = getattr(env, "task", None)
    root = getattr(task, "root_entity", None)
    if root is None:
        return _authored_of_suite(task)
    mjcf = root.mjcf_model
    text = mjcf.to_xml_string().encode()
    return AuthoredModel("model.xml", {"model.xml": text, **mjcf.get_assets()})


def _authored_of_suite(task: Any) -> AuthoredModel | None:
    """Return a domain's model sources from the task's module, or None.

    A task does not keep its model's sources, and may have changed them before
    compiling. Storing the sources checks that they compile to this model.
    """
    name = type(task).__module__
    domain = sys.modules.get(name) if name.startswith("dm_control.suite.") else None
    sources = getattr(domain, "get_model_and_assets", None)
    try:
        text, assets = sources()  # type: ignore[misc]  # None raises TypeError, too
    except TypeError:
        # Some domains, such as stacker, have a model for each number of objects.
        return None
    files = {"model.xml": text, **assets}
    return AuthoredModel("model.xml", {k: _bytes(v) for k, v in files.items()})


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


def _environment(env: Any, env_id: str | None) -> dict[str, Any] | None:
    if env_id is None or not env_id.startswith(_SUITE):
        return None
    arguments = getattr(getattr(env, "task", None), MADE_WITH, None)
    kwargs = None if arguments is None else plain_arguments(arguments)
    known = {"framework": "dm_control", "id": env_id, "kwargs": kwargs}
    return {**known, **around_dm_env(env)}
