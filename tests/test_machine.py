# SPDX-License-Identifier: Apache-2.0
"""What the kernel says a process may use, read from small file trees."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from mjrec.machine import cgroup_cpu_quota, gpu_device_files, usable_cpus


def groups(folder: Path, own: str, files: dict[str, str]) -> dict[str, Path]:
    """Write a cgroup file system and return where it is."""
    root = folder / "cgroup"
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    (folder / "own").write_text(own)
    return {"root": root, "own": folder / "own"}


def test_version_2(tmp_path: Path) -> None:
    """A quota of 2.5 CPUs."""
    where = groups(tmp_path, "0::/\n", {"cpu.max": "250000 100000\n"})
    assert cgroup_cpu_quota(**where) == 2.5


def test_version_1(tmp_path: Path) -> None:
    """The same with the older files."""
    files = {
        "cpu,cpuacct/job/cpu.cfs_quota_us": "150000\n",
        "cpu,cpuacct/job/cpu.cfs_period_us": "100000\n",
    }
    where = groups(tmp_path, "4:cpu,cpuacct:/job\n0::/\n", files)
    assert cgroup_cpu_quota(**where) == 1.5


def test_a_group_above_may_be_narrower(tmp_path: Path) -> None:
    """The least quota on the way up counts."""
    files = {
        "a/cpu.max": "100000 100000\n",
        "a/b/cpu.max": "400000 100000\n",
        "a/b/c/cpu.max": "max 100000\n",
    }
    where = groups(tmp_path, "0::/a/b/c\n", files)
    assert cgroup_cpu_quota(**where) == 1.0


@pytest.mark.parametrize(
    ("own", "files"),
    [
        ("0::/\n", {"cpu.max": "max 100000\n"}),
        ("0::/\n", {}),
        (
            "1:cpu:/\n",
            {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"},
        ),
        ("", {}),
    ],
)
def test_no_limit(own: str, files: dict[str, str], tmp_path: Path) -> None:
    """None, whether it is said or not to be found."""
    assert cgroup_cpu_quota(**groups(tmp_path, own, files)) is None


def test_usable_cpus_follow_the_affinity() -> None:
    """A process that is bound to one CPU has one."""
    before = os.sched_getaffinity(0)
    assert 1 <= usable_cpus() <= len(before)
    os.sched_setaffinity(0, {min(before)})
    try:
        assert usable_cpus() == 1
    finally:
        os.sched_setaffinity(0, before)


def test_gpus(tmp_path: Path) -> None:
    """NVIDIA's devices and everybody's render nodes; nothing else."""
    (tmp_path / "dri").mkdir()
    for name in ("nvidia0", "nvidiactl", "dri/renderD128", "dri/card0", "null"):
        (tmp_path / name).touch()
    assert gpu_device_files(root=tmp_path) == [
        str(tmp_path / "dri/renderD128"),
        str(tmp_path / "nvidia0"),
    ]
