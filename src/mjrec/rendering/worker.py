# SPDX-License-Identifier: Apache-2.0
"""A process that draws frames: `python -m mjrec.rendering.worker`.

Its parent sends::

    {"tries": true}                         it looks first at a frame of its own
    {"drawing": {...}, "indices": [1, 3, 5]}

`drawing` is what `open_drawing` takes; `indices` are the frames. It sends the bytes of
frames, `(height, width, 3) uint8`, and::

    {"size": [48, 64], "gl": {...}}         before the frames of a job
    {"error": {...}}                        instead of a frame and all that would follow
    {"log": ["mjrec.x", 30, "..."]}         for the parent's log
    {"untried": "..."}                      its own frame is not what it should be:
                                            then it ends

It ends with its parent, in mid-drawing too.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InvalidArgument
from ..frames import Frame, grid_frame, grid_shape
from ..messages import carried
from ..parent import Parent
from ..simulation.cameras import Camera, camera_from_members
from ..simulation.gl_probe import draw_test_scene
from ..simulation.recorded_scene import GivenStates, RecordedScene
from ..simulation.renderer import Canvas, SceneRenderer
from ..simulation.warnings import log_mujoco_warnings
from .recorded_facts import check_has_frames, open_for_rendering
from .views import PlainCamera, View

_NICE = 10


class Drawing:
    """Frames of a scene, known by their numbers, from 0.

    Each is the same whatever was drawn before: the cameras are brought to where they
    would be if all before had been drawn.

    Args:
        scene: what is drawn.
        cameras: whose frames they are, in a grid where there are several. All draw
            with one context.
        acquired: what `close` frees.
    """

    def __init__(
        self,
        scene: RecordedScene | GivenStates,
        cameras: Iterable[SceneRenderer],
        acquired: contextlib.ExitStack,
    ) -> None:
        self._scene = scene
        self._cameras = list(cameras)
        self._acquired = acquired
        # The frame whose cameras the renderers have in mind.
        self._last: int | None = None
        self._context_is_old = False

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the frames."""
        height, width = self._cameras[0].size
        rows, columns = grid_shape(len(self._cameras))
        return rows * height, columns * width

    @property
    def gl_facts(self) -> dict[str, Any]:
        """Who draws, and on which device: `gl_context.current_gl_facts`."""
        return self._cameras[0].gl_facts

    def draw(self, index: int, *, out: Frame | None = None) -> Frame:
        """Return a frame, in `out` if that is given.

        Raises:
            InvalidArgument: there is no such frame.
            UnreadableFile: the file is damaged.
            GLError: the driver hangs.
        """
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
            self._cameras[0].model_changed()
            self._context_is_old = False
        frame = self._render(out)
        self._last = index
        return frame

    def close(self) -> None:
        """Free what was acquired for this drawing. Idempotent."""
        self._acquired.close()

    def _render(self, out: Frame | None) -> Frame:
        if len(self._cameras) == 1:
            return self._cameras[0].render(self._scene.data, out=out)
        grid = grid_frame([camera.render(self._scene.data) for camera in self._cameras])
        if out is None:
            return grid
        np.copyto(out, grid)
        return out

    def _prepare(self, index: int, last: int | None) -> None:
        """Bring the cameras to where they are before a frame."""
        start = max(0, index - 1)
        if any(camera.is_following for camera in self._cameras):
            start = 0 if last is None or last >= index else last + 1
        if start == 0:
            for camera in self._cameras:
                camera.begin()
        for earlier in range(start, index):
            self._bring_to(earlier)
            for camera in self._cameras:
                camera.look(self._scene.data)

    def _bring_to(self, index: int) -> None:
        self._context_is_old |= self._scene.bring_to(index)


def trajectory_drawing(
    path: Path,
    view: View,
    *,
    cameras: Sequence[PlainCamera | None] | None = None,
    canvas: Canvas | None = None,
) -> Drawing:
    """Return the frames that `env.render()` would have given in a recorded episode.

    Args:
        path: of the trajectory; its model is looked for beside it.
        view: what of them is to be other than recorded.
        cameras: several in place of that of the view; None among them is as recorded.
            A frame is then all that they show, in a grid.
        canvas: what to draw with; something new, if None.

    Raises:
        UnreadableFile: of the trajectory or its model.
        NoPictures: it has no snapshots.
        UnknownName, InvalidArgument: its model has no such camera, or a size that the
            driver cannot draw.
        GLError: nothing can be drawn here.
    """
    with contextlib.ExitStack() as opened:
        reader = opened.enter_context(open_for_rendering(path, is_vetted=True))
        check_has_frames(reader)
        facts = reader.facts
        scene = RecordedScene(reader)
        model, recorded = scene.model, scene.view
        look: dict[str, Any] = {
            "height": recorded.height if view.height is None else view.height,
            "width": recorded.width if view.width is None else view.width,
            "quality": view.quality
            or (facts.get("video") or {}).get("quality", "full"),
        }
        shared = canvas or opened.enter_context(contextlib.closing(Canvas()))

        def renderer(asked: PlainCamera | None) -> SceneRenderer:
            # Of a camera as recorded it is known how the frames have moved it.
            own: dict[str, Any] = (
                {"camera": _camera(model, asked)}
                if asked is not None
                else {
                    "camera": recorded.camera,
                    "begins_at": scene.previous_cameras,
                    "is_moved": True,
                }
            )
            return SceneRenderer(
                model,
                scene_option=recorded.option,
                max_geom=recorded.max_geom,
                fresh=recorded.fresh,
                canvas=shared,
                **look,
                **own,
            )

        wanted = [view.camera] if cameras is None else cameras
        return Drawing(scene, [renderer(asked) for asked in wanted], opened.pop_all())


def states_drawing(
    directory: Path, spec: int, view: View, *, canvas: Canvas
) -> Drawing:
    """Return the frames of given states, with all that is computed from them.

    Args:
        directory: where `save_states` wrote them.
        spec: which components a state has.
        view: how they are to be drawn, with nothing left open.
        canvas: what to draw with.

    Raises:
        UnknownName, InvalidArgument, GLError: as `trajectory_drawing`.
    """
    scene = GivenStates(directory, spec)
    camera = _camera(scene.model, view.camera)
    look: dict[str, Any] = {
        "height": view.height,
        "width": view.width,
        "quality": view.quality,
    }
    renderer = SceneRenderer(scene.model, camera=camera, canvas=canvas, **look)
    return Drawing(scene, [renderer], contextlib.ExitStack())


def open_drawing(drawing: Mapping[str, Any], canvas: Canvas) -> Drawing:
    """Return what is described, for a worker, in plain JSON.

    Args:
        drawing: `trajectory` (a path), or `states` (a directory) and `spec`; and
            `view`; and, of a trajectory, `cameras`.
        canvas: what to draw with.
    """
    log_mujoco_warnings()
    view = View(**drawing["view"])
    if "trajectory" in drawing:
        path, cameras = Path(drawing["trajectory"]), drawing.get("cameras")
        return trajectory_drawing(path, view, cameras=cameras, canvas=canvas)
    states = Path(drawing["states"])
    return states_drawing(states, drawing["spec"], view, canvas=canvas)


def _camera(model: Any, camera: Any) -> Camera:
    return camera_from_members(model, camera) if isinstance(camera, dict) else camera


def main() -> None:
    """Draw what the parent wants, until it ends."""
    parent = Parent()
    parent.send_warnings()
    parent.listen()
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    canvas = Canvas()
    while True:
        order = parent.receive()
        if "tries" in order:
            try:
                draw_test_scene()
            except Exception as error:
                parent.send(untried=str(error))
                # Not `sys.exit`, which would wait for the driver.
                os._exit(1)
            continue
        try:
            _draw(order, canvas, parent)
        except Exception as error:
            parent.send(error=carried(error))


def _draw(order: Mapping[str, Any], canvas: Canvas, parent: Parent) -> None:
    with contextlib.closing(open_drawing(order["drawing"], canvas)) as drawing:
        parent.send(size=drawing.size, gl=drawing.gl_facts)
        frame = np.empty((*drawing.size, 3), np.uint8)
        for index in order["indices"]:
            drawing.draw(index, out=frame)
            parent.send(frame.data)


if __name__ == "__main__":
    main()
