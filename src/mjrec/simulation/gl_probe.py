# SPDX-License-Identifier: Apache-2.0
"""The child process that tries one OpenGL backend: `python -m` this module.

It imports mujoco as `MUJOCO_GL` says, draws a scene, looks at the picture, and writes
what it found to standard output as JSON objects, one a line and each at once: what was
written stays known if the driver crashes afterwards. Everything that a driver prints
goes to standard error.

::

    {"notes": [...]}                              what a failure may come from
    {"error": "ImportError: ..."}                 it does not render, or
    {"renders": true, "gl_renderer": ..., ...}    it does
    {"frames_per_second": 16.2}                   with --measure
    {"devices": [...]}                            EGL's, where it tells
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import importlib
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..machine import gpu_device_files
from .gl_strings import current_gl_strings

__all__ = ["check_picture", "main"]

_SIZE = 480
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


class WrongPicture(Exception):
    """A frame was drawn and does not show what it should."""


def check_picture(picture: np.ndarray) -> None:
    """Raise unless the probe's scene can be seen in `picture`.

    Raises:
        WrongPicture: it is black or of one colour, or a colour is not in its place.
    """
    if np.ptp(picture.reshape(-1, 3), axis=0).max() == 0:
        colour = tuple(picture[0, 0].tolist())
        raise WrongPicture(f"Every pixel of the picture is {colour}.")
    height, width = picture.shape[:2]
    for name, ((row, column), colour) in _EXPECTED.items():
        pixel = picture[int(row * height), int(column * width)]
        if np.abs(pixel.astype(int) - colour).max() > _TOLERANCE:
            raise WrongPicture(
                f"The picture should show {name}, and that pixel is "
                f"{tuple(pixel.tolist())}."
            )


def main() -> int:
    """Try the backend that `MUJOCO_GL` names and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--measure", action="store_true", help="measure the speed too")
    parser.add_argument(
        "--seconds", type=float, required=True, help="give up, with a traceback, after"
    )
    arguments = parser.parse_args()
    # A driver may hang inside a call, where no Python code can end it.
    faulthandler.enable()
    faulthandler.dump_traceback_later(arguments.seconds, exit=True)
    say = _reporter()
    backend = os.environ.get("MUJOCO_GL", "")
    try:
        _draw_and_report(say, backend, measure=arguments.measure)
    except Exception as error:  # Whatever it is, it is the answer.
        say(notes=list(_notes(backend)), error=_text_of(error))
        return 1
    return 0


def _reporter() -> Callable[..., None]:
    """Return a function that reports, and send all other output to stderr."""
    ours = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def say(**facts: Any) -> None:
        ours.write(json.dumps(facts) + "\n")
        ours.flush()

    return say


def _draw_and_report(say: Callable[..., None], backend: str, *, measure: bool) -> None:
    draw = _drawing_function(backend)
    check_picture(draw())
    say(renders=True, **_gl_strings())
    if measure:
        say(frames_per_second=_frames_per_second(draw))
    if backend == "egl":
        say(devices=list(_egl_devices()))


def _drawing_function(backend: str) -> Callable[[], np.ndarray]:
    """Return a function that draws the scene, at MuJoCo's default quality."""
    # Not at the top: this import is part of what is tried.
    import mujoco

    model = mujoco.MjModel.from_xml_string(_SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    gl_context = _gl_context_class(mujoco, backend)(_SIZE, _SIZE)
    gl_context.make_current()
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    scene = mujoco.MjvScene(model, maxgeom=100)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
    camera.fixedcamid = 0
    option = mujoco.MjvOption()
    viewport = mujoco.MjrRect(0, 0, _SIZE, _SIZE)

    def draw() -> np.ndarray:
        # The context is named so that it lives as long as this function.
        gl_context.make_current()
        picture = np.zeros((_SIZE, _SIZE, 3), np.uint8)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
        mujoco.mjr_render(viewport, scene, context)
        mujoco.mjr_readPixels(picture, None, viewport, context)
        return picture[::-1]

    return draw


def _gl_context_class(mujoco: Any, backend: str) -> Any:
    try:
        return mujoco.GLContext
    except AttributeError:
        # Some versions swallow the reason at import; asking again brings it out.
        if backend:
            importlib.import_module(f"mujoco.{backend}")
        raise


def _gl_strings() -> dict[str, str]:
    # Not needed for drawing, so its failure is none.
    try:
        importlib.import_module("OpenGL.GL")
        return current_gl_strings()
    except Exception:  # PyOpenGL raises what it likes.
        return {}


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


# --- EGL's devices -----------------------------------------------------------------

_EGL_EXTENSIONS = 0x3055
_EGL_DEVICE = 0x322C
_EGL_CUDA_DEVICE = 0x323A
_EGL_DRM_DEVICE_FILE = 0x3233
_EGL_DRM_RENDER_NODE_FILE = 0x3377
# mujoco itself asks for ten.
_MOST_DEVICES = 256


def _egl_devices() -> Iterator[dict[str, Any]]:
    """Yield what EGL tells about its devices, in the order of MUJOCO_EGL_DEVICE_ID."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
        query = _egl_function(
            egl,
            "eglQueryDevicesEXT",
            ctypes.c_uint,
            ctypes.c_int,
            ctypes.POINTER(ctypes.c_void_p),
            ctypes.POINTER(ctypes.c_int),
        )
    except (OSError, AttributeError):
        return
    devices = (ctypes.c_void_p * _MOST_DEVICES)()
    count = ctypes.c_int()
    if query is None or not query(_MOST_DEVICES, devices, ctypes.byref(count)):
        return
    used = _device_in_use(egl)
    for index in range(count.value):
        yield {
            "index": index,
            **_egl_device(egl, devices[index]),
            "in_use": devices[index] == used,
        }


def _egl_device(egl: Any, device: Any) -> dict[str, Any]:
    text = _egl_function(
        egl, "eglQueryDeviceStringEXT", ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int
    )

    def string(name: int) -> str:
        return (text(device, name) or b"").decode(errors="replace") if text else ""

    extensions = string(_EGL_EXTENSIONS).split()
    file = ""
    if "EGL_EXT_device_drm_render_node" in extensions:
        file = string(_EGL_DRM_RENDER_NODE_FILE)
    if not file and "EGL_EXT_device_drm" in extensions:
        file = string(_EGL_DRM_DEVICE_FILE)
    return {
        "device_file": file,
        "cuda_id": _cuda_id(egl, device, extensions),
        "software": "EGL_MESA_device_software" in extensions,
    }


def _cuda_id(egl: Any, device: Any, extensions: list[str]) -> int | None:
    query = _egl_function(
        egl,
        "eglQueryDeviceAttribEXT",
        ctypes.c_uint,
        ctypes.c_void_p,
        ctypes.c_int,
        ctypes.POINTER(ctypes.c_ssize_t),
    )
    value = ctypes.c_ssize_t()
    if query is None or "EGL_NV_device_cuda" not in extensions:
        return None
    found = query(device, _EGL_CUDA_DEVICE, ctypes.byref(value))
    return value.value if found else None


def _device_in_use(egl: Any) -> int | None:
    """Return the device behind the current display, or None where EGL cannot tell."""
    current = _egl_function(egl, "eglGetCurrentDisplay", ctypes.c_void_p)
    query = _egl_function(
        egl,
        "eglQueryDisplayAttribEXT",
        ctypes.c_uint,
        ctypes.c_void_p,
        ctypes.c_int,
        ctypes.POINTER(ctypes.c_ssize_t),
    )
    value = ctypes.c_ssize_t()
    if current is None or query is None:
        return None
    found = query(current(), _EGL_DEVICE, ctypes.byref(value))
    return value.value if found else None


def _egl_function(egl: Any, name: str, result: Any, *arguments: Any) -> Any:
    """Return one of EGL's functions; None where this EGL has none of that name."""
    get = egl.eglGetProcAddress
    get.restype = ctypes.c_void_p
    get.argtypes = [ctypes.c_char_p]
    address = get(name.encode())
    return ctypes.CFUNCTYPE(result, *arguments)(address) if address else None


if __name__ == "__main__":
    status = main()
    # Some versions of mujoco print tracebacks while contexts end at exit.
    os._exit(status)
