# SPDX-License-Identifier: Apache-2.0
"""Whether the videos are those that the recorded rule names: no cherry-picking.

A rule of ours is asked again, about every episode. A function of the user's is not
here to be asked, but it was, before each episode began: the manifest has its answers,
and the videos must be theirs.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from ...errors import InvalidArgument, UnreadableFile
from ...formats.journal import JournalEntry
from ...formats.monitor_directory import Infix, video_prefix
from ...formats.trajectory_file import open_trajectory
from ...recorder.keep_rules import Selection, selection_from
from ...recorder.tracking import FinishedEpisode
from ...results.run import EVALUATION
from ...schedules import (
    Schedule,
    capped_cubic_video_schedule,
    disable_videos,
    record_all,
    schedule_from_text,
    schedule_name,
)
from ..verification import Check, Level, Verdict
from .findings import Findings
from .recorded_monitors import RecordedMonitor, RecordedVideo

_CLAIM = "the episodes with a video are those that the schedule names"
_VIDEOS_CLAIM = "there is a video of each episode that was to have one, and of no other"

_BY_NAME: Mapping[str, Schedule] = {
    schedule_name(schedule): schedule
    for schedule in (capped_cubic_video_schedule, disable_videos, record_all)
}
_WITH_NUMBERS = re.compile(r"every:\d{1,15}|at:\d{1,15}(,\d{1,15}){0,9999}", re.ASCII)
_KEEP = "keep:"
_RULE = re.compile(r"(best|worst|failures):\d{1,18}|failures|median", re.ASCII)

# Numbers of begun episodes, each of which a schedule is asked about.
_MOST_ASKED = 10_000_000
_MOST_NUMBERS = 20

_LEFT_OUT = "they were left out when it was packed (--episodes)"


def check_choice(monitor: RecordedMonitor) -> Iterator[Check]:
    """Yield what is found about which episodes of a monitor have a video."""
    recording = f"recording {monitor.infix}"
    if monitor.manifest is None:
        return
    if monitor.manifest.mjrec is None:
        yield _unknown(recording, "its manifest is not mjrec's and names no schedule")
        return
    said = monitor.details.get("schedule")
    name = said.get("name") if isinstance(said, Mapping) else None
    recorded = _numbers(said.get("recorded")) if isinstance(said, Mapping) else None
    if not isinstance(name, str) or recorded is None:
        reason = "its manifest does not say by which schedule episodes were chosen"
        is_recovered = monitor.details.get("recovered") is True
        yield _check(
            recording,
            Verdict.NOT_CHECKABLE if is_recovered else Verdict.FAIL,
            f"{reason}; its process was killed" if is_recovered else reason,
        )
    else:
        yield _check_rule(monitor, name, recorded)
    yield from _check_videos(monitor, recorded)


def _check_rule(monitor: RecordedMonitor, name: str, recorded: Sequence[int]) -> Check:
    recording = f"recording {monitor.infix}"
    if name.startswith(_KEEP):
        return _check_selection(monitor, name.removeprefix(_KEEP), recorded)
    schedule = _schedule(name)
    if schedule is None:
        return _unknown(
            recording,
            f"a function of the user's chose, {name[:100]!r}, which is not here to be "
            f"asked again; it chose {_listed(recorded)}",
        )
    asked = _asked(monitor)
    if asked is None:
        return _check(
            recording, Verdict.FAIL, "its manifest does not say which episodes it began"
        )
    expected = [number for number in asked if schedule(number)]
    if list(recorded) == expected:
        return _check(
            recording,
            Verdict.PASS,
            f"{name}: of the episodes {asked.start} to {asked.stop - 1}, "
            f"{_listed(expected)}",
            schedule=name,
            episodes=len(asked),
            chosen=len(expected),
        )
    if monitor.details.get("recovered") is True and set(recorded) < set(expected):
        return _unknown(
            recording,
            f"{name} chooses {_listed(expected)}, and what its killed process left "
            f"speaks of {_listed(recorded)}",
        )
    return _check(
        recording,
        Verdict.FAIL,
        f"{name} chooses {_listed(expected)} of the episodes {asked.start} to "
        f"{asked.stop - 1}, and the manifest says {_listed(recorded)}",
    )


def _check_selection(
    monitor: RecordedMonitor, rule: str, recorded: Sequence[int]
) -> Check:
    recording = f"recording {monitor.infix}"
    keep = monitor.details.get("keep")
    keep = keep if isinstance(keep, Mapping) else {}
    if keep.get("rule") != rule:
        return _check(
            recording,
            Verdict.FAIL,
            f"its manifest names two rules, {rule!r:.99} and {keep.get('rule')!r:.99}",
        )
    if keep.get("decided") is not True:
        return _unknown(
            recording,
            f"{rule[:100]} had not decided when the recording ended: what is there is "
            "what was not thrown away yet",
        )
    if list(recorded) != _numbers(keep.get("chosen")):
        return _check(
            recording, Verdict.FAIL, "its manifest names two choices of one rule"
        )
    if keep.get("scope") == EVALUATION:
        return _unknown(
            recording,
            f"{rule[:100]} was asked about all episodes of an evaluation, of whichever "
            "recording, and nothing here says which these were; of this recording it "
            f"chose {_listed(recorded)}",
        )
    selection = _selection(rule)
    if selection is None:
        return _unknown(
            recording,
            f"a function of the user's chose, {rule[:100]!r}, which is not here to be "
            f"asked again; it chose {_listed(recorded)}",
        )
    if monitor.entries is None:
        return _unknown(recording, "there is no journal of its episodes")
    chosen = _chosen(selection, monitor.entries)
    if chosen == list(recorded):
        return _check(
            recording,
            Verdict.PASS,
            f"{rule} of {len(monitor.entries)} episodes: {_listed(chosen)}",
            schedule=f"{_KEEP}{rule}",
            episodes=len(monitor.entries),
            chosen=len(chosen),
        )
    return _check(
        recording,
        Verdict.FAIL,
        f"{rule} of {len(monitor.entries)} episodes is {_listed(chosen)}, and the "
        f"manifest says {_listed(recorded)}",
    )


def _chosen(selection: Selection, entries: Iterable[JournalEntry]) -> list[int]:
    for entry in entries:
        selection.add(_finished(entry))
    selection.close()
    return selection.chosen


def _finished(entry: JournalEntry) -> FinishedEpisode:
    return FinishedEpisode(
        episode_id=entry.episode_id,
        length=entry.length,
        reward=entry.reward,
        type=entry.type,
        terminated=entry.terminated,
        truncated=entry.truncated,
        success=entry.success,
        seed=None,
        options=None,
        start_time=entry.start_time,
        end_time=entry.end_time,
        total_steps=0,
    )


def _schedule(name: str) -> Schedule | None:
    """Return the schedule of ours that has a name."""
    if name in _BY_NAME:
        return _BY_NAME[name]
    if not _WITH_NUMBERS.fullmatch(name):
        return None
    try:
        return schedule_from_text(name)
    except InvalidArgument:
        return None


def _selection(rule: str) -> Selection | None:
    if not _RULE.fullmatch(rule):
        return None
    try:
        return selection_from(rule)
    except InvalidArgument:
        return None


def _asked(monitor: RecordedMonitor) -> range | None:
    """Return the numbers that the schedule was asked about."""
    first = monitor.details.get("first_episode_id")
    following = monitor.details.get("next_episode_id")
    if type(first) is not int or type(following) is not int:
        return None
    if not 0 <= first <= following <= first + _MOST_ASKED:
        return None
    return range(first, following)


def _check_videos(
    monitor: RecordedMonitor, recorded: Sequence[int] | None
) -> Iterator[Check]:
    """Compare the decisions with the videos that are there."""
    found = Findings(Level.STATS, _VIDEOS_CLAIM, whole=f"recording {monitor.infix}")
    wanted = set(recorded or ())
    by_episode = {video.episode_id: video for video in monitor.videos if video.is_main}
    left_out = _left_out(monitor, wanted)
    # Episodes by the reason why they have none.
    lacking: dict[str, list[int]] = {}
    for number in sorted(wanted):
        subject = f"episode {number} of {monitor.infix}"
        if number in left_out:
            lacking.setdefault(_LEFT_OUT, []).append(number)
        elif number in by_episode or _is_inside_clip(monitor.videos, number):
            found.look(subject)
        elif reason := _reason_for_none(monitor, number):
            lacking.setdefault(reason, []).append(number)
        else:
            found.look(
                subject, "it was to have a video, and there is none, nor a reason"
            )
    for reason, numbers in lacking.items():
        found.cannot_tell(f"there is no video of episodes {_listed(numbers)}: {reason}")
    for number, video in sorted(by_episode.items()):
        if recorded is not None and number not in wanted:
            found.look(video.name, "no schedule chose its episode")
    later = {
        video.episode_id
        for video in monitor.videos
        if not video.is_main and not video.is_clip and video.is_there
    }
    if later - wanted:
        found.cannot_tell(
            f"of episodes {_listed(sorted(later - wanted))}, which no schedule chose, "
            "there are videos that were rendered later, of somebody's choice"
        )
    by_steps = sum(not video.is_main and video.is_clip for video in monitor.videos)
    if by_steps:
        found.cannot_tell(
            f"{by_steps} videos begin at steps that a function of the user's chose "
            "(step_trigger), which is not here to be asked again"
        )
    for number, path in sorted(monitor.files.trajectories.items()):
        found.look(path.name, _objection_to_promise(monitor, number))
    yield from found.checks(passed=_listed(sorted(wanted)))


def _objection_to_promise(monitor: RecordedMonitor, number: int) -> str | None:
    """Return what is wrong with the video that a trajectory names."""
    try:
        with open_trajectory(monitor.files.trajectories[number]) as reader:
            promise = reader.facts.get("video")
    except UnreadableFile:
        # That is found elsewhere.
        return None
    infix = Infix.parse(monitor.infix)
    if not isinstance(promise, Mapping) or infix is None:
        return None
    expected = f"{video_prefix(infix, number)}.mp4"
    if promise.get("name") == expected:
        return None
    return f"it says that its video is {promise.get('name')!r:.200}, not {expected}"


def _left_out(monitor: RecordedMonitor, wanted: set[int]) -> set[int]:
    """Return the episodes that whoever packed it chose to leave out."""
    packed = _numbers(monitor.details.get("packed_episodes"))
    return set() if packed is None else wanted - set(packed)


def _reason_for_none(monitor: RecordedMonitor, number: int) -> str | None:
    for entry in _mappings(monitor.details.get("pending")):
        if entry.get("episode_id") == number:
            return "it is still to be rendered: mjrec render"
    for fault in _mappings(monitor.details.get("faults")):
        if fault.get("episode_id") == number:
            return f"{fault.get('what')}: {fault.get('reason')}"[:300]
    following = monitor.details.get("next_episode_id")
    last = monitor.entries[-1].episode_id if monitor.entries else -1
    if type(following) is int and last < number == following - 1:
        return "it was begun, and closed before its first step"
    return None


def _is_inside_clip(videos: Iterable[RecordedVideo], number: int) -> bool:
    """Tell whether a video that is counted in steps was running when it began."""
    return any(
        video.is_clip
        and type(last := video.metadata.get("last_episode_id")) is int
        and video.episode_id < number <= last
        for video in videos
    )


def _mappings(value: Any) -> list[Mapping[str, Any]]:
    entries = value if isinstance(value, list) else []
    return [entry for entry in entries if isinstance(entry, Mapping)]


def _numbers(value: Any) -> list[int] | None:
    if not isinstance(value, list) or any(type(item) is not int for item in value):
        return None
    return value


def _listed(numbers: Sequence[int]) -> str:
    shown = ", ".join(map(str, numbers[:_MOST_NUMBERS])) or "none"
    more = len(numbers) - _MOST_NUMBERS
    return f"{shown} and {more} more" if more > 0 else shown


def _unknown(subject: str, reason: str) -> Check:
    return _check(subject, Verdict.NOT_CHECKABLE, reason)


def _check(subject: str, verdict: Verdict, reason: str, **figures: Any) -> Check:
    return Check(
        level=Level.STATS,
        claim=_CLAIM,
        subject=subject,
        verdict=verdict,
        reason=reason,
        figures=figures,
    )
