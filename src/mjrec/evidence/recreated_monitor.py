# SPDX-License-Identifier: Apache-2.0
"""Construction of the monitor that records a run again, from a recording's inputs."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

from ..environments.recreate import NotRecreated, Recreated
from ..errors import Error, InvalidArgument
from ..monitors.base import EnvironmentMonitor
from ..monitors.monitor import monitored
from ..recorder.keep_rules import RULES, keep_rule
from ..recorder.options import JOIN, RecorderOptions, Statements
from ..schedules import Schedule, schedule_from_text
from ..trackers.monitor_csv import MonitorCsvTracker
from .excuses import note
from .findings import Finding
from .inputs import RecordingInputs

# mjrec's own schedules, keyed by their names in a journal. They are applied again.
_SCHEDULES = {
    "capped_cubic_video_schedule": "cubic",
    "record_all": "all",
    "disable_videos": "none",
}
# Options whose values in a journal are those given to the recorder.
_UNCHANGED = (
    *("quality", "render", "observations", "video_length", "name_prefix", "seed"),
    *("annotate", "tiled"),
)
_SCHEDULE = re.compile(r"(every|at):[\d,]+", re.ASCII)


def recreated_monitor(
    recording: RecordingInputs,
    recreated: Recreated,
    directory: Path,
    *,
    clock: Callable[[], float],
    notes: list[Finding],
) -> EnvironmentMonitor:
    """Return a monitor with the options of the recording's monitor.

    Args:
        recording: the recording's inputs.
        recreated: the recording's environment.
        directory: the monitor directory, which may already contain other recordings of
            the same run.
        clock: returns the time, in seconds since the epoch.
        notes: receives the author's choices, which are believed.

    Raises:
        NotRecreated: an option is invalid, or the monitor cannot be created.
    """
    given, start = recording.options, recording.monitor_csv_start
    try:
        options = RecorderOptions(
            video_callable=_schedule(recording, notes),
            keep=_rule(recording, notes),
            resume=JOIN,
            fps=_rate(given.get("fps")),
            max_fps=_rate(given.get("max_fps")),
            # Videos are rendered after all recordings have been replayed.
            workers=0,
            trajectory_callable=_trajectories(recording),
            allow_early_reset=True,
            step_trigger=_step_trigger(recording, notes),
            **{name: value for name, value in given.items() if name in _UNCHANGED},
            trackers=() if start is None else MonitorCsvTracker(clock=lambda: start),
            statements=Statements(
                infix=recording.infix,
                first_episode_id=recording.first_episode_id,
                provenance=recording.provenance,
                provenance_after=recording.provenance_after,
                clock=clock,
                faults=recording.faults,
            ),
        )
        view = {name: given.get(name) for name in ("camera", "height", "width")}
        env, env_id = recreated.environment, recording.env_id
        monitor = monitored(env, directory, options, env_id=env_id, **view)
        # A recording never has a vector environment.
        return cast("EnvironmentMonitor", monitor)
    except (Error, TypeError, ValueError) as error:
        raise NotRecreated(
            f"it cannot be recorded with its options: {error!s:.300}"
        ) from error


def _schedule(recording: RecordingInputs, notes: list[Finding]) -> Schedule | None:
    name = recording.schedule or ""
    if recording.rule is not None or "step_trigger" in recording.options:
        return None
    if name in _SCHEDULES or _SCHEDULE.fullmatch(name):
        return schedule_from_text(_SCHEDULES.get(name, name))
    chosen = {each.episode_id for each in recording.episodes if each.is_chosen}
    notes.append(_choice(recording, "schedule", f"the schedule {name!r:.80}"))
    return _named(name, chosen.__contains__)


def _rule(recording: RecordingInputs, notes: list[Finding]) -> Any:
    name = recording.rule
    if name is None:
        return None
    with contextlib.suppress(InvalidArgument):
        return keep_rule(name, RULES).name
    notes.append(_choice(recording, "rule", f"the rule {name!r:.80}"))
    return _named(name, lambda _: recording.kept)


def _trajectories(recording: RecordingInputs) -> Callable[[int], bool] | bool | None:
    asked = recording.options.get("trajectories")
    if not isinstance(asked, str):
        return asked
    kept = {each.episode_id for each in recording.episodes if each.has_trajectory}
    return _named(asked, kept.__contains__)


def _step_trigger(
    recording: RecordingInputs, notes: list[Finding]
) -> Callable[[int], bool] | None:
    name = recording.options.get("step_trigger")
    if name is None:
        return None
    starts = recording.clip_starts
    chooser = f"{name!r:.80}, which started clips,"
    choice = _choice(recording, "schedule", chooser, what="steps")
    notes.append(dataclasses.replace(choice, count=len(starts), unit="clip"))
    return _named(name, set(starts).__contains__)


def _choice(
    recording: RecordingInputs, excuse: str, chooser: str, *, what: str = "episodes"
) -> Finding:
    """Return the note that a choice by a function of the author is believed."""
    reason = (
        f"{chooser} is the author's own function; that it chose these {what} is "
        "believed"
    )
    return note(recording.name, excuse, reason, count=len(recording.episodes))


def _named(name: str, function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function that is recorded in files under a given name."""

    def named(what: Any) -> Any:
        return function(what)

    named.__qualname__ = name
    return named


def _rate(text: str | None) -> float | Fraction | None:
    """Return a rate with its original type, so that it is written the same way."""
    if text is None:
        return None
    is_float = "." in text or "e" in text
    return float(text) if is_float else Fraction(text)
