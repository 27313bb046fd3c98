# SPDX-License-Identifier: Apache-2.0
"""A description of the machine that runs the benchmarks."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
from dataclasses import dataclass
from pathlib import Path

from mjrec.formats.ffmpeg import ffmpeg_version
from mjrec.gl.choice import probe
from mjrec.machine import usable_cpus

_PACKAGES = (
    *("mjrec", "mujoco", "gymnasium", "dm-control", "numpy", "h5py"),
    *("imageio-ffmpeg", "moviepy"),
)
_MODEL_NAME = re.compile(r"^model name\s*:\s*(.+)$", re.MULTILINE)
_MEMORY = re.compile(r"^MemTotal:\s*(\d+) kB$", re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class Machine:
    """A machine and the software installed on it.

    Attributes:
        cpu: name of the processor.
        cpus: number of CPUs that this process can use.
        memory: memory in GB.
        kernel: the operating system and its kernel version.
        gl_backend: name of the OpenGL backend.
        gl_renderer: renderer name as reported by OpenGL.
        gl_version: version as reported by OpenGL, including the driver's version.
        python: version of the interpreter.
        ffmpeg: first line of ffmpeg's version output.
        packages: package versions, keyed by name.
        load: load average over the last minute before the benchmarks.
    """

    cpu: str
    cpus: int
    memory: float
    kernel: str
    gl_backend: str
    gl_renderer: str
    gl_version: str
    python: str
    ffmpeg: str
    packages: dict[str, str]
    load: float

    def lines(self) -> list[str]:
        """Return a description to print above the tables."""
        packages = ", ".join(f"{name} {v}" for name, v in self.packages.items())
        return [
            f"{self.cpu}, {self.cpus} usable CPUs, {self.memory:.0f} GB, {self.kernel}",
            f"{self.gl_backend}: {self.gl_renderer}, {self.gl_version}",
            f"Python {self.python}, {packages}",
            f"load before: {self.load:.2f}",
        ]


def examine(backend: str) -> Machine:
    """Return a description of this machine, using an OpenGL backend to draw."""
    drawn = probe(backend)
    return Machine(
        cpu=_first(_MODEL_NAME, "/proc/cpuinfo") or platform.processor(),
        cpus=usable_cpus(),
        memory=int(_first(_MEMORY, "/proc/meminfo") or 0) / 1e6,
        kernel=platform.platform(),
        gl_backend=backend,
        gl_renderer=drawn.gl_renderer,
        gl_version=drawn.gl_version,
        python=platform.python_version(),
        ffmpeg=ffmpeg_version(),
        packages=dict(_versions()),
        load=os.getloadavg()[0],
    )


def _first(pattern: re.Pattern[str], path: str) -> str:
    try:
        found = pattern.search(Path(path).read_text())
    except OSError:
        return ""
    return found[1].strip() if found else ""


def _versions() -> list[tuple[str, str]]:
    found = []
    for name in _PACKAGES:
        try:
            found.append((name, importlib.metadata.version(name)))
        except importlib.metadata.PackageNotFoundError:
            found.append((name, "not installed"))
    return found
