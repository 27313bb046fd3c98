# SPDX-License-Identifier: Apache-2.0
"""Test resources of a process, read from small trees of kernel files."""

import os

import pytest

from mjrec.machine import cgroup_cpu_quota, gpu_device_files, usable_cpus


@pytest.mark.parametrize(
    ("own", "quotas", "expected"),
    [
        ("0::/\n", {"": "250000 100000"}, 2.5),
        # The lowest quota among all parents applies.
        (
            "0::/a/b/c\n",
            {"a": "100000 100000", "a/b": "400000 100000", "a/b/c": "max 100000"},
            1.0,
        ),
        # These trees set no limit.
        ("0::/\n", {"": "max 100000"}, None),
        ("0::/\n", {}, None),
        ("1:cpu:/\n", {"": "100000 100000"}, None),
    ],
)
def test_cgroup_limits_cpus(own, quotas, expected, tmp_path):
    root = tmp_path / "cgroup"
    for group, quota in quotas.items():
        (root / group).mkdir(parents=True, exist_ok=True)
        (root / group / "cpu.max").write_text(f"{quota}\n")
    (tmp_path / "own").write_text(own)
    assert cgroup_cpu_quota(root=root, own=tmp_path / "own") == expected


def test_usable_cpus_follow_the_affinity():
    before = os.sched_getaffinity(0)
    assert 1 <= usable_cpus() <= len(before)
    os.sched_setaffinity(0, {min(before)})
    try:
        assert usable_cpus() == 1
    finally:
        os.sched_setaffinity(0, before)


def test_gpus_are_nvidia_devices_and_render_nodes(tmp_path):
    (tmp_path / "dri").mkdir()
    for name in ("nvidia0", "nvidiactl", "dri/renderD128", "dri/card0", "null"):
        (tmp_path / name).touch()
    assert gpu_device_files(root=tmp_path) == [
        str(tmp_path / "dri/renderD128"),
        str(tmp_path / "nvidia0"),
    ]
