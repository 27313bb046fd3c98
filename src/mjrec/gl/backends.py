# SPDX-License-Identifier: Apache-2.0
"""The OpenGL backends: their names, the variables that select them, and failures.

Messages from MuJoCo and the drivers rarely name a failure's cause or fix. A missing
library shows up as `'NoneType' object has no attribute 'eglQueryString'`, and a wrong
environment variable as `module 'mujoco' has no attribute 'Renderer'`. Their meanings
are listed in one table, `diagnosis.toml`.
"""

from __future__ import annotations

import functools
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

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


@dataclass(frozen=True)
class Diagnosis:
    """The cause of a problem and its fix.

    Attributes:
        cause: what is wrong, in a sentence or two.
        fix: what to do; empty if unknown. Commands are on separate lines, indented by
            two spaces.
    """

    cause: str
    fix: str


def diagnose(
    text: str, *, backend: str | None = None, environ: Mapping[str, str] | None = None
) -> Diagnosis | None:
    """Return the cause and fix of an OpenGL failure, or None if they are unknown.

    Args:
        text: the exception's text, or a process's whole output.
        backend: the backend in use, if known.
        environ: the environment variables at that time; if None, this process's.
    """
    environ = os.environ if environ is None else environ
    wanted = backend or environ.get("MUJOCO_GL", "").strip().lower()
    display = environ.get("DISPLAY")
    facts = {
        **environ,
        "wanted": wanted,
        "platform": environ.get("PYOPENGL_PLATFORM", "another platform"),
        "display": f"cannot open {display}" if display else "DISPLAY is not set",
        "glfw_by_default": ""
        if environ.get("MUJOCO_GL")
        else " Without MUJOCO_GL, mujoco, Gymnasium and dm_control choose GLFW.",
    }
    needed = {None, *environ}
    if rendering_is_off(environ):
        needed.add("off")
    if platforms_contradict(environ, wanted):
        needed.add("contradiction")
    for known in _table():
        found = re.search(known["pattern"], text, re.MULTILINE)
        if (
            found
            and backend in (None, known.get("backend", backend))
            and re.search(known.get("also", ""), text)
            and not ("unless" in known and re.search(known["unless"], text))
            and known.get("needs") in needed
        ):
            words = {**facts, **found.groupdict()}
            # mujoco capitalizes backend names.
            words["wanted"] = words["wanted"].lower()
            return Diagnosis(
                known["cause"].format(**words), known["fix"].format(**words)
            )
    return None


@functools.cache
def _table() -> list[dict[str, str]]:
    """Return the rows of `diagnosis.toml`, with their placeholders filled in."""
    file = Path(__file__).with_name("diagnosis.toml")
    content = tomllib.loads(file.read_text("utf-8"))
    words: dict[str, str] = content["words"]

    def spelled(text: str) -> str:
        return re.sub("%([a-z_]+)%", lambda match: words[match[1]], text)

    rows: list[dict[str, str]] = content["failure"]
    return [{key: spelled(text) for key, text in row.items()} for row in rows]
