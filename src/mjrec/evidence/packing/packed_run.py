# SPDX-License-Identifier: Apache-2.0
"""What the descriptions of a packed run are written from."""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...environments.scenes import shown_arguments
from ...formats.json_fields import read_object, unreadable
from ...formats.monitor_directory import episode_of, infix_of, iter_monitor_files
from ...formats.trajectory_file import open_trajectory
from ...results import Episode, iter_episodes
from ...results.journal_or_stats import MonitorResults
from ...results.monitor_files import MonitorFiles, monitors_of
from .statements import Statements

_SHOWN = 3


@dataclass(frozen=True, kw_only=True)
class PackedVideo:
    """A video in the archive.

    Attributes:
        name: of its file.
        metadata: what its metadata says.
    """

    name: str
    metadata: Mapping[str, Any]

    @property
    def episode_id(self) -> int | None:
        """The number of its episode."""
        return episode_of(self.name)


@dataclass(frozen=True, kw_only=True)
class Session:
    """What one monitor recorded.

    Attributes:
        infix: of its files.
        env_id: what was recorded.
        details: what the manifest says besides what gym's do.
        files: the names of all its files and of its models, sorted.
        videos: those among them that the manifest lists, in its order.
        models: the models among them.
        made_with: the arguments that its environments were made with, each set once,
            as text; "" is one that had none, or of which nothing is known.
        episodes: how many are complete.
        steps: of these.
        start: when the first began, in seconds since the epoch; None where nothing
            says it.
        end: when the last ended, likewise.
    """

    infix: str
    env_id: str
    details: Mapping[str, Any]
    files: tuple[str, ...]
    videos: tuple[PackedVideo, ...]
    models: tuple[str, ...]
    made_with: tuple[str, ...]
    episodes: int
    steps: int
    start: float | None
    end: float | None

    @property
    def versions(self) -> Mapping[str, str]:
        """Of Python and the packages that recorded, by their names."""
        return _texts(self.details.get("versions"))

    @property
    def surroundings(self) -> Mapping[str, Any]:
        """What it was recorded with; nothing where the recording does not say it."""
        return _mapping(self.details.get("surroundings"))

    @property
    def rule(self) -> str | None:
        """The name of the rule by which the recorded episodes were chosen."""
        name = _mapping(self.details.get("schedule")).get("name")
        return name if isinstance(name, str) else None

    @property
    def was_killed(self) -> bool:
        """Whether its process was, and what it left was recovered."""
        return self.details.get("recovered") is True


@dataclass(frozen=True, kw_only=True)
class PackedRun:
    """What is described.

    Attributes:
        name: of the archive, without its ending.
        statements: what the author states.
        sessions: what was recorded, monitor by monitor.
        packed_episodes: the numbers of those that were chosen for packing; None where
            all were.
    """

    name: str
    statements: Statements
    sessions: tuple[Session, ...]
    packed_episodes: tuple[int, ...] | None

    @property
    def env_ids(self) -> list[str]:
        """What was recorded, each once."""
        return list(dict.fromkeys(session.env_id for session in self.sessions))

    @property
    def title(self) -> str:
        """The title that was stated, or one that says what was recorded."""
        if self.statements.title is not None:
            return self.statements.title
        ids = self.env_ids
        more = f" and {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else ""
        return f"Recordings of {', '.join(ids[:_SHOWN])}{more}"

    @property
    def episodes(self) -> int:
        """How many are complete."""
        return sum(session.episodes for session in self.sessions)

    @property
    def videos(self) -> list[tuple[Session, PackedVideo]]:
        """All of them, each with who recorded it."""
        return [(s, video) for s in self.sessions for video in s.videos]

    @property
    def date(self) -> str:
        """The day on which the last episode ended, in UTC, as YYYY-MM-DD.

        It depends on nothing but the recordings. Where they tell no time it is the
        first day of 1970.
        """
        ends = [s.end for s in self.sessions if iso_time(s.end) is not None]
        text = iso_time(max((end for end in ends if end is not None), default=0.0))
        return (text or "1970-01-01")[:10]


def read_run(
    recordings: Path,
    *,
    name: str,
    statements: Statements,
    packed_episodes: Sequence[int] | None,
) -> PackedRun:
    """Return what there is to say of the recordings in a folder.

    Raises:
        UnreadableFile: a file is damaged.
    """
    tallies: dict[str, _Tally] = {}
    for episode in iter_episodes(recordings):
        tallies.setdefault(episode.monitor, _Tally()).add(episode)
    return PackedRun(
        name=name,
        statements=statements,
        sessions=tuple(
            _session(recordings, files, tallies.get(files.infix, _Tally()))
            for files in monitors_of(recordings)
        ),
        packed_episodes=None if packed_episodes is None else tuple(packed_episodes),
    )


def iso_time(seconds: float | None) -> str | None:
    """Return a time as ISO 8601 has it, in UTC; None for what is no time."""
    if seconds is None or not math.isfinite(seconds):
        return None
    try:
        moment = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    except (OverflowError, ValueError, OSError):
        return None
    return moment.isoformat(timespec="milliseconds")


class _Tally:
    """What the episodes of a monitor amount to."""

    def __init__(self) -> None:
        self.episodes = 0
        self.steps = 0
        self.start: float | None = None
        self.end: float | None = None

    def add(self, episode: Episode) -> None:
        self.episodes += 1
        self.steps += episode.length
        if iso_time(episode.start_time) is not None:
            self.start = _extreme(min, self.start, episode.start_time)
        if iso_time(episode.end_time) is not None:
            self.end = _extreme(max, self.end, episode.end_time)


def _extreme(
    of: Callable[[Iterable[float]], float], *values: float | None
) -> float | None:
    return of([value for value in values if value is not None])


def _session(recordings: Path, files: MonitorFiles, tally: _Tally) -> Session:
    results = MonitorResults(files)
    manifest = results.manifest
    assert manifest is not None
    own = [
        path.name
        for path in iter_monitor_files(recordings)
        if infix_of(path.name) == files.infix
    ]
    known = [_of_trajectory(recordings, name) for name in own if name.endswith(".h5")]
    models = sorted({name for found, _ in known for name in found})
    return Session(
        infix=files.infix,
        env_id=str((results.env_info or {}).get("env_id", "(unknown)")),
        details=results.details,
        files=tuple(sorted([*own, *models])),
        videos=tuple(_video(recordings, *names) for names in manifest.videos),
        models=tuple(models),
        made_with=tuple(dict.fromkeys(arguments for _, arguments in known)),
        episodes=tally.episodes,
        steps=tally.steps,
        start=tally.start,
        end=tally.end,
    )


def _of_trajectory(recordings: Path, name: str) -> tuple[list[str], str]:
    """Return the names of a trajectory's models, and its environment's arguments."""
    with open_trajectory(recordings / name) as reader:
        facts = reader.facts
    model = _mapping(facts.get("model"))
    files = [
        file for kind in ("xml", "mjb") if isinstance(file := model.get(kind), str)
    ]
    present = [file for file in files if (recordings / file).exists()]
    environment = _mapping(facts.get("environment"))
    if environment and environment.get("kwargs") is None:
        return present, "arguments that are not recorded"
    return present, shown_arguments(environment.get("kwargs"))


def _video(recordings: Path, video: str, metadata: str) -> PackedVideo:
    with unreadable(recordings / metadata):
        return PackedVideo(name=video, metadata=read_object(recordings / metadata))


def _texts(value: object) -> dict[str, str]:
    return {k: v for k, v in _mapping(value).items() if isinstance(v, str)}


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}
