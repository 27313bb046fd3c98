# SPDX-License-Identifier: Apache-2.0
"""A process that draws frames: `python -m mjrec.rendering.worker`.

Its parent sends::

    {"tries": true}                         it makes its context and, if true, looks at
                                            a frame of its own
    {"prepares": {...}}                     it loads what that will be drawn with
    {"drawing": {...}, "indices": [1, 3, 5]}

`drawing` and `prepares` are what `open_drawing` takes; `indices` are the frames. It
sends the bytes of frames, `(height, width, 3) uint8`, and::

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
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import Error, InvalidArgument
from ..frames import Frame, grid_frame, grid_shape
from ..messages import carried
from ..parent import Parent
from ..simulation.gl_probe import draw_test_scene
from ..simulation.recorded_scene import GivenStates, RecordedScene
from ..simulation.renderer import Canvas, SceneRenderer
from ..simulation.warnings import log_mujoco_warnings
from .recorded_facts import check_has_frames, open_for_rendering
from .views import PlainCamera, View

_NICE = 10
_LOOKS_FOR_RECORDING = 100
_SECONDS_BETWEEN_LOOKS = 0.02


class Drawing:
    """Frames of a scene, known by their numbers, from 0.

    Each is the same whatever was drawn before: the cameras are brought to where they
    would be if all before had been drawn.

    Args:
        scene: what is drawn.
        cameras: whose frames they are, in a grid where there are several. All draw
            with one canvas.
    """

    def __init__(
        self, scene: RecordedScene | GivenStates, cameras: Sequence[SceneRenderer]
    ) -> None:
        self._scene = scene
        self._cameras = cameras
        # The frame whose cameras the renderers have in mind.
        self._last: int | None = None
        self._canvas_is_old = False
        # Whether a frame depends on the one before, at any time.
        self._looks_back = not scene.is_constant or any(
            camera.shows_frame_before for camera in cameras
        )

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

    def draw(self, index: int) -> Frame:
        """Return a frame.

        Raises:
            InvalidArgument: there is no such frame.
            UnreadableFile: the file is damaged.
            GLError: the driver hangs.
        """
        if not 0 <= index < self._scene.count:
            raise InvalidArgument(
                f"There is no frame {index}: there are {self._scene.count}, numbered "
                "from 0."
            )
        last, self._last = self._last, None
        if self._looks_back and (last is None or index != last + 1):
            self._prepare(index, last)
        self._bring_to(index)
        if self._canvas_is_old:
            self._cameras[0].model_changed()
            self._canvas_is_old = False
        frames = [camera.render(self._scene.data) for camera in self._cameras]
        self._last = index
        return frames[0] if len(frames) == 1 else grid_frame(frames)

    def close(self) -> None:
        """Close the files of the scene. Idempotent."""
        self._scene.close()

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
        self._canvas_is_old |= self._scene.bring_to(index)


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
    reader = open_for_rendering(path, is_vetted=True)
    try:
        check_has_frames(reader)
        scene = RecordedScene(reader)
        recorded = scene.view
        quality = (reader.facts.get("video") or {}).get("quality", "full")
        shared: dict[str, Any] = {
            "scene_option": recorded.option,
            "max_geom": recorded.max_geom,
            "fresh": recorded.fresh,
            "height": recorded.height if view.height is None else view.height,
            "width": recorded.width if view.width is None else view.width,
            "quality": view.quality or quality,
            "canvas": canvas or Canvas(),
        }
        # Of a camera as recorded it is known how the frames have moved it.
        as_recorded = {
            "camera": recorded.camera,
            "begins_at": scene.previous_cameras,
            "is_moved": True,
        }
        wanted = [view.camera] if cameras is None else cameras
        own = (as_recorded if c is None else {"camera": c} for c in wanted)
        renderers = [SceneRenderer(scene.model, **shared, **each) for each in own]
        return Drawing(scene, renderers)
    except BaseException:
        reader.close()
        raise


def open_drawing(drawing: Mapping[str, Any], canvas: Canvas) -> Drawing:
    """Return what is described, for a worker, in plain JSON.

    Args:
        drawing: `trajectory` (a path), or `states` (a directory of `save_states`) and
            `spec`; and `view`; and, of a trajectory, `cameras`.
        canvas: what to draw with.

    Raises:
        Error: as of `trajectory_drawing`.
    """
    log_mujoco_warnings()
    view = View(**drawing["view"])
    if "trajectory" in drawing:
        path, cameras = Path(drawing["trajectory"]), drawing.get("cameras")
        return trajectory_drawing(path, view, cameras=cameras, canvas=canvas)
    scene = GivenStates(Path(drawing["states"]), drawing["spec"])
    # Nothing is left open.
    look: dict[str, Any] = vars(view)
    return Drawing(scene, [SceneRenderer(scene.model, canvas=canvas, **look)])


def main() -> None:
    """Draw what the parent wants, until it ends."""
    parent = Parent()
    parent.send_warnings()
    parent.listen()
    os.setpriority(os.PRIO_PROCESS, 0, max(_NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    canvas = Canvas(is_alone=True)
    while True:
        order = parent.receive()
        if "prepares" in order:
            _prepare(order["prepares"], canvas, parent)
        elif "drawing" in order:
            try:
                _draw(order, canvas, parent)
            except Exception as error:
                parent.send(error=carried(error))
        elif order["tries"]:
            try:
                draw_test_scene(canvas=canvas)
            except Exception as error:
                parent.send(untried=str(error))
                # Not `sys.exit`, which would wait for the driver.
                os._exit(1)
        else:
            # What is in the way is said when there is something to draw.
            with contextlib.suppress(Error):
                canvas.open()


def _prepare(drawing: Mapping[str, Any], canvas: Canvas, parent: Parent) -> None:
    """Load the model into the canvas, where it is there before there is more to do."""
    for _ in range(_LOOKS_FOR_RECORDING):
        if parent.has_said_something:
            return
        # A recording is there from its first step on, its model a moment later. What
        # else is in the way is said when there is something to draw.
        with contextlib.suppress(Exception):
            open_drawing(drawing, canvas).close()
            return
        time.sleep(_SECONDS_BETWEEN_LOOKS)


def _draw(order: Mapping[str, Any], canvas: Canvas, parent: Parent) -> None:
    with contextlib.closing(open_drawing(order["drawing"], canvas)) as drawing:
        parent.send(size=drawing.size, gl=drawing.gl_facts)
        for index in order["indices"]:
            parent.send(drawing.draw(index).data)


if __name__ == "__main__":
    main()
