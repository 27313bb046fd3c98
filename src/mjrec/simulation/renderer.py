# SPDX-License-Identifier: Apache-2.0
"""Pictures of a simulation from a renderer of our own, beside the environment's."""

from __future__ import annotations

from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..frames import Frame, check_frame, check_quality, check_size
from .cameras import FREE_CAMERA, Camera, resolve_camera
from .canvas import Canvas

_EVERYTHING = int(mujoco.mjtCatBit.mjCAT_ALL)


class SceneRenderer:
    """Draws a simulation: the pictures of `mujoco.Renderer`, byte for byte.

    Its canvas has a GL context on a thread of its own, so that whatever draws on the
    caller's thread is left alone. The scene is put together on the caller's thread from
    the model and data as they are at that moment, and only the drawing is handed over.
    Neither the model nor the data is written to.

    Most changes to the model show in the next picture. Those to height fields,
    textures, meshes, sizes of planes, textures of materials, fog and rendering quality
    show after `model_changed`.

    An infinite plane is drawn around the place where the cameras stood in the picture
    before. `camera_positions` and `look` give pictures in any order the same planes.

    ::

        with SceneRenderer(model, height=480, width=640, camera="track") as renderer:
            frame = renderer.render(data)

    Args:
        model: the model.
        height: in pixels; may be larger than the model's offscreen buffer.
        width: likewise.
        camera: the name or number of a camera of the model, -1 for the free camera, or
            an `MjvCamera`, which is read anew for every picture.
        scene_option: read anew for every picture; MuJoCo's default, if None, which is
            not dm_control's: that draws no range finders.
        max_geom: how many geoms a scene may have; the rest is not drawn. Environments'
            own renderers have other limits (Gymnasium's 1000).
        quality: `"full"` is what the model asks for. `"draft"` is the model without
            multisampling and with a shadow map of at most 1024x1024.
        fresh: draw each picture as if it were the first, as dm_control does.
        canvas: where to draw, of this model, size and quality, which others may draw
            on in turn; one of its own, if None.

    Attributes:
        size: `(height, width)` of the pictures.

    Raises:
        UnknownName: the model has no such camera, or there is no such quality.
        InvalidArgument: a camera number or a size that cannot be, also a size that the
            driver cannot draw.
        GLError: no OpenGL backend works here, or this process was forked from one that
            had used OpenGL.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
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
        self.size = height, width = check_size(height, width)
        check_quality(quality)
        resolve_camera(model, camera)
        self._model = model
        self._camera = camera
        self._scene_option = scene_option or mujoco.MjvOption()
        self._fresh = fresh
        self._scene = mujoco.MjvScene(model, maxgeom=max_geom)
        self._owns_canvas = canvas is None
        self._canvas = canvas or Canvas(
            model, height=height, width=width, quality=quality
        )

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
        pairs = zip(self._scene.camera, np.asarray(positions), strict=True)
        for camera, position in pairs:
            camera.pos = position

    def look(self, data: mujoco.MjData) -> None:
        """Leave in the scene what a picture of `data` would, without drawing one."""
        camera = resolve_camera(self._model, self._camera)
        mujoco.mjv_updateCamera(self._model, data, camera, self._scene)

    def render(self, data: mujoco.MjData, *, out: Frame | None = None) -> Frame:
        """Return the picture of `data`, a new `(height, width, 3) uint8` array.

        The first row is the top one.

        Args:
            data: of the model. Its derived quantities are drawn as they are: after
                `mj_step` they belong to the state before the last substep.
            out: an array to draw into and return, instead of a new one.

        Raises:
            InvalidFrame: `out` is no picture of this size.
            ClosedError: after `close`.
            GLError: in a forked child, or the driver hangs.
        """
        if out is not None:
            check_frame(out, size=self.size)
        # The last scene may still be drawn, after Ctrl-C.
        self._canvas.settle()
        if self._fresh:
            self.camera_positions = np.zeros((2, 3))
        # The model's free camera and the number of a name may have changed.
        camera = resolve_camera(self._model, self._camera)
        mujoco.mjv_updateScene(
            *(self._model, data, self._scene_option, None, camera),
            *(_EVERYTHING, self._scene),
        )
        return self._canvas.draw(self._scene, out)

    def model_changed(self) -> None:
        """Bring the canvas up to date with the model.

        Compares what a GL context keeps of a model (milliseconds where there are large
        textures) and uploads what differs; a context is made anew only where that is
        not enough.

        Raises:
            GLError: as `render`.
        """
        self._canvas.update(self._model)

    def close(self) -> None:
        """Close the canvas, if it is its own. Idempotent."""
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
