# SPDX-License-Identifier: Apache-2.0
"""Tests of OpenGL backends in a child process, which may crash or hang."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..child_python import Child
from ..machine import gpu_device_files
from .backends import backend_name, environment_for
from .diagnosis import Diagnosis, diagnose
from .egl import EglDevice

# On machines with many GPUs, drivers can take more than ten seconds to initialize.
TIMEOUT = 60.0

_END_OF_OUTPUT = 4000
_SAID = ("renders", "gl_renderer", "gl_vendor", "gl_version", "frames_per_second")
_SOFTWARE = re.compile(r"llvmpipe|softpipe|swrast|SwiftShader|software", re.IGNORECASE)


@dataclass(frozen=True)
class Probe:
    """The result of testing one backend.

    Attributes:
        backend: the backend's name.
        renders: whether a test frame with several colours was correct.
        gl_renderer: the renderer's name in OpenGL; empty if unknown.
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
        """Return a warning if the backend uses the CPU despite a GPU, otherwise ""."""
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
    backend: str,
    *,
    environ: Mapping[str, str] | None = None,
    measure: bool = False,
    timeout: float = TIMEOUT,
) -> Probe:
    """Test `backend` as `use_gl` would set it, and cache the result in this process.

    A cached result is used only if all environment variables are unchanged.

    Args:
        backend: the backend's name.
        environ: the environment variables; if None, this process's.
        measure: whether to measure the speed too.
        timeout: maximum time to wait for a frame, in seconds.

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
    _answers[key] = probe_environment(environ, measure=measure, timeout=timeout)
    return _answers[key]


_answers: dict[tuple[str, frozenset[tuple[str, str]]], Probe] = {}


def probe_environment(
    environ: Mapping[str, str], *, measure: bool = False, timeout: float = TIMEOUT
) -> Probe:
    """Test the backend that `environ` names in `MUJOCO_GL`, with only these variables.

    Args:
        environ: the child's environment variables, which are not corrected.
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
