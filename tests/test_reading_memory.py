# SPDX-License-Identifier: Apache-2.0
"""What stays in memory of thousands of manifests while they are read."""

import tracemalloc

from parts import parametrize

import mjrec
from mjrec.formats.manifest import (
    Manifest,
    StatsFile,
    read_manifest,
    write_manifest,
    write_stats_file,
)
from mjrec.formats.monitor_directory import manifest_name, stats_prefix
from mjrec.reporting.gathering import gather

MONITORS = 40
# What a manifest says of a machine takes far more than what is read from it.
PACKAGES = {f"package-{n}": {"version": "1.0", "sha256": "0" * 64} for n in range(1000)}


def write_monitors(directory, said):
    """Write what many monitors leave that recorded an episode each."""
    directory.mkdir()
    for number in range(MONITORS):
        infix = f"{number}.1"
        name = f"{stats_prefix(infix)}.stats.json"
        stats = StatsFile(1.79e9, (1.79e9 + number,), (3,), (1.0,), ("e",))
        write_stats_file(directory / name, stats)
        manifest = Manifest(
            stats=name,
            videos=(),
            env_info={"gym_version": "mjrec-1", "env_id": "Hopper-v5"},
            mjrec={"provenance": {"packages": said}},
        )
        write_manifest(directory / manifest_name(infix), manifest)
    return directory


def list_episodes(directory):
    """Return how many episodes there are."""
    return sum(1 for _ in mjrec.iter_episodes(directory))


def peak_of(read, path):
    """Return the most bytes that were held while something was read."""
    # The first time, things are loaded that stay.
    read(path)
    tracemalloc.start()
    try:
        read(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@parametrize("read", [mjrec.load_results, list_episodes, gather])
def test_manifests_are_not_kept(tmp_path, read):
    """What all of them say takes no more than what a few do."""
    large = write_monitors(tmp_path / "large", PACKAGES)
    small = write_monitors(tmp_path / "small", {})
    one = peak_of(read_manifest, large / manifest_name("0.1"))
    assert peak_of(read, large) - peak_of(read, small) < 4 * one
