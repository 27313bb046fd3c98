# SPDX-License-Identifier: Apache-2.0
"""Test the causes and fixes given for errors of mujoco 3.3, 3.17 and 4.0."""

import pytest

from mjrec.gl.backends import diagnose

_PLATFORM = {"PYOPENGL_PLATFORM": "osmesa"}
_CONTEXT = (
    "mujoco.FatalError: an OpenGL platform library has not been loaded into this "
    "process, this most likely means that a valid OpenGL context has not been created"
)
_CANNOT = (
    "Cannot use EGL rendering platform. The PYOPENGL_PLATFORM environment variable is "
    "set to {!r} (should be either unset or 'egl')."
)
_NVIDIA = (
    "Cannot initialize a EGL device display.\ndevice file: /dev/nvidia0\n"
    "EGL vendor file: /usr/share/glvnd/egl_vendor.d/50_mesa.json: libEGL_mesa.so.0 "
    "loaded"
)
_NUMBER = "The MUJOCO_EGL_DEVICE_ID environment variable must be an integer between "
_NAMES = "MUJOCO_GL must be one of dict_keys(['glfw', 'egl', 'osmesa']): got 'EGL'."


@pytest.mark.parametrize(
    ("text", "environ", "expected"),
    [
        (_CONTEXT, {}, "GLFW needs a display"),
        ("mujoco.FatalError: gladLoadGL error", {"DISPLAY": ":0"}, "cannot open :0"),
        ("GLFWError: (65550) b'X11: The DISPLAY environment", {}, "choose GLFW"),
        ("GLFWError: (65544) b'X11: The DISPLAY environment", {}, "xvfb-run"),
        ("GLFWError: (65537) b'The GLFW library is not init", {}, "needs a display"),
        ("GLFWError: (65542) b'GLX: Failed to load GLX'", {}, "(GLX: Failed to load"),
        ("'NoneType' object has no attribute 'eglQueryString'", {}, "libEGL.so.1, is"),
        ("'NoneType' object has no attribute 'glGetError'", {}, "libOSMesa.so.8, is"),
        ("Cannot initialize a EGL device display. This", {}, "EGL finds no device"),
        ("Cannot initialize a headless EGL display.", {}, "DRIVER_CAPABILITIES=all"),
        (_NVIDIA, {}, "There is an NVIDIA GPU, but EGL finds no NVIDIA driver"),
        (_CANNOT, {}, "PYOPENGL_PLATFORM (another platform) contradicts MUJOCO"),
        (_CANNOT, _PLATFORM, "PYOPENGL_PLATFORM (osmesa) contradicts MUJOCO_GL (egl)"),
        ("'GLXPlatform' object has no attribute 'EGL'", {}, "with its GLX platform"),
        (f"{_NUMBER}0 and 3 (inclusive), got 7.", {}, "a number from 0 to 3"),
        (f"{_NUMBER}0 and -1 (inclusive), got 0.", {}, "EGL finds no device"),
        ("invalid value for environment variable MUJOCO_GL: gpu", {}, "MUJOCO_GL=gpu"),
        (_NAMES, {}, "MUJOCO_GL=EGL is not the name of a backend, or is not in"),
        (
            "module 'mujoco.rendering.classic.gl_context' has no attribute 'GLContext'",
            {"MUJOCO_GL": "Off"},
            "MUJOCO_GL=Off turns rendering off",
        ),
        ("no attribute 'flex_vertedge'. Did you", {}, 'pip install "mujoco<4"'),
        ("Image width 1280 > framebuffer width 640. E", {}, 'offwidth="1280"'),
        ("Offscreen framebuffer is not complete, error", {}, "offscreen buffer"),
        ("OpenGL error 0x502 in or before mjr_makeContext", {}, "a surface that"),
        ("EGLError(err = EGL_BAD_ACCESS, baseOperation", {}, "another thread"),
        ("failed to open /dev/dri/card0: Permission denied", {}, "open /dev/dri/card"),
        ("No module named 'OpenGL'", {}, "pip install pyopengl"),
        ("EGLError: <exception str() failed>", {}, "was still open when Python exited"),
    ],
)
def test_known_messages_have_a_cause_and_a_fix(text, environ, expected):
    found = diagnose(text, environ=environ)
    assert expected in f"{found.cause}\n{found.fix}"


def test_unknown_message_has_no_cause_and_causes_depend_on_backend():
    assert diagnose("FileNotFoundError: cheetah.xml", environ={}) is None
    for backend, word in (("glfw", "display"), ("egl", "current")):
        assert word in diagnose(_CONTEXT, backend=backend, environ={}).cause
