# SPDX-License-Identifier: Apache-2.0
"""An episode run again in the environment itself, with the recorded actions.

On the machine and MuJoCo of the recording the environment is reset and stepped and
must be where the recording says, bit for bit. Elsewhere errors grow until nothing is
alike, so from the first difference on the environment is put into each recorded state
before it is stepped. What it computes on the way to that state is there too: it has
just been on that way itself, but for one step's error.

Where an episode's beginning cannot be repeated the environment is put into the first
recorded state, and goes on from there.

Floats are recorded as float64, whatever the policy gave. A reward that is computed
from a float32 action may have other last bits; so where all recorded actions are
float32 numbers, that is tried first, and float64 where the rewards then differ.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...environments.made_again import EnvironmentAgain
from ...errors import InvalidArgument
from ...formats.trajectory import TrajectoryReader
from ...recorder.step_arrays import StepArray, step_array
from ...simulation.fields import differing_from
from ...simulation.replay import LiveStates
from .differences import Differences, compared_columns
from .recorded_models import is_of_pictures
from .step_checks import BLOCK_ROWS

_MOST_PARTS = 1000


@dataclass
class Replay:
    """What came of running an episode again.

    Attributes:
        first_state: of the state after the reset.
        states: of those after each step.
        rewards: of each step.
        observations: the first included; None where none are recorded, or they are of
            another kind.
        steps: how many were made.
        ending: how the episode's end differs, as a clause; "" if it does not.
        trouble: what kept the episode from going on; "" if nothing did.
        observation_trouble: why observations cannot be compared; "" if they can.
        synchronised_from: the step from which on each step began at a recorded state;
            None if none did.
        changed: physical fields of the model of which the recording says that they
            changed on the way, and the environment has them otherwise, with the step.
    """

    first_state: Differences
    states: Differences
    rewards: Differences
    observations: Differences | None = None
    steps: int = 0
    ending: str = ""
    trouble: str = ""
    observation_trouble: str = ""
    synchronised_from: int | None = None
    changed: dict[str, int] = field(default_factory=dict)


def action_kinds(reader: TrajectoryReader) -> list[np.dtype[Any]]:
    """Return the kinds of number that the actions may have been, likeliest first."""
    action = reader.kind("action")
    assert action is not None
    recorded = action.base
    if recorded.kind != "f" or recorded.itemsize != 8:
        return [recorded]
    is_single = all(
        np.array_equal(block, block.astype(np.float32), equal_nan=True)
        for block in _blocks_of_actions(reader)
    )
    single = np.dtype(np.float32)
    return [single, recorded] if is_single else [recorded]


def replay_episode(
    reader: TrajectoryReader,
    environment: EnvironmentAgain,
    first_observation: Any,
    *,
    kind: np.dtype[Any],
    is_exact: bool,
    has_limit: bool,
    begins_as_recorded: bool = False,
) -> Replay:
    """Run an episode again in an environment that was just reset for it.

    Args:
        reader: of the episode; it has actions.
        environment: where they are taken.
        first_observation: that the reset gave.
        kind: of the numbers in an action.
        is_exact: whether to go on whatever differs; else a difference is the end of
            going on without the recorded states.
        has_limit: whether the environment has the episodes' limit, so that their being
            cut off can be compared.
        begins_as_recorded: the environment was begun anyhow, and is put into the
            first recorded state; its first state and observation are not compared.

    Raises:
        InvalidArgument: the states are not of the environment's model, or the first
            would be needed and is not recorded.
        UnreadableFile: the file is damaged.
    """
    run = _Run(reader, environment, kind, is_exact, has_limit)
    return run.run(first_observation, begins_as_recorded=begins_as_recorded)


class _Run:
    def __init__(
        self,
        reader: TrajectoryReader,
        environment: EnvironmentAgain,
        kind: np.dtype[Any],
        is_exact: bool,
        has_limit: bool,
    ) -> None:
        self._reader = reader
        self._environment = environment
        self._kind = kind
        self._is_exact = is_exact
        self._has_limit = has_limit
        model, data = environment.simulation()
        parts = reader.columns
        self._model = model
        self._live = LiveStates(model, data, parts, is_settled=environment.is_settled)
        names, self._compared = compared_columns(parts, with_warm_start=is_exact)
        self._result = Replay(
            Differences(names), Differences(names), Differences(["the reward"])
        )
        self._changes = _PhysicalChanges(reader)
        self._parts = _action_parts(reader)
        self._observation: StepArray | None = None

    def run(self, first_observation: Any, *, begins_as_recorded: bool) -> Replay:
        result = self._result
        self._look_at(first_observation)
        if begins_as_recorded:
            self._begin_as_recorded()
        else:
            self._begin(first_observation)
        for start in range(0, self._reader.step_count, BLOCK_ROWS):
            stop = min(start + BLOCK_ROWS, self._reader.step_count)
            if not self._block(start, stop):
                break
        if not result.ending and not result.trouble:
            result.steps = self._reader.step_count
        return result

    def _look_at(self, observation: Any) -> None:
        """Learn what kind of observations there are."""
        kind = self._reader.kind("observation")
        if kind is None:
            return
        array = step_array(observation)
        if array is None or array.kind != kind:
            there = "nothing like an array" if array is None else array.kind
            self._result.observation_trouble = (
                f"observations are recorded as {kind}, and are {there} when made again"
            )
            return
        self._observation = array
        names = [f"observation[{index}]" for index in range(int(np.prod(kind.shape)))]
        self._result.observations = Differences(names)

    def _begin(self, observation: Any) -> None:
        """Compare how the episode begins."""
        row = self._reader.states(0, 1)
        found = np.empty_like(row)
        self._live.read(found[0])
        self._add_states(self._result.first_state, 0, row, found)
        self._desynchronise(0, row[0], found[0])
        if self._observation is not None:
            self._observation.set(observation)
            self._add_observations(0, [self._observation.values.copy()])

    def _begin_as_recorded(self) -> None:
        """Let the episode begin in the first recorded state."""
        row = self._reader.states(0, 1)[0]
        if np.isnan(row).any():
            raise InvalidArgument("the first state is not recorded")
        self._live.begin_at(row)

    def _block(self, start: int, stop: int) -> bool:
        """Make some steps; return whether the episode goes on."""
        reader, result = self._reader, self._result
        rows = reader.states(start, stop + 1)
        actions = reader.actions(start, stop)
        assert actions is not None
        gaps: NDArray[np.bool_] = np.asarray(np.isnan(rows).any(axis=1))
        found = np.full_like(rows[1:], np.nan)
        rewards = np.zeros(stop - start)
        observations: list[NDArray[Any]] = []
        ended = reader.terminated[start:stop] | reader.truncated[start:stop]
        read = self._live.read
        made = 0
        for index, action in enumerate(self._given(actions)):
            number = start + index
            if result.synchronised_from is not None and not gaps[index]:
                self._live.bring_to(rows[index])
            try:
                step = self._environment.step(action)
            # An environment's own code may raise anything at what a file holds.
            except Exception as error:
                result.trouble = (
                    f"step {number + 1} cannot be made: {type(error).__name__}: "
                    f"{error!s:.200}"
                )
                break
            made += 1
            rewards[index] = step.reward
            read(found[index])
            if not self._is_exact:
                self._desynchronise(number + 1, rows[index + 1], found[index])
            if self._changes.any_left:
                self._changes.compare(number + 1, self._model, result.changed)
            if self._observation is not None:
                self._observation.set(step.observation)
                observations.append(self._observation.values.copy())
            if step.terminated or step.truncated or ended[index]:
                result.ending = self._different_end(number, step)
                if result.ending:
                    break
        self._add_states(result.states, start + 1, rows[1 : made + 1], found[:made])
        recorded = reader.rewards[start : start + made]
        steps = np.arange(start + 1, start + made + 1)
        result.rewards.add(steps, recorded[:, np.newaxis], rewards[:made, np.newaxis])
        self._add_observations(start + 1, observations)
        result.steps = start + made
        return not result.trouble and not result.ending

    def _desynchronise(
        self, number: int, row: NDArray[np.float64], found: NDArray[np.float64]
    ) -> None:
        """Note a first difference, where that is the end of going on freely."""
        result = self._result
        if self._is_exact or result.synchronised_from is not None:
            return
        if row.tobytes() != found.tobytes() and not np.isnan(row).any():
            result.synchronised_from = number

    def _given(self, actions: NDArray[Any]) -> Iterator[Any]:
        """Yield actions as the environment was given them."""
        for action in actions.astype(self._kind):
            if self._parts is not None:
                yield _taken_apart(action, self._parts)
            else:
                yield action if np.ndim(action) else action.item()

    def _different_end(self, number: int, step: Any) -> str:
        reader = self._reader
        flags = [("terminated", bool(reader.terminated[number]), step.terminated)]
        if self._has_limit:
            flags.append(("truncated", bool(reader.truncated[number]), step.truncated))
        for name, recorded, found in flags:
            if recorded != found:
                return (
                    f"after step {number + 1} {name} is recorded as {recorded}, and is "
                    f"{found} when made again"
                )
        if number + 1 < reader.step_count and (step.terminated or step.truncated):
            return (
                f"the environment ends the episode after step {number + 1}, and "
                f"{reader.step_count} are recorded"
            )
        return ""

    def _add_states(
        self,
        differences: Differences,
        first: int,
        rows: NDArray[np.float64],
        found: NDArray[np.float64],
    ) -> None:
        known = ~np.isnan(rows).any(axis=1)
        numbers = np.arange(first, first + len(rows))[known]
        differences.add(
            numbers, rows[known][:, self._compared], found[known][:, self._compared]
        )

    def _add_observations(self, first: int, found: list[NDArray[Any]]) -> None:
        differences, array = self._result.observations, self._observation
        if differences is None or array is None or not found:
            return
        recorded = self._reader.observations(first, first + len(found))
        assert recorded is not None
        ours = np.stack(found).reshape(len(found), -1)
        theirs = np.asarray(recorded).reshape(len(found), -1)
        numbers = np.arange(first, first + len(found))
        differences.add(numbers, theirs.astype(np.float64), ours.astype(np.float64))


class _PhysicalChanges:
    """What the recording says of a model that changed on the way."""

    def __init__(self, reader: TrajectoryReader) -> None:
        self._coming = iter(reader.iter_model_changes())
        self._next = self._advanced()

    @property
    def any_left(self) -> bool:
        """Whether there is anything to come."""
        return self._next is not None

    def compare(self, number: int, model: Any, differing: dict[str, int]) -> None:
        """Note what the environment's model has otherwise after a step."""
        while self._next is not None and self._next[0] <= number:
            step, fields = self._next
            if step == number:
                for name in differing_from(model, fields):
                    differing.setdefault(name, number)
            self._next = self._advanced()

    def _advanced(self) -> tuple[int, Mapping[str, NDArray[Any]]] | None:
        for change in self._coming:
            fields = {n: v for n, v in change.fields.items() if not is_of_pictures(n)}
            if fields and change.step > 0:
                return change.step, fields
        return None


def _blocks_of_actions(reader: TrajectoryReader) -> Iterator[NDArray[Any]]:
    for start in range(0, reader.step_count, BLOCK_ROWS):
        block = reader.actions(start, min(start + BLOCK_ROWS, reader.step_count))
        assert block is not None
        yield block


def _action_parts(
    reader: TrajectoryReader,
) -> dict[str, tuple[int, ...]] | None:
    """Return the names and shapes that a recorded action consists of; None for one.

    Raises:
        InvalidArgument: what the recording says of them does not fit.
    """
    said = reader.facts.get("action_parts")
    if said is None:
        return None
    action = reader.kind("action")
    assert action is not None
    trouble = InvalidArgument(f"its actions' parts cannot be: {said!r:.200}")
    if not isinstance(said, list) or len(said) > _MOST_PARTS:
        raise trouble
    parts: dict[str, tuple[int, ...]] = {}
    for each in said:
        if not (isinstance(each, list) and len(each) == 2):
            raise trouble
        name, shape = each
        whole = isinstance(shape, list) and all(
            type(n) is int and n >= 0 for n in shape
        )
        if not isinstance(name, str) or not whole:
            raise trouble
        parts[name] = tuple(shape)
    size = sum(int(np.prod(shape)) for shape in parts.values())
    if action.shape != (size,):
        raise trouble
    return parts


def _taken_apart(
    action: NDArray[Any], parts: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[Any]]:
    taken: dict[str, NDArray[Any]] = {}
    offset = 0
    for name, shape in parts.items():
        size = int(np.prod(shape))
        taken[name] = action[offset : offset + size].reshape(shape)
        offset += size
    return taken
