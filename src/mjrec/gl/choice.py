# SPDX-License-Identifier: Apache-2.0
"""Choosing the backend of this process."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ..errors import GLError
from .backends import (
    BACKENDS,
    backend_in_environment,
    backend_name,
    environment_for,
)
from .diagnosis import Diagnosis
from .probing import Probe, probe

_LOG = logging.getLogger(__name__)

_EARLIER = (
    "mujoco, dm_control and PyOpenGL read the backend once, when they are imported. "
    "Call mjrec.use_gl(), or set MUJOCO_GL, before anything imports them."
)


@dataclass(frozen=True)
class Choice:
    """The backend to use.

    Attributes:
        backend: its name.
        reason: where the name comes from.
        probe: the result of trying it.
        rejected: the backends tried before it, and why they were not taken.
    """

    backend: str
    reason: str
    probe: Probe
    rejected: tuple[tuple[str, Diagnosis], ...] = ()


def use_gl(backend: str | None = None) -> str:
    """Choose the OpenGL backend of this process and return its name.

    The choice is `backend`, else the environment variable `MUJOCO_GL`, else the first
    of EGL, OSMesa and GLFW that renders. A child process draws a test frame with it
    first, which takes about a second, once per process. So the result is a backend that
    works, and one that does not is an error with its cause and fix. To skip the test,
    set `MUJOCO_GL` and do not call this function.

    It sets `MUJOCO_GL` and `PYOPENGL_PLATFORM`; after an error both are unchanged. Call
    it before anything imports mujoco, dm_control or OpenGL. If mujoco is already
    imported, only the backend that it uses can be chosen.

    Args:
        backend: `"egl"`, `"osmesa"` or `"glfw"`, in any case. None lets mjrec choose.

    Raises:
        UnknownName: there is no backend of this name, or of `MUJOCO_GL`'s.
        GLError: `MUJOCO_GL` turns rendering off; mujoco, dm_control or PyOpenGL was
            imported with another backend; or no backend, or not this one, renders. The
            message has the cause and fix of each.
    """
    choice = choose(backend)
    _log(choice)
    set_backend(choice.backend)
    return choice.backend


def backend_for_children() -> str:
    """Return the first backend that renders, for processes that draw for this one.

    Whatever this process has imported, and whatever its `MUJOCO_GL` says.

    Raises:
        GLError: as `use_gl`.
    """
    choice = _first_that_renders(BACKENDS, None, "the first that renders")
    _log(choice)
    return choice.backend


def choose(backend: str | None = None) -> Choice:
    """Return what `use_gl` would choose, and change nothing.

    Raises:
        UnknownName: as `use_gl`.
        GLError: as `use_gl`.
    """
    asked, reason = _asked_for(backend)
    return _first_that_renders(
        [asked] if asked else BACKENDS, asked, reason, conflict_with
    )


def _first_that_renders(
    candidates: Iterable[str],
    asked: str | None,
    reason: str,
    conflict_with: Callable[[str], Diagnosis | None] = lambda _: None,
) -> Choice:
    rejected: list[tuple[str, Diagnosis]] = []
    for candidate in candidates:
        conflict = conflict_with(candidate)
        if conflict:
            rejected.append((candidate, conflict))
            continue
        tried = probe(candidate)
        if tried.renders:
            return Choice(candidate, reason, tried, tuple(rejected))
        rejected.append((candidate, Diagnosis(tried.cause, tried.fix)))
    raise GLError(_nothing_renders(asked, reason, rejected))


def _log(choice: Choice) -> None:
    for name, rejected in choice.rejected:
        _LOG.warning("%s cannot be used: %s %s", name, rejected.cause, rejected.fix)
    if choice.probe.warning():
        _LOG.warning("%s", choice.probe.warning())
    _LOG.info("Using %s (%s).", choice.backend, choice.probe.gl_renderer)


def _asked_for(backend: str | None) -> tuple[str | None, str]:
    if backend is not None:
        return backend_name(backend), "asked for"
    named = backend_in_environment()
    if named:
        return named, "MUJOCO_GL names it"
    return None, "the first that renders"


def conflict_with(backend: str) -> Diagnosis | None:
    """Return why this process cannot use `backend` any more, if so."""
    for package, taken in _taken().items():
        if taken == backend or (package == "PyOpenGL" and backend == "glfw"):
            continue
        with_what = f"with {taken}" if taken else "without a backend"
        return Diagnosis(
            f"{package} was imported {with_what} in this process, and cannot change "
            f"to {backend} any more.",
            _EARLIER,
        )
    return None


def _taken() -> dict[str, str | None]:
    """Return the backend that each package imported so far has taken.

    None stands for one that was imported without any: `MUJOCO_GL` turned rendering
    off, or the import of the backend failed.
    """
    taken: dict[str, str | None] = {}
    mujoco = sys.modules.get("mujoco")
    if mujoco is not None:
        context = getattr(mujoco, "GLContext", None)
        taken["mujoco"] = _known_backend(getattr(context, "__module__", ""))
    dm_control = sys.modules.get("dm_control._render")
    if dm_control is not None:
        taken["dm_control"] = _known_backend(getattr(dm_control, "BACKEND", ""))
    platform = getattr(sys.modules.get("OpenGL.platform"), "PLATFORM", None)
    if platform is not None:
        name = type(platform).__name__.removesuffix("Platform").lower()
        taken["PyOpenGL"] = name
    return taken


def _known_backend(text: object) -> str | None:
    name = str(text).rpartition(".")[2]
    return name if name in BACKENDS else None


def _nothing_renders(
    asked: str | None, reason: str, rejected: list[tuple[str, Diagnosis]]
) -> str:
    if asked:
        first = f"OpenGL backend {asked} ({reason}) cannot be used here."
        last = "`mjrec doctor` shows which backends render here."
    else:
        first = "No OpenGL backend can be used here."
        last = "`mjrec doctor` shows all of it again."
    lines = [first]
    for name, why in rejected:
        lines.append(f"{name}: {why.cause}")
        lines += [f"  {line}" for line in why.fix.splitlines()]
    return "\n".join([*lines, last])


def set_backend(backend: str) -> None:
    """Let `MUJOCO_GL` and `PYOPENGL_PLATFORM` say `backend`."""
    wanted = environment_for(backend, os.environ)
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):
        if name in wanted:
            os.environ[name] = wanted[name]
        else:
            os.environ.pop(name, None)
