# SPDX-License-Identifier: Apache-2.0
import functools
import math

import numpy as np
import pytest
from scipy import stats

from evaluations import write_evaluation
from mjrec import InvalidArgument, UnreadableFile, compare
from mjrec.evaluation.comparing import IMPROVEMENT, TASK_FIGURES, holm_adjusted
from mjrec.evaluation.statistics import Interval

WALK = "dm_control/walker-walk"
RUN = "dm_control/cheetah-run"
compared = functools.partial(compare, resamples=500)


def values(comparison, task=0):
    """Return the figures of a task, in the order of tables."""
    figures = comparison.tasks[task].figures
    return [figures[name].value if name in figures else None for name in TASK_FIGURES]


def sample(mean, *, seed, runs=2):
    rng = np.random.default_rng(seed)
    return rng.normal(mean, 50, (runs, 10)).tolist()


def test_figures_of_a_textbook_example(tmp_path):
    """Exchanging the sides changes their signs."""
    women, men = [20.0, 11, 17, 12], [19.0, 22, 16, 29, 24]
    a = write_evaluation(tmp_path / "a", {"Hopper-v5": [women]}, seeds=(0,))
    b = write_evaluation(tmp_path / "b", {"Hopper-v5": [men]}, seeds=(1,))
    comparison = compared(a, b)
    # scipy's manual and R's wilcox.test give p = 0.111. No seed is in both.
    assert values(comparison) == [15, 22, 7, None, 17 / 20, pytest.approx(1 / 9)]
    assert values(compared(b, a)) == [22, 15, -7, None, 3 / 20, pytest.approx(1 / 9)]
    (task,) = comparison.tasks
    assert (comparison.unit, task.episodes) == ("episodes", (4, 5))
    assert comparison.figures == {IMPROVEMENT: task.figures[IMPROVEMENT]}
    interval = task.figures["difference"].interval
    assert interval.low < 7 < interval.high


def test_trainings_are_compared_by_their_means(tmp_path):
    """Each evaluation is one value, however many episodes it has."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(500, 80, 5), rng.normal(620, 80, 4)
    a, b = (
        [
            write_evaluation(
                tmp_path / f"{side}{k}",
                dict.fromkeys((WALK, RUN), (mean + rng.normal(0, 1, (1, 50))).tolist()),
                policy=f"mine:{side}",
            )
            for k, mean in enumerate(means)
        ]
        for side, means in (("a", x), ("b", y))
    )
    comparison = compared(a, b)
    assert (comparison.unit, comparison.a) == ("evaluations", tuple(a))
    assert comparison.policies == ("mine:a", "mine:b")
    assert comparison.tasks[0].episodes == (250, 200)
    test = stats.mannwhitneyu(y, x)
    mean_a, _, _, paired, better, p_value = values(comparison)
    assert mean_a == pytest.approx(x.mean(), abs=1)
    assert (paired, better) == (None, test.statistic / 20)
    # Holm's adjustment for two tasks doubles it.
    assert p_value == pytest.approx(2 * test.pvalue)
    # Its width is due to trainings; the standard error of 250 episodes is 0.06.
    reach = 1.96 * math.hypot(x.std() / 5**0.5, y.std() / 4**0.5)
    interval = comparison.tasks[0].figures["difference"].interval
    assert interval.high - interval.low == pytest.approx(2 * reach, rel=0.15)
    # As in rliable, scores are (trainings x tasks), and a task is a stratum.
    expected = stats.trim_mean(np.repeat(x, 2) / 1000, 0.25)
    assert comparison.figures["IQM A"].value == pytest.approx(expected, abs=0.001)
    assert comparison.cautions == ()
    # One training does not show how much another would differ.
    (caution, *_) = (single := compared(a[:1], b)).cautions
    assert "A is a single evaluation" in caution
    assert single.tasks[0].figures["difference"].interval is None


def test_impossible_comparisons_are_refused(tmp_path):
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]]})
    with pytest.raises(InvalidArgument, match="twice: B"):
        compare(a, [a, tmp_path / "." / "a"])
    with pytest.raises(InvalidArgument, match="Side A"):
        compare([], a)
    with pytest.raises(UnreadableFile, match="no evaluation"):
        compare(a, tmp_path)
    b = write_evaluation(tmp_path / "b", {RUN: [[3, 4]]})
    with pytest.raises(InvalidArgument, match=rf"(?s){WALK}.*{RUN}"):
        compare(a, b)


def test_figures_across_tasks(tmp_path):
    """Probabilities are averaged over common tasks, scores over those with a scale."""
    hopper = "Hopper-v5"
    a = {WALK: [[100, 200, 300, 400]], hopper: [[1, 2, 3, 4]], "x": [[1] * 4]}
    b = {hopper: [[5, 6, 7, 8]], WALK: [[250, 250, 250, 250]], "y": [[1] * 4]}
    comparison = compared(
        write_evaluation(tmp_path / "a", a), write_evaluation(tmp_path / "b", b)
    )
    assert [task.task for task in comparison.tasks] == [WALK, hopper]
    assert [each.figures[IMPROVEMENT].value for each in comparison.tasks] == [0.5, 1]
    overall = comparison.figures
    interval = overall[IMPROVEMENT].interval
    assert 0.5 <= interval.low < overall[IMPROVEMENT].value == 0.75 < interval.high <= 1
    assert comparison.scored == (WALK,)
    assert (overall["IQM A"].value, overall["IQM B"].value) == (0.25, 0.25)
    assert comparison.left_out == (("x",), ("y",))


@pytest.mark.parametrize("other", [(0, 20), (9, 1)])
def test_scores_need_a_common_and_valid_scale(other, tmp_path):
    returns = {"x": [[1, 2, 3, 4]]}
    a = write_evaluation(tmp_path / "a", returns, score_ranges={"x": (0, 10)})
    b = write_evaluation(tmp_path / "b", returns, score_ranges={"x": other})
    assert compared(a, a).scored == ("x",)
    assert compared(a, b).scored == ()
    assert compared(b, b).scored == (("x",) if other == (0, 20) else ())


def test_pairs_have_the_same_seed_and_number(tmp_path):
    """The order of seeds does not matter. A failed episode has no pair."""
    returns = {
        "a": {3: [10.0, 500, 900, None], 4: [300, 20, 800, 40]},
        "b": {4: [301, None, 802, 41], 3: [11, 501, 902, 1000]},
    }
    a, b = (
        write_evaluation(tmp_path / name, {WALK: [*of.values()]}, seeds=tuple(of))
        for name, of in returns.items()
    )
    comparison = compared(a, b)
    (task,) = comparison.tasks
    paired = task.figures["paired difference"]
    assert task.pairs == 6
    assert paired.value == pytest.approx((1 + 2 + 1 + 1 + 1 + 2) / 6)
    # Unpaired, the difference is much less certain.
    assert 1 <= paired.interval.low <= paired.interval.high <= 2
    unpaired = task.figures["difference"].interval
    assert unpaired.low < 0
    assert task.failed == (1, 1)
    assert "1 of 8 episodes of A failed" in comparison.cautions[0]
    assert "1 of 8 episodes of B failed" in comparison.cautions[1]
    # With another protocol or environment, episodes have other initial states.
    for name, plan in (("c", {"protocol": "suite"}), ("d", {"env_kwargs": {"k": 1}})):
        c = write_evaluation(
            tmp_path / name, {WALK: [*returns["a"].values()]}, seeds=(3, 4), **plan
        )
        assert compared(a, c).tasks[0].pairs == 0


def test_different_conditions_are_cautions_or_remarks(tmp_path):
    few, many = {WALK: sample(1, seed=0)}, {WALK: sample(1, seed=0, runs=12)}
    old, new = ({"mujoco": version, "numpy": "2"} for version in ("3.3", "3.4"))
    a = write_evaluation(tmp_path / "a", few, max_steps=500, versions=old)
    b = write_evaluation(tmp_path / "b", many, versions=new)
    comparison = compared(a, b)
    (caution,) = comparison.cautions
    assert "max_steps is 500 in A and the environment's own in B" in caution
    assert comparison.remarks == (
        "seeds: 0, 1 in A, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 ... in B",
        "mujoco: 3.3 in A, 3.4 in B",
    )
    # The highest return is 500 on one side and 1000 on the other.
    assert comparison.scored == ()
    within = compared([a, b], write_evaluation(tmp_path / "c", {WALK: [[1, 2]]}))
    assert "is 500 or the environment's own in A" in within.cautions[1]
    # Conditions that vary within both sides alike are no difference between them.
    for name, like in (("d", many), ("e", few)):
        write_evaluation(tmp_path / name, like, versions=new)
    same = compared([a, b], [tmp_path / "d", tmp_path / "e"])
    assert [each.partition(":")[0] for each in same.remarks] == ["mujoco"]


@pytest.mark.parametrize(
    ("returns", "why"),
    [
        ([None, None], "no episode of B was completed"),
        ([1.0, -math.inf], "1 of 2 returns of B are NaN or infinite"),
    ],
)
def test_other_tasks_are_compared_without_an_incomparable_one(returns, why, tmp_path):
    a = write_evaluation(tmp_path / "a", {WALK: [[1, 2]], RUN: [[1, 2]]})
    b = write_evaluation(tmp_path / "b", {WALK: [returns], RUN: [[3, 4]]})
    comparison = compared(a, b)
    walk, run = comparison.tasks
    assert (walk.unknown, walk.figures) == (why, {})
    assert walk.not_finite == (0, 0 if returns[0] is None else 1)
    assert comparison.figures[IMPROVEMENT] == run.figures[IMPROVEMENT]
    of_trainings = compared([a], [b, a])
    assert of_trainings.tasks[0].unknown == why.replace("of B", f"of {b}")


def test_equal_returns_have_p_value_one(tmp_path):
    """A single episode has no interval."""
    a = write_evaluation(tmp_path / "a", {WALK: [[1.0]], RUN: [[1.0]]})
    b = write_evaluation(tmp_path / "b", {WALK: [[2.0]], RUN: [[1.0]]})
    comparison = compared(a, b)
    assert comparison.figures[IMPROVEMENT].value == 0.75
    assert comparison.figures[IMPROVEMENT].interval is None
    assert values(comparison, 1) == [1, 1, 0, 0, 0.5, 1]
    same = write_evaluation(tmp_path / "c", {WALK: sample(500, seed=0)})
    [task] = compared(same, same).tasks
    assert task.figures["paired difference"].interval == Interval(0, 0)


def test_holm_adjusted_p_values_are_at_most_one():
    adjusted = holm_adjusted({"a": 0.03, "b": 0.005, "c": 0.04, "d": 0.01})
    assert adjusted == pytest.approx({"a": 0.06, "b": 0.02, "c": 0.06, "d": 0.03})
    assert holm_adjusted({"a": 0.9, "b": 0.8}) == {"a": 1, "b": 1}
