# SPDX-License-Identifier: Apache-2.0
"""The scene that Gymnasium's off-screen viewer shows or would show.

This module imports mujoco through `simulation`. Load it only if there is a simulation.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any

from ..frames import check_size
from ..simulation.cameras import FREE_CAMERA, camera_label, resolve_camera
from ..simulation.view import (
    SceneView,
    copy_members,
    new_scene_flags,
    place_free_camera,
    place_viewer_camera,
    select_camera,
    viewer_option,
)
from .scenes import class_name, has_own_method, is_defined_by

_MODE = "rgb_array"
_RENDERING = "gymnasium.envs.mujoco.mujoco_rendering"

# Gymnasium's default, for environments that do not specify a size.
_SIDE = 480

# The limit that our own renderer uses if the environment has no renderer.
_MAX_GEOM = 10000

# Each is called once at every captured step; its values are compared together.
_OF_SIMULATION = attrgetter("mujoco_renderer", "model", "data")
_OF_RENDERER = attrgetter("model", "camera_id", "_viewers")
_NO_VIEWERS: dict[str, Any] = {}


class ViewerScene:
    """The scene shown by an environment's viewer.

    If the environment has a viewer for `rgb_array`, the scene has the viewer's own
    camera and options, including the user's changes. Until then, it is the scene that a
    viewer created at the first frame would show, as long as the environment keeps its
    renderer.

    Args:
        simulated: an object with MuJoCo's `model` and `data` and, if it is a Gymnasium
            environment, `mujoco_renderer`.
        camera: a name, a number or an `MjvCamera`; None for the environment's own.
        height: height in pixels; None for the environment's own.
        width: width in pixels; None for the environment's own.

    Raises:
        UnknownName: the model has no such camera.
        InvalidArgument: the camera's number or the size is invalid.
    """

    def __init__(
        self, simulated: Any, *, camera: Any, height: int | None, width: int | None
    ) -> None:
        self._simulated = simulated
        self._asked = camera
        self._data: Any = None
        self._height, self._width = check_size(
            _own_side(simulated, "height") if height is None else height,
            _own_side(simulated, "width") if width is None else width,
        )
        own = FREE_CAMERA if camera is None else camera
        # These objects are never replaced, because they are watched for changes.
        self._camera = resolve_camera(simulated.model, own)
        self._option = viewer_option()
        self._labelled: tuple[Any, Any] | None = None
        self._start()

    def __call__(self) -> SceneView:
        """Return the view, which `at_frame` keeps up to date from now on."""
        self._update()
        self._data = self._simulated.data
        self._note_unmoved()
        return SceneView(
            camera=self._camera,
            option=self._option,
            max_geom=getattr(self._renderer, "max_geom", _MAX_GEOM),
            fresh=False,
            height=self._height,
            width=self._width,
            label=self._label(),
        )

    def at_frame(self, capture: Callable[[], None]) -> None:
        """Call `capture` with the view of the current frame."""
        self._update()
        self._is_settled = True
        self._note_unmoved()
        capture()

    def forget(self) -> None:
        """Treat the next frame as if it were the first.

        An existing viewer is not changed.
        """
        self._start()

    def is_unmoved(self) -> bool:
        """Check quickly whether the view is known to be unchanged since the last frame.

        Changes to the model, the camera and the option are not checked for. The result
        is True if the simulation is the same as when the view was returned, and there
        is no viewer that the user could have changed.
        """
        unmoved = self._unmoved
        return unmoved is not None and unmoved == (
            _OF_SIMULATION(self._simulated),
            _OF_RENDERER(self._renderer),
        )

    def obstacle(self) -> str | None:
        """Return the reason why the viewer's frame would be different, or None."""
        renderer, viewer = self._renderer, self._viewer()
        if renderer is not None and renderer.model is not self._simulated.model:
            return "the renderer does not draw the model that the environment simulates"
        return None if viewer is None else _addition(viewer, self._new_flags)

    def _label(self) -> str | int | dict[str, Any]:
        """Return the camera's metadata label, which is cached because it is slow."""
        asked = self._camera if self._asked is None else self._asked
        seen = (self._model, asked, *_pose(self._camera))
        if self._labelled is None or self._labelled[0] != seen:
            self._labelled = (seen, camera_label(self._model, asked))
        return self._labelled[1]

    def _start(self) -> None:
        self._model = self._simulated.model
        self._renderer: Any = getattr(self._simulated, "mujoco_renderer", None)
        self._new_flags = new_scene_flags(self._model)
        self._is_settled = False
        self._camera_id: int | None = None
        # The values that `is_unmoved` expects; None if it must return False.
        self._unmoved: tuple[tuple[Any, ...], tuple[Any, ...]] | None = None
        flags = getattr(self._renderer, "_vopt", None)
        copy_members(viewer_option(flags), self._option)
        if self._asked is not None:
            # In another model, the name may refer to a different number.
            camera = resolve_camera(self._model, self._asked)
            copy_members(camera, self._camera)

    def _note_unmoved(self) -> None:
        renderer, model = self._renderer, self._model
        self._unmoved = None
        if self._is_settled and renderer is not None:
            self._unmoved = (
                (renderer, model, self._data),
                (model, renderer.camera_id, _NO_VIEWERS),
            )

    def _update(self) -> None:
        renderer = getattr(self._simulated, "mujoco_renderer", None)
        if renderer is not self._renderer or self._simulated.model is not self._model:
            self._start()
        viewer = self._viewer()
        if viewer is not None:
            copy_members(viewer.vopt, self._option)
        if self._asked is None and renderer is not None:
            self._update_own_camera(viewer)
        elif self._asked is None or self._asked == FREE_CAMERA:
            # The free camera's pose depends on the model's fields.
            place_free_camera(self._model, self._camera)

    def _update_own_camera(self, viewer: Any) -> None:
        renderer = self._renderer
        if viewer is not None:
            copy_members(viewer.cam, self._camera)
        elif not self._is_settled:
            config = renderer.default_cam_config
            data = self._simulated.data
            place_viewer_camera(self._model, data, config, self._camera)
        elif renderer.camera_id == self._camera_id:
            # This is the usual case at every step.
            return
        self._camera_id = renderer.camera_id
        select_camera(self._camera, self._camera_id)

    def _viewer(self) -> Any:
        # The viewers of other render modes have their own cameras.
        viewers = getattr(self._renderer, "_viewers", None)
        return viewers.get(_MODE) if viewers else None


def _pose(camera: Any) -> tuple[Any, ...]:
    return (
        *(int(camera.type), camera.fixedcamid, camera.trackbodyid),
        *(camera.distance, camera.azimuth, camera.elevation, camera.orthographic),
        *camera.lookat.tolist(),
    )


def _own_side(simulated: Any, name: str) -> int:
    renderer = getattr(simulated, "mujoco_renderer", None)
    side = getattr(renderer, name, None) or getattr(simulated, name, None)
    return int(side or _SIDE)


def _addition(viewer: Any, new_flags: bytes) -> str | None:
    """Return a description of what a viewer shows in addition to the scene, or None."""
    if viewer._markers:
        return "markers were added to the viewer"
    if viewer._overlays:
        return "the viewer's frames have a text overlay"
    if viewer.pert.select or viewer.pert.active:
        return "a body is selected in the viewer"
    if viewer.scn.flags.tobytes() != new_flags:
        return "rendering flags of the viewer's scene were changed"
    render = type(viewer).render
    if has_own_method(viewer, "render") or not is_defined_by(
        render, _RENDERING, "OffScreenViewer.render"
    ):
        return f"the viewer {class_name(type(viewer))} is not Gymnasium's own"
    return None
