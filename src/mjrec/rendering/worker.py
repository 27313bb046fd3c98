# SPDX-License-Identifier: Apache-2.0
"""A process that draws frames: `python -m mjrec.rendering.worker`.

Its parent sends::

    {"tries": true}                         create the context and, if true, check a
                                            test frame
    {"prepares": {...}}                     load the model of that drawing
    {"drawing": {...}, "indices": [1, 3, 5]}

`drawing` and `prepares` are arguments of `open_drawing`; `indices` are the numbers of
the frames. The worker sends the bytes of frames, `(height, width, 3) uint8`, and::

    {"size": [48, 64], "gl": {...}}         before the frames of a job
    {"error": {...}}                        instead of a frame and all later ones
    {"log": ["mjrec.x", 30, "..."]}         for the parent's log
    {"untried": "..."}                      the test frame is wrong; the worker exits

The worker ends when its parent does, even in the middle of a frame.
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
from ..messages import Parent, carried
from ..simulation.gl_probe import draw_test_scene
from ..simulation.recorded_scene import GivenStates, RecordedScene
from ..simulation.renderer import Canvas, SceneRenderer
from ..simulation.warnings import log_mujoco_warnings
from .jobs import PlainCamera, View
from .recorded_facts import check_has_frames, open_for_rendering

_NICE = 10
_LOOKS_FOR_RECORDING = 100
_SECONDS_BETWEEN_LOOKS = 0.02


class Drawing:
    """The frames of a scene, numbered from 0, which are drawn in ascending order.

    A frame does not depend on which frames were drawn before: the cameras are moved to
    where they would be if all earlier frames had been drawn.

    Args:
        scene: the scene to draw.
        cameras: a renderer for each camera. Several renderers produce a grid of frames.
            All use the same canvas.
    """

    def __init__(
        self, scene: RecordedScene | GivenStates, cameras: Sequence[SceneRenderer]
    ) -> None:
        self._scene = scene
        self._cameras = cameras
        # The number of the frame that the renderers' cameras have reached.
        self._last = -1
        self._canvas_is_old = False
        # Whether a frame can depend on the previous one.
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
        """Facts about the renderer and device; see `gl_context.current_gl_facts`."""
        return self._cameras[0].gl_facts

    def draw(self, index: int) -> Frame:
        """Draw a frame, `(height, width, 3) uint8`.

        Raises:
            InvalidArgument: the frame does not exist.
            UnreadableFile: the file is damaged.
            GLError: the driver hangs.
        """
        if not 0 <= index < self._scene.count:
            raise InvalidArgument(
                f"Frame {index} does not exist: there are {self._scene.count} frames, "
                "numbered from 0."
            )
        if self._looks_back:
            self._look_up_to(index)
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

    def _look_up_to(self, index: int) -> None:
        """Move the cameras to where they are just before a frame."""
        start = self._last + 1
        if not any(camera.is_following for camera in self._cameras):
            start = max(start, index - 1)
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
    """Return the frames that `env.render()` would have returned in a recorded episode.

    Args:
        path: the trajectory. Its model is expected in the same directory.
        view: changes from the recording.
        cameras: the cameras to use in place of the view's; None in the list stands for
            the recorded camera. Each frame is then a grid of their frames.
        canvas: the canvas to draw with; None creates a new one.

    Raises:
        UnreadableFile: the trajectory or its model cannot be read.
        NoPictures: the trajectory has no snapshots.
        UnknownName, InvalidArgument: the model lacks the camera, or the driver cannot
            draw frames of this size.
        GLError: nothing can be drawn on this machine.
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
        # For a camera as recorded, the recording contains its movement.
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
    """Open a drawing that is described in plain JSON.

    Args:
        drawing: `trajectory` (a path) and, optionally, `cameras`; or `states` (a
            directory written by `save_states`) and `spec`. Both contain `view`.
        canvas: the canvas to draw with.

    Raises:
        Error: see `trajectory_drawing`.
    """
    log_mujoco_warnings()
    view = View(**drawing["view"])
    if "trajectory" in drawing:
        path, cameras = Path(drawing["trajectory"]), drawing.get("cameras")
        return trajectory_drawing(path, view, cameras=cameras, canvas=canvas)
    scene = GivenStates(Path(drawing["states"]), drawing["spec"])
    # If states are given, no setting of the view is None.
    look: dict[str, Any] = vars(view)
    return Drawing(scene, [SceneRenderer(scene.model, canvas=canvas, **look)])


def main() -> None:
    """Draw the frames that the parent requests, until the parent ends."""
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
                # `sys.exit` would wait for the driver.
                os._exit(1)
        else:
            # Errors are reported when there is something to draw.
            with contextlib.suppress(Error):
                canvas.open()


def _prepare(drawing: Mapping[str, Any], canvas: Canvas, parent: Parent) -> None:
    """Load the model into the canvas, if it appears before the next message."""
    for _ in range(_LOOKS_FOR_RECORDING):
        if parent.has_said_something:
            return
        # A recording exists from its first step on, and its model a moment later. All
        # other errors are reported when there is something to draw.
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
