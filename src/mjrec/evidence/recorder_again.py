# SPDX-License-Identifier: Apache-2.0
"""Construction of the monitor that records a run again, from a recording's inputs."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

from ..environments.recreate import NotRecreated, Recreated
from ..errors import Error, InvalidArgument
from ..monitors.base import EnvironmentMonitor
from ..monitors.monitor import monitored
from ..recorder.keep_rules import RULES, keep_rule
from ..recorder.opening import JOIN, Statements
from ..recorder.options import RecorderOptions
from ..recorder.tracking import FinishedEpisode, Tracker
from ..schedules import Schedule, schedule_from_text
from ..trackers.monitor_csv import MonitorCsvTracker
from .inputs import RecordingInputs
from .notes import Notes

# mjrec's own schedules by their names in a journal. They choose episodes again.
_SCHEDULES = {
    "capped_cubic_video_schedule": "cubic",
    "record_all": "all",
    "disable_videos": "none",
}
_SCHEDULE = re.compile(r"(every|at):[\d,]+", re.ASCII)


def monitor_again(
    recording: RecordingInputs,
    recreated: Recreated,
    directory: Path,
    *,
    clock: Callable[[], float],
    only_counted: bool,
    notes: Notes,
) -> EnvironmentMonitor:
    """Return a monitor with the options of the recording's monitor.

    Args:
        recording: the recording's inputs.
        recreated: the recording's environment.
        directory: the monitor directory, which may already contain other recordings of
            the same run.
        clock: returns the time, in seconds since the epoch.
        only_counted: record only rewards and ends.
        notes: receives the author's choices, which are believed.

    Raises:
        NotRecreated: an option is invalid, or the monitor cannot be created.
    """
    given = recording.options
    try:
        options = RecorderOptions(
            video_callable=_schedule(recording, notes),
            keep=_rule(recording, notes),
            resume=JOIN,
            fps=_rate(given.get("fps")),
            max_fps=_rate(given.get("max_fps")),
            quality=given.get("quality", "full"),
            render=given.get("render"),
            # Videos are rendered after all recordings have been replayed.
            workers=0,
            trajectory_callable=_trajectories(recording),
            observations=given.get("observations", False),
            allow_early_reset=True,
            step_trigger=_step_trigger(recording, notes),
            video_length=given.get("video_length"),
            name_prefix=given.get("name_prefix"),
            seed=given.get("seed"),
            annotate=given.get("annotate", False),
            tiled=given.get("tiled", False),
            trackers=_trackers(recording),
            statements=Statements(
                infix=recording.own_infix,
                first_episode_id=recording.first_episode_id,
                provenance=recording.provenance,
                provenance_after=recording.provenance_after,
                clock=clock,
                faults=recording.faults,
                only_counted=only_counted,
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


def _schedule(recording: RecordingInputs, notes: Notes) -> Schedule | None:
    name = recording.schedule or ""
    if recording.rule is not None or "step_trigger" in recording.options:
        return None
    if name in _SCHEDULES or _SCHEDULE.fullmatch(name):
        return schedule_from_text(_SCHEDULES.get(name, name))
    chosen = {each.episode_id for each in recording.episodes if each.is_chosen}
    _believe_choice(recording, notes, "schedule", f"the schedule {name!r:.80}")
    return _named(name, chosen.__contains__)


def _rule(
    recording: RecordingInputs, notes: Notes
) -> str | Callable[[Sequence[FinishedEpisode]], Iterable[int]] | None:
    name = recording.rule
    if name is None:
        return None
    with contextlib.suppress(InvalidArgument):
        return keep_rule(name, RULES).name
    _believe_choice(recording, notes, "rule", f"the rule {name!r:.80}")
    return _named(name, lambda _: recording.kept)


def _trajectories(recording: RecordingInputs) -> Callable[[int], bool] | bool | None:
    asked = recording.options.get("trajectories")
    if not isinstance(asked, str):
        return asked
    kept = {each.episode_id for each in recording.episodes if each.has_trajectory}
    return _named(asked, kept.__contains__)


def _step_trigger(
    recording: RecordingInputs, notes: Notes
) -> Callable[[int], bool] | None:
    name = recording.options.get("step_trigger")
    if name is None:
        return None
    starts = set(recording.clip_starts)
    _believe_choice(
        recording,
        notes,
        "schedule",
        f"{name!r:.80}, which started clips,",
        what="steps",
        count=len(recording.clip_starts),
        unit="clip",
    )
    return _named(name, starts.__contains__)


def _believe_choice(
    recording: RecordingInputs,
    notes: Notes,
    excuse: str,
    chooser: str,
    *,
    what: str = "episodes",
    **counted: Any,
) -> None:
    """Note that a choice by a function of the author is believed."""
    counted = counted or {"count": len(recording.episodes)}
    reason = f"{chooser} is the author's own function; that it chose these {what} is "
    notes.add(recording.name, excuse, f"{reason}believed", **counted)


def _trackers(recording: RecordingInputs) -> Sequence[Tracker]:
    start = recording.monitor_csv_start
    return () if start is None else [MonitorCsvTracker(clock=lambda: start)]


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
