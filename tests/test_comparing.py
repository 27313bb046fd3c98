# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from evaluations import write_evaluation
from mjrec import (
    Comparison,
    InvalidArgument,
    MissingDependency,
    UnreadableFile,
    compare,
)
from mjrec.evaluation.comparing import holm_adjusted
from mjrec.evaluation.statistics import Interval

WALK = "dm_control/walker-walk"
RUN = "dm_control/cheetah-run"


def compared(a: Path | Sequence[Path], b: Path | Sequence[Path]) -> Comparison:
    return compare(a, b, resamples=500)


def drawn(mean: float, *, seed: int, runs: int = 2) -> list[list[float]]:
    rng = np.random.default_rng(seed)
    returns: list[list[float]] = rng.normal(mean, 50, (runs, 10)).tolist()
    return returns


def test_figures_of_a_task_by_hand(tmp_path: Path) -> None:
    """The textbook's five and four ages, as returns; B is the men."""
    women, men = [20.0, 11, 17, 12], [19.0, 22, 16, 29, 24]
    a = write_evaluation(tmp_path / "a", {"Hopper-v5": [women]}, seeds=(0,))
    b = write_evaluation(tmp_path / "b", {"Hopper-v5": [men]}, seeds=(1,))
    comparison = compared(a, b)
    (task,) = comparison.tasks
    assert comparison.unit == "episodes"
    assert (task.episodes_a, task.episodes_b) == (4, 5)
    assert (task.mean_a, task.mean_b, task.difference) == (15, 22, 7)
    assert task.probability == comparison.probability == 17 / 20
    # scipy's manual has 0.111, and R's wilcox.test too.
    assert task.p_value == task.p_value_holm == pytest.approx(1 / 9)
    assert task.difference_interval is not None
    assert task.difference_interval.low < 7 < task.difference_interval.high
    assert task.probability_interval == comparison.probability_interval
    # No seed is in both, and no task has a scale.
    assert (task.paired, comparison.scores) == (None, None)


def test_the_other_way_round_everything_turns(tmp_path: Path) -> None:
    """B - A is not A - B."""
    a = write_evaluation(tmp_path / "a", {WALK: drawn(500, seed=0)})
    b = write_evaluation(tmp_path / "b", {WALK: drawn(600, seed=1)})
    one, other = compared(a, b), compared(b, a)
    assert one.tasks[0].difference == -(other.tasks[0].difference or 0)
    assert one.probability == pytest.approx(1 - (other.probability or 0))
    assert one.tasks[0].p_value == pytest.approx(other.tasks[0].p_value)
    assert (one.probability or 0) > 0.5
    assert one.scores is not None
    assert other.scores is not None
    assert one.scores.difference == pytest.approx(-other.scores.difference)
    assert one.scores.interval is not None
    assert one.scores.interval.low < one.scores.difference < one.scores.interval.high


def test_trainings_are_compared_by_their_means(tmp_path: Path) -> None:
    """Each evaluation is one value: many episodes of a training say no more of it."""
    rng = np.random.default_rng(0)
    means = {"a": rng.normal(500, 80, 5), "b": rng.normal(620, 80, 4)}
    sides = {
        side: [
            write_evaluation(
                tmp_path / f"{side}{k}",
                {
                    task: (m + rng.normal(0, 1, (1, 50))).tolist()
                    for task in (WALK, RUN)
                },
                policy=f"mine:{side}",
            )
            for k, m in enumerate(of)
        ]
        for side, of in means.items()
    }
    comparison = compared(sides["a"], sides["b"])
    assert comparison.unit == "evaluations"
    assert comparison.a == tuple(sides["a"])
    assert (comparison.policy_a, comparison.policy_b) == ("mine:a", "mine:b")
    task = comparison.tasks[0]
    assert (task.episodes_a, task.episodes_b) == (250, 200)
    x, y = means["a"], means["b"]
    assert task.mean_a == pytest.approx(x.mean(), abs=1)
    test = stats.mannwhitneyu(y, x)
    assert task.p_value == pytest.approx(test.pvalue)
    assert task.probability == test.statistic / 20
    assert task.paired is None
    # What differs is the training: not the standard error of 250 episodes, 0.06.
    reach = 1.96 * math.hypot(x.std() / 5**0.5, y.std() / 4**0.5)
    interval = task.difference_interval
    assert interval is not None
    assert interval.high - interval.low == pytest.approx(2 * reach, rel=0.15)
    # As rliable has it: scores are (trainings x tasks), a task is a stratum.
    assert comparison.scores is not None
    pooled = np.repeat(x, 2) / 1000
    assert comparison.scores.iqm_a == pytest.approx(
        stats.trim_mean(pooled, 0.25), abs=0.001
    )
    assert comparison.cautions == ()


def test_one_training_against_several_has_no_intervals(tmp_path: Path) -> None:
    """Figures, and a caution."""
    one, *several = (
        write_evaluation(tmp_path / str(k), {WALK: drawn(500 + k, seed=k)})
        for k in range(4)
    )
    comparison = compared([one], several)
    assert comparison.tasks[0].difference is not None
    assert comparison.tasks[0].difference_interval is None
    assert comparison.probability_interval is None
    assert "A is a single evaluation" in comparison.cautions[0]


def test_an_evaluation_counts_once(tmp_path: Path) -> None:
    """Two names of one directory are not two trainings; no directory is an error."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]]})
    with pytest.raises(InvalidArgument, match="twice: B"):
        compare(a, [a, tmp_path / "." / "a"])
    with pytest.raises(InvalidArgument, match="side of A"):
        compare([], a)


def test_an_evaluation_is_no_better_than_itself(tmp_path: Path) -> None:
    """And the pairs show it without any doubt."""
    a = write_evaluation(tmp_path / "a", {WALK: drawn(500, seed=0)})
    comparison = compare(a, str(a))
    (task,) = comparison.tasks
    assert (task.difference, task.probability) == (0, 0.5)
    assert task.p_value == pytest.approx(1, abs=0.02)
    assert task.paired is not None
    assert (task.paired.episodes, task.paired.difference) == (20, 0)
    assert task.paired.interval == Interval(0, 0)
    assert comparison.cautions == comparison.remarks == ()


def test_over_tasks(tmp_path: Path) -> None:
    """The mean of the tasks' probabilities; scores of those that have a scale."""
    a = write_evaluation(
        tmp_path / "a",
        {WALK: [[100, 200, 300, 400]], "Hopper-v5": [[1, 2, 3, 4]], "x": [[1] * 4]},
    )
    b = write_evaluation(
        tmp_path / "b",
        {"Hopper-v5": [[5, 6, 7, 8]], WALK: [[250, 250, 250, 250]], "y": [[1] * 4]},
    )
    comparison = compared(a, b)
    assert [task.task for task in comparison.tasks] == [WALK, "Hopper-v5"]
    assert [task.probability for task in comparison.tasks] == [0.5, 1]
    assert comparison.probability == 0.75
    interval = comparison.probability_interval
    assert interval is not None
    assert 0.5 <= interval.low < 0.75 < interval.high <= 1
    scores = comparison.scores
    assert scores is not None
    assert (scores.tasks, scores.iqm_a, scores.iqm_b) == ((WALK,), 0.25, 0.25)
    assert (comparison.only_in_a, comparison.only_in_b) == (("x",), ("y",))


@pytest.mark.parametrize("other", [(0, 20), (10, 10), (9, 1)])
def test_scores_need_one_scale_everywhere(
    other: tuple[float, float], tmp_path: Path
) -> None:
    """A share of one range is not one of another; and a file may say anything."""
    returns = {"Hopper-v5": [[1, 2, 3, 4]]}
    a, b = (
        write_evaluation(
            tmp_path / str(scale), returns, score_ranges={"Hopper-v5": scale}
        )
        for scale in ((0, 10), other)
    )
    assert compared(a, b).scores is None
    assert compared(b, b).scores is None or other == (0, 20)
    assert compared(a, a).scores is not None


def test_pairs_are_of_the_same_seed_and_number(tmp_path: Path) -> None:
    """However the seeds are ordered; what failed in one has no partner."""
    hard = [[10.0, 500, 900, None], [300, 20, 800, 40]]
    a = write_evaluation(tmp_path / "a", {WALK: hard}, seeds=(3, 4))
    b = write_evaluation(
        tmp_path / "b",
        {WALK: [[301, None, 802, 41], [11, 501, 902, 1000]]},
        seeds=(4, 3),
    )
    comparison = compared(a, b)
    (task,) = comparison.tasks
    assert task.paired is not None
    assert task.paired.episodes == 6
    assert task.paired.difference == pytest.approx((1 + 2 + 1 + 1 + 1 + 2) / 6)
    assert task.paired.interval is not None
    assert 1 <= task.paired.interval.low <= task.paired.interval.high <= 2
    # Of unpaired ones, nobody could say so much.
    assert task.difference_interval is not None
    assert task.difference_interval.low < 0
    assert (task.failed_a, task.failed_b) == (1, 1)
    assert len(comparison.cautions) == 2
    assert "1 of 8 episodes of A failed" in comparison.cautions[0]


@pytest.mark.parametrize("plan", [{"protocol": "suite"}, {"env_kwargs": {"a": 1}}])
def test_episodes_that_began_otherwise_are_no_pairs(
    plan: dict[str, object], tmp_path: Path
) -> None:
    """One random stream for a seed goes on as long as the policy lets it."""
    a = write_evaluation(tmp_path / "a", {WALK: drawn(1, seed=0)})
    b = write_evaluation(tmp_path / "b", {WALK: drawn(1, seed=0)}, **plan)
    assert compared(a, b).tasks[0].paired is None


def test_other_conditions_are_a_caution(tmp_path: Path) -> None:
    """Other seeds are only told."""
    a = write_evaluation(
        tmp_path / "a",
        {WALK: drawn(1, seed=0)},
        max_steps=500,
        versions={"mujoco": "3.3", "numpy": "2"},
    )
    b = write_evaluation(
        tmp_path / "b",
        {WALK: drawn(1, seed=0, runs=12)},
        versions={"mujoco": "3.4", "numpy": "2"},
    )
    comparison = compared(a, b)
    (caution,) = comparison.cautions
    assert "max_steps was 500 in A and is the environment's own in B" in caution
    assert comparison.remarks == (
        "seeds: 0, 1 in A, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 ... in B",
        "mujoco: 3.3 in A, 3.4 in B",
    )
    # A return of at most 500 on one side, and of 1000 on the other.
    assert comparison.scores is None
    within = compared([a, b], write_evaluation(tmp_path / "c", {WALK: [[1, 2]]}))
    assert "was 500 or the environment's own in A" in within.cautions[1]


def test_no_task_in_common_is_an_error(tmp_path: Path) -> None:
    """It lists what there is in both."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]]})
    b = write_evaluation(tmp_path / "b", {RUN: [[3, 4]]})
    with pytest.raises(InvalidArgument, match=rf"(?s){WALK}.*{RUN}"):
        compare(a, b)


@pytest.mark.parametrize(
    ("returns", "why", "not_finite"),
    [
        ([None, None], "no episode of B was completed", 0),
        ([1.0, math.nan], "1 of 2 returns of B are NaN or infinite", 1),
        ([1.0, -math.inf], "1 of 2 returns of B are NaN or infinite", 1),
    ],
)
def test_a_task_that_cannot_be_compared_says_why(
    returns: list[float | None], why: str, not_finite: int, tmp_path: Path
) -> None:
    """And the others go on without it."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]], RUN: [[1, 2]]})
    b = write_evaluation(tmp_path / "b", {WALK: [returns], RUN: [[3, 4]]})
    comparison = compared(a, b)
    walk, run = comparison.tasks
    assert (walk.unknown, walk.not_finite_b) == (why, not_finite)
    assert (walk.difference, walk.probability, walk.p_value) == (None, None, None)
    assert comparison.compared == (run,)
    assert comparison.probability == run.probability == 1
    of_trainings = compared([a], [b, a])
    assert of_trainings.tasks[0].unknown == why.replace("of B", f"of {b}")


def test_nothing_to_compare(tmp_path: Path) -> None:
    """No figures, and no error: the evaluation itself is whole."""
    a = write_evaluation(tmp_path / "a", {WALK: [[None, None]]})
    comparison = compared(a, a)
    assert (comparison.probability, comparison.probability_interval) == (None, None)
    assert comparison.compared == ()


def test_equal_returns_are_no_evidence(tmp_path: Path) -> None:
    """Of a single episode there is no interval either; scipy would divide by zero."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1.0]], RUN: [[1.0]]})
    b = write_evaluation(tmp_path / "b", {WALK: [[2.0]], RUN: [[1.0]]})
    comparison = compare(a, b)
    assert (comparison.probability, comparison.probability_interval) == (0.75, None)
    assert comparison.tasks[0].interval_method is None
    assert comparison.tasks[1].p_value == 1


def test_holm_by_hand() -> None:
    """Four tests, as in Holm's own procedure."""
    adjusted = holm_adjusted({"a": 0.03, "b": 0.005, "c": 0.04, "d": 0.01})
    assert adjusted == pytest.approx({"a": 0.06, "b": 0.02, "c": 0.06, "d": 0.03})


@given(st.lists(st.floats(0, 1), min_size=1, max_size=9))
def test_holm_keeps_the_order_and_only_raises(p_values: list[float]) -> None:
    """Up to 1; never above Bonferroni's."""
    named = {str(k): p for k, p in enumerate(p_values)}
    adjusted = holm_adjusted(named)
    for name, p in named.items():
        assert p <= adjusted[name] <= min(1, p * len(named))
    ranked = sorted(named, key=lambda name: named[name])
    assert [adjusted[name] for name in ranked] == sorted(adjusted.values())


def test_without_scipy_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line, with the command."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]]})
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    with pytest.raises(MissingDependency, match=r'pip install "mjrec\[evaluation\]"'):
        compare(a, a)


def test_what_is_no_evaluation(tmp_path: Path) -> None:
    """The directory is named."""
    with pytest.raises(UnreadableFile, match="no evaluation"):
        compare(tmp_path, tmp_path)
