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
            dm_control's. The model may be another one at each call.
        look: returns how the environment shows its scene; asked at the first picture.
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
        self._model: mujoco.MjModel | None = None
        if camera is not None:
            resolve_camera(raw_model(simulation()[0]), camera)

    def render(self) -> Frame:
        """Return the picture of this moment, `(height, width, 3) uint8`."""
        model, data = self._simulation()
        if self._renderer is None:
            self._renderer = self._made(raw_model(model))
        elif raw_model(model) is not self._model:
            self._renderer.model_changed(model)
        self._model = raw_model(model)
        return self._renderer.render(raw_data(data))

    def begin_episode(self) -> None:
        """Look for what a reset may have changed below the renderer.

        Height fields, textures and meshes are copied into the OpenGL context; a task
        that makes a new terrain in its reset changes only the model.
        """
        if self._renderer is not None:
            self._model = raw_model(self._simulation()[0])
            self._renderer.model_changed(self._model)

    def facts(self) -> dict[str, Any]:
        """Return what the metadata of a video says about its pictures."""
        facts: dict[str, Any] = {"pictures": "scene", "quality": "full"}
        if self._model is not None:
            facts["camera"] = camera_label(self._model, self._camera)
        if self._renderer is not None:
            facts.update(self._renderer.gl_facts)
        return facts

    def close(self) -> None:
        """Free the renderer. Idempotent."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _made(self, model: mujoco.MjModel) -> SceneRenderer:
        look = self._look()
        if self._camera is None:
            self._camera = look.camera
        return SceneRenderer(
            model,
            height=self._height,
            width=self._width,
            camera=self._camera,
            scene_option=look.scene_option,
            max_geom=look.max_geom,
        )


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
