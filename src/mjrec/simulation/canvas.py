# SPDX-License-Identifier: Apache-2.0
"""An OpenGL context that draws scenes of a model, from any thread."""

from __future__ import annotations

import copy
import hashlib
from typing import Any

import mujoco
import numpy as np

from ..errors import InvalidArgument
from ..frames import Frame, check_quality, check_size
from .baked_fields import BakedFields
from .gl_strings import current_gl_strings, largest_picture
from .gl_thread import GLStrings, GLThread, gl_error


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
    def gl_strings(self) -> GLStrings:
        """Who draws: OpenGL's vendor, renderer and version."""
        return self._thread.strings

    @property
    def gl_facts(self) -> dict[str, Any]:
        """What metadata says of who draws, as `gl_strings.current_gl_facts`."""
        return self._thread.facts

    def go_over_to(
        self, model: mujoco.MjModel, *, height: int, width: int, quality: str
    ) -> None:
        """Draw scenes of another model, or in another size or quality.

        Raises:
            InvalidArgument, ClosedError, GLError: as a new one, or `draw`.
        """
        baked = BakedFields.of(model)
        self._thread.call(self._context.prepare, model, height, width, quality)
        self._baked = baked

    def update(self, model: mujoco.MjModel) -> None:
        """Bring the context up to date with changes of its model.

        Args:
            model: the same, or loaded from the same file.

        Raises:
            ClosedError, GLError: as `draw`.
        """
        baked = BakedFields.of(model)
        if changed := baked.changed_since(self._baked):
            self._thread.call(self._context.upload, model, changed)
            self._baked = baked

    def draw(self, scene: mujoco.MjvScene, out: Frame | None = None) -> Frame:
        """Return the picture of `scene`, the top row first, in `out` if that is given.

        Raises:
            ClosedError: after `close`.
            GLError: in a forked child, or the driver hangs.
        """
        return self._thread.call(self._context.draw, scene, out)

    def check_usable(self) -> None:
        """Raise ClosedError or GLError if `draw` would, without waiting."""
        self._thread.check_usable()

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
        kind = (_digest(model), height, width, quality)
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


def _digest(model: mujoco.MjModel) -> bytes:
    # Not what a recording says of its model, which may be a stranger's.
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.blake2b(buffer.data).digest()


# What to upload for which attribute of `BakedFields`, and how many there are.
_UPLOADS = {
    "hfields": ("nhfield", mujoco.mjr_uploadHField),
    "textures": ("ntex", mujoco.mjr_uploadTexture),
    "meshes": ("nmesh", mujoco.mjr_uploadMesh),
}


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
        """Bring the context up to date with what `BakedFields` says has changed."""
        if not changed <= _UPLOADS.keys():
            height, width = self._rectangle.height, self._rectangle.width
            self.prepare(model, height, width, self._quality)
            return
        for name in changed:
            count, upload = _UPLOADS[name]
            for index in range(getattr(model, count)):
                upload(model, self._context, index)

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
