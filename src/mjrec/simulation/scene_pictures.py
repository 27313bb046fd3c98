# SPDX-License-Identifier: Apache-2.0
"""Pictures of a live simulation, drawn by a renderer of our own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco

from ..frames import Frame, check_size
from .cameras import camera_names, raw_data, raw_model, resolve_camera
from .renderer import SceneRenderer

__all__ = ["Look", "ScenePictures", "camera_label", "option_without_rangefinder"]


@dataclass(frozen=True, kw_only=True)
class Look:
    """How an environment shows its scene.

    Attributes:
        camera: a name, a number, or an `mujoco.MjvCamera`.
        scene_option: the `mujoco.MjvOption`; None is MuJoCo's default.
        max_geom: how many geoms the scene may have.
    """

    camera: Any = -1
    scene_option: mujoco.MjvOption | None = None
    max_geom: int = 10000


class ScenePictures:
    """Pictures of a simulation from any camera and of any size.

    Args:
        simulation: returns the model and the data of this moment, MuJoCo's own or
            dm_control's. A model other than the last one gets a renderer of its own.
        look: returns how the environment shows its scene; asked when a renderer is
            made.
        camera: instead of the look's.
        height: in pixels.
        width: in pixels.

    Raises:
        UnknownName: the model has no such camera.
        InvalidArgument: a size that cannot be.
    """

    render_mode = "rgb_array"

    def __init__(
        self,
        simulation: Callable[[], tuple[Any, Any]],
        *,
        look: Callable[[], Look],
        camera: Any,
        height: int,
        width: int,
    ) -> None:
        self._simulation = simulation
        self._look = look
        self._camera = camera
        self._height, self._width = check_size(height, width)
        self._renderer: SceneRenderer | None = None
        self._drawn_model: mujoco.MjModel | None = None
        self._shown_camera: Any = camera
        if camera is not None:
            resolve_camera(self._model(), camera)

    def render(self) -> Frame:
        """Return the picture of this moment, `(height, width, 3) uint8`."""
        renderer = self._renderer_for(self._model())
        return renderer.render(raw_data(self._simulation()[1]))

    def begin_episode(self) -> None:
        """Look for what a reset may have changed below the renderer.

        Height fields, textures and meshes are copied into the OpenGL context; a task
        that makes a new terrain in its reset changes only the model.
        """
        # Another model gets another renderer when it is drawn.
        if self._renderer is not None and self._draws(self._model()):
            self._renderer.model_changed()

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its pictures."""
        facts: dict[str, Any] = {"pictures": "scene", "quality": "full"}
        if self._drawn_model is not None:
            facts["camera"] = camera_label(self._drawn_model, self._shown_camera)
        if self._renderer is not None:
            vendor, renderer, version = self._renderer.gl_strings
            facts.update(gl_vendor=vendor, gl_renderer=renderer, gl_version=version)
        return facts

    def close(self) -> None:
        """Free the renderer. Idempotent."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _model(self) -> mujoco.MjModel:
        return raw_model(self._simulation()[0])

    def _draws(self, model: mujoco.MjModel) -> bool:
        # The Python wrapper of one and the same model can be made anew at each
        # access; the address tells models apart. The drawn one is kept alive, so that
        # no other can come to lie where it was.
        drawn = self._drawn_model
        return drawn is not None and bool(drawn._address == model._address)

    def _renderer_for(self, model: mujoco.MjModel) -> SceneRenderer:
        if self._renderer is None or not self._draws(model):
            self.close()
            look = self._look()
            self._shown_camera = look.camera if self._camera is None else self._camera
            self._renderer = SceneRenderer(
                model,
                height=self._height,
                width=self._width,
                camera=self._shown_camera,
                scene_option=look.scene_option,
                max_geom=look.max_geom,
            )
            self._drawn_model = model
        return self._renderer


def option_without_rangefinder() -> mujoco.MjvOption:
    """Return dm_control's default option, which differs from MuJoCo's in one flag."""
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False
    return option


def camera_label(model: mujoco.MjModel, camera: Any) -> str | int | dict[str, Any]:
    """Return a camera as metadata says it: a name, a number, or a free camera's pose.

    Args:
        model: has the camera.
        camera: a name, a number (-1 is the free camera) or an `mujoco.MjvCamera`.
    """
    if isinstance(camera, str):
        return camera
    if not isinstance(camera, mujoco.MjvCamera):
        return _name_or_number(model, int(camera))
    if int(camera.type) == int(mujoco.mjtCamera.mjCAMERA_FIXED):
        return _name_or_number(model, camera.fixedcamid)
    return {
        "type": mujoco.mjtCamera(camera.type).name,
        "trackbodyid": int(camera.trackbodyid),
        "lookat": camera.lookat.tolist(),
        "distance": float(camera.distance),
        "azimuth": float(camera.azimuth),
        "elevation": float(camera.elevation),
    }


def _name_or_number(model: mujoco.MjModel, number: int) -> str | int:
    # Unnamed cameras have an empty name.
    name = model.cam(number).name if number >= 0 else ""
    return name if name in camera_names(model) and name else number
