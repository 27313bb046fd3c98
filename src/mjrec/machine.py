# SPDX-License-Identifier: Apache-2.0
"""What this machine is, and what it lets this process use.

Of what it is, that counts on which the last bit of a simulation depends, besides
MuJoCo's version. MuJoCo calls the C library's sines and exponentials, which choose
their code by what the CPU can do: without FMA the same wheel on the same machine gives
other trajectories.
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
# What is said of a CPU on x86 and on ARM.
_FLAGS = ("flags", "Features")
_MODELS = ("model name", "CPU part")


def usable_cpus() -> int:
    """Return how many CPUs this process can keep busy; at least 1.

    It is the number that the process may run on (its affinity), or the quota of its
    cgroup where that is less: a container that is given 2.5 CPUs of 64 has 2.
    """
    allowed = len(os.sched_getaffinity(0))
    quota = cgroup_cpu_quota()
    return allowed if quota is None else max(1, min(allowed, int(quota)))


def cgroup_cpu_quota(
    *, root: Path = _CGROUPS, own: Path = _OWN_CGROUPS
) -> float | None:
    """Return the CPUs that the cgroup grants, or None where nothing limits them.

    A limit on any group above counts too. Those of version 2 are read.

    Args:
        root: where the cgroup file system is mounted.
        own: the file that names the groups of this process.
    """
    # Inside a container the path may be the host's, which is not mounted; the
    # root then is the container's own group.
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
    """Return the device files of the GPUs that there are, sorted.

    Args:
        root: the directory of device files.
    """
    found = [*root.glob("nvidia[0-9]*"), *root.glob("dri/renderD*")]
    return sorted(map(str, found))


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
    """Return `workers` if it is a number of processes, or None.

    Raises:
        InvalidArgument: it is something else.
    """
    whole = isinstance(workers, int) and not isinstance(workers, bool)
    if workers is not None and not (whole and workers >= 1):
        raise InvalidArgument(
            "workers must be a positive whole number, or None for one on each CPU that "
            f"can be used, got {workers!r}."
        )
    return workers
