# SPDX-License-Identifier: Apache-2.0
"""Manifest and statistics file are gym's, and safe to read from anybody."""

import pytest

from mjrec.errors import UnreadableFile
from mjrec.formats.manifest import read_manifest, read_stats_file

STATS_TEXT = (
    '{"initial_reset_timestamp": 10.5, "timestamps": [11.0, 12.0], '
    '"episode_lengths": [3, 4], "episode_rewards": [1.5, -2.0], '
    '"episode_types": ["t", "e"]}'
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "openaigym.some.0.1.json"


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ('{"stats": "s", "videos": []', "not valid JSON"),
        ('{"videos": [], "env_info": {}}', "it has no 'stats'"),
        ('{"stats": 1, "videos": [], "env_info": {}}', "it must be a string"),
        ('{"stats": "s", "videos": [["a"]], "env_info": {}}', "it has 1 names"),
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
        ("[3, 4]", '"34"', "it must be a list"),
        ("[3, 4]", "[3, true]", "not true or false"),
        ("[3, 4]", "[3, 4.5]", "'episode_lengths' is wrong"),
        ("[3, 4]", "[3]", "1 episode_lengths"),
        ('["t", "e"]', '["t"]', "1 episode_types for 2"),
        ("1.5", "9" * 400, "too large for a float"),
    ],
)
def test_damage_of_statistics_is_named(path, right, wrong, reason):
    """Each kind is one clear error."""
    with pytest.raises(UnreadableFile, match=f"{path.name}: No such file"):
        read_stats_file(path)
    path.write_text(STATS_TEXT.replace(right, wrong))
    with pytest.raises(UnreadableFile, match=reason):
        read_stats_file(path)
