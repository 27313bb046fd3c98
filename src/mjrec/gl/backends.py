# SPDX-License-Identifier: Apache-2.0
"""Names of the OpenGL backends, and the environment variables that select one."""

from __future__ import annotations

import os
from collections.abc import Mapping

from ..errors import GLError, UnknownName

# In the order in which they are tested: EGL needs no display and can use a GPU, OSMesa
# needs no display, and GLFW needs one.
BACKENDS = ("egl", "osmesa", "glfw")

_KIND = "OpenGL backend"
_SYNONYMS = {"glx": "glfw"}
# Other values that mujoco accepts. The values in `_ON` do not name a backend.
_ON = frozenset({"", "enable", "enabled", "on", "true", "1"})
_OFF = frozenset({"disable", "disabled", "off", "false", "0"})


def backend_name(text: object) -> str:
    """Return the backend that `text` names, in the spelling that all programs accept.

    Case and surrounding whitespace are ignored: mujoco accepts `EGL`, but Gymnasium and
    dm_control do not.

    Raises:
        UnknownName: no such backend exists.
    """
    name = _normalised(text)
    if name not in BACKENDS:
        raise UnknownName(_KIND, text, BACKENDS)
    return name


def backend_in_environment(environ: Mapping[str, str] | None = None) -> str | None:
    """Return the backend that `MUJOCO_GL` names, or None if it does not name one.

    Args:
        environ: the environment variables; if None, this process's.

    Raises:
        UnknownName: `MUJOCO_GL` names an unknown backend.
        GLError: `MUJOCO_GL` turns rendering off.
    """
    environ = os.environ if environ is None else environ
    text = environ.get("MUJOCO_GL", "")
    if rendering_is_off(environ):
        raise GLError(
            f"The environment variable MUJOCO_GL is {text!r}, which turns rendering "
            f"off. Unset it, or set it to one of {', '.join(BACKENDS)}."
        )
    name = _normalised(text)
    if name in _ON:
        return None
    if name not in BACKENDS:
        raise UnknownName(
            _KIND,
            text,
            BACKENDS,
            hint="This name comes from the environment variable MUJOCO_GL: set it to "
            "one of these, or unset it and let mjrec try them.",
        )
    return name


def rendering_is_off(environ: Mapping[str, str]) -> bool:
    """Return whether `MUJOCO_GL` turns rendering off."""
    return _normalised(environ.get("MUJOCO_GL", "")) in _OFF


def platforms_contradict(environ: Mapping[str, str], backend: str | None) -> bool:
    """Return whether `PYOPENGL_PLATFORM` keeps mujoco from using `backend`."""
    platform = environ.get("PYOPENGL_PLATFORM", "").lower()
    return backend in ("egl", "osmesa") and platform not in ("", backend)


def environment_for(backend: str, environ: Mapping[str, str]) -> dict[str, str]:
    """Return a copy of `environ` whose variables select `backend`."""
    changed = {**environ, "MUJOCO_GL": backend}
    if backend in ("egl", "osmesa"):
        changed["PYOPENGL_PLATFORM"] = backend
    elif changed.get("PYOPENGL_PLATFORM", "").lower() == "osmesa":
        # GLFW creates its contexts with GLX or EGL, never with OSMesa.
        del changed["PYOPENGL_PLATFORM"]
    return changed


def _normalised(text: object) -> str:
    name = str(text).strip().lower()
    return _SYNONYMS.get(name, name)
