# SPDX-License-Identifier: Apache-2.0
"""Pictures of a recorded episode, or of given states, in any order.

This is what a worker does; whoever wants many pictures lets several workers do it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..errors import InvalidArgument
from ..frames import Frame, grid_frame, grid_shape
from ..simulation.cameras import Camera, camera_from_members
from ..simulation.eyes import Eye
from ..simulation.given_states import GivenStates
from ..simulation.mujoco_warnings import log_mujoco_warnings
from ..simulation.recorded_scene import RecordedScene
from ..simulation.renderer import SceneRenderer
from .recorded_facts import open_for_rendering
from .recorded_pictures import check_has_pictures
from .views import PlainCamera, View


class Drawing(Protocol):
    """Pictures that are known by their numbers, from 0."""

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""

    @property
    def gl_facts(self) -> dict[str, Any]:
        """Who draws, and on which device: `gl_strings.current_gl_facts`."""

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
        cameras: several in place of that of the view; None among them is as recorded.
            A picture is then all that they show, in a grid.

    Raises:
        UnreadableFile: of the trajectory or its model.
        NoPictures: it has no snapshots.
        UnknownName, InvalidArgument: its model has no such camera, or a size that the
            driver cannot draw.
        GLError: nothing can be drawn here.
    """

    def __init__(
        self,
        path: Path,
        view: View,
        *,
        cameras: Sequence[PlainCamera | None] | None = None,
    ) -> None:
        self._reader = open_for_rendering(path)
        try:
            check_has_pictures(self._reader)
            scene = RecordedScene(self._reader)
        except BaseException:
            self._reader.close()
            raise
        self._pictures = _Pictures(scene)
        try:
            for camera in [view.camera] if cameras is None else cameras:
                self._pictures.eyes.append(self._eye(scene, view, camera))
        except BaseException:
            self.close()
            raise

    def _eye(self, scene: RecordedScene, view: View, camera: PlainCamera | None) -> Eye:
        recorded = scene.view
        chosen = recorded.camera if camera is None else _camera(scene.model, camera)
        return Eye(
            SceneRenderer(
                scene.model,
                height=_or(view.height, recorded.height),
                width=_or(view.width, recorded.width),
                camera=chosen,
                scene_option=recorded.option,
                max_geom=recorded.max_geom,
                quality=view.quality or _recorded_quality(self._reader.header.facts),
                fresh=recorded.fresh,
            ),
            # Of a camera as recorded it is known how the pictures have moved it.
            camera=None if camera is None else chosen,
            before=scene.previous_cameras if camera is None else np.zeros((2, 3)),
        )

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self._pictures.size

    @property
    def gl_facts(self) -> dict[str, Any]:
        """Who draws, and on which device: `gl_strings.current_gl_facts`."""
        return self._pictures.gl_facts()

    def draw(self, index: int, *, out: Frame | None = None) -> Frame:
        """Return picture `index` of the trajectory, in `out` if that is given.

        Raises:
            InvalidArgument: there is no such picture.
            UnreadableFile: the file is damaged.
            GLError: the driver hangs.
        """
        return self._pictures.draw(index, out)

    def close(self) -> None:
        """Close the file and free the renderers. Idempotent."""
        self._pictures.close()
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
        camera = _camera(scene.model, _or(view.camera, -1))
        renderer = SceneRenderer(
            scene.model,
            height=view.height,
            width=view.width,
            camera=camera,
            quality=view.quality or "full",
        )
        self._pictures = _Pictures(scene)
        self._pictures.eyes.append(
            Eye(renderer, camera=camera, before=np.zeros((2, 3)))
        )

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self._pictures.size

    @property
    def gl_facts(self) -> dict[str, Any]:
        """Who draws, and on which device: `gl_strings.current_gl_facts`."""
        return self._pictures.gl_facts()

    def draw(self, index: int, *, out: Frame | None = None) -> Frame:
        """Return the picture of row `index`, in `out` if that is given."""
        return self._pictures.draw(index, out)

    def close(self) -> None:
        """Free the renderer. Idempotent."""
        self._pictures.close()


def open_drawing(drawing: Mapping[str, Any]) -> Drawing:
    """Return what is described, for a worker, in plain JSON.

    Args:
        drawing: `trajectory` (a path), or `states` (a directory) and `spec`; and
            `view`; and, of a trajectory, `cameras`.
    """
    log_mujoco_warnings()
    view = View(**drawing["view"])
    if "trajectory" in drawing:
        return TrajectoryDrawing(
            Path(drawing["trajectory"]), view, cameras=drawing.get("cameras")
        )
    return StatesDrawing(Path(drawing["states"]), drawing["spec"], view)


class _Scene(Protocol):
    @property
    def data(self) -> Any: ...

    @property
    def count(self) -> int: ...

    def bring_to(self, index: int) -> bool: ...


class _Pictures:
    """Draws a scene so that each picture is as if all before had been drawn.

    An infinite plane depends on where the cameras were in the picture before, and a
    camera that follows a body on all pictures before.

    Args:
        scene: what is drawn.

    Attributes:
        eyes: whose pictures they are, in a grid where there are several.
    """

    def __init__(self, scene: _Scene) -> None:
        self.eyes: list[Eye] = []
        self._scene = scene
        # The picture whose cameras the renderers have in mind.
        self._last: int | None = None
        self._context_is_old = False

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.eyes[0].renderer.size
        rows, columns = grid_shape(len(self.eyes))
        return rows * height, columns * width

    def draw(self, index: int, out: Frame | None) -> Frame:
        if not 0 <= index < self._scene.count:
            raise InvalidArgument(
                f"There is no picture {index}: there are {self._scene.count}, numbered "
                "from 0."
            )
        last, self._last = self._last, None
        if last is None or index != last + 1:
            self._prepare(index, last)
        self._bring_to(index)
        if self._context_is_old:
            for eye in self.eyes:
                eye.renderer.model_changed()
            self._context_is_old = False
        frame = self._render(out)
        self._last = index
        return frame

    def gl_facts(self) -> dict[str, Any]:
        return self.eyes[0].renderer.gl_facts

    def close(self) -> None:
        for eye in self.eyes:
            eye.renderer.close()

    def _render(self, out: Frame | None) -> Frame:
        if len(self.eyes) == 1:
            return self.eyes[0].renderer.render(self._scene.data, out=out)
        frames = [eye.renderer.render(self._scene.data) for eye in self.eyes]
        grid = grid_frame(frames)
        if out is None:
            return grid
        np.copyto(out, grid)
        return out

    def _prepare(self, index: int, last: int | None) -> None:
        """Bring the cameras to where they are before a picture."""
        start = max(0, index - 1)
        if any(eye.is_following for eye in self.eyes):
            start = 0 if last is None or last >= index else last + 1
        if start == 0:
            for eye in self.eyes:
                eye.begin()
        for earlier in range(start, index):
            self._bring_to(earlier)
            for eye in self.eyes:
                eye.renderer.look(self._scene.data)

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
