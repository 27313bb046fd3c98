# SPDX-License-Identifier: Apache-2.0
"""Test that `StatsRecorder` writes statistics of complete episodes."""

import json
import math
import time
from pathlib import Path

import numpy as np
import pytest

from mjrec import ClosedError, InvalidArgument, ResetNeeded, StatsRecorder
from mjrec.formats.manifest import read_stats_file


@pytest.fixture
def recorder(tmp_path):
    return StatsRecorder(str(tmp_path), "openaigym.episode_batch.0.1", env_id="Env-v0")


def run_episode(recorder, rewards, *, end=True):
    recorder.before_reset()
    recorder.after_reset(None)
    for index, reward in enumerate(rewards):
        recorder.before_step(None)
        recorder.after_step(None, reward, end and index == len(rewards) - 1, {})


def test_only_complete_episodes_are_written(recorder):
    with pytest.raises(ResetNeeded, match="Env-v0 before the first reset"):
        recorder.before_step(None)
    before = time.time()
    run_episode(recorder, [1.0, 2.5])
    run_episode(recorder, [1.0], end=False)
    recorder.close()
    recorder.close()
    stats = read_stats_file(Path(recorder.path))
    assert (stats.episode_lengths, stats.episode_rewards) == ((2,), (3.5,))
    assert stats.episode_types == ("t",)
    [end] = stats.timestamps
    assert before <= stats.initial_reset_timestamp <= end <= time.time()
    for refused in (recorder.before_reset, recorder.before_step):
        with pytest.raises(ClosedError):
            refused()


@pytest.mark.parametrize(
    ("rewards", "total"),
    [
        ([1, np.array([1.0]), np.array(1), np.int8(1), True], 5.0),
        # A sum in float32 would lose the ones.
        ([np.float32(1e8), np.float32(1), np.float32(1)], 1e8 + 2),
        *(([value], value) for value in (math.nan, math.inf, -math.inf)),
    ],
)
def test_rewards_add_up_in_float64(recorder, rewards, total):
    run_episode(recorder, rewards)
    recorder.close()
    json.loads(Path(recorder.path).read_text(), parse_constant=pytest.fail)
    read = read_stats_file(Path(recorder.path)).episode_rewards
    assert read == pytest.approx((total,), nan_ok=True, abs=0, rel=0)


def test_type_takes_effect_at_the_next_reset(recorder):
    run_episode(recorder, [0.0], end=False)
    recorder.type = "e"
    recorder.after_step(None, 0.0, True, {})
    run_episode(recorder, [])
    run_episode(recorder, [0.0])
    assert recorder.episode_types == ["t", "e"]
    with pytest.raises(InvalidArgument, match="training"):
        recorder.type = "x"
    for reward in (None, "much", np.zeros(2), [1.0, 2.0]):
        with pytest.raises(InvalidArgument, match="one number"):
            run_episode(recorder, [reward])
