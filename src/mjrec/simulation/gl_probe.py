# SPDX-License-Identifier: Apache-2.0
"""The program of a child process that tests one OpenGL backend.

The child imports mujoco with the backend in `MUJOCO_GL`, draws a scene, and checks the
frame. It sends each result to its parent immediately, so no result is lost if the
driver crashes afterwards.

::

    {"notes": [...]}                              possible causes of a failure
    {"error": "ImportError: ..."}                 the backend does not render, or
    {"renders": true, "gl_renderer": ..., ...}    it renders
    {"frames_per_second": 16.2}                   with --measure
    {"devices": [...]}                            with EGL, if it lists any
"""

from __future__ import annotations

import ctypes
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..gl.egl import egl_devices
from ..machine import gpu_device_files
from ..messages import Parent

_SIZE = 480
_SMALL = 96
_MEASURED_SECONDS = 0.8
_MEASURED_FRAMES = 200

# The colored geoms are purely emissive, so their pixels do not depend on the light. The
# floor and the shadows take as long to draw as in a normal scene.
_SCENE = """
<mujoco>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1=".2 .3 .4" width="8"
      height="48"/>
    <texture name="checker" type="2d" builtin="checker" rgb1=".3 .3 .3"
      rgb2=".5 .5 .5" width="256" height="256"/>
    <material name="floor" texture="checker" texrepeat="4 4"/>
    <material name="shining" emission="1" specular="0" shininess="0"/>
  </asset>
  <default>
    <geom type="box" size=".3 .3 .3" material="shining"/>
  </default>
  <worldbody>
    <light pos="0 -1 4" dir="0 .2 -1"/>
    <geom type="plane" size="3 3 .1" material="floor"/>
    <geom pos="-.9 0 .6" rgba="1 0 0 1"/>
    <geom pos=".9 0 .6" rgba="0 0 1 1"/>
    <geom type="sphere" pos="0 0 1.5" rgba="0 1 0 1"/>
    <camera name="front" pos="0 -4 1" xyaxes="1 0 0 0 0 1" fovy="45"/>
  </worldbody>
</mujoco>
"""

# A pixel's (row, column) as fractions of height and width, and its expected color.
_EXPECTED = {
    "red on the left": ((0.62, 0.23), (255, 0, 0)),
    "blue on the right": ((0.62, 0.77), (0, 0, 255)),
    "green at the top": ((0.35, 0.5), (0, 255, 0)),
}
_TOLERANCE = 40


class WrongFrame(Exception):
    """A frame was drawn but does not show the expected scene."""


def check_frame(frame: np.ndarray) -> None:
    """Check that `frame` shows the probe's scene.

    Raises:
        WrongFrame: the frame has a single color, or a color is in the wrong place.
    """
    if np.ptp(frame.reshape(-1, 3), axis=0).max() == 0:
        colour = tuple(frame[0, 0].tolist())
        raise WrongFrame(f"Every pixel of the frame is {colour}.")
    height, width = frame.shape[:2]
    for name, ((row, column), colour) in _EXPECTED.items():
        pixel = frame[int(row * height), int(column * width)]
        if np.abs(pixel.astype(int) - colour).max() > _TOLERANCE:
            raise WrongFrame(
                f"The frame should show {name}, but the pixel there is "
                f"{tuple(pixel.tolist())}."
            )


def draw_test_scene(
    side: int = _SMALL, canvas: Any = None
) -> tuple[Callable[[], np.ndarray], dict[str, Any]]:
    """Draw the test scene and check the frame.

    The scene is drawn at MuJoCo's default quality, or without shadows and multisampling
    if the frame is smaller than the probe's own.

    Args:
        side: side of the square frame in pixels.
        canvas: the canvas to draw with; see `SceneRenderer`.

    Returns:
        A function that draws the scene again, and metadata about the driver.

    Raises:
        WrongFrame: the frame does not show the expected scene.
        Exception: any other error, because drivers may raise any type.
    """
    # Imported here because these imports are part of the test.
    import mujoco

    from .renderer import SceneRenderer

    model = mujoco.MjModel.from_xml_string(_SCENE)
    if side < _SIZE:
        model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = SceneRenderer(
        model, height=side, width=side, camera="front", canvas=canvas
    )
    check_frame(renderer.render(data))
    return lambda: renderer.render(data), renderer.gl_facts


def main() -> None:
    """Test the backend in `MUJOCO_GL`."""
    parent = Parent()
    backend = os.environ.get("MUJOCO_GL", "")
    facts: dict[str, Any] = {}
    try:
        draw, facts = draw_test_scene(_SIZE)
        parent.send(renders=True, **facts)
        if "--measure" in sys.argv:
            parent.send(frames_per_second=_frames_per_second(draw))
    except Exception as error:  # Any error is a result.
        parent.send(notes=list(_notes(backend)), error=_text_of(error))
    # This comes last, because querying CUDA's device numbers initializes CUDA, which
    # may fail or hang.
    if backend == "egl":
        used = facts.get("gl_device", {}).get("index")
        devices = [
            {**dataclasses.asdict(device), "in_use": device.index == used}
            for device in egl_devices()
        ]
        parent.send(devices=devices)


def _frames_per_second(draw: Callable[[], np.ndarray]) -> float:
    frames = 0
    start = time.perf_counter()
    while True:
        draw()
        frames += 1
        elapsed = time.perf_counter() - start
        if elapsed >= _MEASURED_SECONDS or frames >= _MEASURED_FRAMES:
            return frames / elapsed


# --- Possible causes of a failure -------------------------------------------------

_LIBRARIES = {
    "egl": ["libEGL.so.1"],
    "osmesa": ["libOSMesa.so.8"],
    "glfw": ["libGL.so.1"],
}
_LIBRARY_DIRECTORIES = ("/usr/lib", "/usr/lib/*-linux-gnu", "/usr/lib64", "/lib64")
_VENDOR_DIRECTORIES = "/etc/glvnd/egl_vendor.d:/usr/share/glvnd/egl_vendor.d"


def _notes(backend: str) -> Iterator[str]:
    """Yield a note about each file that the backend may need."""
    for library in _LIBRARIES.get(backend, []):
        yield f"library {library}: {_load(library)}"
    if backend == "egl":
        yield from _vendor_notes()
    if backend == "osmesa":
        yield from _mesa_notes()
    for file in gpu_device_files():
        yield f"device file: {file}"


def _load(library: str) -> str:
    try:
        ctypes.CDLL(library)
    except OSError as error:
        return f"cannot be loaded ({error})"
    return "loaded"


def _vendor_notes() -> Iterator[str]:
    """Yield notes about the drivers that libEGL would find."""
    names = os.environ.get("__EGL_VENDOR_LIBRARY_FILENAMES", "")
    directories = os.environ.get("__EGL_VENDOR_LIBRARY_DIRS", "") or _VENDOR_DIRECTORIES
    files = (
        [Path(name) for name in names.split(":")]
        if names
        else [
            file
            for directory in directories.split(":")
            for file in sorted(Path(directory).glob("*.json"))
        ]
    )
    present = [file for file in files if file.is_file()]
    if not present:
        yield "EGL vendor file: none"
    for file in present:
        yield f"EGL vendor file: {file}: {_vendor_library(file)}"


def _vendor_library(file: Path) -> str:
    try:
        library = json.loads(file.read_text())["ICD"]["library_path"]
    except (OSError, ValueError, LookupError, TypeError) as error:
        return f"is not readable ({error})"
    return f"{library} {_load(str(library))}"


def _mesa_notes() -> Iterator[str]:
    """Yield Mesa's version, which has been part of a library's name since 24.2."""
    for directory in _LIBRARY_DIRECTORIES:
        for file in Path("/").glob(f"{directory.lstrip('/')}/libgallium-*.so"):
            yield f"Mesa's library: {file.name}"


def _text_of(error: BaseException) -> str:
    """Return an exception and its causes, outermost first, one per line."""
    lines = []
    link: BaseException | None = error
    while link is not None:
        lines.append(f"{type(link).__name__}: {link}")
        link = link.__cause__ or link.__context__
    return "\n".join(lines)


if __name__ == "__main__":
    main()
    # Some versions of mujoco print tracebacks when contexts are freed at exit.
    os._exit(0)
