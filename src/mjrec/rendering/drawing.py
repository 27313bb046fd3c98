# SPDX-License-Identifier: Apache-2.0
"""Pictures of a recorded episode, or of given states, in any order.

This is what a worker does; whoever wants many pictures lets several workers do it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InvalidArgument
from ..frames import Frame
from ..simulation.cameras import Camera, camera_from_members
from ..simulation.given_states import GivenStates
from ..simulation.mujoco_warnings import log_mujoco_warnings
from ..simulation.recorded_scene import RecordedScene
from ..simulation.renderer import SceneRenderer
from .recorded_facts import open_for_rendering
from .recorded_pictures import check_has_pictures
from .views import PlainCamera, View

__all__ = ["Drawing", "StatesDrawing", "TrajectoryDrawing", "open_drawing"]


class Drawing(Protocol):
    """Pictures that are known by their numbers, from 0."""

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""

    @property
    def gl_strings(self) -> dict[str, str]:
        """Who draws: `gl_vendor`, `gl_renderer`, `gl_version`."""

    def draw(self, index: int, *, out: Frame | None = None) -> Frame:
        """Return a picture, in `out` if that is given.

        It is the same whatever was drawn before.
        """

    def close(self) -> None:
        """Free what was acquired. Idempotent."""


class TrajectoryDrawing:
    """The pictures that `env.render()` would have given in a recorded episode.

    Args:
        path: of the trajectory; its model is looked for beside it.
        view: what of them is to be other than recorded.

    Raises:
        UnreadableFile: of the trajectory or its model.
        NoPictures: it has no snapshots.
        UnknownName, InvalidArgument: its model has no such camera, or a size that the
            driver cannot draw.
        GLError: nothing can be drawn here.
    """

    def __init__(self, path: Path, view: View) -> None:
        self._reader = open_for_rendering(path)
        try:
            check_has_pictures(self._reader)
            scene = RecordedScene(self._reader)
            as_recorded = view.camera is None
            self._pictures = _Pictures(
                scene,
                SceneRenderer(
                    scene.model,
                    height=_or(view.height, scene.view.height),
                    width=_or(view.width, scene.view.width),
                    camera=scene.view.camera
                    if view.camera is None
                    else _camera(scene.model, view.camera),
                    scene_option=scene.view.option,
                    max_geom=scene.view.max_geom,
                    quality=view.quality
                    or _recorded_quality(self._reader.header.facts),
                    fresh=scene.view.fresh,
                ),
                before=scene.previous_cameras if as_recorded else np.zeros((2, 3)),
            )
        except BaseException:
            self._reader.close()
            raise

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self._pictures.renderer.size

    @property
    def gl_strings(self) -> dict[str, str]:
        """Who draws: `gl_vendor`, `gl_renderer`, `gl_version`."""
        return self._pictures.gl_strings()

    def draw(self, index: int, *, out: Frame | None = None) -> Frame:
        """Return picture `index` of the trajectory, in `out` if that is given.

        Raises:
            InvalidArgument: there is no such picture.
            UnreadableFile: the file is damaged.
            GLError: the driver hangs.
        """
        return self._pictures.draw(index, out)

    def close(self) -> None:
        """Close the file and free the renderer. Idempotent."""
        self._pictures.renderer.close()
        self._reader.close()


class StatesDrawing:
    """The pictures of given states, with everything computed that follows from them.

    Args:
        directory: where `save_states` wrote them.
        spec: which components a state has.
        view: how they are to be drawn, with nothing left open.

    Raises:
        UnknownName, InvalidArgument, GLError: as `TrajectoryDrawing`.
    """

    def __init__(self, directory: Path, spec: int, view: View) -> None:
        scene = GivenStates(directory, spec)
        assert view.height is not None
        assert view.width is not None
        self._pictures = _Pictures(
            scene,
            SceneRenderer(
                scene.model,
                height=view.height,
                width=view.width,
                camera=_camera(scene.model, _or(view.camera, -1)),
                quality=view.quality or "full",
            ),
            before=np.zeros((2, 3)),
        )

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self._pictures.renderer.size

    @property
    def gl_strings(self) -> dict[str, str]:
        """Who draws: `gl_vendor`, `gl_renderer`, `gl_version`."""
        return self._pictures.gl_strings()

    def draw(self, index: int, *, out: Frame | None = None) -> Frame:
        """Return the picture of row `index`, in `out` if that is given."""
        return self._pictures.draw(index, out)

    def close(self) -> None:
        """Free the renderer. Idempotent."""
        self._pictures.renderer.close()


def open_drawing(drawing: Mapping[str, Any]) -> Drawing:
    """Return what is described, for a worker, in plain JSON.

    Args:
        drawing: `trajectory` (a path), or `states` (a directory) and `spec`; and
            `view`.
    """
    log_mujoco_warnings()
    view = View(**drawing["view"])
    if "trajectory" in drawing:
        return TrajectoryDrawing(Path(drawing["trajectory"]), view)
    return StatesDrawing(Path(drawing["states"]), drawing["spec"], view)


class _Scene(Protocol):
    @property
    def data(self) -> Any: ...

    @property
    def count(self) -> int: ...

    def bring_to(self, index: int) -> bool: ...


class _Pictures:
    """Draws a scene so that each picture is as if all before had been drawn.

    An infinite plane depends on where the cameras were in the picture before.
    """

    def __init__(
        self, scene: _Scene, renderer: SceneRenderer, *, before: ArrayLike
    ) -> None:
        self._scene = scene
        self.renderer = renderer
        self._before = before
        # The picture whose cameras the renderer has in mind.
        self._last: int | None = None
        self._context_is_old = False

    def draw(self, index: int, out: Frame | None) -> Frame:
        if not 0 <= index < self._scene.count:
            raise InvalidArgument(
                f"There is no picture {index}: there are {self._scene.count}, numbered "
                "from 0."
            )
        if self._last is None or index != self._last + 1:
            self._prepare(index)
        self._last = None
        self._bring_to(index)
        if self._context_is_old:
            self.renderer.model_changed()
            self._context_is_old = False
        frame = self.renderer.render(self._scene.data, out=out)
        self._last = index
        return frame

    def gl_strings(self) -> dict[str, str]:
        vendor, renderer, version = self.renderer.gl_strings
        return {"gl_vendor": vendor, "gl_renderer": renderer, "gl_version": version}

    def _prepare(self, index: int) -> None:
        if index == 0:
            self.renderer.camera_positions = self._before
        else:
            self._bring_to(index - 1)
            self.renderer.look(self._scene.data)

    def _bring_to(self, index: int) -> None:
        self._context_is_old |= self._scene.bring_to(index)


def _camera(model: Any, camera: PlainCamera) -> Camera:
    if isinstance(camera, dict):
        return camera_from_members(model, camera)
    return camera


def _recorded_quality(facts: Mapping[str, Any]) -> Any:
    return (facts.get("video") or {}).get("quality", "full")


def _or(value: Any, otherwise: Any) -> Any:
    return otherwise if value is None else value
