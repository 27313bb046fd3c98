# SPDX-License-Identifier: Apache-2.0
"""What the descriptions of a packed run are written from."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..environments.scenes import shown_arguments, shown_wrappers
from ..formats.json_fields import read_object, unreadable
from ..formats.monitor_directory import infix_of, iter_monitor_files
from ..formats.trajectory_hdf5 import open_hdf5
from ..plain_text import counted
from ..results import Episode, iter_episodes
from ..results.journal_or_stats import MonitorResults
from ..results.monitor_files import MonitorFiles, monitors_of
from ..results.run import EVALUATION
from .layout import STATES_LEFT_OUT
from .statements import Statements, state

_SHOWN = 3
_NEVER = "1970-01-01"


@dataclass(frozen=True, kw_only=True)
class PackingOptions:
    """How a run is packed; `environment.json` says it.

    Attributes:
        name: of the archive, without its ending.
        title: as it was stated, likewise:
        authors: none, where it is anonymous.
        license: SPDX identifier or URL.
        episodes: the numbers of those that were chosen; None where all were.
        anonymous: whether what names a user, a machine or an author is taken out.
        max_size: the most bytes of the archive.
    """

    name: str
    title: str | None = None
    authors: tuple[str, ...] = ()
    license: str | None = None
    episodes: tuple[int, ...] | None = None
    anonymous: bool = False
    max_size: int | None = None


@dataclass
class Tally:
    """What episodes amount to.

    Attributes:
        episodes: how many.
        steps: of these.
        start: when the first began, in ISO 8601 in UTC; None where nothing says it.
        end: when the last ended, likewise.
    """

    episodes: int = 0
    steps: int = 0
    start: str | None = None
    end: str | None = None

    def add(self, episode: Episode) -> None:
        """Count one more."""
        self.episodes += 1
        self.steps += episode.length
        starts = (self.start, _iso_time(episode.start_time))
        ends = (self.end, _iso_time(episode.end_time))
        # Of one length and one zone, so that the order is that of the texts.
        self.start = min(filter(None, starts), default=None)
        self.end = max(filter(None, ends), default=None)


@dataclass(frozen=True, kw_only=True)
class Session:
    """What one monitor recorded, as far as it is in the archive.

    Attributes:
        infix: of its files.
        env_id: what was recorded.
        versions: of Python and the packages that recorded, by their names.
        provenance: what it was recorded with; empty where nothing says it.
        rule: the name of the rule by which the recorded episodes were chosen.
        was_killed: whether its process was, and what it left was recovered.
        files: the names of its files.
        models: the names of the models among what its trajectories refer to.
        videos: the name of each video that the manifest lists, and its metadata.
        made_with: the arguments that its environments were made with, each set once,
            as text; "" is one that had none, or about which nothing is known.
        tally: of the complete episodes.
        with_states: how many recorded episodes have their states in the archive.
        with_actions: how many have their actions there.
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
        """Return each different set of facts that its videos' metadata has."""
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
    """What is described.

    Attributes:
        options: how it is packed.
        statements: what the author states.
        sessions: what was recorded, monitor by monitor.
    """

    options: PackingOptions
    statements: Statements
    sessions: tuple[Session, ...]

    @property
    def env_ids(self) -> list[str]:
        """What was recorded, each once."""
        return list(dict.fromkeys(session.env_id for session in self.sessions))

    @property
    def extras(self) -> list[str]:
        """The extras of mjrec that verifying it needs."""
        is_of_suite = any(name.startswith("dm_control/") for name in self.env_ids)
        return ["evidence", *(["dm-control"] if is_of_suite else [])]

    @property
    def title(self) -> str:
        """The title that was stated, or one that says what was recorded."""
        ids = self.env_ids
        more = f" and {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else ""
        return self.statements.title or f"Recordings of {', '.join(ids[:_SHOWN])}{more}"

    @property
    def holds(self) -> str:
        """How much of what is in the archive, in words."""
        episodes = sum(session.tally.episodes for session in self.sessions)
        return (
            f"statistics of {counted(episodes, 'episode')} of "
            f"{', '.join(self.env_ids)}, "
            f"{counted(sum(len(s.videos) for s in self.sessions), 'video')}, actions "
            f"of {counted(sum(s.with_actions for s in self.sessions), 'episode')} and "
            f"physics states of "
            f"{counted(sum(s.with_states for s in self.sessions), 'episode')}"
        )

    @property
    def date(self) -> str:
        """The day on which the last episode ended, in UTC, as YYYY-MM-DD.

        It depends on nothing but the recordings. Where they tell no time it is the
        first day of 1970.
        """
        ends = (session.tally.end for session in self.sessions)
        return max(filter(None, ends), default=_NEVER)[:10]


def read_run(recordings: Path, *, options: PackingOptions) -> PackedRun:
    """Return what there is to say of the recordings in a folder.

    Raises:
        UnreadableFile: a file is damaged.
        InvalidArgument: a title, an author or a licence that cannot be.
    """
    statements = state(
        title=options.title, authors=options.authors, license=options.license
    )
    tallies: dict[str, Tally] = {}
    for episode in iter_episodes(recordings):
        tallies.setdefault(episode.monitor, Tally()).add(episode)
    files: dict[str, list[str]] = {}
    for path in iter_monitor_files(recordings):
        files.setdefault(infix_of(path.name) or "", []).append(path.name)
    return PackedRun(
        options=options,
        statements=statements,
        sessions=tuple(
            _session(
                recordings,
                monitor,
                files.get(monitor.infix, []),
                tallies.get(monitor.infix, Tally()),
            )
            for monitor in monitors_of(recordings)
            # What no manifest speaks of is not packed.
            if monitor.manifest is not None
        ),
    )


def facts_in(value: object) -> Mapping[str, Any]:
    """Return a mapping as it is; an empty one for anything else."""
    return value if isinstance(value, Mapping) else {}


def _session(
    recordings: Path, monitor: MonitorFiles, files: list[str], tally: Tally
) -> Session:
    results = MonitorResults(monitor)
    manifest, details = results.manifest, results.details
    assert manifest is not None
    facts = [_facts(recordings / name) for name in files if name.endswith(".h5")]
    with_states = [each for each in facts if not each.get(STATES_LEFT_OUT)]
    named = [facts_in(each.get("model")) for each in facts]
    models = {n for m in named for n in (m.get("xml"), m.get("mjb")) if n}
    # An evaluation chooses among all its recordings, whatever each one's schedule.
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
        files=tuple(files),
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
    except (OverflowError, ValueError, OSError):  # no calendar has it
        return None
    return moment.isoformat(timespec="milliseconds")
