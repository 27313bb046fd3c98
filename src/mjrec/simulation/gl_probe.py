# SPDX-License-Identifier: Apache-2.0
"""The child process that tries one OpenGL backend: `python -m` this module.

It imports mujoco as `MUJOCO_GL` says, draws a scene, looks at the frame, and sends
what it found to its parent, each thing at once: what was sent stays known if the driver
crashes afterwards.

::

    {"notes": [...]}                              what a failure may come from
    {"error": "ImportError: ..."}                 it does not render, or
    {"renders": true, "gl_renderer": ..., ...}    it does
    {"frames_per_second": 16.2}                   with --measure
    {"devices": [...]}                            EGL's, where it tells; in any case
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
from ..parent import Parent

_SIZE = 480
_SMALL = 96
_MEASURED_SECONDS = 0.8
_MEASURED_FRAMES = 200

# Colours that only shine, so that their pixels are the same whatever the light; the
# floor and the shadows cost what they cost in a usual scene.
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

# (row, column) as parts of the height and the width, and what stands there.
_EXPECTED = {
    "red on the left": ((0.62, 0.23), (255, 0, 0)),
    "blue on the right": ((0.62, 0.77), (0, 0, 255)),
    "green at the top": ((0.35, 0.5), (0, 255, 0)),
}
_TOLERANCE = 40


class WrongFrame(Exception):
    """A frame was drawn and does not show what it should."""


def check_frame(frame: np.ndarray) -> None:
    """Raise unless the probe's scene can be seen in `frame`.

    Raises:
        WrongFrame: it is black or of one colour, or a colour is not in its place.
    """
    if np.ptp(frame.reshape(-1, 3), axis=0).max() == 0:
        colour = tuple(frame[0, 0].tolist())
        raise WrongFrame(f"Every pixel of the frame is {colour}.")
    height, width = frame.shape[:2]
    for name, ((row, column), colour) in _EXPECTED.items():
        pixel = frame[int(row * height), int(column * width)]
        if np.abs(pixel.astype(int) - colour).max() > _TOLERANCE:
            raise WrongFrame(
                f"The frame should show {name}, and that pixel is "
                f"{tuple(pixel.tolist())}."
            )


def draw_test_scene(
    side: int = _SMALL, canvas: Any = None
) -> tuple[Callable[[], np.ndarray], dict[str, Any]]:
    """Draw the test scene and look at the frame.

    At MuJoCo's default quality; where a small frame is enough, without shadows.

    Args:
        side: of the frame, in pixels.
        canvas: what to draw with, as of `SceneRenderer`.

    Returns:
        What draws it again, and what metadata says of who draws.

    Raises:
        WrongFrame: it does not show what it should.
        Exception: of any kind; drivers raise what they like.
    """
    # Not at the top: these imports are part of what is tried.
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
    """Try the backend that `MUJOCO_GL` names."""
    parent = Parent()
    backend = os.environ.get("MUJOCO_GL", "")
    facts: dict[str, Any] = {}
    try:
        draw, facts = draw_test_scene(_SIZE)
        parent.send(renders=True, **facts)
        if "--measure" in sys.argv:
            parent.send(frames_per_second=_frames_per_second(draw))
    except Exception as error:  # Whatever it is, it is the answer.
        parent.send(notes=list(_notes(backend)), error=_text_of(error))
    # Last, because asking for CUDA's numbers begins CUDA, which may fail or hang.
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


# --- What a failure may come from -------------------------------------------------

_LIBRARIES = {
    "egl": ["libEGL.so.1"],
    "osmesa": ["libOSMesa.so.8"],
    "glfw": ["libGL.so.1"],
}
_LIBRARY_DIRECTORIES = ("/usr/lib", "/usr/lib/*-linux-gnu", "/usr/lib64", "/lib64")
_VENDOR_DIRECTORIES = "/etc/glvnd/egl_vendor.d:/usr/share/glvnd/egl_vendor.d"


def _notes(backend: str) -> Iterator[str]:
    """Yield what there is of a backend's parts, one sentence each."""
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
    """Yield which drivers libEGL finds, by its own rules."""
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
    """Yield Mesa's version: since 24.2 it is part of a library's name."""
    for directory in _LIBRARY_DIRECTORIES:
        for file in Path("/").glob(f"{directory.lstrip('/')}/libgallium-*.so"):
            yield f"Mesa's library: {file.name}"


def _text_of(error: BaseException) -> str:
    """Return an exception and what caused it, outermost first, a line each."""
    lines = []
    link: BaseException | None = error
    while link is not None:
        lines.append(f"{type(link).__name__}: {link}")
        link = link.__cause__ or link.__context__
    return "\n".join(lines)


if __name__ == "__main__":
    main()
    # Some versions of mujoco print tracebacks while contexts end at exit.
    os._exit(0)
