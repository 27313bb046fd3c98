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

    A limit on any group above counts too; both versions of cgroups are read.

    Args:
        root: where the cgroup file systems are mounted.
        own: the file that names the groups of this process.
    """
    quotas = []
    for controllers, group in _own_groups(own):
        if controllers == "":
            quotas += [_quota_v2(root / part) for part in _upwards(group)]
        elif "cpu" in controllers.split(","):
            for mounted in (root / "cpu", root / controllers):
                quotas += [_quota_v1(mounted / part) for part in _upwards(group)]
    return min((quota for quota in quotas if quota is not None), default=None)


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


def _own_groups(own: Path) -> list[tuple[str, str]]:
    """Return pairs of controllers ("" is version 2) and the group's path."""
    try:
        lines = own.read_text().splitlines()
    except OSError:
        return []
    fields = (line.split(":", 2) for line in lines)
    return [(field[1], field[2]) for field in fields if len(field) == 3]


def _upwards(group: str) -> list[str]:
    """Return the relative paths of a group and all those above it.

    Inside a container the path may be the host's, of which nothing is mounted; the
    last one, the root, then is the container's own group.
    """
    path = PurePosixPath(group.lstrip("/"))
    return [str(part) for part in (path, *path.parents)]


def _quota_v2(group: Path) -> float | None:
    words = _words(group / "cpu.max")
    if len(words) != 2 or words[0] == "max":
        return None
    return int(words[0]) / int(words[1])


def _quota_v1(group: Path) -> float | None:
    quota = _words(group / "cpu.cfs_quota_us")
    period = _words(group / "cpu.cfs_period_us")
    if not quota or not period or int(quota[0]) <= 0:
        return None
    return int(quota[0]) / int(period[0])


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []


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
