# SPDX-License-Identifier: Apache-2.0
"""Facts about this machine, and the resources that this process may use.

The last bits of a simulation depend on these facts and on MuJoCo's version. MuJoCo
calls the C library's sine and exponential functions, which choose their code by CPU
feature. Without FMA, the same wheel gives different trajectories on the same machine.
"""

from __future__ import annotations

import functools
import hashlib
import os
import platform
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from types import MappingProxyType

from .errors import InvalidArgument

_CGROUPS = Path("/sys/fs/cgroup")
_OWN_CGROUPS = Path("/proc/self/cgroup")
_CPUINFO = Path("/proc/cpuinfo")
# The names of these fields on x86 and on ARM.
_FLAGS = ("flags", "Features")
_MODELS = ("model name", "CPU part")


def usable_cpus() -> int:
    """Return the number of CPUs that this process can keep busy, at least 1.

    This is the number of CPUs that the process may run on (its affinity), or its
    cgroup's quota if that is less: a container with 2.5 of 64 CPUs can use 2.
    """
    allowed = len(os.sched_getaffinity(0))
    quota = cgroup_cpu_quota()
    return allowed if quota is None else max(1, min(allowed, int(quota)))


def cgroup_cpu_quota(
    *, root: Path = _CGROUPS, own: Path = _OWN_CGROUPS
) -> float | None:
    """Return the number of CPUs that the cgroup allows, or None if unlimited.

    Limits on parent groups count too. Only version 2 cgroups are supported.

    Args:
        root: mount point of the cgroup file system.
        own: the file that lists this process's groups.
    """
    # Inside a container the path may be the host's, which is not mounted. The root is
    # then the container's own group.
    groups = [line.split("::", 1) for line in _lines(own)]
    quotas = [
        quota
        for group in groups
        if group[0] == "0" and len(group) == 2
        for path in (PurePosixPath(group[1].lstrip("/")) / "_").parents
        if (quota := _quota(root / path / "cpu.max")) is not None
    ]
    return min(quotas, default=None)


def gpu_device_files(*, root: Path = Path("/dev")) -> list[str]:
    """Return the device files of the machine's GPUs, sorted.

    Args:
        root: the directory of device files.
    """
    found = [*root.glob("nvidia[0-9]*"), *root.glob("dri/renderD*")]
    return sorted(map(str, found))


@functools.cache
def machine_fingerprint() -> Mapping[str, str]:
    """Return the facts in which two machines must agree for bit-identical results.

    Returns:
        `architecture`, `libc` (name and version), `cpu_flags` (the SHA-256 of the
        sorted names of the CPU's features, joined by spaces; "" if unknown) and
        `tunables` (the variable GLIBC_TUNABLES, which can mask features).
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
    """Return the model name of the first CPU; "" if unknown."""
    return next((_cpuinfo()[name] for name in _MODELS if name in _cpuinfo()), "")


def cpu_flags() -> tuple[str, ...]:
    """Return the names of the first CPU's features, sorted."""
    flags = next((_cpuinfo()[name] for name in _FLAGS if name in _cpuinfo()), "")
    return tuple(sorted(flags.split()))


def _quota(file: Path) -> float | None:
    words = " ".join(_lines(file)).split()
    if len(words) != 2 or words[0] == "max":
        return None
    return int(words[0]) / int(words[1])


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(errors="replace").splitlines()
    except OSError:
        return []


@functools.cache
def _cpuinfo() -> Mapping[str, str]:
    fields: dict[str, str] = {}
    for line in _lines(_CPUINFO):
        name, colon, value = line.partition(":")
        if colon:
            fields.setdefault(name.strip(), value.strip())
    return MappingProxyType(fields)


def check_workers(workers: int | None) -> int | None:
    """Return `workers` if it is a positive whole number or None.

    Raises:
        InvalidArgument: `workers` is anything else.
    """
    whole = isinstance(workers, int) and not isinstance(workers, bool)
    if workers is not None and not (whole and workers >= 1):
        raise InvalidArgument(
            "workers must be a positive whole number, or None for one per usable CPU, "
            f"not {workers!r}."
        )
    return workers
