# SPDX-License-Identifier: Apache-2.0
"""An OpenGL context that draws scenes of a model, from any thread.

Most of a model is read anew for every frame. What stands in `_UPLOADS` and `_WHOLE` was
copied to the graphics card, or compiled into a display list, when the context was made,
and a later change does not show until it is uploaded or the context is made anew.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np

from ..errors import InvalidArgument
from ..frames import Frame, check_quality, check_size
from .fields import holder_of
from .gl_info import current_gl_strings, largest_picture
from .gl_thread import GLThread, gl_error


class _Upload(NamedTuple):
    """Fields of a model, how many things they describe, and what uploads one of them.

    Attributes:
        arrays: names of arrays.
        number: the field that says how many.
        function: takes the model, the context and the number of one.
    """

    arrays: tuple[str, ...]
    number: str
    function: Callable[..., None]


_UPLOADS = {
    "hfields": _Upload(
        ("hfield_data", "hfield_size"), "nhfield", mujoco.mjr_uploadHField
    ),
    "textures": _Upload(("tex_data",), "ntex", mujoco.mjr_uploadTexture),
    "meshes": _Upload(
        (
            *("mesh_vert", "mesh_normal", "mesh_texcoord", "mesh_graph"),
            *("mesh_face", "mesh_facenormal", "mesh_facetexcoord"),
        ),
        "nmesh",
        mujoco.mjr_uploadMesh,
    ),
}

# What needs a new context. Absent from some versions of mujoco: tex_colorspace.
_WHOLE = (
    *("mat_texid", "skin_face", "skin_texcoord"),
    *("tex_type", "tex_width", "tex_height", "tex_nchannel", "tex_colorspace"),
)
_WHOLE_VISUAL = tuple(
    f"vis.{struct}.{name}"
    for struct, names in {
        "map": ("fogstart", "fogend", "haze", "shadowclip", "shadowscale"),
        "rgba": ("fog", "haze"),
        "quality": ("shadowsize", "offsamples", "numslices", "numstacks", "numquads"),
        "global_": ("linewidth",),
    }.items()
    for name in names
)
_OTHERWISE = "whole"


def is_kept_by_context(name: str) -> bool:
    """Tell whether a context may keep a field of this name.

    Args:
        name: of an array of `MjModel` (`tex_data`), or of a member of its structs
            (`vis.map.haze`).
    """
    uploaded = any(name in upload.arrays for upload in _UPLOADS.values())
    # Of planes only, which the name does not tell.
    of_planes = ("geom_type", "geom_size")
    return uploaded or name in (*_WHOLE, *_WHOLE_VISUAL, *of_planes)


def _kept_fields(model: mujoco.MjModel) -> dict[str, bytes]:
    """Return digests of what a context keeps, by what brings it up to date."""
    digests = {name: _digest(model, upload.arrays) for name, upload in _UPLOADS.items()}
    # Each plane has a display list; other geoms are scaled as they are drawn.
    is_plane = model.geom_type == int(mujoco.mjtGeom.mjGEOM_PLANE)
    planes = is_plane.tobytes() + model.geom_size[is_plane].tobytes()
    digests[_OTHERWISE] = _digest(model, (*_WHOLE, *_WHOLE_VISUAL)) + planes
    return digests


def _digest(model: mujoco.MjModel, names: tuple[str, ...]) -> bytes:
    digest = hashlib.blake2b(digest_size=16)
    for name in names:
        if "." in name or hasattr(model, name):
            value = getattr(*holder_of(model, name))
            digest.update(np.ascontiguousarray(value).data)
    return digest.digest()


class Canvas:
    """Draws scenes of one model in one size and quality, until `go_over_to`.

    Its context lives on a thread of its own, see `GLThread`. Several renderers may draw
    on it, in turn.

    Args:
        model: of the scenes.
        height: in pixels.
        width: in pixels.
        quality: as of `SceneRenderer`.

    Raises:
        InvalidArgument: a size that the driver cannot draw.
        GLError: as of `GLThread`.
    """

    def __init__(
        self, model: mujoco.MjModel, *, height: int, width: int, quality: str
    ) -> None:
        # Nothing of what the caller sees is shared with the thread, except while a call
        # lasts: dropping the canvas ends the thread.
        self._context = _Context()
        self._thread = GLThread(finish=self._context.free)
        try:
            self.go_over_to(model, height=height, width=width, quality=quality)
        except BaseException:
            self.close()
            raise

    @property
    def gl_facts(self) -> dict[str, Any]:
        """What metadata says of who draws, as `gl_info.current_gl_facts`."""
        return self._thread.facts

    def go_over_to(
        self, model: mujoco.MjModel, *, height: int, width: int, quality: str
    ) -> None:
        """Draw scenes of another model, or in another size or quality.

        Raises:
            InvalidArgument, ClosedError, GLError: as a new one, or `draw`.
        """
        kept = _kept_fields(model)
        self._thread.call(self._context.prepare, model, height, width, quality)
        self._kept = kept

    def update(self, model: mujoco.MjModel) -> None:
        """Bring the context up to date with changes of its model.

        Args:
            model: the same, or loaded from the same file.

        Raises:
            ClosedError, GLError: as `draw`.
        """
        kept = _kept_fields(model)
        changed = {name for name in kept if kept[name] != self._kept[name]}
        if changed:
            self._thread.call(self._context.upload, model, changed)
            self._kept = kept

    def draw(self, scene: mujoco.MjvScene, out: Frame | None = None) -> Frame:
        """Return the picture of `scene`, the top row first, in `out` if that is given.

        Raises:
            ClosedError: after `close`.
            GLError: in a forked child, or the driver hangs.
        """
        return self._thread.call(self._context.draw, scene, out)

    def settle(self) -> None:
        """Return when nothing is drawn any more, which may be after Ctrl-C."""
        self._thread.settle()

    def close(self) -> None:
        """Free the context and end its thread. Idempotent."""
        self._thread.close()


class KeptCanvas:
    """The canvas of a process that draws one thing after the other.

    Its context stays as it is for what has the same model, size and quality.
    """

    def __init__(self) -> None:
        self._canvas: Canvas | None = None
        self._kind: object = None

    def canvas(
        self,
        model: mujoco.MjModel,
        *,
        height: int,
        width: int,
        quality: str,
    ) -> Canvas:
        """Return the canvas for what is drawn until the next call.

        Args:
            model: of the scenes.
            height: in pixels.
            width: in pixels.
            quality: as of `SceneRenderer`.

        Raises:
            UnknownName: there is no such quality.
            InvalidArgument, GLError: as `Canvas`.
        """
        height, width = check_size(height, width)
        check_quality(quality)
        before, self._kind = self._kind, None
        kind = (_model_digest(model), height, width, quality)
        if self._canvas is None:
            self._canvas = Canvas(model, height=height, width=width, quality=quality)
        elif kind == before:
            self._canvas.update(model)
        else:
            self._canvas.go_over_to(model, height=height, width=width, quality=quality)
        self._kind = kind
        return self._canvas

    def close(self) -> None:
        """Free the context. Idempotent."""
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None


def _model_digest(model: mujoco.MjModel) -> bytes:
    # Not what a recording says of its model, which may be a stranger's.
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.blake2b(buffer.data).digest()


class _Context:
    """What lives on the GL thread; every method is called there."""

    def __init__(self) -> None:
        self._context: mujoco.MjrContext | None = None

    def prepare(
        self, model: mujoco.MjModel, height: int, width: int, quality: str
    ) -> None:
        """Make the context for `model`, in place of an earlier one."""
        _check_driver_can_draw(height, width)
        self._quality = quality
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._bottom_up = np.empty((height, width, 3), np.uint8)
        # Only the context needs these settings, and it keeps no reference.
        for_context = _with_settings(model, height, width, quality)
        self.free()
        try:
            context = mujoco.MjrContext(
                for_context, int(mujoco.mjtFontScale.mjFONTSCALE_150)
            )
        except mujoco.FatalError as error:
            what = f"A {width}x{height} picture cannot be drawn"
            raise gl_error(what, error, remedy="Ask for a smaller one.") from error
        self._context = context
        mujoco.mjr_setBuffer(int(mujoco.mjtFramebuffer.mjFB_OFFSCREEN), context)

    def upload(self, model: mujoco.MjModel, changed: set[str]) -> None:
        """Bring the context up to date with what `_kept_fields` says has changed."""
        if _OTHERWISE in changed:
            height, width = self._rectangle.height, self._rectangle.width
            self.prepare(model, height, width, self._quality)
            return
        for name in changed:
            upload = _UPLOADS[name]
            for index in range(getattr(model, upload.number)):
                upload.function(model, self._context, index)

    def draw(self, scene: mujoco.MjvScene, out: Frame | None) -> Frame:
        """Return the picture of `scene`, in `out` if that is given."""
        mujoco.mjr_render(self._rectangle, scene, self._context)
        mujoco.mjr_readPixels(self._bottom_up, None, self._rectangle, self._context)
        frame = np.empty_like(self._bottom_up) if out is None else out
        np.copyto(frame, self._bottom_up[::-1])
        return frame

    def free(self) -> None:
        """Free the context. Idempotent."""
        if self._context is not None:
            self._context.free()
        self._context = None


_DRAFT_SHADOW_MAP = 1024


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


def _check_driver_can_draw(height: int, width: int) -> None:
    limit = largest_picture()
    if max(height, width) > limit:
        renderer = current_gl_strings().get("gl_renderer")
        raise InvalidArgument(
            f"A picture of {width}x{height} pixels is larger than this OpenGL driver "
            f"({renderer}) can draw: {limit}x{limit}."
        )
