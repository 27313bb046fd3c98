# SPDX-License-Identifier: Apache-2.0
"""Pictures of a simulation from a renderer of our own, beside the environment's."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InvalidArgument
from ..frames import Frame, check_frame, check_quality, check_size
from .cameras import FREE_CAMERA, Camera, raw_data, raw_model, resolve_camera
from .canvas import Canvas
from .gl_thread import GLStrings


class SceneRenderer:
    """Draws a simulation: the pictures of `mujoco.Renderer`, byte for byte.

    It has a GL context on a thread of its own, so that whatever draws on the caller's
    thread is left alone; it may be used from any thread, and several at once may
    exist. The scene is put together on the caller's thread from the model and data as
    they are at that moment, and only the drawing is handed over. Neither the model nor
    the data is written to; a picture larger than the model's offscreen buffer, or of
    another quality, is drawn with a copy's settings.

    Most changes to the model show in the next picture. Those to height fields,
    textures, meshes, sizes of planes, textures of materials, fog and rendering quality
    show after `model_changed`, and so does another model: call it at each reset.

    An infinite plane is drawn around the place where the cameras stood in the picture
    before. `camera_positions` and `look` give pictures in any order the same planes.

    ::

        with SceneRenderer(model, height=480, width=640, camera="track") as renderer:
            frame = renderer.render(data)

    Args:
        model: a `mujoco.MjModel`, or dm_control's wrapper of one.
        height: in pixels.
        width: in pixels.
        camera: the name or number of a camera of the model, -1 for the free camera, or
            an `MjvCamera`, which is read anew for every picture.
        scene_option: a `mujoco.MjvOption`, read anew for every picture; MuJoCo's
            default, if None. dm_control's default differs from it: it draws no range
            finders.
        max_geom: how many geoms a scene may have; the rest is not drawn. Environments'
            own renderers have other limits (Gymnasium's 1000).
        quality: `"full"` is what the model asks for. `"draft"` is the model without
            multisampling and with a shadow map of at most 1024x1024.
        fresh: draw each picture as if it were the first, as dm_control does.
        canvas: where to draw, of this model, size and quality, which others may draw
            on in turn; one of its own, if None.

    Raises:
        UnknownName: the model has no such camera, or there is no such quality.
        InvalidArgument: a camera number or a size that cannot be, also a size that the
            driver cannot draw.
        GLError: no OpenGL backend works here, or this process was forked from one that
            had used OpenGL.
    """

    def __init__(
        self,
        model: Any,
        *,
        height: int,
        width: int,
        camera: Camera = FREE_CAMERA,
        scene_option: mujoco.MjvOption | None = None,
        max_geom: int = 10000,
        quality: str = "full",
        fresh: bool = False,
        canvas: Canvas | None = None,
    ) -> None:
        self._height, self._width = check_size(height, width)
        check_quality(quality)
        self._model = raw_model(model)
        self._camera = camera
        self._scene_option = scene_option or mujoco.MjvOption()
        self._max_geom = _check_max_geom(max_geom)
        self._fresh = fresh
        resolve_camera(self._model, camera)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._max_geom)
        self._quality = quality
        self._one_at_a_time = threading.Lock()
        self._owns_canvas = canvas is None
        self._canvas = canvas or Canvas(
            self._model, height=self._height, width=self._width, quality=quality
        )

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self._height, self._width

    @property
    def gl_strings(self) -> GLStrings:
        """Who draws: OpenGL's vendor, renderer and version."""
        return self._canvas.gl_strings

    @property
    def gl_facts(self) -> dict[str, Any]:
        """What metadata says of who draws, as `gl_info.current_gl_facts`."""
        return self._canvas.gl_facts

    @property
    def camera_positions(self) -> NDArray[np.float32]:
        """Where the two cameras stood in the last picture, `(2, 3)`, in metres.

        All zeros before the first. Set it to draw the next picture as if another one
        had been drawn before.
        """
        return np.array([camera.pos for camera in self._scene.camera])

    @camera_positions.setter
    def camera_positions(self, positions: ArrayLike) -> None:
        for camera, position in zip(
            self._scene.camera, np.asarray(positions), strict=True
        ):
            camera.pos = position

    def look(self, data: Any) -> None:
        """Leave in the scene what a picture of `data` would, without drawing one.

        Raises:
            InvalidArgument, ClosedError, GLError: as `render`.
        """
        with self._scene_of(raw_data(data)) as data:
            camera = resolve_camera(self._model, self._camera)
            mujoco.mjv_updateCamera(self._model, data, camera, self._scene)

    def render(self, data: Any, *, out: Frame | None = None) -> Frame:
        """Return the picture of `data`, a new `(height, width, 3) uint8` array.

        The first row is the top one.

        Args:
            data: the `mujoco.MjData` of the model, or dm_control's wrapper of it. Its
                derived quantities are drawn as they are: after `mj_step` they belong to
                the state before the last substep, see `mj_forward`.
            out: an array to draw into and return, instead of a new one.

        Raises:
            InvalidArgument: the data belongs to a model of another structure.
            InvalidFrame: `out` is no picture of this size.
            ClosedError: after `close`.
            GLError: in a forked child, or the driver hangs.
        """
        if out is not None:
            check_frame(out, size=self.size)
        with self._scene_of(raw_data(data)) as data:
            if self._fresh:
                self.camera_positions = np.zeros((2, 3))
            self._update_scene(data)
            return self._canvas.draw(self._scene, out)

    def model_changed(self, model: Any = None) -> None:
        """Bring the renderer up to date with its model, or go over to another one.

        Afterwards it draws what a new renderer would draw. Compares what a GL context
        keeps of a model (milliseconds where there are large textures) and uploads what
        differs; a context is made anew only where that is not enough.

        Args:
            model: the model from now on; None is the same object as before. A name or
                number given as camera is looked up in it.

        Raises:
            UnknownName, InvalidArgument: another model lacks the camera; the renderer
                goes on with the model it had.
            ClosedError: after `close`.
            GLError: as `render`.
        """
        self._canvas.check_usable()
        with self._one_at_a_time:
            self._canvas.settle()
            if model is None or raw_model(model) is self._model:
                self._canvas.update(self._model)
            else:
                self._go_over_to(raw_model(model))

    def close(self) -> None:
        """Free the context and end its thread, if they are its own. Idempotent."""
        if self._owns_canvas:
            self._canvas.close()

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return (
            f"SceneRenderer(height={self._height}, width={self._width}, "
            f"camera={self._camera!r}, gl={self.gl_strings.renderer!r})"
        )

    @contextlib.contextmanager
    def _scene_of(self, data: mujoco.MjData) -> Iterator[mujoco.MjData]:
        """Have the scene for oneself, to put `data` into it."""
        # Before the lock, which another thread may have held at the time of a fork.
        self._canvas.check_usable()
        with self._one_at_a_time:
            # Memory beyond the arrays of smaller data would be read.
            _check_belongs(data, self._model)
            # The thread may still be drawing the last scene, after Ctrl-C.
            self._canvas.settle()
            yield data

    def _update_scene(self, data: mujoco.MjData) -> None:
        mujoco.mjv_updateScene(
            self._model,
            data,
            self._scene_option,
            None,
            # The model's free camera and the number of a name may have changed.
            resolve_camera(self._model, self._camera),
            int(mujoco.mjtCatBit.mjCAT_ALL),
            self._scene,
        )

    def _go_over_to(self, model: mujoco.MjModel) -> None:
        resolve_camera(model, self._camera)
        scene = mujoco.MjvScene(model, maxgeom=self._max_geom)
        self._canvas.go_over_to(
            model, height=self._height, width=self._width, quality=self._quality
        )
        self._model, self._scene = model, scene


def _check_max_geom(max_geom: int) -> int:
    whole = isinstance(max_geom, int | np.integer) and not isinstance(max_geom, bool)
    if not whole or max_geom < 1:
        raise InvalidArgument(
            f"max_geom must be a whole number of at least 1, got {max_geom!r}."
        )
    return int(max_geom)


# They settle the lengths of the arrays that a scene is made of.
_SIZES = (
    *("nbody", "ngeom", "nsite", "ncam", "nlight"),
    *("nflexvert", "nskin", "ntendon", "nwrap", "nsensordata"),
)


def _check_belongs(data: mujoco.MjData, model: mujoco.MjModel) -> None:
    """Raise InvalidArgument if the arrays of `data` have other sizes than `model` says.

    A copy of the data's model is as good as the model itself.
    """
    origin = data.model
    if origin is model:
        return
    differing = [
        f"{name} {getattr(origin, name)}, not {getattr(model, name)}"
        for name in _SIZES
        if getattr(origin, name) != getattr(model, name)
    ]
    if differing:
        raise InvalidArgument(
            f"The data belongs to another model ({'; '.join(differing)}). If the "
            "environment has compiled a new one, call model_changed with it first."
        )
