# SPDX-License-Identifier: Apache-2.0
"""Ledgers: written line by line, and read whatever became of their writers."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any

import pytest
from full_disk import file_size_limit

import mjrec
from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.ledger import Ledger, ledger_name, read_ledgers
from mjrec.evaluation.plan import Batch
from mjrec.formats.journal import JournalEntry, JournalWriter

TASK = "Hopper-v5"


def result(episode: int, **changes: Any) -> EpisodeResult:
    """Return the result of an episode of seed 7."""
    known: dict[str, Any] = {
        "total_reward": 1.5,
        "length": 4,
        "terminated": True,
        "truncated": False,
        "success": True,
        "warnings": {"BADQACC": 2},
        "monitor": "0.1",
        "episode_id": episode,
        "start_time": 100.0 + episode,
        "seconds": 0.25,
    }
    return EpisodeResult(task=TASK, seed=7, episode=episode, **{**known, **changes})


def failed(episode: int) -> EpisodeResult:
    """Return the result of one that failed before there was a monitor."""
    return EpisodeResult(
        task=TASK,
        seed=7,
        episode=episode,
        total_reward=None,
        length=0,
        terminated=None,
        truncated=None,
        failure="ValueError: no",
    )


def ledger_of(
    folder: Path, episodes: int = 3, *, name: str = "0.1", whole: bool = False
) -> Ledger:
    """Begin a ledger of a batch."""
    batch = Batch(task=TASK, folder="x", seed=7, episodes=tuple(range(episodes)))
    return Ledger(folder / ledger_name(name), batch, whole=whole)


def write(
    folder: Path, *results: EpisodeResult, name: str = "0.1", whole: bool = False
) -> Path:
    """Write a ledger with these results, of three that there were to be."""
    ledger = ledger_of(folder, name=name, whole=whole)
    for each in results:
        ledger.begin(each.unit, monitor=name, episode_id=each.episode)
        ledger.end(each)
    ledger.close()
    return folder / ledger_name(name)


def journal(folder: Path, *episode_ids: int) -> None:
    """Write the journal of the monitor 0.1."""
    writer = JournalWriter(folder / "openaigym.episodes.0.1.jsonl")
    for number in episode_ids:
        entry = JournalEntry(
            episode_id=number,
            length=9,
            reward=-2.0,
            type="e",
            start_time=50.0,
            end_time=52.0,
            seed=None,
            options=None,
            terminated=False,
            truncated=True,
            success=None,
        )
        writer.append(entry)
    writer.close()


def test_results_are_read_as_they_were_written(tmp_path: Path) -> None:
    """Each by its seed and number; failures too."""
    results = [result(0), result(1, success=None, warnings={}), failed(2)]
    write(tmp_path, *results)
    assert read_ledgers(tmp_path) == {each.unit: each for each in results}


@pytest.mark.parametrize("reward", [math.nan, math.inf, -math.inf, 0.1 + 0.2])
def test_every_return_is_kept(tmp_path: Path, reward: float) -> None:
    """Bit for bit, and one that is no number is no failure."""
    write(tmp_path, result(0, total_reward=reward))
    found = read_ledgers(tmp_path)[7, 0].total_reward
    assert found == reward or (math.isnan(reward) and math.isnan(found or 0))


def test_without_ledgers_nothing_is_done(tmp_path: Path) -> None:
    """Nor without a directory."""
    assert read_ledgers(tmp_path) == {}
    assert read_ledgers(tmp_path / "none") == {}


@pytest.mark.parametrize("cut", [1, 20, 100])
def test_a_line_that_was_cut_off_is_no_result(tmp_path: Path, cut: int) -> None:
    """Its writer was killed in the middle of it."""
    path = write(tmp_path, result(0), result(1))
    path.write_bytes(path.read_bytes()[:-cut])
    assert [*read_ledgers(tmp_path)] == [(7, 0)]


def test_what_the_journal_calls_complete_is_done(tmp_path: Path) -> None:
    """It is written first: a process killed between the two has lost nothing."""
    ledger = ledger_of(tmp_path)
    for episode, number in ((1, 4), (2, 5)):
        ledger.begin((7, episode), monitor="0.1", episode_id=number)
    ledger.close()
    journal(tmp_path, 3, 4)
    expected = EpisodeResult(
        task=TASK,
        seed=7,
        episode=1,
        total_reward=-2.0,
        length=9,
        terminated=False,
        truncated=True,
        monitor="0.1",
        episode_id=4,
        start_time=50.0,
        seconds=2.0,
    )
    assert read_ledgers(tmp_path) == {(7, 1): expected}


def test_of_an_episode_that_was_done_twice_the_first_counts(tmp_path: Path) -> None:
    """Whatever the ledgers are called."""
    write(tmp_path, result(0, start_time=2.0, monitor="0.1"), name="0.1")
    write(tmp_path, result(0, start_time=1.0, monitor="0.2"), name="0.2")
    assert read_ledgers(tmp_path)[7, 0].monitor == "0.2"


def test_a_batch_that_is_a_whole_counts_when_it_is_one(tmp_path: Path) -> None:
    """Half of a random stream is nothing; of two whole ones the first counts."""
    results = [result(n, start_time=10.0 + n) for n in range(3)]
    write(tmp_path, *results[:2], name="0.1", whole=True)
    assert read_ledgers(tmp_path) == {}
    for name, start in (("0.3", 40.0), ("0.2", 20.0)):
        own = [result(n, monitor=name, start_time=start + n) for n in range(3)]
        write(tmp_path, *own, name=name, whole=True)
    found = read_ledgers(tmp_path)
    assert [found[7, n].monitor for n in range(3)] == ["0.2"] * 3


@pytest.mark.parametrize(
    "line",
    [
        "{",
        "[]",
        '{"ended": {"seed": 7}}',
        '{"ended": {"seed": -1, "episode": 1}}',
        '{"begun": [7], "monitor": "0.1", "episode_id": 1}',
        '{"begun": [7, 1], "monitor": "../0.1", "episode_id": 1}',
        '{"batch": "all", "seed": 0, "whole": false}',
    ],
)
def test_a_bad_line_is_left_out(
    tmp_path: Path, line: str, caplog: pytest.LogCaptureFixture
) -> None:
    """And said; what is good counts."""
    path = write(tmp_path, result(0))
    with path.open("a") as file:
        file.write(f"{line}\n")
    with caplog.at_level(logging.WARNING):
        assert [*read_ledgers(tmp_path)] == [(7, 0)]
    assert "left out" in caplog.text


def test_a_newer_ledger_is_not_guessed_at(tmp_path: Path) -> None:
    """It may mean something else."""
    path = write(tmp_path, result(0))
    lines = path.read_text().splitlines()
    lines[0] = json.dumps({**json.loads(lines[0]), "ledger": 2})
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(mjrec.UnreadableFile, match="newer mjrec"):
        read_ledgers(tmp_path)


def test_on_a_full_disk_no_half_line_stays(tmp_path: Path) -> None:
    """It is said, and what comes when there is space again is whole."""
    ledger = ledger_of(tmp_path)
    ledger.end(result(0))
    with file_size_limit(400), pytest.raises(mjrec.FileNotWritten, match="--resume"):
        ledger.end(result(1))
    ledger.end(result(2))
    ledger.close()
    assert [*read_ledgers(tmp_path)] == [(7, 0), (7, 2)]
