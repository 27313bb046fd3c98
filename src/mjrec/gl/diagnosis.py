# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of rendering failures: from an error message to its cause and exact fix.

Messages from MuJoCo and the drivers rarely name either. A missing library shows up as
`'NoneType' object has no attribute 'eglQueryString'`, and a wrong environment variable
as `module 'mujoco' has no attribute 'Renderer'`. Their meanings are listed in one
table, `diagnosis.toml`.
"""

from __future__ import annotations

import functools
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from .backends import platforms_contradict, rendering_is_off


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
    """Return the cause and fix of an OpenGL failure, or None if it is unknown.

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
    """Return the rows of `diagnosis.toml`, with its words filled in."""
    file = Path(__file__).with_name("diagnosis.toml")
    content = tomllib.loads(file.read_text("utf-8"))
    words: dict[str, str] = content["words"]

    def spelled(text: str) -> str:
        return re.sub("%([a-z_]+)%", lambda match: words[match[1]], text)

    rows: list[dict[str, str]] = content["failure"]
    return [{key: spelled(text) for key, text in row.items()} for row in rows]
