# SPDX-License-Identifier: Apache-2.0
"""One table from what MuJoCo and the drivers say to its cause and the exact fix.

Their messages rarely name either: a missing library shows as `'NoneType' object has no
attribute 'eglQueryString'`, a wrong environment variable as `module 'mujoco' has no
attribute 'Renderer'`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from .backends import BACKENDS, platforms_contradict, rendering_is_off

# The least that renders on Debian 12 and Ubuntu 24.04.
EGL_PACKAGES = ("libegl1", "libegl-mesa0", "libgl1-mesa-dri", "libopengl0")
OSMESA_PACKAGES = ("libosmesa6", "libgl1")


@dataclass(frozen=True)
class Diagnosis:
    """Why something does not render.

    Attributes:
        cause: what is wrong, in a sentence or two.
        fix: what to do, or nothing where that is not known. Commands stand on lines
            of their own, indented by two.
    """

    cause: str
    fix: str


@dataclass(frozen=True)
class _Known:
    """A row of the table.

    Attributes:
        pattern: what the failure's text holds.
        cause: the diagnosis; `{name}` is a group of the pattern, an environment
            variable, or one of `_words`.
        fix: likewise.
        backend: whose failure it is; None: it can be any backend's.
        also: what else the text holds.
        unless: what the text does not hold.
        when: whether it can be, by the environment variables and the backend.
    """

    pattern: str
    cause: str
    fix: str
    backend: str | None = None
    also: str = ""
    unless: str | None = None
    when: Callable[[Mapping[str, str], str | None], bool] = lambda *_: True


def diagnose(
    text: str,
    *,
    backend: str | None = None,
    environ: Mapping[str, str] | None = None,
) -> Diagnosis | None:
    """Return the cause and the fix of a failure, or None if it is not a known one.

    Args:
        text: the exception's text or all that a process printed.
        backend: the backend that was tried, where that is known.
        environ: the environment variables at that time; this process's, if None.
    """
    environ = os.environ if environ is None else environ
    for known in _TABLE:
        found = re.search(known.pattern, text, re.MULTILINE)
        if (
            found
            and (known.backend is None or backend in (None, known.backend))
            and re.search(known.also, text)
            and not (known.unless and re.search(known.unless, text))
            and known.when(environ, backend)
        ):
            words = {**environ, **_words(environ, backend), **found.groupdict()}
            return Diagnosis(known.cause.format(**words), known.fix.format(**words))
    return None


def _words(environ: Mapping[str, str], backend: str | None) -> dict[str, str]:
    """Return what causes say of the environment."""
    display = environ.get("DISPLAY")
    return {
        "wanted": _wanted(environ, backend),
        "platform": environ.get("PYOPENGL_PLATFORM", "another platform"),
        "display": f"cannot open {display}" if display else "DISPLAY is not set",
        "glfw_by_default": ""
        if environ.get("MUJOCO_GL")
        else " Without MUJOCO_GL, mujoco, Gymnasium and dm_control choose GLFW.",
    }


def _wanted(environ: Mapping[str, str], backend: str | None) -> str:
    return backend or environ.get("MUJOCO_GL", "").strip().lower()


def _is_set(name: str) -> Callable[[Mapping[str, str], str | None], bool]:
    return lambda environ, backend: bool(environ.get(name))


def _apt(*packages: str) -> str:
    return (
        "On Debian and Ubuntu, as root:\n  apt-get update\n"
        f"  apt-get install -y {' '.join(packages)}"
    )


_INSTALL_EGL = _apt(*EGL_PACKAGES)
_HIDDEN = r"module 'mujoco[\w.]*' has no attribute '(Renderer|GLContext)'"
_CONTRADICTION = (
    "The environment variable PYOPENGL_PLATFORM ({platform}) contradicts MUJOCO_GL "
    "({wanted}): mujoco then leaves its renderer out."
)
_SET_PLATFORM = (
    "Take the variable away, or set it to {wanted}:\n  unset PYOPENGL_PLATFORM"
)
_DEVICE = (
    r"MUJOCO_EGL_DEVICE_ID environment variable must be an integer between 0 and "
    r"{last} \(inclusive\), got (?P<got>-?\d+)"
)
_ITS_OWN = (
    " It counts EGL's devices, which need not be CUDA's; a container sees only its own."
)
_UNSET_DEVICE = ", or take it away:\n  unset MUJOCO_EGL_DEVICE_ID"
_NO_DISPLAY = (
    r"Cannot initialize a (headless )?EGL (device )?display|EGL_NOT_INITIALIZED"
    r"|eglQueryDevicesEXT is not available|between 0 and -1 \(inclusive\)"
)
# What the dynamic loader says of a library that is there.
_BROKEN = r"library {} cannot be loaded \((?P<said>(?!.*No such file).+)\)"
_NO_OSMESA = (
    r"'NoneType' object has no attribute '(glGetError|OSMesa\w+)'"
    r"|library libOSMesa\.so\.8: cannot be loaded"
)
_INSTALL_OSMESA = (
    f"{_apt(*OSMESA_PACKAGES)}\nWhere apt knows no libosmesa6 (Mesa 25.1 and later "
    "have no OSMesa), set MUJOCO_GL=egl."
)
_NO_CONTEXT = "an OpenGL platform library has not been loaded|gladLoadGL error"

# The first row that fits answers: settings before libraries, the particular before the
# general.
_TABLE = (
    _Known(
        _HIDDEN,
        "MUJOCO_GL={MUJOCO_GL} turns rendering off.",
        f"Unset MUJOCO_GL, or set it to one of {', '.join(BACKENDS)}.",
        when=lambda environ, backend: rendering_is_off(environ),
    ),
    _Known(
        r"invalid value for environment variable MUJOCO_GL: (?P<name>.*)",
        "MUJOCO_GL={name} is not a backend's name, or not in small letters.",
        f"Set it to one of {', '.join(BACKENDS)}, or unset it.",
    ),
    _Known(
        r"MUJOCO_GL must be one of .*got:? '?(?P<name>[^'.]*)",
        "MUJOCO_GL={name} is not a backend's name, or not in small letters.",
        f"Set it to one of {', '.join(BACKENDS)}, or unset it.",
    ),
    # The reason that mujoco gives lacks the value, by an oversight.
    *(
        _Known(
            f"Cannot use {name} rendering platform",
            _CONTRADICTION.replace("{wanted}", name.lower()),
            _SET_PLATFORM.replace("{wanted}", name.lower()),
        )
        for name in ("EGL", "OSMesa")
    ),
    _Known(
        _HIDDEN,
        _CONTRADICTION,
        _SET_PLATFORM,
        when=lambda environ, backend: platforms_contradict(
            environ, _wanted(environ, backend)
        ),
    ),
    _Known(
        "flex_vertedge",
        "This dm_control does not know MuJoCo 4: it reads MjModel.flex_vertedge, "
        "which is gone.",
        'Use MuJoCo 3 until dm_control does:\n  python -m pip install "mujoco<4"',
    ),
    _Known(
        "No module named 'OpenGL",
        "The Python package OpenGL is not installed.",
        "Run:\n  python -m pip install pyopengl",
    ),
    _Known(
        r"No module named '(?P<package>\w+)",
        "The Python package {package} is not installed.",
        "Run:\n  python -m pip install {package}",
    ),
    _Known(
        _DEVICE.format(last="0"),
        "MUJOCO_EGL_DEVICE_ID={got}, and EGL sees one device, number 0." + _ITS_OWN,
        "Set MUJOCO_EGL_DEVICE_ID to 0" + _UNSET_DEVICE,
    ),
    _Known(
        _DEVICE.format(last=r"(?P<last>\d+)"),
        "MUJOCO_EGL_DEVICE_ID={got}, and EGL sees devices 0 to {last}." + _ITS_OWN,
        "Set MUJOCO_EGL_DEVICE_ID to a number from 0 to {last}" + _UNSET_DEVICE,
    ),
    _Known(
        r"invalid literal for int\(\)",
        "MUJOCO_EGL_DEVICE_ID={MUJOCO_EGL_DEVICE_ID} is not a whole number.",
        "Set it to one of EGL's devices (0 is the first)" + _UNSET_DEVICE,
        backend="egl",
        when=lambda environ, backend: "MUJOCO_EGL_DEVICE_ID" in environ,
    ),
    _Known(
        _BROKEN.format(r"libEGL\.so\.1:"),
        "EGL's library is there and cannot be loaded: {said}.",
        _INSTALL_EGL,
        backend="egl",
    ),
    _Known(
        # At exit mujoco asks a library that is gone already for the current context.
        r"'NoneType' object has no attribute 'egl(?!GetCurrentContext)\w+'"
        r"|library libEGL\.so\.1: cannot be loaded",
        "EGL's library, libEGL.so.1, is not installed.",
        _INSTALL_EGL,
        backend="egl",
    ),
    *(
        _Known(
            _NO_DISPLAY,
            f"EGL looks for drivers only in {name} ({{{name}}}), where there is none.",
            f"Take the variable away:\n  unset {name}",
            backend="egl",
            also="EGL vendor file: none",
            when=_is_set(name),
        )
        for name in ("__EGL_VENDOR_LIBRARY_FILENAMES", "__EGL_VENDOR_LIBRARY_DIRS")
    ),
    # An NVIDIA GPU whose EGL driver was not brought into the container.
    _Known(
        _NO_DISPLAY,
        "There is an NVIDIA GPU, and EGL finds no NVIDIA driver (no 10_nvidia.json, "
        "or not the library that it names).",
        "In a container, start it with NVIDIA_DRIVER_CAPABILITIES=all (or one that "
        "includes graphics); elsewhere install the driver's EGL part, on Debian "
        f"libnvidia-egl-*. To draw on the CPU instead: {_INSTALL_EGL}",
        backend="egl",
        also="device file: /dev/nvidia",
        unless="EGL vendor file: .*nvidia.* loaded",
    ),
    _Known(
        _NO_DISPLAY,
        "EGL is installed and no driver for it: there is no file in "
        "/usr/share/glvnd/egl_vendor.d.",
        _INSTALL_EGL,
        backend="egl",
        also="EGL vendor file: none",
    ),
    _Known(
        r"EGL vendor file: (?P<file>\S+): (?P<library>\S+) cannot be loaded",
        "EGL's driver {library}, named in {file}, cannot be loaded.",
        _INSTALL_EGL,
        backend="egl",
        also=_NO_DISPLAY,
    ),
    _Known(
        r"MESA-LOADER: failed to open (?P<driver>\S+):",
        "Mesa's driver {driver} is not installed.",
        _INSTALL_EGL,
        backend="egl",
        also=_NO_DISPLAY,
    ),
    _Known(
        _NO_DISPLAY,
        "EGL finds no device that it can draw on: its driver is missing, or does not "
        "fit the kernel's.",
        f"{_INSTALL_EGL}\nWith an NVIDIA GPU in a container, start it with "
        "NVIDIA_DRIVER_CAPABILITIES=all.",
        backend="egl",
    ),
    _Known(
        r"libgallium-(?P<mesa>(25\.[1-9]|2[6-9]\.|[3-9]\d\.)[\d.]*\d)",
        "Mesa {mesa} has no OSMesa: it was removed in Mesa 25.1.",
        "Use EGL, which draws the same pictures without a GPU: set MUJOCO_GL=egl. "
        f"If it is not installed: {_INSTALL_EGL}",
        backend="osmesa",
        also=_NO_OSMESA,
    ),
    _Known(
        _BROKEN.format(r"libOSMesa\.so\.8:"),
        "OSMesa's library is there and cannot be loaded: {said}.",
        _INSTALL_OSMESA,
        backend="osmesa",
    ),
    _Known(
        _NO_OSMESA,
        "OSMesa's library, libOSMesa.so.8, is not installed.",
        _INSTALL_OSMESA,
        backend="osmesa",
    ),
    _Known(
        "'NoneType' object has no attribute 'glGetError'",
        "libOpenGL.so.0 and libGL.so.1 cannot be loaded.",
        _INSTALL_EGL,
    ),
    _Known(
        r"'(?P<name>\w+)Platform' object has no attribute '\w+'",
        "PyOpenGL was imported, with its {name} platform, before the backend was "
        "chosen.",
        "Set MUJOCO_GL, or call mjrec.use_gl(), before anything imports OpenGL, "
        "mujoco or dm_control.",
    ),
    _Known(
        r"GLFWError: \(\d+\) b?['\"]?(?P<said>GLX: [^'\"\n]*)",
        "The display gives no OpenGL ({said}).",
        _apt("libgl1", "libglx-mesa0", "libgl1-mesa-dri"),
        backend="glfw",
    ),
    _Known(
        r"The DISPLAY environment variable is missing|Failed to open display (\S+?)'?$"
        rf"|GLFWError: \((?:65544|65550|65537)\)|{_NO_CONTEXT}",
        "GLFW needs a display, and there is none ({display}).{glfw_by_default}",
        "Set MUJOCO_GL to egl or osmesa before anything imports mujoco, or bring a "
        "virtual display:\n  xvfb-run -a <your command>",
        backend="glfw",
    ),
    _Known(
        _NO_CONTEXT,
        "No OpenGL context was current when mujoco began to draw.",
        "Make a mujoco.GLContext and call its make_current(), on the same thread, "
        "before MjrContext or mujoco.Renderer.",
    ),
    _Known(
        r"EGL_BAD_ACCESS|Cannot make context .* current on thread",
        "The OpenGL context is in use on another thread.",
        "Draw on the thread that made the context, or close it there first.",
    ),
    _Known(
        r"Image (?P<side>width|height) (?P<asked>\d+) > framebuffer \w+ (?P<has>\d+)",
        "The picture's {side}, {asked}, is more than the model's offscreen buffer "
        "has, {has}.",
        'In the MJCF: <visual><global off{side}="{asked}"/></visual>; in Python '
        "model.vis.global_.off{side} = {asked} before the renderer is made.",
    ),
    _Known(
        "Offscreen framebuffer is not complete",
        "The driver could not make the offscreen buffer, for want of memory perhaps.",
        "Close renderers that are not needed, use smaller pictures, or set "
        '<visual><quality offsamples="0"/></visual> in the MJCF.',
    ),
    _Known(
        "OpenGL error 0x502 in or before mjr_makeContext",
        "The OpenGL context has a surface that MuJoCo takes for a window.",
        "Make the context without a surface, as mujoco.GLContext does.",
    ),
    _Known(
        r"(?P<file>/dev/(?:dri|nvidia)[\w/]*).*Permission denied",
        "This user may not open {file}.",
        "As root, then log in again:\n  usermod -aG render,video <your user>",
    ),
    _Known(
        r"^WrongPicture: (?P<said>.*)$",
        "The driver draws, and draws wrongly. {said}",
        "Update the driver, or use another backend.",
    ),
    _Known(
        r"^(?:no answer|Timeout)\b.*$",
        "The driver hangs: no picture came in time.",
        "Try another backend or device. With several processes on one GPU, start "
        "fewer; never fork a process that has drawn.",
    ),
    _Known(
        r"^The driver crashed \((?P<signal>\w+)\)",
        "The driver crashed ({signal}).",
        "Update the driver, or use another backend. Where it crashed:\n"
        "  mjrec doctor --json",
    ),
    _Known(
        r"Exception ignored in.*(Renderer|GLContext)|<exception str\(\) failed>"
        r"|'NoneType' object has no attribute 'eglGetCurrentContext'",
        "A renderer was still open when Python ended. Nothing is lost; MuJoCo 4 no "
        "longer says it.",
        "Close renderers and environments before the program ends.",
    ),
)
