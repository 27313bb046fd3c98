# SPDX-License-Identifier: Apache-2.0
"""The level `physics`: the states follow from the actions, and the rewards from them.

Of each recorded episode, one after the other, three things are asked:

- whether its model is the one that its environment has;
- whether each state follows from the one before, by MuJoCo alone (`step_checks`);
- whether the environment, made again, goes through the same states, gives the same
  rewards and observations, and ends where the recording ends (`environment_replay`).

Of each recording, whether it is called as what was made (`name_checks`).

A state that does not follow by MuJoCo alone is a failure, even where the environment
cannot be made again: it may do more than `mj_step`, such as moving a target, but only
the environment itself can show that. Where it does, by giving those very states, the
second question is not the one to ask, and is not checkable.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ...environments.made_again import (
    EnvironmentAgain,
    NotMadeAgain,
    RecordedEnvironment,
    make_again,
    recorded_environment,
)
from ...errors import Error, UnreadableFile
from ...formats.monitor_directory import episode_of, infix_of, iter_monitor_files
from ...formats.spans import is_in_flight, recordings_in_flight
from ...formats.trajectory_file import open_trajectory
from ...simulation.warnings import log_mujoco_warnings
from ..verification import Check, Level, Verdict
from .episode_physics import EpisodePhysics
from .name_checks import EnvironmentNames
from .recorded_models import RecordedModels
from .task import Count, Task


def check_physics(
    task: Task, count: Count, *, made_again: set[str] | None = None
) -> Iterator[Check]:
    """Yield what there is to say of the physics of each recorded episode.

    Args:
        task: what is asked for.
        count: told how many episodes are done, and of how many.
        made_again: gets the sha256 of each compiled model that was made again here.
    """
    files = iter_monitor_files(task.recordings)
    in_flight = [each.path for each in recordings_in_flight(task.recordings)]
    paths = sorted(path for path in (*files, *in_flight) if _is_trajectory(path))
    # Else MuJoCo writes a file into the reader's working directory.
    log_mujoco_warnings()
    workshop, names = _Workshop(task), EnvironmentNames()
    try:
        for number, path in enumerate(paths):
            count(number, len(paths))
            yield from _checks_of(path, workshop, names)
            if made_again is not None:
                made_again |= workshop.models.made_again
        yield from names.checks()
        count(len(paths), len(paths))
    finally:
        workshop.close()


def _is_trajectory(path: Path) -> bool:
    is_one = path.name.startswith("openaigym.trajectory.")
    return is_one and path.suffix == ".h5"


def _checks_of(
    path: Path, workshop: _Workshop, names: EnvironmentNames
) -> Iterator[Check]:
    subject = f"episode {episode_of(path.name)} of {infix_of(path.name)}"
    if is_in_flight(path):
        yield Check(
            level=Level.PHYSICS,
            claim="the episode's states are recorded",
            subject=subject,
            verdict=Verdict.NOT_CHECKABLE,
            reason=f"{path.name} was never finished; `mjrec recover` finishes what a "
            "killed process has left",
        )
        return
    try:
        with open_trajectory(path) as reader:
            names.add(str(infix_of(path.name)), reader.facts)
            episode = EpisodePhysics(reader, subject, workshop.models)
            yield from episode.checks(workshop.made)
    except Error as error:
        reason = error.reason if isinstance(error, UnreadableFile) else str(error)
        yield Check(
            level=Level.PHYSICS,
            claim="the episode's states can be read",
            subject=subject,
            verdict=Verdict.FAIL,
            reason=f"{path.name}: {reason}".rstrip("."),
        )


class _Workshop:
    """What episodes share: their models, and the environment made last."""

    def __init__(self, task: Task) -> None:
        self.models = RecordedModels(task.recordings)
        self._trust = task.trust
        self._recorded: RecordedEnvironment | None = None
        self._made: EnvironmentAgain | NotMadeAgain | None = None

    def made(self, facts: Mapping[str, Any]) -> EnvironmentAgain:
        """Return the environment of a recording; the next call may close it.

        Raises:
            NotMadeAgain: it is not made.
        """
        recorded = recorded_environment(facts)
        if recorded.framework == "mjcf":
            return self._of_sources(recorded, facts)
        if recorded != self._recorded or self._made is None:
            self.close()
            self._recorded = recorded
            try:
                self._made = make_again(recorded, trust=self._trust)
            except NotMadeAgain as refusal:
                self._made = refusal
        if isinstance(self._made, NotMadeAgain):
            raise self._made
        return self._made

    def close(self) -> None:
        """Close the environment; idempotent."""
        made, self._made = self._made, None
        if made is not None and not isinstance(made, NotMadeAgain):
            made.close()

    def _of_sources(
        self, recorded: RecordedEnvironment, facts: Mapping[str, Any]
    ) -> EnvironmentAgain:
        try:
            model = self.models.from_sources(facts)
        except UnreadableFile as error:
            raise NotMadeAgain(
                f"its MJCF cannot be had: {error.reason}".rstrip(".")
            ) from error
        return make_again(recorded, model=model)
