# SPDX-License-Identifier: Apache-2.0
"""The manifest is gym's with one key more, and cannot point outside its directory."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mjrec.errors import UnreadableFile
from mjrec.formats.manifest import Manifest, read_manifest, write_manifest

MANIFEST = Manifest(
    stats="s.stats.json",
    videos=(("a.mp4", "a.meta.json"), ("b.mp4", "b.meta.json")),
    env_info={"gym_version": "mjrec-1", "env_id": "Hopper-v5"},
    mjrec={"format": 1, "pending": []},
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.manifest.0.1.manifest.json"


def test_keys_are_in_gyms_order_with_ours_last(path: Path) -> None:
    """What is read is what was written; nothing stands for a missing key of ours."""
    write_manifest(path, MANIFEST)
    assert read_manifest(path) == MANIFEST
    assert list(json.loads(path.read_text())) == [
        "stats",
        "videos",
        "env_info",
        "mjrec",
    ]
    write_manifest(path, Manifest("s", (("a", "b"),), {"gym_version": "0.21.0"}, None))
    assert path.read_text() == (
        '{"stats": "s", "videos": [["a", "b"]], "env_info": {"gym_version": "0.21.0"}}'
    )
    assert read_manifest(path).mjrec is None


@pytest.mark.parametrize(
    "name", ["../s", "a/b", "/etc/passwd", "..", ".", "", "a\\b", "a\0b"]
)
def test_a_name_outside_the_directory_is_refused(path: Path, name: str) -> None:
    """As statistics, video or metadata, when reading and when writing."""
    for stats, videos in ((name, []), ("s", [[name, "m"]]), ("s", [["v", name]])):
        path.write_text(json.dumps({"stats": stats, "videos": videos, "env_info": {}}))
        with pytest.raises(UnreadableFile, match="not the name of a file"):
            read_manifest(path)
    path.unlink()
    with pytest.raises(ValueError, match="not the name of a file"):
        write_manifest(path, Manifest(name, (), {}, None))
    assert not path.exists()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ('{"stats": "s", "videos": []', "not whole JSON"),
        ("null", "an object belongs there, not null"),
        ('{"videos": [], "env_info": {}}', "it has no 'stats'"),
        ('{"stats": 1, "videos": [], "env_info": {}}', "a text belongs there"),
        ('{"stats": "s", "videos": [["a"]], "env_info": {}}', "not 1 names"),
        ('{"stats": "s", "videos": [], "env_info": [], "x": 1}', "an object belongs"),
        ('{"stats": "s", "videos": [], "env_info": {}, "mjrec": 1}', "'mjrec'"),
    ],
)
def test_damage_is_named_with_the_reason(path: Path, content: str, reason: str) -> None:
    """Each kind is one clear error."""
    path.write_text(content)
    with pytest.raises(UnreadableFile, match=reason) as caught:
        read_manifest(path)
    assert caught.value.path == path
