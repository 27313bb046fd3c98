# SPDX-License-Identifier: Apache-2.0
"""Which OpenGL drew a picture."""

from __future__ import annotations

import importlib
import sys

__all__ = ["current_gl_strings"]

_NAMES = ("GL_VENDOR", "GL_RENDERER", "GL_VERSION")


def current_gl_strings() -> dict[str, str]:
    """Return vendor, renderer and version of the context current on this thread.

    The keys are `gl_vendor`, `gl_renderer` and `gl_version`; empty where no context
    is current, or none was made through PyOpenGL.
    """
    # PyOpenGL chooses its platform when it is first imported: whoever drew has done so
    # already, and nobody else may do it here.
    if "OpenGL.platform" not in sys.modules:
        return {}
    gl = importlib.import_module("OpenGL.GL")
    strings = {}
    for name in _NAMES:
        try:
            value = gl.glGetString(getattr(gl, name))
        except gl.GLError:
            return {}
        if value is None:
            return {}
        strings[name.lower()] = value.decode(errors="replace")
    return strings
