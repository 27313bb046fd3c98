# SPDX-License-Identifier: Apache-2.0
"""Manifest and statistics file are gym's, and safe to read from anybody."""

import json

import pytest

from mjrec.errors import UnreadableFile
from mjrec.formats.manifest import (
    Manifest,
    StatsFile,
    read_manifest,
    read_stats_file,
    write_manifest,
    write_stats_file,
)

MANIFEST = Manifest(
    stats="s.stats.json",
    videos=(("a.mp4", "a.meta.json"), ("b.mp4", "b.meta.json")),
    env_info={"gym_version": "mjrec-1", "env_id": "Hopper-v5"},
    mjrec={"format": 1, "pending": []},
)
STATS = StatsFile(
    initial_reset_timestamp=10.5,
    timestamps=(11.0, 12.0),
    episode_lengths=(3, 4),
    episode_rewards=(1.5, -2.0),
    episode_types=("t", "e"),
)
STATS_TEXT = (
    '{"initial_reset_timestamp": 10.5, "timestamps": [11.0, 12.0], '
    '"episode_lengths": [3, 4], "episode_rewards": [1.5, -2.0], '
    '"episode_types": ["t", "e"]}'
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "openaigym.some.0.1.json"


def test_keys_of_a_manifest_are_in_gyms_order_with_ours_last(path):
    """What is read is what was written; nothing stands for a missing key of ours."""
    write_manifest(path, MANIFEST)
    assert read_manifest(path) == MANIFEST
    assert [*json.loads(path.read_text())] == ["stats", "videos", "env_info", "mjrec"]
    write_manifest(path, Manifest("s", (("a", "b"),), {"gym_version": "0.21.0"}, None))
    assert path.read_text() == (
        '{"stats": "s", "videos": [["a", "b"]], "env_info": {"gym_version": "0.21.0"}}'
    )
    assert read_manifest(path).mjrec is None


def test_the_text_of_statistics_is_what_gym_wrote(path):
    """Same keys, order and spacing; gyms before 0.4.7 wrote no types."""
    write_stats_file(path, STATS)
    assert path.read_text() == STATS_TEXT
    assert read_stats_file(path) == STATS
    untyped = StatsFile(1.0, (2.0,), (1,), (1.0,), None)
    with path.open() as old:
        write_stats_file(path, untyped)
        # A reader that has the old file open keeps it whole.
        assert old.read() == STATS_TEXT
    assert list(path.parent.iterdir()) == [path]
    assert "episode_types" not in path.read_text()
    assert read_stats_file(path) == untyped


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ('{"stats": "s", "videos": []', "not whole JSON"),
        ('{"videos": [], "env_info": {}}', "it has no 'stats'"),
        ('{"stats": 1, "videos": [], "env_info": {}}', "a text belongs there"),
        ('{"stats": "s", "videos": [["a"]], "env_info": {}}', "not 1 names"),
        ('{"stats": "..", "videos": [], "env_info": {}}', "not the name of a file"),
        ('{"stats": "s", "videos": [["a/b", "c"]], "env_info": {}}', "'a/b' is not"),
        ('{"stats": "s", "videos": [], "env_info": {}, "mjrec": 1}', "'mjrec'"),
    ],
)
def test_damage_of_a_manifest_is_named(path, content, reason):
    """Each kind is one clear error."""
    path.write_text(content)
    with pytest.raises(UnreadableFile, match=reason) as caught:
        read_manifest(path)
    assert caught.value.path == path


@pytest.mark.parametrize(
    ("right", "wrong", "reason"),
    [
        ("[3, 4]", '"34"', "a list belongs there"),
        ("[3, 4]", "[3, true]", "not true or false"),
        ("[3, 4]", "[3, 4.5]", "'episode_lengths' is wrong"),
        ("[3, 4]", "[3]", "1 episode_lengths"),
        ('["t", "e"]', '["t"]', "1 episode_types for 2"),
        ("1.5", "9" * 400, "larger than a float"),
    ],
)
def test_damage_of_statistics_is_named(path, right, wrong, reason):
    """Each kind is one clear error."""
    with pytest.raises(UnreadableFile, match=f"{path.name}: No such file"):
        read_stats_file(path)
    path.write_text(STATS_TEXT.replace(right, wrong))
    with pytest.raises(UnreadableFile, match=reason):
        read_stats_file(path)
