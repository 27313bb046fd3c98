# SPDX-License-Identifier: Apache-2.0
"""Recording the steps of which nothing but the state is new.

A fast simulation's step takes no longer than some hundred instructions of Python, so
whatever is asked at every step shows. Nearly all steps of an episode whose pictures are
drawn later, or that gets none, are alike: no error, no end, the same model, the same
view. Of these nothing is asked that is known; what is not usual goes the recorder's own
way.

What is here stands in place of `Recorder.before_step` and `Recorder.step` for as long
as the recorder has it: `before_step`, the environment's step, and, where that did not
end the episode, `step`. Where one of the two returns False, the recorder's method of
that name is to be called after all.
"""

from __future__ import annotations

from typing import Any

from ..errors import FileNotWritten
from .stats_recorder import StatsRecorder
from .trajectory_recorder import MomentCopier

# Of a reward, which is NumPy's float64 as a rule, and those before: `+` would make one
# of the sum too, and converting each takes ten times as long.
_sum = float.__add__


class CountedSteps:
    """The usual steps of an episode of which nothing but statistics is recorded.

    Args:
        stats: counts them.
    """

    __slots__ = ("_stats",)

    def __init__(self, stats: StatsRecorder) -> None:
        self._stats = stats

    def before_step(self, action: Any) -> bool:
        """Tell whether a step may be taken."""
        stats = self._stats
        # Others may have ended the episode, or its recording.
        return stats.done is False and not stats.closed

    def step(self, reward: Any) -> bool:
        """Count a step that did not end the episode; return False if it is not usual.

        Then it was not counted.
        """
        if not isinstance(reward, float):
            return False
        stats = self._stats
        # Numbers, because an episode has begun.
        total = _sum(reward, stats.rewards)  # type: ignore[arg-type]
        # No call from here on, behind which a signal's handler could raise.
        stats.rewards = total
        stats.steps += 1  # type: ignore[operator]
        stats.total_steps += 1
        return True


class UsualSteps:
    """The usual steps of an episode whose states are recorded, from its second one on.

    Args:
        copier: of the trajectory.
        stats: counts the steps.
    """

    __slots__ = (
        "_can_copy",
        "_copy_moment",
        "_copy_step",
        "_log",
        "_set_action",
        "_stats",
        "_stride",
    )

    def __init__(self, copier: MomentCopier, stats: StatsRecorder) -> None:
        self._log = copier.log
        self._stats = stats
        self._set_action = copier.set_action
        self._can_copy = copier.can_copy
        self._copy_step = copier.copy_step
        self._copy_moment = copier.copy_moment
        self._stride = copier.stride

    def before_step(self, action: Any) -> bool:
        """Note the action of the coming step; return False if it is not like others."""
        stats, set_action = self._stats, self._set_action
        # Others may have ended the episode, or its recording.
        if stats.done is not False or stats.closed:
            return False
        # Not `self._set_action(...)`: calling what an attribute holds takes CPython
        # 3.11 twice as long.
        return set_action(action)

    def step(self, reward: Any) -> bool:
        """Record a step that did not end the episode; return False if it is not usual.

        Then nothing of it was recorded.
        """
        log, stats, can_copy = self._log, self._stats, self._can_copy
        if not isinstance(reward, float) or not can_copy():
            return False
        number = log.steps + 1
        copy = self._copy_step if number % self._stride else self._copy_moment
        # A number, because an episode has begun.
        total = _sum(reward, stats.rewards)  # type: ignore[arg-type]
        try:
            copy(number, reward)
        except FileNotWritten:
            # The recorder will meet it too, and knows what is to be done.
            return False
        finally:
            # Also where a signal's handler has raised behind the copying; in here there
            # is no call behind which one could.
            if log.steps == number:
                stats.rewards = total
                stats.steps += 1  # type: ignore[operator]
                stats.total_steps += 1
        return True
