# SPDX-License-Identifier: Apache-2.0
"""Counting episodes in ledgers while these grow."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

from mjrec.evaluation.episode_results import EpisodeResult
from mjrec.evaluation.ledger import Ledger, ledger_name
from mjrec.evaluation.plan import Batch
from mjrec.evaluation.progress_counts import LedgerCounts
from mjrec.json_text import dumps


def begin(folder: Path, episodes: int, name: str = "0.1") -> None:
    """Begin the ledger of a batch."""
    batch = Batch(task="T", folder="t", seed=0, episodes=tuple(range(episodes)))
    Ledger(folder / ledger_name(name), batch, whole=False).close()


def end(folder: Path, result: EpisodeResult, name: str = "0.1") -> None:
    """Add the end of an episode, as a ledger does."""
    values = dataclasses.asdict(result)
    with (folder / ledger_name(name)).open("a") as file:
        file.write(dumps({"ended": values}) + "\n")


def result(episode: int, failure: str | None = None) -> EpisodeResult:
    """Return what came of an episode."""
    return EpisodeResult(
        task="T",
        seed=0,
        episode=episode,
        total_reward=None if failure else 1.0,
        length=3,
        terminated=None if failure else False,
        truncated=None if failure else True,
        failure=failure,
    )


def taking(seconds: float) -> Callable[[], float]:
    """Return a clock on which everything takes so long."""
    return itertools.count(step=seconds).__next__


def test_counts_what_has_been_added_since(tmp_path: Path) -> None:
    """Each line once, also of ledgers that came later; failures are told apart."""
    counts = LedgerCounts([tmp_path, tmp_path / "not there yet"])
    assert counts.look() == (0, 0)
    begin(tmp_path, 3)
    end(tmp_path, result(0))
    assert counts.look() == (1, 0)
    end(tmp_path, result(1, failure="it raised"))
    begin(tmp_path, 1, "1.1")
    end(tmp_path, result(0), "1.1")
    assert counts.look() == counts.look() == (3, 1)


def test_half_a_line_is_counted_when_it_is_whole(tmp_path: Path) -> None:
    """Its writer is at it now."""
    begin(tmp_path, 2)
    end(tmp_path, result(0))
    path = tmp_path / ledger_name("0.1")
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    counts = LedgerCounts([tmp_path])
    assert counts.look() == (0, 0)
    path.write_bytes(whole)
    assert counts.look() == (1, 0)


def test_ledger_whose_batch_is_over_is_not_opened_again(tmp_path: Path) -> None:
    """There may be thousands of them, and one look several times a second."""
    begin(tmp_path, 1)
    end(tmp_path, result(0))
    counts = LedgerCounts([tmp_path])
    assert counts.look() == (1, 0)
    end(tmp_path, result(0))
    assert counts.look() == (1, 0)


def test_where_looking_takes_long_it_is_done_less_often(tmp_path: Path) -> None:
    """So much is left for handing out work; what is new is counted after that."""
    begin(tmp_path, 3)
    counts = LedgerCounts([tmp_path], clock=taking(1.0))
    assert counts.look() == (0, 0)
    end(tmp_path, result(0))
    assert [counts.look() for _ in range(19)] == [(0, 0)] * 18 + [(1, 0)]
