# SPDX-License-Identifier: Apache-2.0
"""Choice of this process's OpenGL backend."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from ..errors import GLError
from .backends import BACKENDS, backend_in_environment, backend_name, environment_for
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
        backend: the backend's name.
        reason: why the backend was chosen.
        probe: the result of the backend's test.
        rejected: the backends that were tried first, and why they were rejected.
    """

    backend: str
    reason: str
    probe: Probe
    rejected: tuple[tuple[str, Diagnosis], ...] = ()


def use_gl(backend: str | None = None) -> str:
    """Choose the OpenGL backend for this process and return its name.

    The choice is `backend` if given, otherwise the environment variable `MUJOCO_GL` if
    set, otherwise the first of EGL, OSMesa and GLFW that works. A child process first
    renders a test frame with the backend, which takes about a second, once per process.
    So if a backend is returned, it works. Otherwise an error gives the cause and the
    fix. To skip the test, set `MUJOCO_GL` and do not call this function.

    This function sets `MUJOCO_GL` and `PYOPENGL_PLATFORM`, and changes neither if it
    raises an error. Call it before anything imports mujoco, dm_control or OpenGL. If
    mujoco is already imported, only the backend that it uses can be chosen.

    Args:
        backend: `"egl"`, `"osmesa"` or `"glfw"`, in upper or lower case. If None, mjrec
            chooses.

    Raises:
        UnknownName: `backend` or `MUJOCO_GL` is not the name of a backend.
        GLError: `MUJOCO_GL` turns rendering off; mujoco, dm_control or PyOpenGL was
            imported with another backend; the requested backend does not work; or no
            backend was requested and none works. The message gives the cause and fix
            for each.
    """
    choice = choose(backend)
    _log(choice)
    set_backend(choice.backend)
    return choice.backend


def backend_for_children() -> str:
    """Return the first working backend, for processes that render for this one.

    This process's imports and its `MUJOCO_GL` do not matter.

    Raises:
        GLError: no backend works.
    """
    choice = _first_that_renders(BACKENDS, None, "the first that works")
    _log(choice)
    return choice.backend


def choose(backend: str | None = None) -> Choice:
    """Return the choice that `use_gl` would make, without changing anything.

    Raises:
        UnknownName: see `use_gl`.
        GLError: see `use_gl`.
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
        return backend_name(backend), "requested"
    named = backend_in_environment()
    if named:
        return named, "set by MUJOCO_GL"
    return None, "the first that works"


def conflict_with(backend: str) -> Diagnosis | None:
    """Return the reason why this process cannot use `backend`, or None if it can."""
    for package, taken in _taken().items():
        if taken == backend or (package == "PyOpenGL" and backend == "glfw"):
            continue
        with_what = f"with {taken}" if taken else "without a backend"
        return Diagnosis(
            f"{package} was imported {with_what} in this process and can no longer "
            f"switch to {backend}.",
            _EARLIER,
        )
    return None


def _taken() -> dict[str, str | None]:
    """Return the backend that each imported package uses, by package.

    None means that a package was imported without a backend, because `MUJOCO_GL` turned
    rendering off or because importing the backend failed.
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
        last = "Run `mjrec doctor` to see which backends work here."
    else:
        first = "No OpenGL backend can be used here."
        last = "Run `mjrec doctor` to see the details again."
    lines = [first]
    for name, why in rejected:
        lines.append(f"{name}: {why.cause}")
        lines += [f"  {line}" for line in why.fix.splitlines()]
    return "\n".join([*lines, last])


def set_backend(backend: str) -> None:
    """Set `MUJOCO_GL` and `PYOPENGL_PLATFORM` to `backend`."""
    wanted = environment_for(backend, os.environ)
    for name in ("MUJOCO_GL", "PYOPENGL_PLATFORM"):
        if name in wanted:
            os.environ[name] = wanted[name]
        else:
            os.environ.pop(name, None)
