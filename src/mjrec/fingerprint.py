# SPDX-License-Identifier: Apache-2.0
"""What of a machine the last bit of a simulation depends on, besides MuJoCo's version.

MuJoCo calls the C library's sines and exponentials, which choose their code by what the
CPU can do: without FMA the same wheel on the same machine gives other trajectories.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

_CPUINFO = Path("/proc/cpuinfo")
# What is said of a CPU on x86 and on ARM.
_FLAGS = ("flags", "Features")
_MODELS = ("model name", "CPU part")


@functools.cache
def machine_fingerprint() -> Mapping[str, str]:
    """Return what two machines must share for equal bits.

    Returns:
        `architecture`, `libc` (name and version), `cpu_flags` (the sha256 of the sorted
        names of what the CPU can do, joined by spaces; "" where the system does not
        say) and `tunables` (the variable GLIBC_TUNABLES, which can mask them).
    """
    flags = " ".join(cpu_flags())
    return MappingProxyType(
        {
            "architecture": platform.machine(),
            "libc": " ".join(platform.libc_ver()).strip(),
            "cpu_flags": hashlib.sha256(flags.encode()).hexdigest() if flags else "",
            "tunables": os.environ.get("GLIBC_TUNABLES", ""),
        }
    )


def cpu_model() -> str:
    """Return what the system calls the first CPU; "" where it does not say."""
    return next((_cpuinfo()[name] for name in _MODELS if name in _cpuinfo()), "")


def cpu_flags() -> tuple[str, ...]:
    """Return the names of what the first CPU can do, sorted."""
    flags = next((_cpuinfo()[name] for name in _FLAGS if name in _cpuinfo()), "")
    return tuple(sorted(flags.split()))


@functools.cache
def _cpuinfo() -> Mapping[str, str]:
    try:
        lines = _CPUINFO.read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    said: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        if colon:
            said.setdefault(name.strip(), value.strip())
    return MappingProxyType(said)
