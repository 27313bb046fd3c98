# SPDX-License-Identifier: Apache-2.0
"""The provenance of recordings, as labels and values for people.

Facts that are missing in the files are left out. If monitors differ in a fact, all
values are listed.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..evaluation.evaluation import Evaluation
from ..evaluation.plan import SEEDED
from ..formats.json_fields import facts_in
from ..formats.manifest import GYM_VERSION
from ..results.journal_or_stats import MonitorResults

Pairs = Iterable[tuple[str, str]]

SELECTION: Final = "Selection of videos"

# In the order of the page.
_LABELS: Final = (
    *("Environment", "Environment arguments", "Monitors", "Policy", "Protocol"),
    *("Seeds", "Episodes per seed", "Maximum steps per episode", SELECTION),
    *("Versions", "OpenGL renderer", "Recorded on", "Recorded"),
)
# Package names and how they are shown, in this order.
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
    "cubic": "episodes 0, 1, 8, 27 ... and every 1000th, counted across the seeds",
}
_KEPT: Final = "keep:"
_LONGEST_TEXT: Final = 1000
_MOST_LISTED: Final = 20


def joined(pairs: Pairs) -> list[tuple[str, str]]:
    """Return each label with its different values, in the order of the page.

    Empty values are left out.
    """
    values: dict[str, dict[str, None]] = {label: {} for label in _LABELS}
    for label, value in pairs:
        if value:
            values[label][value[:_LONGEST_TEXT]] = None
    return [
        (label, _some(found, "; " if label != "Monitors" else ", "))
        for label, found in values.items()
        if found
    ]


def machine_of(monitor: MonitorResults) -> tuple[str, str]:
    """Return the label and value for the machine that a monitor recorded on."""
    provenance = facts_in(_details(monitor).get("provenance"))
    cpu = facts_in(provenance.get("cpu")).get("model")
    return "Recorded on", _joined(cpu, provenance.get("system"))


def pairs_of_monitor(monitor: MonitorResults) -> Pairs:
    """Yield the provenance of a monitor's recordings."""
    details = _details(monitor)
    yield machine_of(monitor)
    yield "Monitors", monitor.files.infix
    policy = facts_in(facts_in(details.get("provenance")).get("policy"))
    sha256 = policy.get("sha256")
    if isinstance(policy.get("file"), str):
        yield "Policy", _joined(policy["file"], f"sha256 {sha256}" if sha256 else None)
    yield SELECTION, _schedule(details)
    yield "Versions", _versions(details.get("versions"))
    gym = (monitor.env_info or {}).get("gym_version")
    if isinstance(gym, str) and gym != GYM_VERSION:
        yield "Versions", f"gym {gym}"


def pairs_of_results(results: Evaluation, task: str) -> Iterator[tuple[str, str]]:
    """Yield the provenance of the episodes of one task of an evaluation."""
    plan = results.plan
    yield "Environment", task
    kwargs = (f"{key}={value!r}" for key, value in plan.env_kwargs.items())
    yield "Environment arguments", ", ".join(kwargs)
    yield "Policy", plan.policy + " (an object)" * plan.is_object
    seeded = "seeded: episode i of seed s starts from SeedSequence([s, i])"
    suite = "suite: one random stream per task and seed"
    yield "Protocol", seeded if plan.protocol == SEEDED else suite
    yield "Seeds", _some(map(str, plan.seeds), ", ")
    yield "Episodes per seed", str(plan.episodes)
    limit = "the environment's own limit, or 1000 if it has none"
    yield "Maximum steps per episode", str(plan.max_steps or limit)
    chosen = f"{spaced(plan.keep)}; chosen after all episodes of the task had ended"
    yield SELECTION, _RULES.get(plan.keep, chosen)
    yield "Versions", _versions(results.versions)


def spaced(rule: str) -> str:
    """Return a selection rule with a space after each comma."""
    return ", ".join(part.strip() for part in rule.split(","))


def recorded_when(rows: NDArray[np.void]) -> str:
    """Return the time range in which episodes ended; empty if unknown."""
    known = rows["end_time"][~np.isnan(rows["end_time"])]
    if not len(known):
        return ""
    try:
        first, last = (_minute(float(end)) for end in (known.min(), known.max()))
    except (OverflowError, ValueError, OSError):
        return ""
    return f"{first} UTC" if first == last else f"{first} to {last} UTC"


def _minute(seconds: float) -> str:
    return f"{datetime.datetime.fromtimestamp(seconds, datetime.UTC):%Y-%m-%d %H:%M}"


def _details(monitor: MonitorResults) -> Mapping[str, Any]:
    try:
        return monitor.details
    except UnreadableFile:
        return {}


def _some(values: Iterable[str], between: str) -> str:
    listed = list(values)
    more = len(listed) - _MOST_LISTED
    if more > 0:
        listed[_MOST_LISTED:] = [f"and {more} more"]
    return between.join(listed)


def _versions(versions: Any) -> str:
    by_package = facts_in(versions)
    known = [(shown, by_package.get(package)) for package, shown in _PACKAGES.items()]
    return ", ".join(f"{name} {of}" for name, of in known if isinstance(of, str))


def _schedule(details: Mapping[str, Any]) -> str:
    name = facts_in(details.get("schedule")).get("name")
    if not isinstance(name, str):
        return "" if details else "chosen by a schedule that gym did not record"
    if name.startswith(_KEPT):
        rule = spaced(name.removeprefix(_KEPT))
        return f"{rule}; chosen after all episodes had ended"
    return _SCHEDULES.get(name, f"chosen by {name} before each began")


def _joined(*texts: Any) -> str:
    return ", ".join(text for text in texts if isinstance(text, str))
