# SPDX-License-Identifier: Apache-2.0
"""Frames of a simulation from a renderer of our own, beside the environment's."""

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
from .cameras import (
    FREE_CAMERA,
    Camera,
    has_infinite_plane,
    is_tracking,
    resolve_camera,
)
from .fields import holder_of
from .gl_context import (
    context_kept,
    current_gl_facts,
    gl_error,
    new_context,
    raw_opengl,
    refuse_fork_of_gl,
)

_EVERYTHING = int(mujoco.mjtCatBit.mjCAT_ALL)
_DRAFT_SHADOW_MAP = 1024
_MAX_RENDERBUFFER_SIZE = 0x84E8

# Most of a model is read anew for every frame. This was copied to the graphics card, or
# compiled into a display list, when the context was made. Absent from some versions of
# mujoco: tex_colorspace.
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
    """Return whether an OpenGL context may keep a field of this name.

    Args:
        name: of an array of `MjModel` (`tex_data`), or of a member of its structs
            (`vis.map.haze`).
    """
    return name in (*_KEPT, *_KEPT_OF_PLANES)


class Canvas:
    """What scenes are drawn with: an OpenGL context for a model, size and quality.

    It stays as it is from one `prepare` to the next where those three do, and nothing
    has changed that the context keeps of the model.

    Args:
        is_alone: nothing else draws in this process, so that its context can stay
            current on its thread.

    Attributes:
        gl_facts: what metadata says of who draws, as `current_gl_facts`.
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
        """Make the context now, so that the first frame comes sooner. Idempotent.

        Raises:
            GLError: as of `new_context`.
        """
        with self._current():
            pass

    def prepare(
        self, model: mujoco.MjModel, *, height: int, width: int, quality: str
    ) -> None:
        """Make it ready for scenes of a model.

        Raises:
            InvalidArgument: a size that the driver cannot draw.
            GLError: as of `new_context`.
        """
        # Not by what a recording says of its model, which may be a stranger's.
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        kind = (hashlib.blake2b(buffer.data).digest(), height, width, quality)
        if kind != self._kind:
            self._kept = b""
            self._rectangle = mujoco.MjrRect(0, 0, width, height)
            self._bottom_up = np.empty((height, width, 3), np.uint8)
            self._quality = quality
        self._kind = kind
        self.update(model)

    def update(self, model: mujoco.MjModel) -> None:
        """Bring it up to date with changes of its model.

        Args:
            model: the same, or loaded from the same file.

        Raises:
            InvalidArgument, GLError: as `prepare`.
        """
        kept = _kept_of(model)
        if kept != self._kept:
            self._kept = b""
            self._load(model)
            self._kept = kept

    def draw(self, scene: mujoco.MjvScene) -> Frame:
        """Return the frame of `scene`, the top row first.

        Raises:
            ClosedError: after `close`.
            GLError: in a forked child.
        """
        with self._current():
            mujoco.mjr_render(self._rectangle, scene, self._drawing)
            mujoco.mjr_readPixels(self._bottom_up, None, self._rectangle, self._drawing)
        return np.ascontiguousarray(self._bottom_up[::-1])

    def close(self) -> None:
        """Free what lies in the context, then the context. Idempotent."""
        self._closed = True
        context, self._context = self._context, None
        # At exit EGL may have been shut down already, and all is gone. What a
        # forked child has is its parent's.
        if context is not None and os.getpid() == self._process_id:
            with context_kept(), contextlib.suppress(Exception):
                context.make_current()
                self._free_drawing()
                context.free()

    # Forgotten, MuJoCo's context would be freed in whichever context is current then,
    # and take what lies there under the same numbers.
    __del__ = close

    @contextlib.contextmanager
    def _current(self) -> Iterator[None]:
        if self._closed:
            raise ClosedError("The renderer is closed.")
        if self._is_alone and self._context is not None:
            yield
            return
        refuse_fork_of_gl()
        with context_kept():
            if self._context is None:
                self._context = new_context()
                self.gl_facts = current_gl_facts()
            else:
                self._context.make_current()
            yield

    def _load(self, model: mujoco.MjModel) -> None:
        """Give the context what it keeps of a model."""
        height, width = self._rectangle.height, self._rectangle.width
        with self._current():
            # The longest side that the driver can draw.
            limits = np.zeros(1, np.int32)
            raw_opengl().glGetIntegerv(_MAX_RENDERBUFFER_SIZE, limits)
            limit = int(limits[0])
            if max(height, width) > limit:
                raise InvalidArgument(
                    f"A frame of {width}x{height} pixels is larger than this OpenGL "
                    f"driver ({self.gl_facts['gl_renderer']}) can draw: "
                    f"{limit}x{limit}."
                )
            self._free_drawing()
            # Only the context needs these settings, and it keeps no reference.
            for_context = _with_settings(model, height, width, self._quality)
            try:
                self._drawing = mujoco.MjrContext(
                    for_context, int(mujoco.mjtFontScale.mjFONTSCALE_150)
                )
            except mujoco.FatalError as error:
                what = f"A {width}x{height} frame cannot be drawn"
                raise gl_error(what, error, remedy="Ask for a smaller one.") from error
            offscreen = int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN)
            mujoco.mjr_setBuffer(offscreen, self._drawing)

    def _free_drawing(self) -> None:
        if self._drawing is not None:
            self._drawing.free()
            self._drawing = None


class SceneRenderer:
    """Draws a simulation: the frames of `mujoco.Renderer`, byte for byte.

    What else draws on the caller's thread is left alone. Neither the model nor the data
    is written to.

    Most changes to the model show in the next frame. Those to height fields,
    textures, meshes, sizes of planes, textures of materials, fog and rendering quality
    show after `model_changed`.

    MuJoCo's visualiser remembers the frame before: an infinite plane is drawn around
    the place where the cameras stood in it, and a camera that tracks a body goes a part
    of the way to it in each frame. `begin` and `look` bring the renderer to any frame
    as if all before had been drawn.

    ::

        with SceneRenderer(model, height=480, width=640, camera="track") as renderer:
            frame = renderer.render(data)

    Args:
        model: the model.
        height: in pixels; may be larger than the model's offscreen buffer.
        width: likewise.
        camera: as `resolve_camera` takes it; an `MjvCamera` is read anew for every
            frame.
        scene_option: read anew for every frame; MuJoCo's default, if None, which is
            not dm_control's: that draws no range finders.
        max_geom: how many geoms a scene may have; the rest is not drawn. Environments'
            own renderers have other limits (Gymnasium's 1000).
        quality: `"full"` is what the model asks for. `"draft"` is the model without
            multisampling and with a shadow map of at most 1024x1024.
        fresh: draw each frame as if it were the first, as dm_control does.
        canvas: what to draw with, which others of this model, size and quality may draw
            with in turn; one of its own, if None.
        begins_at: where the two cameras of its scene stand before the first frame,
            `(2, 3)`.
        is_moved: the camera is brought to its place before each frame from outside.

    Attributes:
        size: `(height, width)` of the frames.
        is_following: each frame moves the camera.

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
        camera: Camera | Mapping[str, Any] = FREE_CAMERA,
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
        placed = resolve_camera(model, camera)
        self.is_following = not is_moved and is_tracking(placed)
        self._model = model
        # The place of the free camera and the number of a name may change.
        self._camera = placed if isinstance(camera, Mapping) else camera
        self._scene_option = scene_option or mujoco.MjvOption()
        self._fresh = fresh
        self._begins_at = np.asarray(begins_at)
        self._begins_looking_at = placed.lookat.copy()
        self._scene = mujoco.MjvScene(model, maxgeom=max_geom)
        self._owns_canvas = canvas is None
        self._canvas = canvas or Canvas()
        self._canvas.prepare(model, height=height, width=width, quality=quality)

    @property
    def gl_facts(self) -> dict[str, Any]:
        """What metadata says of who draws, as `gl_context.current_gl_facts`."""
        return self._canvas.gl_facts

    @property
    def shows_frame_before(self) -> bool:
        """Whether a frame depends on where the cameras stood in the one before."""
        return self.is_following or (
            not self._fresh and has_infinite_plane(self._model)
        )

    def begin(self) -> None:
        """Go to before the first frame."""
        self._put_cameras(self._begins_at)
        if self.is_following:
            resolve_camera(self._model, self._camera).lookat[:] = (
                self._begins_looking_at
            )

    def look(self, data: mujoco.MjData) -> None:
        """Leave in the scene what a frame of `data` would, without drawing one."""
        camera = resolve_camera(self._model, self._camera)
        mujoco.mjv_updateCamera(self._model, data, camera, self._scene)

    def render(self, data: mujoco.MjData) -> Frame:
        """Return the frame of `data`, a new `(height, width, 3) uint8` array.

        The first row is the top one.

        Args:
            data: of the model. Its derived quantities are drawn as they are: after
                `mj_step` they belong to the state before the last substep.

        Raises:
            ClosedError: after `close`.
            GLError: in a forked child.
        """
        if self._fresh:
            self._put_cameras(np.zeros((2, 3)))
        camera = resolve_camera(self._model, self._camera)
        mujoco.mjv_updateScene(
            *(self._model, data, self._scene_option, None, camera),
            *(_EVERYTHING, self._scene),
        )
        return self._canvas.draw(self._scene)

    def model_changed(self) -> None:
        """Bring the canvas up to date with the model.

        Compares what an OpenGL context keeps of a model (milliseconds where there are
        large textures), and gives it that anew where something differs.

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

    def __exit__(self, *error: object) -> None:
        self.close()

    def _put_cameras(self, positions: np.ndarray) -> None:
        for camera, position in zip(self._scene.camera, positions, strict=True):
            camera.pos = position


def _kept_of(model: mujoco.MjModel) -> bytes:
    """Return a digest of what an OpenGL context keeps of a model."""
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
    """Return `model`, or a copy with a large enough buffer and of that quality."""
    buffer = model.vis.global_
    is_large_enough = height <= buffer.offheight and width <= buffer.offwidth
    if is_large_enough and quality == "full":
        return model
    changed = copy.copy(model)
    changed.vis.global_.offheight = max(height, buffer.offheight)
    changed.vis.global_.offwidth = max(width, buffer.offwidth)
    if quality == "draft":
        settings = changed.vis.quality
        settings.offsamples = 0
        settings.shadowsize = min(settings.shadowsize, _DRAFT_SHADOW_MAP)
    return changed
