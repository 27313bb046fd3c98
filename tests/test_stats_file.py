# SPDX-License-Identifier: Apache-2.0
"""The statistics file is gym's, and safe to read from anybody."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import pytest

from mjrec.errors import UnreadableFile
from mjrec.formats.stats_file import StatsFile, read_stats_file, write_stats_file

STATS = StatsFile(
    initial_reset_timestamp=10.5,
    timestamps=(11.0, 12.0),
    episode_lengths=(3, 4),
    episode_rewards=(1.5, -2.0),
    episode_types=("t", "e"),
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.episode_batch.0.1.stats.json"


def test_it_comes_back_as_it_was(path: Path) -> None:
    """What is read is what was written."""
    write_stats_file(path, STATS)
    assert read_stats_file(path) == STATS


def test_the_text_is_what_gym_wrote() -> None:
    """Same keys in the same order, same spacing."""
    assert STATS.to_json() == (
        '{"initial_reset_timestamp": 10.5, "timestamps": [11.0, 12.0], '
        '"episode_lengths": [3, 4], "episode_rewards": [1.5, -2.0], '
        '"episode_types": ["t", "e"]}'
    )


def test_rewards_that_json_has_no_number_for_come_back(path: Path) -> None:
    """NaN and infinity survive, in a file that every JSON reader accepts."""
    rewards = (math.nan, math.inf, -math.inf)
    stats = StatsFile(None, (1.0, 2.0, 3.0), (1, 1, 1), rewards, None)
    write_stats_file(path, stats)
    json.loads(path.read_text(), parse_constant=pytest.fail)
    assert read_stats_file(path).episode_rewards == pytest.approx(rewards, nan_ok=True)


def test_gyms_own_words_for_them_are_read(path: Path) -> None:
    """NaN and Infinity as tokens, which gym wrote, are accepted."""
    write_stats_file(path, STATS)
    path.write_text(path.read_text().replace("1.5, -2.0", "NaN, -Infinity"))
    rewards = read_stats_file(path).episode_rewards
    assert math.isnan(rewards[0])
    assert rewards[1] == -math.inf


def test_a_file_without_types_has_none(path: Path) -> None:
    """Gyms before 0.4.7 wrote no types."""
    stats = StatsFile(1.0, (2.0,), (1,), (1.0,), None)
    write_stats_file(path, stats)
    assert "episode_types" not in path.read_text()
    assert read_stats_file(path) == stats


def test_writing_replaces_the_file_at_once(path: Path) -> None:
    """A reader that has the old file open keeps it whole; nothing else is left."""
    write_stats_file(path, STATS)
    with path.open() as old:
        write_stats_file(path, StatsFile(None, (), (), (), ()))
        assert json.load(old)["episode_lengths"] == [3, 4]
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "not whole JSON"),
        (STATS.to_json()[:-1], "not whole JSON"),
        ("[]", "an object belongs there, not a list"),
        ("[" * 100_000, "nested too deeply"),
        ("{}", "it has no 'timestamps'"),
        (STATS.to_json().replace("[3, 4]", '"34"'), "a list belongs there"),
        (STATS.to_json().replace("[3, 4]", "[3, true]"), "not true or false"),
        (STATS.to_json().replace("[3, 4]", "[3, 4.5]"), "'episode_lengths' is wrong"),
        (STATS.to_json().replace("[3, 4]", "[3]"), "1 episode_lengths"),
        (STATS.to_json().replace('["t", "e"]', '["t"]'), "1 episode_types for 2"),
        (STATS.to_json().replace("1.5", "9" * 400), "larger than a float"),
    ],
)
def test_a_damaged_file_is_named_with_the_reason(
    path: Path, content: str, reason: str
) -> None:
    """Each kind of damage is one clear error."""
    path.write_text(content)
    with pytest.raises(UnreadableFile, match=reason) as caught:
        read_stats_file(path)
    assert caught.value.path == path


def test_a_missing_file_is_named(path: Path) -> None:
    """The same error as for a damaged one."""
    with pytest.raises(UnreadableFile, match=f"{path.name}: No such file"):
        read_stats_file(path)


def test_a_pipe_is_not_waited_for(path: Path) -> None:
    """A directory from elsewhere may hold anything under this name."""
    os.mkfifo(path)
    with pytest.raises(UnreadableFile, match="not a regular file"):
        read_stats_file(path)


def test_text_that_is_not_utf_8_is_damage(path: Path) -> None:
    """The reason says so."""
    path.write_bytes(b'{"timestamps": "\xff"}')
    with pytest.raises(UnreadableFile, match="UTF-8"):
        read_stats_file(path)
