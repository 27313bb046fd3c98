# SPDX-License-Identifier: Apache-2.0
"""Where the pictures of a dm_control environment come from."""

from __future__ import annotations

from typing import Any

from ..frames import check_size
from ..simulation.cameras import camera_label, raw_model, resolve_camera
from ..simulation.gl_context import current_gl_facts
from .no_pictures import NoPictureSource

_NOT_BY_PHYSICS = (
    "physics.render() draws no picture from an MjvCamera, nor one that is larger than "
    "the model's offscreen buffer; such pictures are drawn from recorded states and "
    "never live. Leave render= out"
)

# The size of `physics.render()` where none is asked for.
_HEIGHT, _WIDTH = 240, 320


def dm_control_pictures(
    env: Any,
    *,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
) -> PhysicsPictures | NoPictureSource:
    """Return the source of a dm_control environment's pictures.

    Args:
        env: an environment with dm_control's `physics`.
        camera: a name or number; None is dm_control's default, the free camera.
        height: in pixels; None is 240, dm_control's default.
        width: in pixels; None is 320, likewise.

    The pictures are those of `physics.render()`. What that cannot draw is not drawn
    live: a picture larger than the model's offscreen buffer, and one from an
    `MjvCamera`.

    Raises:
        UnknownName: the model has no such camera.
        InvalidArgument: a number or a size that cannot be.
    """
    height, width = picture_size(height, width)
    if camera is not None:
        resolve_camera(raw_model(env.physics.model), camera)
    if not drawn_by_physics(env.physics, camera, height, width):
        return NoPictureSource(_NOT_BY_PHYSICS)
    return PhysicsPictures(env, camera=camera, height=height, width=width)


class PhysicsPictures:
    """The pictures that `physics.render()` gives.

    Args:
        env: the environment; its physics may be another one at each call.
        camera: a name or number; None is the free camera.
        height: in pixels.
        width: in pixels.
    """

    render_mode = "rgb_array"

    def __init__(self, env: Any, *, camera: Any, height: int, width: int) -> None:
        self._env = env
        self._camera = -1 if camera is None else camera
        self._height = height
        self._width = width

    def render(self) -> Any:
        """Return the picture of this moment, `(height, width, 3) uint8`."""
        return self._env.physics.render(
            height=self._height, width=self._width, camera_id=self._camera
        )

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its pictures."""
        physics = self._env.physics
        facts: dict[str, Any] = {
            "pictures": "env.render",
            "quality": "full",
            "camera": camera_label(raw_model(physics.model), self._camera),
        }
        with physics.contexts.gl.make_current() as context:
            facts.update(context.call(current_gl_facts))
        return facts


def picture_size(height: int | None, width: int | None) -> tuple[int, int]:
    """Return `(height, width)` with dm_control's default for what is None.

    Raises:
        InvalidArgument: a size that cannot be.
    """
    return check_size(
        _HEIGHT if height is None else height, _WIDTH if width is None else width
    )


def drawn_by_physics(physics: Any, camera: Any, height: int, width: int) -> bool:
    """Tell whether `physics.render()` draws such pictures."""
    buffer = physics.model.vis.global_
    named = camera is None or isinstance(camera, str | int)
    return bool(named and height <= buffer.offheight and width <= buffer.offwidth)
