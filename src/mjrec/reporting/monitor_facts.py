# SPDX-License-Identifier: Apache-2.0
"""Human-readable provenance and finished videos of monitors, from their files.

Facts that are missing from the files are left out. If a fact differs between monitors,
all values are listed.
"""

from __future__ import annotations

import datetime
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..evaluation.evaluation import Evaluation
from ..evaluation.plan import SEEDED, kwargs_as_text
from ..formats.json_fields import facts_in, field, integer, rate, read_object
from ..formats.manifest import GYM_VERSION
from ..formats.monitor_directory import episode_of, view_of
from ..formats.regular_files import regular_path
from ..formats.video_metadata import finished_videos, is_broken, metadata_path
from ..results.journal_or_stats import MonitorResults
from .contents import ReportVideo, end_times

T = TypeVar("T")
Pairs = Iterable[tuple[str, str]]

SELECTION: Final = "Selection of videos"

# In the order used on the page.
_LABELS: Final = (
    *("Environment", "Environment arguments", "Monitors", "Policy", "Protocol"),
    *("Seeds", "Episodes per seed", "Maximum steps per episode", SELECTION),
    *("Versions", "OpenGL renderer", "Recorded on", "Recorded"),
)
# Package names and their display names, in display order.
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
    "decided before each episode began",
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
_SHA256: Final = re.compile(r"[0-9a-f]{64}", re.ASCII)
_NUMBER: Final = re.compile(r"-?\d+", re.ASCII)
_MOST_PIXELS: Final = 1 << 15


def joined(pairs: Pairs) -> list[tuple[str, str]]:
    """Return each label with its distinct values, in the order used on the page.

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
    """Return the label and value for the machine on which a monitor recorded."""
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
    """Yield the provenance of one task's episodes in an evaluation."""
    plan = results.plan
    yield "Environment", task
    yield "Environment arguments", ", ".join(kwargs_as_text(plan.env_kwargs))
    yield "Policy", plan.policy_and_kwargs + " (an object)" * plan.is_object
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
    known = end_times(rows)
    known = known[~np.isnan(known)]
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
    return _SCHEDULES.get(name, f"chosen by {name} before each episode began")


def _joined(*texts: Any) -> str:
    return ", ".join(text for text in texts if isinstance(text, str))


def recorded_videos(
    results: MonitorResults, directory: Path, problems: list[str]
) -> list[ReportVideo]:
    """Return the existing finished videos of a monitor, without duplicates.

    These are the videos listed in the manifest and those finished after the manifest
    was written, from all cameras. Text recordings are included.

    Args:
        results: the monitor's results.
        directory: the directory with the monitor's files.
        problems: a list to which missing and unreadable files are added.
    """
    found: list[ReportVideo] = []
    for name in sorted(set(_names(results)), key=_order):
        path = directory / name
        facts: Mapping[str, Any] = {}
        try:
            regular_path(path)
        except (OSError, ValueError) as error:
            problems.append(f"The video {path} is left out: {_reason(error)}.")
            continue
        try:
            facts = read_object(metadata_path(path))
        except (OSError, ValueError) as error:
            problems.append(
                f"The metadata of {path} cannot be read: {_reason(error)}. The video "
                "is shown without it."
            )
        found.append(_video(path, facts, results))
    return found


def _names(results: MonitorResults) -> Iterator[str]:
    try:
        manifest = results.manifest
    except UnreadableFile:
        # Reading the episodes will also fail and report the error.
        manifest = None
    if manifest is not None:
        yield from (video for video, _ in manifest.videos)
    files = results.files
    for number in files.videos.keys() & files.metadata.keys():
        if not is_broken(files.metadata[number]):
            yield from (name for name, _ in finished_videos(files.videos[number]))


def _order(name: str) -> tuple[int, str, str]:
    # The first camera's video comes before the videos from other cameras.
    return episode_of(name) or 0, view_of(name), name


def _reason(error: Exception) -> object:
    return error.strerror if isinstance(error, OSError) else error


def _video(
    path: Path, facts: Mapping[str, Any], results: MonitorResults
) -> ReportVideo:
    episode_id = episode_of(path.name)
    if facts.get("first_step") is not None or "sub_environments" in facts:
        episode_id = None
    drawn_with = (facts.get("gl_renderer"), facts.get("gl_version"))
    texts = [text[:_LONGEST_TEXT] for text in drawn_with if isinstance(text, str)]
    sha256 = facts.get("file_sha256")
    is_hash = isinstance(sha256, str) and _SHA256.fullmatch(sha256)
    command = trajectory = None
    if episode_id is not None and facts.get("recording") == "deferred":
        trajectory = results.files.trajectories.get(episode_id)
        command = None if trajectory is None else _command(path, facts, trajectory)
    frames, fps = _known(facts, "frame_count", integer), _known(facts, "fps", rate)
    return ReportVideo(
        path=path,
        infix=results.files.infix,
        episode_id=episode_id,
        height=_known(facts, "height", _pixels),
        width=_known(facts, "width", _pixels),
        seconds=float(frames / fps) if frames and frames > 0 and fps else None,
        camera=_camera(facts.get("camera")),
        renderer=", ".join(texts) or None,
        sha256=sha256 if is_hash else None,
        command=command,
        notes=list(_notes(facts)),
        trajectory=trajectory,
    )


def _command(path: Path, facts: Mapping[str, Any], trajectory: Path) -> str | None:
    """Return the shell command that rerenders a video into a new file."""
    camera = facts.get("camera")
    options = []
    if view_of(path.name) and "tiled" not in facts:
        # The video is not from the first camera, so the command must name its camera.
        is_name = isinstance(camera, str) and not _NUMBER.fullmatch(camera)
        if not is_name and type(camera) is not int:
            return None
        options = [f"--camera={camera}"]
    # A file name may look like an option.
    target = f"./{trajectory}" if str(trajectory).startswith("-") else str(trajectory)
    return shlex.join(["mjrec", "render", target, *options, "--out", "again.mp4"])


def _notes(facts: Mapping[str, Any]) -> Iterator[str]:
    if facts.get("complete") is False:
        reason = facts.get("reason")
        why = reason if isinstance(reason, str) else "reason unknown"
        yield f"Incomplete: the episode was not over ({why[:_LONGEST_TEXT]})."
    if facts.get("first_step") is not None:
        yield "A clip, counted in steps: it may span several episodes."
    if "sub_environments" in facts:
        yield "Shows several sub-environments side by side."
    if facts.get("recording") == "live":
        yield "Recorded live: it cannot be rendered again from recorded states."
    if facts.get("quality") == "draft":
        yield "Rendered in draft quality."
    if "annotated" in facts:
        yield "Has captions on its frames."
    speed = facts.get("playback_speed")
    if isinstance(speed, float) and abs(speed - 1) > 1e-3:
        yield f"Plays at {speed:.3g} times the speed of the simulation."
    selection = facts.get("selection")
    if isinstance(selection, Mapping) and isinstance(selection.get("rule"), str):
        rule, among = (
            spaced(selection["rule"][:_LONGEST_TEXT]),
            selection.get("finished"),
        )
        of = f" from {among} episodes" if type(among) is int else ""
        if selection.get("decided") is True:
            yield f"Chosen by {rule}{of} after all episodes had ended."
        else:
            yield f"Kept because the run ended before {rule} could be applied."


def _known(facts: Mapping[str, Any], key: str, read: Callable[[Any], T]) -> T | None:
    """Return a field from the metadata; None if it is missing or invalid."""
    try:
        return field(facts, key, read)
    except ValueError:
        return None


def _pixels(value: Any) -> int:
    if not 0 < (count := integer(value)) <= _MOST_PIXELS:
        raise ValueError(value)
    return count


def _camera(camera: Any) -> str | None:
    match camera:
        case str():
            return camera[:_LONGEST_TEXT]
        case bool():
            return None
        case int():
            return "free camera" if camera == -1 else f"camera {camera}"
        case [_, *_]:
            return ", ".join(_camera(one) or "?" for one in camera[:100])
        case {"type": 1}:
            return "tracking camera"
        case {}:
            return "free camera"
    return None
