# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjrec import (
    ClosedError,
    InvalidArgument,
    ResetNeeded,
    ResetNotAllowed,
    StatsRecorder,
)
from mjrec.formats.stats_file import read_stats_file


@pytest.fixture
def recorder(tmp_path: Path) -> StatsRecorder:
    return StatsRecorder(str(tmp_path), "openaigym.episode_batch.0.1", env_id="Env-v0")


def run_episode(
    recorder: StatsRecorder, rewards: list[Any], *, end: bool = True
) -> None:
    recorder.before_reset()
    recorder.after_reset(None)
    for index, reward in enumerate(rewards):
        recorder.before_step(None)
        recorder.after_step(None, reward, end and index == len(rewards) - 1, {})


def test_counts_steps_and_adds_up_rewards(recorder: StatsRecorder) -> None:
    """A complete episode's length and return are in the lists and in the file."""
    run_episode(recorder, [1.0, 2.5])
    recorder.close()
    stats = read_stats_file(Path(recorder.path))
    assert stats.episode_lengths == (2,)
    assert stats.episode_rewards == (3.5,)
    assert stats.episode_types == ("t",)


def test_times_are_wall_clock(recorder: StatsRecorder) -> None:
    """The first reset and the end of an episode are seconds since the epoch."""
    before = time.time()
    run_episode(recorder, [0.0])
    assert recorder.initial_reset_timestamp is not None
    assert before <= recorder.initial_reset_timestamp <= recorder.timestamps[0]
    assert recorder.timestamps[0] <= time.time()


@pytest.mark.parametrize(
    "reward", [1, np.float32(1), np.int8(1), np.array([1.0]), np.array(1), True]
)
def test_reward_may_be_any_one_number(recorder: StatsRecorder, reward: Any) -> None:
    """Numbers, NumPy scalars and arrays of one element count the same."""
    run_episode(recorder, [reward])
    assert recorder.episode_rewards == [1.0]


@pytest.mark.parametrize("reward", [None, "much", np.zeros(2), [1.0, 2.0]])
def test_other_rewards_are_an_error(recorder: StatsRecorder, reward: Any) -> None:
    """What is not one number is named in the error."""
    with pytest.raises(InvalidArgument, match="one number"):
        run_episode(recorder, [reward])


def test_rewards_add_up_in_float64(recorder: StatsRecorder) -> None:
    """Rewards of float32 are not summed in float32, where they would be lost."""
    run_episode(recorder, [np.float32(1e8), np.float32(1), np.float32(1)])
    assert recorder.episode_rewards == [1e8 + 2]


@pytest.mark.parametrize("reward", [math.nan, math.inf, -math.inf])
def test_nan_and_infinity_survive_valid_json(
    recorder: StatsRecorder, reward: float
) -> None:
    """A strict JSON parser reads the file, and our reader gives the value back."""

    def refuse(token: str) -> None:
        raise AssertionError(f"{token} is not JSON")

    run_episode(recorder, [reward])
    recorder.close()
    json.loads(Path(recorder.path).read_text(), parse_constant=refuse)
    [read] = read_stats_file(Path(recorder.path)).episode_rewards
    assert read == reward or (math.isnan(read) and math.isnan(reward))


def test_step_before_reset_needs_a_reset(recorder: StatsRecorder) -> None:
    """The error names the environment."""
    with pytest.raises(ResetNeeded, match="Env-v0 before the first reset"):
        recorder.before_step(None)


def test_step_after_the_end_needs_a_reset(recorder: StatsRecorder) -> None:
    """An episode that is over takes no step."""
    run_episode(recorder, [0.0])
    with pytest.raises(ResetNeeded, match="after the end"):
        recorder.before_step(None)


def test_reset_in_mid_episode_is_an_error(recorder: StatsRecorder) -> None:
    """The error says how far the episode is and how to allow it."""
    run_episode(recorder, [0.0], end=False)
    with pytest.raises(ResetNotAllowed, match=r"after 1 steps.*allow_early_reset=True"):
        recorder.before_reset()


def test_reset_twice_in_a_row_is_allowed(recorder: StatsRecorder) -> None:
    """Without a step in between nothing is lost, and nothing is counted."""
    run_episode(recorder, [])
    run_episode(recorder, [1.0])
    assert recorder.episode_lengths == [1]
    assert recorder.episode_types == ["t"]


def test_early_reset_drops_the_episode(tmp_path: Path) -> None:
    """Where it is allowed, its steps count only in the total."""
    recorder = StatsRecorder(str(tmp_path), "x", allow_early_reset=True)
    run_episode(recorder, [5.0], end=False)
    run_episode(recorder, [1.0])
    assert recorder.episode_rewards == [1.0]
    assert recorder.total_steps == 2


def test_type_takes_effect_at_the_next_reset(recorder: StatsRecorder) -> None:
    """Types stay aligned with the completed episodes."""
    run_episode(recorder, [0.0], end=False)
    recorder.type = "e"
    recorder.after_step(None, 0.0, True, {})
    run_episode(recorder, [])
    run_episode(recorder, [0.0])
    assert recorder.episode_types == ["t", "e"]


def test_unknown_type_is_an_error(recorder: StatsRecorder) -> None:
    """Only "t" and "e" are types."""
    with pytest.raises(InvalidArgument, match="training"):
        recorder.type = "x"


def test_autoreset_begins_the_next_episode(tmp_path: Path) -> None:
    """An environment that resets itself is stepped on and on."""
    recorder = StatsRecorder(str(tmp_path), "x", autoreset=True)
    run_episode(recorder, [1.0])
    recorder.before_step(None)
    recorder.after_step(None, 2.0, True, {})
    assert recorder.episode_rewards == [1.0, 2.0]


def test_incomplete_episode_is_not_written(recorder: StatsRecorder) -> None:
    """Only complete episodes are statistics."""
    run_episode(recorder, [1.0])
    run_episode(recorder, [1.0], end=False)
    recorder.close()
    assert read_stats_file(Path(recorder.path)).episode_lengths == (1,)


def test_file_follows_the_directory_and_not_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A relative directory means the one at construction, wherever chdir goes."""
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path)
    recorder = StatsRecorder("a", "x")
    monkeypatch.chdir(os.sep)
    recorder.close()
    assert (tmp_path / "a" / "x.stats.json").exists()


def test_closed_recorder_refuses(recorder: StatsRecorder) -> None:
    """close() may be called twice; nothing else may be called after it."""
    recorder.close()
    recorder.close()
    with pytest.raises(ClosedError):
        recorder.before_reset()
    with pytest.raises(ClosedError):
        recorder.before_step()
