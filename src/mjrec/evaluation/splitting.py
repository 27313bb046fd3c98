# SPDX-License-Identifier: Apache-2.0
"""The pieces in which an evaluation is handed out."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence

from .plan import SUITE, Batch, EvaluatedTask, EvaluationPlan

# So that the last ones end at about the same time, and making an environment, which
# each of them does, does not cost more than running it.
_BATCHES_PER_WORKER = 4

_Unit = tuple[int, int]


def batches_of(
    plan: EvaluationPlan,
    done: Mapping[str, Container[_Unit]],
    *,
    workers: int,
    alone: Container[str] = (),
) -> list[Batch]:
    """Return what is left to do, in the order of the plan.

    Args:
        plan: what is evaluated.
        done: seed and number of the episodes that are done, by task.
        workers: how many processes it is for.
        alone: the names of tasks of which each episode is to have an environment of its
            own: what is drawn live depends on what was drawn before.
    """
    left = {task.name: _left(plan, done.get(task.name, ())) for task in plan.tasks}
    return list(_batches(plan, left, workers, alone))


def _left(plan: EvaluationPlan, done: Container[_Unit]) -> Mapping[int, Sequence[int]]:
    """Return the numbers of the episodes that are left, by seed."""
    return {
        seed: [n for n in range(plan.episodes) if (seed, n) not in done]
        for seed in plan.seeds
    }


def _batches(
    plan: EvaluationPlan,
    left: Mapping[str, Mapping[int, Sequence[int]]],
    workers: int,
    alone: Container[str],
) -> Iterator[Batch]:
    units = sum(len(numbers) for runs in left.values() for numbers in runs.values())
    usual = max(1, units // (_BATCHES_PER_WORKER * workers))
    for task in plan.tasks:
        size = 1 if task.name in alone else usual
        for seed, numbers in left[task.name].items():
            if plan.protocol == SUITE:
                # All or nothing: an episode starts where the last one has ended.
                numbers, size = numbers and range(plan.episodes), plan.episodes
            yield from _cut(task, seed, numbers, size)


def _cut(
    task: EvaluatedTask, seed: int, numbers: Sequence[int], size: int
) -> Iterator[Batch]:
    for first in range(0, len(numbers), size):
        yield Batch(
            task=task.name,
            folder=task.folder,
            seed=seed,
            episodes=tuple(numbers[first : first + size]),
        )
