# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from evaluations import write_evaluation
from mjrec import InvalidArgument, MissingDependency, UnreadableFile
from mjrec.evaluation.comparing import compare, holm_adjusted
from mjrec.evaluation.summaries import Bootstrap, Interval

WALK = "dm_control/walker-walk"
RUN = "dm_control/cheetah-run"
QUICK = Bootstrap(resamples=500)


def drawn(mean: float, *, seed: int, runs: int = 2) -> list[list[float]]:
    rng = np.random.default_rng(seed)
    returns: list[list[float]] = rng.normal(mean, 50, (runs, 10)).tolist()
    return returns


def test_figures_of_a_task_by_hand(tmp_path: Path) -> None:
    """The textbook's five and four ages, as returns; B is the men."""
    women, men = [20.0, 11, 17, 12], [19.0, 22, 16, 29, 24]
    a = write_evaluation(tmp_path / "a", {"Hopper-v5": [women]}, seeds=(0,))
    b = write_evaluation(tmp_path / "b", {"Hopper-v5": [men]}, seeds=(1,))
    comparison = compare(a, b, bootstrap=QUICK)
    (task,) = comparison.tasks
    assert (task.episodes_a, task.episodes_b) == (4, 5)
    assert (task.mean_a, task.mean_b, task.difference) == (15, 22, 7)
    assert task.probability == comparison.probability == 17 / 20
    # scipy's manual has 0.111, and R's wilcox.test too.
    assert task.p_value == pytest.approx(1 / 9)
    assert task.p_value_holm == task.p_value
    assert task.difference_interval is not None
    assert task.difference_interval.low < 7 < task.difference_interval.high
    assert task.probability_interval == comparison.probability_interval
    # No seed is in both, and no task has a scale.
    assert task.paired is None
    assert comparison.scores is None


def test_the_other_way_round_everything_turns(tmp_path: Path) -> None:
    """B - A is not A - B."""
    values = {WALK: drawn(500, seed=0)}, {WALK: drawn(600, seed=1)}
    a, b = (
        write_evaluation(tmp_path / n, v) for n, v in zip("ab", values, strict=True)
    )
    one, other = compare(a, b, bootstrap=QUICK), compare(b, a, bootstrap=QUICK)
    assert one.tasks[0].difference == -(other.tasks[0].difference or 0)
    assert one.probability == pytest.approx(1 - (other.probability or 0))
    assert one.tasks[0].p_value == pytest.approx(other.tasks[0].p_value)
    assert (one.probability or 0) > 0.5
    assert one.scores is not None
    assert other.scores is not None
    assert one.scores.difference == pytest.approx(-other.scores.difference)
    for scores in (one.scores, other.scores):
        assert scores.interval is not None
        assert scores.interval.low < scores.difference < scores.interval.high


def test_an_evaluation_is_no_better_than_itself(tmp_path: Path) -> None:
    """And the pairs show it without any doubt."""
    a = write_evaluation(tmp_path / "a", {WALK: drawn(500, seed=0)})
    comparison = compare(a, str(a), bootstrap=QUICK)
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
        {WALK: [[100, 200, 300, 400]], "Hopper-v5": [[1, 2, 3, 4]]},
    )
    b = write_evaluation(
        tmp_path / "b",
        {"Hopper-v5": [[5, 6, 7, 8]], WALK: [[250, 250, 250, 250]]},
    )
    comparison = compare(a, b, bootstrap=QUICK)
    assert [task.task for task in comparison.tasks] == [WALK, "Hopper-v5"]
    assert [task.probability for task in comparison.tasks] == [0.5, 1]
    assert comparison.probability == 0.75
    interval = comparison.probability_interval
    assert interval is not None
    assert 0.5 <= interval.low < 0.75 < interval.high <= 1
    scores = comparison.scores
    assert scores is not None
    assert (scores.tasks, scores.iqm_a, scores.iqm_b) == ((WALK,), 0.25, 0.25)
    assert scores.interval is not None
    assert scores.interval.low < 0 < scores.interval.high


def test_scores_need_the_same_scale_in_both(tmp_path: Path) -> None:
    """A share of one range is not one of another."""
    returns = {"Hopper-v5": [[1, 2, 3, 4]]}
    a, b = (
        write_evaluation(
            tmp_path / str(most), returns, score_ranges={"Hopper-v5": (0, most)}
        )
        for most in (10, 20)
    )
    assert compare(a, b, bootstrap=QUICK).scores is None
    assert compare(a, a, bootstrap=QUICK).scores is not None


@pytest.mark.parametrize("scale", [(5, 5), (9, 1), (0, 1e-320), (-1e308, 1e308)])
def test_impossible_scales_are_none(scale: tuple[float, float], tmp_path: Path) -> None:
    """A file may say anything."""
    a = write_evaluation(
        tmp_path / "a", {"x": [[1, 2, 3, 4]]}, score_ranges={"x": scale}
    )
    assert compare(a, a, bootstrap=QUICK).scores is None


def test_pairs_are_of_the_same_seed_and_number(tmp_path: Path) -> None:
    """However the seeds are ordered; what failed in one has no partner."""
    hard = [[10.0, 500, 900, None], [300, 20, 800, 40]]
    a = write_evaluation(tmp_path / "a", {WALK: hard}, seeds=(3, 4))
    b = write_evaluation(
        tmp_path / "b",
        {WALK: [[301, None, 802, 41], [11, 501, 902, 1000]]},
        seeds=(4, 3),
    )
    comparison = compare(a, b, bootstrap=QUICK)
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
    assert compare(a, b, bootstrap=QUICK).tasks[0].paired is None


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
    comparison = compare(a, b, bootstrap=QUICK)
    (caution,) = comparison.cautions
    assert "max_steps was 500 in A and is the environment's own in B" in caution
    assert comparison.remarks == (
        "seeds: 0, 1 in A, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 ... in B",
        "mujoco: 3.3 in A, 3.4 in B",
    )
    # A return of at most 500 on one side, and of 1000 on the other.
    assert comparison.scores is None


def test_tasks_in_one_only_are_named(tmp_path: Path) -> None:
    """The others are compared."""
    a = write_evaluation(tmp_path / "a", {"x": [[1, 2]], WALK: [[1, 2]], RUN: [[3, 4]]})
    b = write_evaluation(tmp_path / "b", {RUN: [[3, 4]], "y": [[1, 2]]})
    comparison = compare(a, b, bootstrap=QUICK)
    assert [task.task for task in comparison.tasks] == [RUN]
    assert (comparison.only_in_a, comparison.only_in_b) == (("x", WALK), ("y",))


def test_no_task_in_common_is_an_error(tmp_path: Path) -> None:
    """It lists what there is in both."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]]})
    b = write_evaluation(tmp_path / "b", {RUN: [[3, 4]]})
    with pytest.raises(InvalidArgument, match=rf"(?s){WALK}.*{RUN}"):
        compare(a, b)


@pytest.mark.parametrize(
    ("returns", "why"),
    [
        ([None, None], "no episode of B was completed"),
        ([1.0, math.nan], "1 of 2 returns of B are NaN or infinite"),
        ([1.0, -math.inf], "1 of 2 returns of B are NaN or infinite"),
        ([1e300, 1.0], "returns of B are too large to be added up"),
    ],
)
def test_a_task_that_cannot_be_compared_says_why(
    returns: list[float | None], why: str, tmp_path: Path
) -> None:
    """And the others go on without it."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]], RUN: [[1, 2]]})
    b = write_evaluation(tmp_path / "b", {WALK: [returns], RUN: [[3, 4]]})
    comparison = compare(a, b, bootstrap=QUICK)
    walk, run = comparison.tasks
    assert walk.unknown == why
    assert (walk.difference, walk.probability, walk.p_value) == (None, None, None)
    assert comparison.compared == (run,)
    assert comparison.probability == run.probability == 1


def test_nothing_to_compare(tmp_path: Path) -> None:
    """No figures, and no error: the evaluation itself is whole."""
    a = write_evaluation(tmp_path / "a", {WALK: [[None, None]]})
    comparison = compare(a, a, bootstrap=QUICK)
    assert comparison.probability is None
    assert comparison.probability_interval is None
    assert comparison.compared == ()


def test_single_episodes_have_no_intervals(tmp_path: Path) -> None:
    """Figures, and how far they can be trusted is not said."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1.0]], RUN: [[1.0]]})
    b = write_evaluation(tmp_path / "b", {WALK: [[2.0]], RUN: [[1.0]]})
    comparison = compare(a, b)
    assert (comparison.probability, comparison.probability_interval) == (0.75, None)
    assert comparison.tasks[0].interval_method is None
    # All returns are the same: scipy would divide zero by zero.
    assert comparison.tasks[1].p_value == 1


def test_all_returns_equal_is_no_evidence(tmp_path: Path) -> None:
    """Whatever their number."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1000.0] * 20]})
    (task,) = compare(a, a, bootstrap=QUICK).tasks
    assert (task.p_value, task.probability) == (1, 0.5)


def test_holm_by_hand() -> None:
    """Four tests, as in Holm's own procedure."""
    adjusted = holm_adjusted({"a": 0.03, "b": 0.005, "c": 0.04, "d": 0.01})
    assert adjusted == pytest.approx({"a": 0.06, "b": 0.02, "c": 0.06, "d": 0.03})
    assert list(adjusted) == ["a", "b", "c", "d"]


@given(st.lists(st.floats(0, 1), min_size=1, max_size=9))
def test_holm_keeps_the_order_and_only_raises(p_values: list[float]) -> None:
    """Up to 1; never above Bonferroni's."""
    named = {str(k): p for k, p in enumerate(p_values)}
    adjusted = holm_adjusted(named)
    for name, p in named.items():
        assert p <= adjusted[name] <= min(1, p * len(named))
    ranked = sorted(named, key=lambda name: named[name])
    assert [adjusted[name] for name in ranked] == sorted(adjusted.values())


def test_p_values_are_scipys(tmp_path: Path) -> None:
    """Two-sided, of samples with ties."""
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 9, 30) * 1.0, rng.integers(2, 11, 40) * 1.0
    a = write_evaluation(tmp_path / "a", {WALK: [x.tolist()]})
    b = write_evaluation(tmp_path / "b", {WALK: [y.tolist()]})
    (task,) = compare(a, b, bootstrap=QUICK).tasks
    assert task.p_value == pytest.approx(mannwhitneyu(x, y).pvalue)


def test_without_scipy_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One line, with the command."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]]})
    monkeypatch.setitem(sys.modules, "scipy.stats", None)
    with pytest.raises(MissingDependency, match=r'pip install "mjrec\[evaluation\]"'):
        compare(a, a, bootstrap=QUICK)


def test_what_is_no_evaluation(tmp_path: Path) -> None:
    """The directory is named."""
    with pytest.raises(UnreadableFile, match="no evaluation"):
        compare(tmp_path, tmp_path)
