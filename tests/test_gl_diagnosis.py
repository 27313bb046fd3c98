# SPDX-License-Identifier: Apache-2.0
"""What users see, in the words of mujoco 3.3, 3.17 and 4.0, is explained."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from mjrec.gl import diagnose

_EGL = "Cannot use EGL rendering platform. The PYOPENGL_PLATFORM environment variable"
_CONTEXT = (
    "mujoco.FatalError: an OpenGL platform library has not been loaded into this "
    "process, this most likely means that a valid OpenGL context has not been created "
    "before mjr_makeContext was called"
)


@pytest.mark.parametrize(
    ("text", "environ", "cause", "fix"),
    [
        (_CONTEXT, {}, "GLFW needs a display", "MUJOCO_GL to egl"),
        (
            "mujoco.FatalError: gladLoadGL error",
            {"DISPLAY": ":0"},
            "cannot open :0",
            "MUJOCO_GL to egl",
        ),
        (
            "GLFWError: (65550) b'X11: The DISPLAY environment variable is missing'",
            {},
            "choose GLFW",
            "xvfb-run",
        ),
        (
            "GLFWError: (65544) b'X11: The DISPLAY environment variable is missing'",
            {},
            "GLFW needs a display",
            "xvfb-run",
        ),
        (
            "GLFWError: (65537) b'The GLFW library is not initialized'",
            {},
            "GLFW needs a display",
            "xvfb-run",
        ),
        (
            "GLFWError: (65542) b'GLX: Failed to load GLX'",
            {"DISPLAY": ":0"},
            "(GLX: Failed to load GLX)",
            "libgl1",
        ),
        (
            "AttributeError: 'NoneType' object has no attribute 'eglQueryString'",
            {},
            "libEGL.so.1, is not installed",
            "libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0",
        ),
        (
            "AttributeError: 'NoneType' object has no attribute 'glGetError'",
            {},
            "libOSMesa.so.8, is not installed",
            "libosmesa6 libgl1",
        ),
        (
            "ImportError: Cannot initialize a EGL device display. This likely means "
            "that your EGL driver does not support the PLATFORM_DEVICE extension",
            {},
            "EGL finds no device",
            "libegl-mesa0",
        ),
        (
            "RuntimeError: Cannot initialize a headless EGL display.",
            {},
            "EGL finds no device",
            "NVIDIA_DRIVER_CAPABILITIES",
        ),
        (
            "Cannot initialize a EGL device display.\n"
            "EGL vendor file: /usr/share/glvnd/egl_vendor.d/50_mesa.json: "
            "libEGL_mesa.so.0 loaded\ndevice file: /dev/nvidia0",
            {},
            "There is an NVIDIA GPU, and EGL finds no NVIDIA driver",
            "NVIDIA_DRIVER_CAPABILITIES=all",
        ),
        (
            "AttributeError: module 'mujoco' has no attribute 'Renderer'",
            {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "osmesa"},
            "PYOPENGL_PLATFORM (osmesa) contradicts MUJOCO_GL (egl)",
            "unset PYOPENGL_PLATFORM",
        ),
        (
            f"ImportError: {_EGL} is set to {{!r}} (should be either unset or 'egl').",
            {},
            "contradicts MUJOCO_GL (egl)",
            "unset PYOPENGL_PLATFORM",
        ),
        (
            "ImportError: Failed to import OpenGL backend (MUJOCO_GL='egl'): "
            f"{_EGL} is set to {{!r}} (should be either unset or 'egl').. Ensure that "
            "'glfw' and 'pyopengl' are installed.",
            {"PYOPENGL_PLATFORM": "osmesa"},
            "PYOPENGL_PLATFORM (osmesa) contradicts MUJOCO_GL (egl)",
            "unset PYOPENGL_PLATFORM",
        ),
        (
            "AttributeError: 'GLXPlatform' object has no attribute 'EGL'",
            {},
            "imported, with its GLX platform, before",
            "mjrec.use_gl()",
        ),
        (
            "RuntimeError: The MUJOCO_EGL_DEVICE_ID environment variable must be an "
            "integer between 0 and 3 (inclusive), got 7.",
            {},
            "MUJOCO_EGL_DEVICE_ID=7, and EGL sees devices 0 to 3",
            "a number from 0 to 3",
        ),
        (
            "RuntimeError: The MUJOCO_EGL_DEVICE_ID environment variable must be an "
            "integer between 0 and -1 (inclusive), got 0.",
            {},
            "EGL finds no device",
            "libegl-mesa0",
        ),
        (
            "RuntimeError: invalid value for environment variable MUJOCO_GL: gpu",
            {},
            "MUJOCO_GL=gpu is not a backend's name",
            "egl, osmesa, glfw",
        ),
        (
            "RuntimeError: Environment variable MUJOCO_GL must be one of "
            "dict_keys(['glfw', 'egl', 'osmesa']): got 'EGL'.",
            {},
            "MUJOCO_GL=EGL is not a backend's name, or not in small letters",
            "egl, osmesa, glfw",
        ),
        (
            "AttributeError: module 'mujoco.gl_context' has no attribute 'GLContext'",
            {"MUJOCO_GL": "Off"},
            "MUJOCO_GL=Off turns rendering off",
            "Unset MUJOCO_GL",
        ),
        (
            "AttributeError: module 'mujoco.rendering.classic.gl_context' has no "
            "attribute 'GLContext'",
            {"MUJOCO_GL": "off"},
            "MUJOCO_GL=off turns rendering off",
            "Unset MUJOCO_GL",
        ),
        (
            "AttributeError: 'MjModel' object has no attribute 'flex_vertedge'. Did "
            "you mean: 'flex_vertadr'?",
            {},
            "does not know MuJoCo 4",
            'pip install "mujoco<4"',
        ),
        (
            "ValueError: Image width 1280 > framebuffer width 640. Either reduce",
            {},
            "width, 1280, is more",
            'offwidth="1280"',
        ),
        (
            "Offscreen framebuffer is not complete, error 0x8cdd",
            {},
            "offscreen buffer",
            "smaller pictures",
        ),
        (
            "OpenGL error 0x502 in or before mjr_makeContext",
            {},
            "surface",
            "mujoco.GLContext",
        ),
        (
            "EGLError(err = EGL_BAD_ACCESS, baseOperation = eglMakeCurrent)",
            {},
            "another thread",
            "thread that made",
        ),
        (
            "libEGL warning: failed to open /dev/dri/renderD128: Permission denied",
            {},
            "may not open /dev/dri/renderD128.",
            "usermod -aG render",
        ),
        (
            "ModuleNotFoundError: No module named 'OpenGL'",
            {},
            "OpenGL is not installed",
            "pip install pyopengl",
        ),
        (
            "Exception ignored in: <function GLContext.__del__ at 0x7f>\n"
            "OpenGL.raw.EGL._errors.EGLError: <exception str() failed>",
            {},
            "when Python ended",
            "Close renderers",
        ),
    ],
)
def test_known_failures(
    text: str, environ: dict[str, str], cause: str, fix: str
) -> None:
    """A message leads to its cause and to what to do."""
    found = diagnose(text, environ=environ)
    assert found is not None
    assert cause in found.cause
    assert fix in found.fix


def test_unknown_failures() -> None:
    """Nothing is made up about a failure that is not known."""
    assert diagnose("FileNotFoundError: cheetah.xml", environ={}) is None


def test_the_backend_tells_like_messages_apart() -> None:
    """The same words mean a display with GLFW and a context with EGL."""
    assert "display" in diagnose(_CONTEXT, backend="glfw", environ={}).cause  # type: ignore[union-attr]  # fails the test if None
    assert "current" in diagnose(_CONTEXT, backend="egl", environ={}).cause  # type: ignore[union-attr]  # fails the test if None


def test_what_a_user_of_mujoco_sees() -> None:
    """A user's own program, with contradicting variables, in today's words."""
    environ = {**os.environ, "MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "osmesa"}
    code = (
        "import mujoco\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco/>')\n"
        "mujoco.Renderer(model)"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code],
        env=environ,
        capture_output=True,
        check=False,
        text=True,
    )
    found = diagnose(done.stderr, environ=environ)
    assert found is not None, done.stderr
    assert "PYOPENGL_PLATFORM (osmesa) contradicts MUJOCO_GL (egl)" in found.cause
