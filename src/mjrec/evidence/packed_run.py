# SPDX-License-Identifier: Apache-2.0
"""The facts from which the descriptions of a packed run are written."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..environments.scenes import shown_arguments, shown_wrappers
from ..formats import json_fields
from ..formats.json_fields import facts_in, read_object, unreadable
from ..formats.trajectory_hdf5 import open_hdf5
from ..plain_text import counted, listed
from ..results import Episode, iter_episodes
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, monitors_of
from ..results.run import EVALUATION
from .layout import STATES_LEFT_OUT
from .statements import Statements, state

_SHOWN = 3
# The file of an evaluation's plan; see `evaluation.plan`.
_PLAN = "evaluation.json"
_NEVER = "1970-01-01"


@dataclass(frozen=True, kw_only=True)
class PackingOptions:
    """Options for packing a run, as `environment.json` records them.

    Attributes:
        name: the archive's name without its extension.
        title: the stated title, or None.
        authors: the stated authors; empty if the archive is anonymous.
        license: the stated SPDX identifier or URL, or None.
        episodes: numbers of the chosen episodes; None for all.
        anonymous: whether names of users, machines and authors are removed.
        max_size: maximum size of the archive in bytes; None for no limit.
        planned: number of episodes in the plan of an evaluation, otherwise None.
    """

    name: str
    title: str | None = None
    authors: tuple[str, ...] = ()
    license: str | None = None
    episodes: tuple[int, ...] | None = None
    anonymous: bool = False
    max_size: int | None = None
    planned: int | None = None


@dataclass
class Tally:
    """Totals over episodes.

    Attributes:
        episodes: number of episodes.
        steps: total number of steps.
        total_return: sum of their returns.
        start: start time of the first episode, in ISO 8601 and UTC; None if unknown.
        end: end time of the last episode, in ISO 8601 and UTC; None if unknown.
    """

    episodes: int = 0
    steps: int = 0
    total_return: float = 0.0
    start: str | None = None
    end: str | None = None

    def add(self, episode: Episode) -> None:
        """Add an episode to the totals."""
        self.episodes += 1
        self.steps += episode.length
        self.total_return += episode.reward
        starts = (self.start, _iso_time(episode.start_time))
        ends = (self.end, _iso_time(episode.end_time))
        # All have the same length and time zone, so strings sort by time.
        self.start = min(filter(None, starts), default=None)
        self.end = max(filter(None, ends), default=None)

    @property
    def mean_return(self) -> float | None:
        """The mean return of the episodes; None without episodes."""
        return self.total_return / self.episodes if self.episodes else None


@dataclass(frozen=True, kw_only=True)
class Session:
    """One monitor's recording, as far as the archive contains it.

    Attributes:
        infix: the infix of its files' names.
        env_id: the recorded environment's id.
        versions: versions of Python and the recording packages, keyed by name.
        provenance: the recording's provenance; empty if unknown.
        rule: the name of the rule that chose the recorded episodes.
        was_killed: whether its process was killed and the recording recovered.
        files: the names of its files.
        models: the names of the model files that its trajectories refer to and that
            are in the archive.
        videos: the name of each video in the manifest, with its metadata.
        made_with: the distinct sets of arguments of the environments, as text; ""
            stands for no arguments or unknown ones.
        tally: totals over the complete episodes.
        with_states: number of recorded episodes whose states are in the archive.
        with_actions: number of recorded episodes whose actions are in the archive.
    """

    infix: str
    env_id: str
    versions: Mapping[str, str]
    provenance: Mapping[str, Any]
    rule: str | None
    was_killed: bool
    files: tuple[str, ...]
    models: tuple[str, ...]
    videos: tuple[tuple[str, Mapping[str, Any]], ...]
    made_with: tuple[str, ...]
    tally: Tally
    with_states: int
    with_actions: int

    def different(self, *keys: str) -> list[dict[str, Any]]:
        """Return the distinct sets of values of `keys` in its videos' metadata."""
        found: list[dict[str, Any]] = []
        for _, metadata in self.videos:
            facts = {key: metadata.get(key) for key in keys}
            if any(value is not None for value in facts.values()) and (
                facts not in found
            ):
                found.append(facts)
        return found


@dataclass(frozen=True, kw_only=True)
class PackedRun:
    """A packed run and its recordings.

    Attributes:
        options: the options for packing.
        statements: the author's statements.
        sessions: the recordings, one for each monitor.
    """

    options: PackingOptions
    statements: Statements
    sessions: tuple[Session, ...]

    @property
    def env_ids(self) -> list[str]:
        """The ids of the recorded environments, without duplicates."""
        return list(dict.fromkeys(session.env_id for session in self.sessions))

    @property
    def extras(self) -> list[str]:
        """The extras of mjrec that are needed to verify the run."""
        is_of_suite = any(name.startswith("dm_control/") for name in self.env_ids)
        return ["evidence", *(["dm-control"] if is_of_suite else [])]

    @property
    def title(self) -> str:
        """The stated title, or one derived from the recorded environments' ids."""
        made = f"Recordings of {listed(self.env_ids, _SHOWN)}"
        return self.statements.title or made

    @property
    def episodes(self) -> int:
        """The number of complete episodes."""
        return sum(session.tally.episodes for session in self.sessions)

    @property
    def is_unfinished(self) -> bool:
        """Whether an evaluation planned more episodes than are complete."""
        return self.episodes < (self.options.planned or 0)

    @property
    def holds(self) -> str:
        """A summary of the archive's content in words."""
        return (
            f"statistics of {counted(self.episodes, 'episode')} of "
            f"{', '.join(self.env_ids)}, "
            f"{counted(sum(len(s.videos) for s in self.sessions), 'video')}, actions "
            f"of {counted(sum(s.with_actions for s in self.sessions), 'episode')} and "
            f"physics states of "
            f"{counted(sum(s.with_states for s in self.sessions), 'episode')}"
        )

    @property
    def date(self) -> str:
        """The day on which the last episode ended, in UTC, as YYYY-MM-DD.

        It depends only on the recordings. If they contain no times, it is the first day
        of 1970.
        """
        ends = (session.tally.end for session in self.sessions)
        return max(filter(None, ends), default=_NEVER)[:10]


def read_run(recordings: Path, *, options: PackingOptions) -> PackedRun:
    """Read the facts about the recordings in a folder.

    Raises:
        UnreadableFile: a file is damaged.
        InvalidArgument: a title, an author or a license is invalid.
    """
    statements = state(
        title=options.title, authors=options.authors, license=options.license
    )
    tallies: dict[str, Tally] = {}
    for episode in iter_episodes(recordings):
        tallies.setdefault(episode.monitor, Tally()).add(episode)
    return PackedRun(
        options=options,
        statements=statements,
        sessions=tuple(
            _session(monitor, tallies.get(monitor.infix, Tally()))
            for monitor in monitors_of(recordings)
            # Recordings without a manifest are not packed.
            if monitor.manifest is not None
        ),
    )


def planned_episodes(directory: Path) -> int | None:
    """Return the number of episodes that an evaluation planned.

    Return None if the directory has no evaluation.

    Raises:
        UnreadableFile: the plan is damaged.
    """
    path = directory / _PLAN
    if not path.is_file():
        return None
    with unreadable(path):
        plan = json_fields.field(read_object(path), "plan", json_fields.mapping)
        tasks, seeds = (len(plan[name]) for name in ("tasks", "seeds"))
        return tasks * seeds * json_fields.field(plan, "episodes", json_fields.integer)


def _session(monitor: MonitorFiles, tally: Tally) -> Session:
    results = MonitorResults(monitor)
    manifest, details = results.manifest, results.details
    assert monitor.manifest is not None
    assert manifest is not None
    recordings = monitor.manifest.parent
    visible = [path for path in monitor.paths if not path.name.startswith(".")]
    facts = [_facts(path) for path in visible if path.suffix == ".h5"]
    with_states = [each for each in facts if not each.get(STATES_LEFT_OUT)]
    named = [facts_in(each.get("model")) for each in facts]
    models = {n for m in named for n in (m.get("xml"), m.get("mjb")) if n}
    # An evaluation chooses from all its recordings, regardless of their schedules.
    keep = facts_in(details.get("keep"))
    is_of_evaluation = keep.get("scope") == EVALUATION
    chosen_by = keep if is_of_evaluation else facts_in(details.get("schedule"))
    rule = chosen_by.get("rule" if is_of_evaluation else "name")
    versions = facts_in(details.get("versions"))
    return Session(
        infix=monitor.infix,
        env_id=str((results.env_info or {}).get("env_id", "(unknown)")),
        versions={k: v for k, v in versions.items() if isinstance(v, str)},
        provenance=facts_in(details.get("provenance")),
        rule=rule if isinstance(rule, str) else None,
        was_killed=details.get("recovered") is True,
        files=tuple(path.name for path in visible),
        models=tuple(sorted(name for name in models if (recordings / name).exists())),
        videos=tuple(
            (video, _read(recordings / metadata)) for video, metadata in manifest.videos
        ),
        made_with=tuple(dict.fromkeys(map(_arguments, facts))),
        tally=tally,
        with_states=len(with_states),
        with_actions=sum(each["has_actions"] for each in facts),
    )


def _facts(trajectory: Path) -> Mapping[str, Any]:
    with open_hdf5(trajectory) as reader:
        return {**reader.facts, "has_actions": reader.kind("action") is not None}


def _arguments(facts: Mapping[str, Any]) -> str:
    environment = facts_in(facts.get("environment"))
    if environment and environment.get("kwargs") is None:
        return "arguments that are not recorded"
    shown = shown_arguments(environment.get("kwargs"))
    wrappers = shown_wrappers(environment)
    if not wrappers:
        return shown
    return f"{shown or 'its defaults'}, in the wrappers {', '.join(wrappers)}"


def _read(path: Path) -> Mapping[str, Any]:
    with unreadable(path):
        return read_object(path)


def _iso_time(seconds: float | None) -> str | None:
    if seconds is None or not math.isfinite(seconds):
        return None
    try:
        moment = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    except (OverflowError, ValueError, OSError):  # out of range
        return None
    return moment.isoformat(timespec="milliseconds")
