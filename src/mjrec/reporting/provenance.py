# SPDX-License-Identifier: Apache-2.0
"""How recordings came about, as labels and values for people.

What a file does not say is left out; where several monitors say different things, all
of them are there.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ..errors import Error, UnreadableFile
from ..evaluation.kept_episodes import keep_rule
from ..evaluation.plan import SEEDED, EvaluationPlan
from ..evaluation.results_files import ReadResults
from ..formats.manifest import GYM_VERSION
from ..results.journal_or_stats import MonitorResults
from .contents import EpisodeColumns
from .recorded_videos import RecordedVideo

Rows = list[tuple[str, str]]

# In this order, by the names of the packages.
_PACKAGES: Final = {
    "mjrec": "mjrec",
    "mujoco": "MuJoCo",
    "gymnasium": "Gymnasium",
    "gymnasium-robotics": "Gymnasium-Robotics",
    "dm-control": "dm_control",
    "dm_control": "dm_control",
    "numpy": "NumPy",
    "python": "Python",
}
_SCHEDULES: Final = {
    "capped_cubic_video_schedule": "episodes 0, 1, 8, 27 ... 729, then every 1000th; "
    "decided before each began",
    "disable_videos": "none",
}
_RULES: Final = {
    "all": "all episodes",
    "none": "none",
    "cubic": "episodes 0, 1, 8, 27 ... and every 1000th, counted over the seeds",
}
_KEPT: Final = "keep:"
_LONGEST_TEXT: Final = 1000
_MOST_LISTED: Final = 20


@dataclass(frozen=True)
class MonitorOrigin:
    """What a monitor says of how its recordings came about.

    What it does not say is None.

    Attributes:
        infix: its own.
        policy: the file of the policy.
        schedule: by which rule videos were chosen.
        versions: of the packages.
        gym: the version of gym, where that wrote the files.
        machine: CPU and system.
    """

    infix: str
    policy: str | None
    schedule: str | None
    versions: str | None
    gym: str | None
    machine: str | None


def origin_of(monitor: MonitorResults) -> MonitorOrigin:
    """Return what a monitor says of how its recordings came about."""
    details = _details(monitor)
    return MonitorOrigin(
        infix=monitor.files.infix,
        policy=_policy(details),
        schedule=_schedule(details),
        versions=_versions(details),
        gym=_gym(monitor),
        machine=_machine(details),
    )


def provenance_of_monitors(
    environment: str,
    monitors: Sequence[MonitorOrigin],
    videos: Iterable[RecordedVideo],
    columns: EpisodeColumns,
) -> Rows:
    """Return how the episodes of one environment of a monitor directory came about.

    Args:
        environment: what it is called.
        monitors: what those say that recorded it.
        videos: of these monitors.
        columns: their episodes.
    """
    versions = [*(m.versions for m in monitors), *(m.gym for m in monitors)]
    return [
        ("Environment", environment),
        ("Monitors", ", ".join(_some(m.infix for m in monitors))),
        *_row("Policy", (m.policy for m in monitors)),
        *_row("Selection of videos", (m.schedule for m in monitors)),
        *_row("Versions", versions),
        *_row("OpenGL of the videos", map(_renderer, videos)),
        *_row("Recorded on", (m.machine for m in monitors)),
        *_row("Recorded", [_times(columns)]),
    ]


def provenance_of_evaluation(
    results: ReadResults,
    task: str,
    monitors: Iterable[MonitorOrigin],
    videos: Iterable[RecordedVideo],
    columns: EpisodeColumns,
) -> Rows:
    """Return how the episodes of one task of an evaluation came about.

    Args:
        results: of the evaluation.
        task: its name.
        monitors: what those of the task's folder say.
        videos: of these monitors.
        columns: the episodes.
    """
    plan = results.plan
    return [
        ("Environment", task),
        *_row("Arguments of the environment", [_arguments(plan)]),
        ("Policy", plan.policy[:_LONGEST_TEXT] + " (an object)" * plan.is_object),
        ("Protocol", _protocol(plan)),
        ("Seeds", ", ".join(_some(map(str, plan.seeds)))),
        ("Episodes of each seed", str(plan.episodes)),
        ("Most steps of an episode", _most_steps(plan)),
        ("Selection of videos", _rule(plan.keep)),
        *_row("Versions", [_in_words(results.versions)]),
        *_row("OpenGL of the videos", map(_renderer, videos)),
        *_row("Recorded on", (monitor.machine for monitor in monitors)),
        *_row("Recorded", [_times(columns)]),
    ]


def _row(label: str, values: Iterable[str | None]) -> Rows:
    """Return a row of what is said, each once; none where nothing is."""
    said = list(dict.fromkeys(value for value in values if value))
    return [(label, "; ".join(_some(said)))] if said else []


def _some(values: Iterable[str]) -> list[str]:
    listed = list(values)
    more = len(listed) - _MOST_LISTED
    return listed if more <= 0 else [*listed[:_MOST_LISTED], f"and {more} more"]


def _versions(details: Mapping[str, Any]) -> str | None:
    return _in_words(details.get("versions"))


def _in_words(versions: Any) -> str | None:
    if not isinstance(versions, Mapping):
        return None
    named = {
        shown: _short(versions[package])
        for package, shown in _PACKAGES.items()
        if isinstance(versions.get(package), str)
    }
    return ", ".join(f"{name} {version}" for name, version in named.items()) or None


def _gym(monitor: MonitorResults) -> str | None:
    version = (monitor.env_info or {}).get("gym_version")
    if not isinstance(version, str) or version == GYM_VERSION:
        return None
    return f"gym {_short(version)}"


def _policy(details: Mapping[str, Any]) -> str | None:
    policy = _mapping(_mapping(details.get("surroundings")).get("policy"))
    file, sha256 = policy.get("file"), policy.get("sha256")
    if not isinstance(file, str):
        return None
    return _short(file) + (f", sha256 {_short(sha256)}" if sha256 else "")


def _schedule(details: Mapping[str, Any]) -> str | None:
    name = _mapping(details.get("schedule")).get("name")
    if not isinstance(name, str):
        return None if details else "as its schedule chose; gym did not write it down"
    if name.startswith(_KEPT):
        rule = _short(name.removeprefix(_KEPT))
        return f"{rule}; chosen after all episodes had ended"
    return _SCHEDULES.get(name, f"as {_short(name)} chose, before each began")


def _rule(keep: str) -> str:
    known = _RULES.get(keep)
    if known is not None:
        return known
    try:
        keep_rule(keep)
    except Error:
        return _short(keep)
    return f"{keep}; chosen after all episodes of the task had ended"


def _renderer(video: RecordedVideo) -> str | None:
    keys = ("gl_renderer", "gl_version")
    said = (video.metadata.get(key) for key in keys)
    return ", ".join(_short(text) for text in said if isinstance(text, str)) or None


def _machine(details: Mapping[str, Any]) -> str | None:
    surroundings = _mapping(details.get("surroundings"))
    said = (_mapping(surroundings.get("cpu")).get("model"), surroundings.get("system"))
    return ", ".join(_short(text) for text in said if isinstance(text, str)) or None


def _times(columns: EpisodeColumns) -> str | None:
    known = columns.end_time[~np.isnan(columns.end_time)]
    if not len(known):
        return None
    first, last = _date(float(known.min())), _date(float(known.max()))
    if first is None or last is None:
        return None
    return f"{first} UTC" if first == last else f"{first} to {last} UTC"


def _date(seconds: float) -> str | None:
    try:
        moment = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    except (OverflowError, ValueError, OSError):
        return None
    return f"{moment:%Y-%m-%d %H:%M}"


def _protocol(plan: EvaluationPlan) -> str:
    if plan.protocol == SEEDED:
        return "seeded: episode i of seed s starts from SeedSequence([s, i])"
    return "suite: one random stream for each task and seed"


def _most_steps(plan: EvaluationPlan) -> str:
    if plan.max_steps is None:
        return "the environment's own limit, 1000 where it has none"
    return str(plan.max_steps)


def _arguments(plan: EvaluationPlan) -> str | None:
    return ", ".join(_short(f"{k}={v!r}") for k, v in plan.env_kwargs.items()) or None


def _details(monitor: MonitorResults) -> Mapping[str, Any]:
    try:
        return monitor.details
    except UnreadableFile:
        return {}


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _short(value: object) -> str:
    return str(value)[:_LONGEST_TEXT]
