# SPDX-License-Identifier: Apache-2.0
"""From what mujoco and the drivers say to its cause and the exact fix.

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

__all__ = ["EGL_PACKAGES", "OSMESA_PACKAGES", "Diagnosis", "diagnose"]

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
class _Failure:
    text: str
    backend: str | None
    environ: Mapping[str, str]

    def search(self, pattern: str) -> re.Match[str] | None:
        return re.search(pattern, self.text, re.MULTILINE)

    def is_of(self, *backends: str) -> bool:
        """Tell whether it can be a failure of one of these backends."""
        return self.backend is None or self.backend in backends


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
    failure = _Failure(text, backend, os.environ if environ is None else environ)
    return next(filter(None, (known(failure) for known in _KNOWN)), None)


def _commands(*commands: str) -> str:
    return "".join(f"\n  {command}" for command in commands)


def _install(packages: tuple[str, ...]) -> str:
    return _commands("apt-get update", f"apt-get install -y {' '.join(packages)}")


_INSTALL_EGL = f"On Debian and Ubuntu, as root:{_install(EGL_PACKAGES)}"
_INSTALL_OSMESA = f"On Debian and Ubuntu, as root:{_install(OSMESA_PACKAGES)}"
_INSTALL_MUJOCO_3 = 'python -m pip install "mujoco<4"'
_WITHOUT_REASON = r"module 'mujoco[\w.]*' has no attribute '(Renderer|GLContext)'"


def _rendering_off(failure: _Failure) -> Diagnosis | None:
    if not (failure.search(_WITHOUT_REASON) and rendering_is_off(failure.environ)):
        return None
    return Diagnosis(
        f"MUJOCO_GL={failure.environ['MUJOCO_GL']} turns rendering off.",
        f"Unset MUJOCO_GL, or set it to one of {', '.join(BACKENDS)}.",
    )


def _contradicting_platforms(failure: _Failure) -> Diagnosis | None:
    said = failure.search(r"Cannot use (EGL|OSMesa) rendering platform")
    hidden = failure.search(_WITHOUT_REASON)
    backend = failure.backend or failure.environ.get("MUJOCO_GL", "").strip().lower()
    contradict = platforms_contradict(failure.environ, backend)
    if not said and not (hidden and contradict):
        return None
    # The reason that mujoco gives for EGL lacks the value, by an oversight.
    wanted = said[1].lower() if said else backend
    value = failure.environ.get("PYOPENGL_PLATFORM", "another platform")
    return Diagnosis(
        f"The environment variable PYOPENGL_PLATFORM ({value}) contradicts MUJOCO_GL "
        f"({wanted}): mujoco then leaves its renderer out.",
        f"Take the variable away, or set it to {wanted}:"
        f"{_commands('unset PYOPENGL_PLATFORM')}",
    )


def _opengl_imported_before(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"'(\w+)Platform' object has no attribute '(\w+)'")
    if not found:
        return None
    return Diagnosis(
        f"PyOpenGL was imported, with its {found[1]} platform, before the backend was "
        "chosen.",
        "Set MUJOCO_GL, or call mjrec.use_gl(), before anything imports OpenGL, "
        "mujoco or dm_control.",
    )


def _old_dm_control(failure: _Failure) -> Diagnosis | None:
    if not failure.search(r"flex_vertedge"):
        return None
    return Diagnosis(
        "This dm_control does not know MuJoCo 4: it reads MjModel.flex_vertedge, "
        "which is gone.",
        f"Use MuJoCo 3 until dm_control does:{_commands(_INSTALL_MUJOCO_3)}",
    )


def _unknown_name(failure: _Failure) -> Diagnosis | None:
    found = failure.search(
        r"invalid value for environment variable MUJOCO_GL: (?P<a>.*)"
    ) or failure.search(r"MUJOCO_GL must be one of .*got:? '?(?P<a>[^'.]*)")
    if not found:
        return None
    return Diagnosis(
        f"MUJOCO_GL={found['a']} is not a backend's name, or not in small letters.",
        f"Set it to one of {', '.join(BACKENDS)}, or unset it.",
    )


def _device_number(failure: _Failure) -> Diagnosis | None:
    found = failure.search(
        r"MUJOCO_EGL_DEVICE_ID environment variable must be an integer between 0 and "
        r"(-?\d+) \(inclusive\), got (-?\d+)"
    )
    if not found or int(found[1]) < 0:
        return None
    last = int(found[1])
    sees = "one device, number 0" if last == 0 else f"devices 0 to {last}"
    choose = "0" if last == 0 else f"a number from 0 to {last}"
    return Diagnosis(
        f"MUJOCO_EGL_DEVICE_ID={found[2]}, and EGL sees {sees}. It counts EGL's "
        "devices, which need not be CUDA's; a container sees only its own.",
        f"Set MUJOCO_EGL_DEVICE_ID to {choose}, or take it away:"
        f"{_commands('unset MUJOCO_EGL_DEVICE_ID')}",
    )


def _device_no_number(failure: _Failure) -> Diagnosis | None:
    value = failure.environ.get("MUJOCO_EGL_DEVICE_ID")
    if (
        value is None
        or not failure.is_of("egl")
        or not failure.search(r"invalid literal for int\(\)")
    ):
        return None
    return Diagnosis(
        f"MUJOCO_EGL_DEVICE_ID={value} is not a whole number.",
        "Set it to one of EGL's devices (0 is the first), or take it away:"
        f"{_commands('unset MUJOCO_EGL_DEVICE_ID')}",
    )


def _no_egl_library(failure: _Failure) -> Diagnosis | None:
    # At exit mujoco asks a library that is gone already for the current context.
    symptom = r"'NoneType' object has no attribute 'egl(?!GetCurrentContext)\w+'"
    detail = failure.search(r"library libEGL\.so\.1: cannot be loaded \((.*)\)")
    if not (failure.is_of("egl") and (failure.search(symptom) or detail)):
        return None
    return Diagnosis(_library_cause("EGL", "libEGL.so.1", detail), _INSTALL_EGL)


def _osmesa_removed(failure: _Failure) -> Diagnosis | None:
    """OSMesa is missing, and the Mesa that is installed has none."""
    mesa = failure.search(r"libgallium-((?:25\.[1-9]|2[6-9]\.|[3-9]\d\.)[\d.]*\d)")
    if not (mesa and _lacks_osmesa(failure)):
        return None
    return Diagnosis(
        f"Mesa {mesa[1]} has no OSMesa: it was removed in Mesa 25.1.",
        "Use EGL, which draws the same pictures without a GPU: set MUJOCO_GL=egl. "
        f"If it is not installed: {_INSTALL_EGL}",
    )


def _no_osmesa_library(failure: _Failure) -> Diagnosis | None:
    if not _lacks_osmesa(failure):
        return None
    detail = failure.search(r"library libOSMesa\.so\.8: cannot be loaded \((.*)\)")
    return Diagnosis(
        _library_cause("OSMesa", "libOSMesa.so.8", detail),
        f"{_INSTALL_OSMESA}\nWhere apt knows no libosmesa6 (Mesa 25.1 and later have "
        "no OSMesa), set MUJOCO_GL=egl.",
    )


def _lacks_osmesa(failure: _Failure) -> bool:
    symptom = r"'NoneType' object has no attribute '(glGetError|OSMesa\w+)'"
    noted = r"library libOSMesa\.so\.8: cannot be loaded"
    found = failure.search(symptom) or failure.search(noted)
    return failure.is_of("osmesa") and found is not None


def _no_gl_library(failure: _Failure) -> Diagnosis | None:
    if not failure.search(r"'NoneType' object has no attribute 'glGetError'"):
        return None
    return Diagnosis("libOpenGL.so.0 and libGL.so.1 cannot be loaded.", _INSTALL_EGL)


def _library_cause(what: str, library: str, detail: re.Match[str] | None) -> str:
    said = detail[1] if detail else ""
    if said and "No such file" not in said:
        return f"{what}'s library is there and cannot be loaded: {said}."
    return f"{what}'s library, {library}, is not installed."


_NO_DISPLAY = (
    r"Cannot initialize a (headless )?EGL (device )?display|EGL_NOT_INITIALIZED"
    r"|eglQueryDevicesEXT is not available|between 0 and -1 \(inclusive\)"
)


def _named_vendor_files_missing(failure: _Failure) -> Diagnosis | None:
    if not (_no_egl_driver(failure) and failure.search(r"EGL vendor file: none")):
        return None
    for name in ("__EGL_VENDOR_LIBRARY_FILENAMES", "__EGL_VENDOR_LIBRARY_DIRS"):
        if failure.environ.get(name):
            return Diagnosis(
                f"EGL looks for drivers only in {name} "
                f"({failure.environ[name]}), where there is none.",
                f"Take the variable away:{_commands(f'unset {name}')}",
            )
    return None


def _nvidia_without_driver(failure: _Failure) -> Diagnosis | None:
    """An NVIDIA GPU whose EGL driver was not brought into the container."""
    if not (
        _no_egl_driver(failure)
        and failure.search(r"device file: /dev/nvidia")
        and not failure.search(r"EGL vendor file: .*nvidia.* loaded")
    ):
        return None
    return Diagnosis(
        "There is an NVIDIA GPU, and EGL finds no NVIDIA driver (no 10_nvidia.json, "
        "or not the library that it names).",
        "In a container, start it with NVIDIA_DRIVER_CAPABILITIES=all (or one that "
        "includes graphics); elsewhere install the driver's EGL part, on Debian "
        f"libnvidia-egl-*. To draw on the CPU instead: {_INSTALL_EGL}",
    )


def _no_vendor_file(failure: _Failure) -> Diagnosis | None:
    if not (_no_egl_driver(failure) and failure.search(r"EGL vendor file: none")):
        return None
    return Diagnosis(
        "EGL is installed and no driver for it: there is no file in "
        "/usr/share/glvnd/egl_vendor.d.",
        _INSTALL_EGL,
    )


def _vendor_library_missing(failure: _Failure) -> Diagnosis | None:
    found = failure.search(
        r"EGL vendor file: (?P<file>\S+): (?P<library>\S+) cannot be loaded"
    )
    if not (_no_egl_driver(failure) and found):
        return None
    return Diagnosis(
        f"EGL's driver {found['library']}, named in {found['file']}, cannot be loaded.",
        _INSTALL_EGL,
    )


def _no_mesa_driver(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"MESA-LOADER: failed to open (\S+):")
    if not (_no_egl_driver(failure) and found):
        return None
    return Diagnosis(f"Mesa's driver {found[1]} is not installed.", _INSTALL_EGL)


def _no_egl_display(failure: _Failure) -> Diagnosis | None:
    if not _no_egl_driver(failure):
        return None
    return Diagnosis(
        "EGL finds no device that it can draw on: its driver is missing, or does not "
        "fit the kernel's.",
        f"{_INSTALL_EGL}\nWith an NVIDIA GPU in a container, start it with "
        "NVIDIA_DRIVER_CAPABILITIES=all.",
    )


def _no_egl_driver(failure: _Failure) -> bool:
    return failure.is_of("egl") and failure.search(_NO_DISPLAY) is not None


def _glfw_without_display(failure: _Failure) -> Diagnosis | None:
    found = failure.search(
        r"The DISPLAY environment variable is missing|Failed to open display (\S+?)'?$"
        r"|GLFWError: \((?:65544|65550|65537)\)"
    )
    loaded = failure.search(
        "an OpenGL platform library has not been loaded|gladLoadGL error"
    )
    if not failure.is_of("glfw") or not (found or loaded):
        return None
    display = failure.environ.get("DISPLAY", "")
    state = f"cannot open {display}" if display else "DISPLAY is not set"
    chosen = (
        ""
        if failure.environ.get("MUJOCO_GL")
        else " Without MUJOCO_GL, mujoco, Gymnasium and dm_control choose GLFW."
    )
    return Diagnosis(
        f"GLFW needs a display, and there is none ({state}).{chosen}",
        "Set MUJOCO_GL to egl or osmesa before anything imports mujoco, or bring a "
        f"virtual display:{_commands('xvfb-run -a <your command>')}",
    )


def _glfw_without_glx(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"GLFWError: \(\d+\) b?['\"]?(GLX: [^'\"\n]*)")
    if not (failure.is_of("glfw") and found):
        return None
    packages = ("libgl1", "libglx-mesa0", "libgl1-mesa-dri")
    return Diagnosis(
        f"The display gives no OpenGL ({found[1]}).",
        f"On Debian and Ubuntu, as root:{_install(packages)}",
    )


def _no_current_context(failure: _Failure) -> Diagnosis | None:
    if not failure.search(
        "an OpenGL platform library has not been loaded|gladLoadGL error"
    ):
        return None
    return Diagnosis(
        "No OpenGL context was current when mujoco began to draw.",
        "Make a mujoco.GLContext and call its make_current(), on the same thread, "
        "before MjrContext or mujoco.Renderer.",
    )


def _wrong_thread(failure: _Failure) -> Diagnosis | None:
    if not failure.search(r"EGL_BAD_ACCESS|Cannot make context .* current on thread"):
        return None
    return Diagnosis(
        "The OpenGL context is in use on another thread.",
        "Draw on the thread that made the context, or close it there first.",
    )


def _frame_too_large(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"Image (width|height) (\d+) > framebuffer \w+ (\d+)")
    if not found:
        return None
    field = {"width": "offwidth", "height": "offheight"}[found[1]]
    return Diagnosis(
        f"The picture's {found[1]}, {found[2]}, is more than the model's offscreen "
        f"buffer has, {found[3]}.",
        f'In the MJCF: <visual><global {field}="{found[2]}"/></visual>; in Python '
        f"model.vis.global_.{field} = {found[2]} before the renderer is made.",
    )


def _incomplete_framebuffer(failure: _Failure) -> Diagnosis | None:
    if not failure.search("Offscreen framebuffer is not complete"):
        return None
    return Diagnosis(
        "The driver could not make the offscreen buffer, for want of memory perhaps.",
        "Close renderers that are not needed, use smaller pictures, or set "
        '<visual><quality offsamples="0"/></visual> in the MJCF.',
    )


def _window_buffer(failure: _Failure) -> Diagnosis | None:
    if not failure.search(r"OpenGL error 0x502 in or before mjr_makeContext"):
        return None
    return Diagnosis(
        "The OpenGL context has a surface that MuJoCo takes for a window.",
        "Make the context without a surface, as mujoco.GLContext does.",
    )


def _no_access(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"(/dev/(?:dri|nvidia)[\w/]*).*Permission denied")
    if not found:
        return None
    return Diagnosis(
        f"This user may not open {found[1]}.",
        "As root, then log in again:"
        f"{_commands('usermod -aG render,video <your user>')}",
    )


def _missing_package(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"No module named '(\w+)")
    if not found:
        return None
    package = {"OpenGL": "pyopengl", "dm_control": "dm-control"}.get(found[1], found[1])
    return Diagnosis(
        f"The Python package {found[1]} is not installed.",
        f"Run:{_commands(f'python -m pip install {package}')}",
    )


def _hang(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"^(?:no answer|Timeout)\b.*$")
    if not found:
        return None
    return Diagnosis(
        "The driver hangs: no picture came in time.",
        "Try another backend or device. With several processes on one GPU, start "
        "fewer; never fork a process that has drawn.",
    )


def _crash(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"^The driver crashed \((\w+)\)")
    if not found:
        return None
    return Diagnosis(
        f"The driver crashed ({found[1]}).",
        "Update the driver, or use another backend. Where it crashed:"
        f"{_commands('mjrec doctor --json')}",
    )


def _wrong_picture(failure: _Failure) -> Diagnosis | None:
    found = failure.search(r"^WrongPicture: (.*)$")
    if not found:
        return None
    return Diagnosis(
        f"The driver draws, and draws wrongly. {found[1]}",
        "Update the driver, or use another backend.",
    )


def _noise_at_exit(failure: _Failure) -> Diagnosis | None:
    if not failure.search(
        r"Exception ignored in.*(Renderer|GLContext)|<exception str\(\) failed>"
        r"|'NoneType' object has no attribute 'eglGetCurrentContext'"
    ):
        return None
    return Diagnosis(
        "A renderer was still open when Python ended. Nothing is lost; MuJoCo 4 no "
        "longer says it.",
        "Close renderers and environments before the program ends.",
    )


# The first that knows the failure answers: settings before libraries, the particular
# before the general.
_KNOWN: tuple[Callable[[_Failure], Diagnosis | None], ...] = (
    _rendering_off,
    _unknown_name,
    _contradicting_platforms,
    _old_dm_control,
    _missing_package,
    _device_number,
    _device_no_number,
    _no_egl_library,
    _named_vendor_files_missing,
    _nvidia_without_driver,
    _no_vendor_file,
    _vendor_library_missing,
    _no_mesa_driver,
    _no_egl_display,
    _osmesa_removed,
    _no_osmesa_library,
    _no_gl_library,
    _opengl_imported_before,
    _glfw_without_glx,
    _glfw_without_display,
    _no_current_context,
    _wrong_thread,
    _frame_too_large,
    _incomplete_framebuffer,
    _window_buffer,
    _no_access,
    _wrong_picture,
    _hang,
    _crash,
    _noise_at_exit,
)
