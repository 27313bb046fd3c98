# SPDX-License-Identifier: Apache-2.0
"""Renderers that draw the pictures of an episode in any order.

MuJoCo's visualiser remembers: an infinite plane is drawn around the place where the
cameras stood in the picture before, and a camera that tracks a body goes a part of the
way to it in each picture.
"""

from __future__ import annotations

import mujoco
from numpy.typing import ArrayLike

from .cameras import Camera
from .renderer import SceneRenderer

# A plain integer: see `cameras`.
_TRACKING = int(mujoco.mjtCamera.mjCAMERA_TRACKING)


class Eye:
    """One camera's renderer, brought to any picture as if all before had been drawn.

    Args:
        renderer: of its pictures.
        camera: what it draws with; None where somebody else moves that.
        before: where the two cameras of its scene stand before the first picture.
    """

    def __init__(
        self, renderer: SceneRenderer, *, camera: Camera | None, before: ArrayLike
    ) -> None:
        self.renderer = renderer
        self._before = before
        self._following: mujoco.MjvCamera | None = None
        if isinstance(camera, mujoco.MjvCamera) and camera.type == _TRACKING:
            self._following = camera
            self._start = camera.lookat.copy()

    @property
    def is_following(self) -> bool:
        """Whether each picture moves its camera, by a part of the way to a body."""
        return self._following is not None

    def begin(self) -> None:
        """Go to before the first picture."""
        self.renderer.camera_positions = self._before
        if self._following is not None:
            self._following.lookat[:] = self._start
