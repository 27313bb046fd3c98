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
TEXT = (
    '{"initial_reset_timestamp": 10.5, "timestamps": [11.0, 12.0], '
    '"episode_lengths": [3, 4], "episode_rewards": [1.5, -2.0], '
    '"episode_types": ["t", "e"]}'
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "openaigym.episode_batch.0.1.stats.json"


def test_the_text_is_what_gym_wrote(path: Path) -> None:
    """Same keys, order and spacing; gyms before 0.4.7 wrote no types."""
    write_stats_file(path, STATS)
    assert path.read_text() == TEXT
    assert read_stats_file(path) == STATS
    untyped = StatsFile(1.0, (2.0,), (1,), (1.0,), None)
    write_stats_file(path, untyped)
    assert "episode_types" not in path.read_text()
    assert read_stats_file(path) == untyped


def test_nan_and_infinity_come_back(path: Path) -> None:
    """From a file that is JSON, and from gym's own tokens."""
    rewards = (math.nan, math.inf, -math.inf)
    write_stats_file(path, StatsFile(None, (1.0, 2.0, 3.0), (1, 1, 1), rewards, None))
    json.loads(path.read_text(), parse_constant=pytest.fail)
    assert read_stats_file(path).episode_rewards == pytest.approx(rewards, nan_ok=True)
    path.write_text(TEXT.replace("1.5, -2.0", "NaN, -Infinity"))
    read = read_stats_file(path).episode_rewards
    assert read == pytest.approx((math.nan, -math.inf), nan_ok=True)


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
        (TEXT[:-1], "not whole JSON"),
        ("[]", "an object belongs there, not a list"),
        ("[" * 100_000, "nested too deeply"),
        ("{}", "it has no 'timestamps'"),
        ('{"timestamps": "\udcff"}', "UTF-8"),
        (TEXT.replace("[3, 4]", '"34"'), "a list belongs there"),
        (TEXT.replace("[3, 4]", "[3, true]"), "not true or false"),
        (TEXT.replace("[3, 4]", "[3, 4.5]"), "'episode_lengths' is wrong"),
        (TEXT.replace("[3, 4]", "[3]"), "1 episode_lengths"),
        (TEXT.replace('["t", "e"]', '["t"]'), "1 episode_types for 2"),
        (TEXT.replace("1.5", "9" * 400), "larger than a float"),
    ],
)
def test_damage_is_named_with_the_reason(path: Path, content: str, reason: str) -> None:
    """Each kind is one clear error."""
    path.write_bytes(os.fsencode(content))
    with pytest.raises(UnreadableFile, match=reason) as caught:
        read_stats_file(path)
    assert caught.value.path == path


def test_a_missing_file_and_a_pipe_are_one_error(path: Path) -> None:
    """A pipe is not waited for."""
    with pytest.raises(UnreadableFile, match=f"{path.name}: No such file"):
        read_stats_file(path)
    os.mkfifo(path)
    with pytest.raises(UnreadableFile, match="not a regular file"):
        read_stats_file(path)
