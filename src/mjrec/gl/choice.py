# SPDX-License-Identifier: Apache-2.0
"""Choice of this process's OpenGL backend, based on tests in child processes.

A child process is used because a driver may crash or hang.
"""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..child_python import Child
from ..errors import GLError
from ..machine import gpu_device_files
from .backends import (
    BACKENDS,
    Diagnosis,
    backend_in_environment,
    backend_name,
    diagnose,
    environment_for,
)
from .egl import EglDevice

_LOG = logging.getLogger(__name__)

# On machines with many GPUs, drivers can take more than ten seconds to initialize.
TIMEOUT = 60.0

_END_OF_OUTPUT = 4000
_SAID = ("renders", "gl_renderer", "gl_vendor", "gl_version", "frames_per_second")
_SOFTWARE = re.compile(r"llvmpipe|softpipe|swrast|SwiftShader|software", re.IGNORECASE)
_BY_DEFAULT = "the first that works"
_EARLIER = (
    "mujoco, dm_control and PyOpenGL read the backend once, when they are imported. "
    "Call mjrec.use_gl(), or set MUJOCO_GL, before anything imports them."
)


@dataclass(frozen=True)
class Probe:
    """The result of testing one backend.

    Attributes:
        backend: the backend's name.
        renders: whether a test frame with several colors was rendered correctly.
        gl_renderer: the renderer's name as reported by OpenGL; empty if unknown.
        gl_vendor: the renderer's vendor.
        gl_version: the version of OpenGL, including the driver's.
        frames_per_second: rendering speed for a small scene at 480x480 pixels and
            MuJoCo's default quality; None if not measured.
        devices: EGL's devices, if known, even if none of them works.
        cause: why the backend does not work.
        fix: what to do; empty if unknown.
        output: the end of the child process's output, if the backend does not work.
    """

    backend: str
    renders: bool
    gl_renderer: str = ""
    gl_vendor: str = ""
    gl_version: str = ""
    frames_per_second: float | None = None
    devices: tuple[EglDevice, ...] = ()
    cause: str = ""
    fix: str = ""
    output: str = ""

    @property
    def software(self) -> bool:
        """Whether the backend renders on the CPU."""
        return self.renders and bool(
            self.backend == "osmesa" or _SOFTWARE.search(self.gl_renderer)
        )

    def warning(self) -> str:
        """Return a warning if the backend uses the CPU despite a GPU, else ""."""
        files = gpu_device_files() if self.software else []
        if not files:
            return ""
        closed = [file for file in files if not os.access(file, os.R_OK | os.W_OK)]
        if self.backend == "osmesa":
            way = "OSMesa always renders on the CPU, but EGL can use the GPU."
        elif closed:
            way = (
                f"This user has no permission to open {closed[0]}: add the user to the "
                "file's group."
            )
        else:
            way = (
                "EGL finds no driver for it, or MUJOCO_EGL_DEVICE_ID selects another "
                "device. A container with an NVIDIA GPU needs "
                "NVIDIA_DRIVER_CAPABILITIES=all."
            )
        return (
            f"{self.backend} renders on the CPU ({self.gl_renderer or self.backend}) "
            f"although there is a GPU ({', '.join(files)}). {way}"
        )


def probe(
    backend: str, *, environ: Mapping[str, str] | None = None, measure: bool = False
) -> Probe:
    """Test `backend` as set by `use_gl`, and cache the result in this process.

    A cached result is used only if all environment variables are unchanged.

    Args:
        backend: the backend's name.
        environ: the environment variables; if None, this process's.
        measure: whether to measure the speed too.

    Raises:
        UnknownName: no such backend exists.
    """
    environ = environment_for(
        backend_name(backend), os.environ if environ is None else environ
    )
    key = (environ["MUJOCO_GL"], frozenset(environ.items()))
    known = _answers.get(key)
    if known and not (measure and known.renders and known.frames_per_second is None):
        return known
    _answers[key] = probe_environment(environ, measure=measure)
    return _answers[key]


_answers: dict[tuple[str, frozenset[tuple[str, str]]], Probe] = {}


def probe_environment(
    environ: Mapping[str, str], *, measure: bool = False, timeout: float = TIMEOUT
) -> Probe:
    """Test the backend that `environ` names in `MUJOCO_GL`, with only these variables.

    Args:
        environ: the child's environment variables, which are used unchanged.
        measure: whether to measure the speed too.
        timeout: maximum time to wait for a frame, in seconds.
    """
    backend = environ["MUJOCO_GL"]
    facts, output = _ask_child(environ, measure=measure, timeout=timeout)
    known = {name: facts[name] for name in _SAID if name in facts}
    devices = tuple(EglDevice(**device) for device in facts.get("devices", ()))
    if known.get("renders"):
        return Probe(backend=backend, devices=devices, **known)
    # If a failure is not in the table, the output itself is given as the cause.
    words = "\n".join(list(filter(str.strip, output.splitlines()))[-3:])
    found = diagnose(output, backend=backend, environ=environ) or Diagnosis(
        words or "The child process printed nothing.", ""
    )
    return Probe(
        *(backend, False),
        devices=devices,
        cause=found.cause,
        fix=found.fix,
        output=output[-_END_OF_OUTPUT:],
    )


def _ask_child(
    environ: Mapping[str, str], *, measure: bool, timeout: float
) -> tuple[dict[str, Any], str]:
    """Return the child's facts, and all text that may explain a failure."""
    facts: dict[str, Any] = {}
    is_silent = False
    try:
        arguments = ["--measure"] if measure else []
        child = Child("mjrec.simulation.gl_probe", *arguments, environ=environ)
    except OSError as error:
        return {}, f"{sys.executable} could not be started: {error}"
    with child:
        for message in child.messages(timeout):
            is_silent = message is None
            facts |= message or {}
        if is_silent:
            child.stacks()
            end = f"no answer within {timeout:g} seconds"
            child.kill()
        else:
            end = f"The child process {child.how_it_ended()}."
        words = [child.printed(), *facts.get("notes", [])]
    return facts, "\n".join(filter(None, [*words, facts.get("error") or end]))


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
    So if a backend is returned, it works. Otherwise, an error explains the cause and
    the fix. To skip the test, set `MUJOCO_GL` and do not call this function.

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
            backend was requested and none works. The message gives each failure's cause
            and fix.
    """
    choice = choose(backend)
    _log(choice)
    set_backend(choice.backend)
    return choice.backend


def backend_for_children() -> str:
    """Return the first working backend, for processes that render for this one.

    This ignores the process's imports and its `MUJOCO_GL`.

    Raises:
        GLError: no backend works.
    """
    choice = _first_that_renders(None, _BY_DEFAULT, is_for_children=True)
    _log(choice)
    return choice.backend


def choose(backend: str | None = None) -> Choice:
    """Return the choice that `use_gl` would make, without changing anything.

    Raises:
        UnknownName: see `use_gl`.
        GLError: see `use_gl`.
    """
    asked, reason = None, _BY_DEFAULT
    if backend is not None:
        asked, reason = backend_name(backend), "requested"
    elif named := backend_in_environment():
        asked, reason = named, "set by MUJOCO_GL"
    return _first_that_renders(asked, reason)


def _first_that_renders(
    asked: str | None, reason: str, *, is_for_children: bool = False
) -> Choice:
    rejected: list[tuple[str, Diagnosis]] = []
    for candidate in [asked] if asked else BACKENDS:
        conflict = None if is_for_children else conflict_with(candidate)
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
    """Return the backend that each imported package uses, keyed by package.

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
        first = f"The OpenGL backend {asked} ({reason}) cannot be used here."
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
