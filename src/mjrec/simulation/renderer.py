# SPDX-License-Identifier: Apache-2.0
"""A renderer for frames of a simulation, independent of the environment's renderer."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from ..errors import ClosedError, InvalidArgument
from ..frames import Frame, check_quality, check_size
from . import cameras, gl_context
from .fields import holder_of

_EVERYTHING = int(mujoco.mjtCatBit.mjCAT_ALL)
_DRAFT_SHADOW_MAP = 1024
_MAX_RENDERBUFFER_SIZE = 0x84E8

# Most of a model is read again for every frame. These fields are copied to the graphics
# card, or compiled into a display list, when the context is created. tex_colorspace is
# missing from some versions of mujoco.
_KEPT = (
    *("hfield_data", "hfield_size"),
    *("tex_data", "tex_type", "tex_width", "tex_height", "tex_nchannel"),
    *("tex_colorspace", "mat_texid", "skin_face", "skin_texcoord"),
    *("mesh_vert", "mesh_normal", "mesh_texcoord", "mesh_graph"),
    *("mesh_face", "mesh_facenormal", "mesh_facetexcoord"),
    *("vis.map.fogstart", "vis.map.fogend", "vis.map.haze"),
    *("vis.map.shadowclip", "vis.map.shadowscale", "vis.rgba.fog", "vis.rgba.haze"),
    *("vis.quality.shadowsize", "vis.quality.offsamples", "vis.quality.numslices"),
    *("vis.quality.numstacks", "vis.quality.numquads", "vis.global_.linewidth"),
)
# Each plane has a display list; other geoms are scaled as they are drawn.
_KEPT_OF_PLANES = ("geom_type", "geom_size")


def is_kept_by_context(name: str) -> bool:
    """Return whether an OpenGL context may keep a copy of a field.

    Args:
        name: the name of an array of `MjModel` (`tex_data`), or of a member of its
            structs (`vis.map.haze`).
    """
    return name in (*_KEPT, *_KEPT_OF_PLANES)


class Canvas:
    """An OpenGL context for a model, size and quality, in which scenes are drawn.

    `prepare` does not change the context if all three are the same as before and the
    context's copy of the model is up to date.

    Args:
        is_alone: whether no other code draws in this process; the context then stays
            current on its thread.

    Attributes:
        gl_facts: metadata about the driver; see `current_gl_facts`.
    """

    def __init__(self, *, is_alone: bool = False) -> None:
        self._is_alone = is_alone
        self.gl_facts: dict[str, Any] = {}
        self._context: Any = None
        self._drawing: mujoco.MjrContext | None = None
        self._closed = False
        self._process_id = os.getpid()
        self._kind: object = None
        self._kept = b""

    def open(self) -> None:
        """Create the context now, so that the first frame takes less time. Idempotent.

        Raises:
            GLError: see `new_context`.
        """
        with self._current():
            pass

    def prepare(
        self, model: mujoco.MjModel, *, height: int, width: int, quality: str
    ) -> None:
        """Prepare the context for drawing scenes of a model.

        Raises:
            InvalidArgument: the driver cannot draw frames of this size.
            GLError: see `new_context`.
        """
        # Hash the model itself, because the facts in a recording may be untrusted.
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        kind = (hashlib.blake2b(buffer.data).digest(), height, width, quality)
        if kind != self._kind:
            self._kept = b""
            self._rectangle = mujoco.MjrRect(0, 0, width, height)
            self._bottom_up = np.empty((height, width, 3), np.uint8)
            self._quality = quality
        self._kind = kind
        self._extent = float(model.stat.extent)
        self.update(model)

    def update(self, model: mujoco.MjModel) -> None:
        """Bring the context up to date with changes to its model.

        Args:
            model: the same model, or one loaded from the same file.

        Raises:
            InvalidArgument, GLError: see `prepare`.
        """
        kept = _kept_of(model)
        if kept != self._kept:
            self._kept = b""
            self._load(model)
            self._kept = kept

    def draw(self, scene: mujoco.MjvScene) -> Frame:
        """Draw `scene`, and return the frame, with the top row first.

        Raises:
            ClosedError: after `close`.
            GLError: in a forked child.
        """
        with self._current():
            mujoco.mjr_render(self._rectangle, scene, self._drawing)
            mujoco.mjr_readPixels(self._bottom_up, None, self._rectangle, self._drawing)
        return np.ascontiguousarray(self._bottom_up[::-1])

    def close(self) -> None:
        """Free the context and everything in it. Idempotent."""
        self._closed = True
        context, self._context = self._context, None
        # At exit, EGL may already have shut down, and then nothing is left to free. A
        # forked child must not free its parent's context.
        if context is not None and os.getpid() == self._process_id:
            with gl_context.context_kept(), contextlib.suppress(Exception):
                context.make_current()
                self._free_drawing()
                context.free()

    # Without this, MuJoCo would free its objects in whichever context is then current,
    # and so delete objects of that context that have the same numbers.
    __del__ = close

    @contextlib.contextmanager
    def _current(self) -> Iterator[None]:
        if self._closed:
            raise ClosedError("The renderer is closed.")
        if self._is_alone and self._context is not None:
            yield
            return
        gl_context.refuse_fork_of_gl()
        with gl_context.context_kept():
            if self._context is None:
                self._context = gl_context.new_context()
                self.gl_facts = gl_context.current_gl_facts()
            else:
                self._context.make_current()
            yield

    def _load(self, model: mujoco.MjModel) -> None:
        """Copy a model to the context, which keeps parts of it."""
        height, width = self._rectangle.height, self._rectangle.width
        with self._current():
            # The longest side that the driver supports.
            limits = np.zeros(1, np.int32)
            gl_context.raw_opengl().glGetIntegerv(_MAX_RENDERBUFFER_SIZE, limits)
            limit = int(limits[0])
            if max(height, width) > limit:
                raise InvalidArgument(
                    f"A frame of {width}x{height} pixels is too large. This OpenGL "
                    f"driver ({self.gl_facts['gl_renderer']}) can draw at most "
                    f"{limit}x{limit}."
                )
            self._free_drawing()
            # Only the context needs these settings. It keeps no reference to the copy.
            for_context = _with_settings(model, height, width, self._quality)
            # Shadows and fog are scaled by the extent that the context was created
            # with. The environment's context ignores later changes, and workers would
            # see them at different frames.
            for_context.stat.extent = self._extent
            try:
                self._drawing = mujoco.MjrContext(
                    for_context, int(mujoco.mjtFontScale.mjFONTSCALE_150)
                )
            except mujoco.FatalError as error:
                what = f"A {width}x{height} frame cannot be drawn"
                raise gl_context.gl_error(
                    what, error, remedy="Try a smaller size."
                ) from error
            offscreen = int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN)
            mujoco.mjr_setBuffer(offscreen, self._drawing)

    def _free_drawing(self) -> None:
        if self._drawing is not None:
            self._drawing.free()
            self._drawing = None


class SceneRenderer:
    """A renderer whose frames equal those of `mujoco.Renderer`, byte for byte.

    It does not disturb other code that draws on the caller's thread, and modifies
    neither the model nor the data.

    Most changes to the model take effect in the next frame. Changes to height fields,
    textures, meshes, plane sizes, material textures, fog and rendering quality take
    effect only after `model_changed`.

    MuJoCo's visualizer remembers the previous frame: an infinite plane is drawn around
    the cameras' positions in that frame, and a camera that tracks a body moves part of
    the way toward the body in each frame. `look` updates this memory as if the frame
    had been drawn.

    ::

        with SceneRenderer(model, height=480, width=640, camera="track") as renderer:
            frame = renderer.render(data)

    Args:
        model: the model.
        height: height in pixels, which may exceed the model's offscreen buffer.
        width: width in pixels, which may exceed the model's offscreen buffer.
        camera: the camera; see `resolve_camera`. An `MjvCamera` is read again for every
            frame.
        scene_option: the visual options, read again for every frame; None for MuJoCo's
            default. dm_control's default differs, because it draws no range finders.
        max_geom: maximum number of geoms in the scene; additional geoms are not drawn.
            The environments' own renderers have different limits (Gymnasium's is 1000).
        quality: `"full"` uses the model's own settings. `"draft"` draws without
            multisampling and with a shadow map of at most 1024x1024.
        fresh: whether to draw each frame as if it were the first, as dm_control does.
        canvas: the canvas to draw with. Renderers of the same model, size and quality
            may take turns with it. None means a new canvas.
        begins_at: positions of the scene's two cameras before the first frame,
            `(2, 3)`.
        is_moved: whether other code moves the camera before each frame.

    Attributes:
        size: `(height, width)` of the frames.
        is_following: whether each frame moves the camera.

    Raises:
        UnknownName: the model has no such camera, or the quality is unknown.
        InvalidArgument: the camera's number or the size is invalid, or the driver
            cannot draw this size.
        GLError: no OpenGL backend works here, or this process was forked from a process
            that had used OpenGL.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        height: int,
        width: int,
        camera: cameras.Camera | Mapping[str, Any] = cameras.FREE_CAMERA,
        scene_option: mujoco.MjvOption | None = None,
        max_geom: int = 10000,
        quality: str = "full",
        fresh: bool = False,
        canvas: Canvas | None = None,
        begins_at: ArrayLike = ((0, 0, 0), (0, 0, 0)),
        is_moved: bool = False,
    ) -> None:
        self.size = height, width = check_size(height, width)
        check_quality(quality)
        placed = cameras.resolve_camera(model, camera)
        self.is_following = not is_moved and cameras.is_tracking(placed)
        self._model = model
        # Kept by name or number, because the model's cameras may change later.
        self._camera = placed if isinstance(camera, Mapping) else camera
        self._scene_option = scene_option or mujoco.MjvOption()
        self._fresh = fresh
        self._scene = mujoco.MjvScene(model, maxgeom=max_geom)
        self._put_cameras(np.asarray(begins_at))
        self._owns_canvas = canvas is None
        self._canvas = canvas or Canvas()
        self._canvas.prepare(model, height=height, width=width, quality=quality)

    @property
    def gl_facts(self) -> dict[str, Any]:
        """Metadata about the driver; see `current_gl_facts`."""
        return self._canvas.gl_facts

    @property
    def shows_frame_before(self) -> bool:
        """Whether a frame depends on the cameras' positions in the previous frame."""
        return self.is_following or (
            not self._fresh and cameras.has_infinite_plane(self._model)
        )

    def look(self, data: mujoco.MjData) -> None:
        """Update the scene's cameras as drawing a frame of `data` would."""
        camera = cameras.resolve_camera(self._model, self._camera)
        mujoco.mjv_updateCamera(self._model, data, camera, self._scene)

    def render(self, data: mujoco.MjData) -> Frame:
        """Render `data`, and return the frame as a `(height, width, 3) uint8` array.

        The first row is at the top.

        Args:
            data: the model's data. Its derived quantities are drawn as they are. After
                `mj_step`, they belong to the state before the last substep.

        Raises:
            ClosedError: after `close`.
            GLError: in a forked child.
        """
        if self._fresh:
            self._put_cameras(np.zeros((2, 3)))
        camera = cameras.resolve_camera(self._model, self._camera)
        mujoco.mjv_updateScene(
            *(self._model, data, self._scene_option, None, camera),
            *(_EVERYTHING, self._scene),
        )
        return self._canvas.draw(self._scene)

    def model_changed(self) -> None:
        """Bring the canvas up to date with the model.

        This compares the parts of the model that an OpenGL context keeps, and copies
        them again if any has changed. This takes milliseconds with large textures.

        Raises:
            GLError: see `render`.
        """
        self._canvas.update(self._model)

    def close(self) -> None:
        """Close the canvas if this renderer created it. Idempotent."""
        if self._owns_canvas:
            self._canvas.close()

    def __enter__(self) -> SceneRenderer:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _put_cameras(self, positions: np.ndarray) -> None:
        for camera, position in zip(self._scene.camera, positions, strict=True):
            camera.pos = position


def _kept_of(model: mujoco.MjModel) -> bytes:
    """Return a digest of the parts of a model that an OpenGL context keeps."""
    digest = hashlib.blake2b(digest_size=16)
    for name in _KEPT:
        if "." in name or hasattr(model, name):
            value = getattr(*holder_of(model, name))
            digest.update(np.ascontiguousarray(value).data)
    is_plane = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    digest.update(is_plane.tobytes() + model.geom_size[is_plane].tobytes())
    return digest.digest()


def _with_settings(
    model: mujoco.MjModel, height: int, width: int, quality: str
) -> mujoco.MjModel:
    """Return a copy of `model` with settings for frames of this size and quality."""
    changed = copy.copy(model)
    buffer = changed.vis.global_
    buffer.offheight = max(height, buffer.offheight)
    buffer.offwidth = max(width, buffer.offwidth)
    if quality == "draft":
        settings = changed.vis.quality
        settings.offsamples = 0
        settings.shadowsize = min(settings.shadowsize, _DRAFT_SHADOW_MAP)
    return changed
