# SPDX-License-Identifier: Apache-2.0
"""Which OpenGL drew a picture."""

from __future__ import annotations

import ctypes
import importlib
import sys
from typing import Any

from .egl_devices import egl_devices

_NAMES = ("GL_VENDOR", "GL_RENDERER", "GL_VERSION")
_MAX_RENDERBUFFER_SIZE = 0x84E8


def raw_opengl() -> Any:
    """Return PyOpenGL's functions of OpenGL 1.0, for use on a thread with a context.

    Not `OpenGL.GL`, which takes longer to import than a picture to draw.
    """
    # It chooses its platform when it is imported, and mujoco sets which one when it
    # imports its context class: not before there is a context.
    return importlib.import_module("OpenGL.raw.GL.VERSION.GL_1_0")


def current_gl_strings() -> dict[str, str]:
    """Return vendor, renderer and version of the context current on this thread.

    The keys are `gl_vendor`, `gl_renderer` and `gl_version`; empty where no context
    is current, or none was made through PyOpenGL.
    """
    # Whoever drew has imported it already, and nobody else may do it here.
    if "OpenGL.platform" not in sys.modules:
        return {}
    gl = raw_opengl()
    strings = {}
    for name in _NAMES:
        try:
            pointer = gl.glGetString(getattr(gl, name))
        except sys.modules["OpenGL.error"].Error:
            return {}
        value = ctypes.cast(pointer, ctypes.c_char_p).value
        if value is None:
            return {}
        strings[name.lower()] = value.decode(errors="replace")
    return strings


def largest_picture() -> int:
    """Return the longest side that the driver of this thread's context can draw."""
    limit = ctypes.c_int()
    raw_opengl().glGetIntegerv(_MAX_RENDERBUFFER_SIZE, limit)
    return limit.value


def current_gl_facts() -> dict[str, Any]:
    """Return what metadata says of who draws on this thread.

    These are the strings and, where EGL tells on which of its devices it draws,
    `gl_device`: its `index` in EGL's list and, of a GPU whose driver says them, its
    `file` and its `uuid`. CUDA's number is not asked for, because that would begin
    CUDA in a process that may be somebody else's and forked later.
    """
    facts: dict[str, Any] = current_gl_strings()
    if facts and _is_egl():
        for device in egl_devices(with_cuda=False):
            if device.in_use:
                known = {"file": device.device_file, "uuid": device.uuid}
                said = {name: value for name, value in known.items() if value}
                facts["gl_device"] = {"index": device.index, **said}
    return facts


def _is_egl() -> bool:
    platform = getattr(sys.modules["OpenGL.platform"], "PLATFORM", None)
    return type(platform).__name__ == "EGLPlatform"
