# SPDX-License-Identifier: Apache-2.0
"""Reading a run's inputs from an unpacked, untrusted archive.

This runs in a sandbox, because it parses journals and HDF5 files.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, get_args

from numpy.typing import NDArray

from .. import json_text
from ..errors import Error, UnreadableFile
from ..formats.journal import JournalEntry, read_journal
from ..formats.json_fields import (
    base_name,
    facts_in,
    from_json,
    read_object,
    unreadable,
)
from ..formats.manifest import read_manifest
from ..formats.monitor_directory import FILE_PREFIX, episode_of
from ..formats.regular_files import open_regular
from ..formats.trajectory import TrajectoryReader
from ..formats.trajectory_hdf5 import open_hdf5
from ..machine import machine_fingerprint
from ..provenance import versions
from ..recorder.monitored_run import What
from ..recorder.options import LIVE
from ..rendering.recorded_facts import asked_rate
from ..results.monitor_files import MonitorFiles, monitors_of
from ..results.run import EVALUATION
from .inputs import OPTIONS, Inputs, RecordingInputs, count
from .layout import ENVIRONMENT, RECORDINGS
from .packed_run import PackingOptions
from .portable_names import portable_parts

_SOURCES = re.compile(r"openaigym\.model\.[0-9a-f]{16}\.zip", re.ASCII)
_UNREADABLE = "Its inputs cannot be read"
_LONGEST_HEADER = 10_000
_MOST_EPISODES = 1_000_000
# Rows of states to read at once.
_ROWS = 10_000
# The keys of the journal's events about episodes of an evaluation.
_UNIT = ("seed", "episode")
_FAILED = (*_UNIT, "episode_id", "failure", "length", "start_time", "seconds")
# The keys of a provenance that recorders write, each with the fixed set of keys below
# it, if any.
_PROVENANCE: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("command", "working_directory", "python", "packages"), ()),
    **dict.fromkeys(("system", "variables"), ()),
    "machine": ("architecture", "libc", "cpu_flags", "tunables"),
    "cpu": ("model", "flags", "usable"),
    "code": ("root", "commit", "dirty", "remote"),
    "policy": ("file", "sha256"),
}
# The keys of a choice among an evaluation's episodes, in a video's facts and a journal.
_SELECTION = ("rule", "decided", "scope", "finished", "roles")
_EVALUATION_KEEP = (*_SELECTION[:-1], "chosen", "recorded", "recording")
_RATES = ("fps", "max_fps")
_FAULT = ("episode_id", "what", "reason")
# The facts of a trajectory that are inputs of its episode.
_FACTS = (
    *("type", "seed", "options", "random_state", "exception"),
    *("action_dtypes", "action_parts", "start_time", "end_time"),
)
# The facts of a completed episode that are inputs, whether it has a trajectory or not.
_OF_ENTRY = ("type", "seed", "options", "start_time", "end_time")
# The facts that are believed if the episode's actions were not kept.
_ENDS = ("reward", "terminated", "truncated", "success")


def read_inputs(data: Path) -> tuple[Inputs, dict[str, NDArray[Any]]]:
    """Return the inputs of a run and the arrays that they refer to.

    Args:
        data: the folder that contains the recordings and, for a packed run, its
            descriptions.

    Raises:
        Error: a file is damaged or contains invalid values.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        packing = _packing(data / ENVIRONMENT)
        monitors = list(monitors_of(data / RECORDINGS))
        strays = [files for files in monitors if packing and files.manifest is None]
        if strays:
            name = strays[0].paths[0].name
            raise ValueError(f"{name} does not belong to a recording with a manifest")
        recordings = [_recording(files, arrays) for files in monitors]
    except UnreadableFile as error:
        raise Error(f"{_UNREADABLE}: {error.path.name}: {error.reason}") from error
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise Error(f"{_UNREADABLE}: {error!s:.300}") from error
    inputs = Inputs(
        recordings=tuple(sorted(recordings, key=_begun)),
        packing=packing,
        planned=packing.get("planned"),
    )
    return inputs, arrays


def _begun(recording: RecordingInputs) -> tuple[float, str]:
    times = [e.start_time for e in recording.episodes if e.start_time is not None]
    return min(times, default=0.0), recording.infix


def _packing(path: Path) -> Mapping[str, Any]:
    if not path.exists():
        return {}
    with unreadable(path):
        said = facts_in(read_object(path).get("packed_with")).get("options")
        if not isinstance(said, Mapping):
            return {}
        packing_options(said)
    return said


def packing_options(said: Mapping[str, Any]) -> PackingOptions:
    """Return the packing options that an archive records.

    Raises:
        ValueError: an option is invalid.
    """
    try:
        options = from_json(PackingOptions, said)
    except ValueError as error:
        raise ValueError(f"its packing options are invalid: {error}") from error
    if len(portable_parts(options.name)) != 1:
        raise ValueError(f"{options.name!r:.80} is not a valid name for an archive")
    return options


def _recording(files: MonitorFiles, arrays: dict[str, NDArray[Any]]) -> RecordingInputs:
    journal = _Journal(files.journal)
    run: dict[str, Any] = next(reversed(journal.facts_of("run")), {})
    known = {key: run[key] for key in ("schedule", "first_episode_id") if key in run}
    environment = facts_in(run.get("environment")) or None
    return from_json(
        RecordingInputs,
        {
            **known,
            **_events(journal),
            "infix": files.infix,
            "env_id": str(facts_in(run.get("env_info")).get("env_id", "")),
            "environment": environment,
            "is_elsewhere": run.get("versions") != dict(versions()),
            "sources": _sources(files, environment),
            "options": _options(run.get("options")),
            "rule": facts_in(run.get("keep")).get("rule"),
            "monitor_csv_start": _monitor_csv_start(files),
            "episodes": list(_episodes(files, journal, environment, arrays)),
            "has_sources": any(
                path.suffix == ".zip"
                for path in (files.journal or Path()).parent.glob("openaigym.model.*")
            ),
        },
    )


def _monitor_csv_start(files: MonitorFiles) -> float | None:
    name = f"{FILE_PREFIX}.results.{files.infix}.monitor.csv"
    if files.journal is None or not (path := files.journal.with_name(name)).is_file():
        return None
    with open_regular(path) as file:
        header = file.readline(_LONGEST_HEADER).decode()
    start = json_text.loads(header.removeprefix("#")).get("t_start")
    return start if isinstance(start, int | float) else None


class _Journal:
    """The content of a journal.

    Args:
        path: the journal, or None if it is missing.

    Attributes:
        entries: its completed episodes, keyed by number.
        events: its other lines, each as the number of lines before it (not counting the
            first), its kind and its facts.
    """

    def __init__(self, path: Path | None) -> None:
        self.entries: dict[int, JournalEntry] = {}
        self.events: list[tuple[int, str, Any]] = []
        lines = 0

        def note(kind: str, facts: Any) -> None:
            nonlocal lines
            self.events.append((lines, kind, facts))
            lines += kind != "run"

        for entry in read_journal(path, on_event=note) if path else ():
            lines += 1
            self.entries[entry.episode_id] = entry
            if len(self.entries) > _MOST_EPISODES:
                raise ValueError(f"more than {_MOST_EPISODES} episodes")

    def facts_of(self, kind: str) -> list[dict[str, Any]]:
        """Return the facts of all events of one kind."""
        return [f for _, k, f in self.events if k == kind and isinstance(f, dict)]

    def of_episodes(self, kind: str) -> dict[int, list[dict[str, Any]]]:
        """Return the facts of all events of one kind, keyed by episode number."""
        found: dict[int, list[dict[str, Any]]] = {}
        for facts in self.facts_of(kind):
            if type(number := facts.get("episode_id")) is int:
                found.setdefault(number, []).append(facts)
        return found


def _events(journal: _Journal) -> dict[str, Any]:
    """Return the inputs that are events in a journal."""
    found: dict[str, Any] = {"faults": [], "evaluation_keeps": []}
    events = found["evaluation_events"] = []
    for before, kind, facts in journal.events:
        match kind, facts:
            case "provenance", dict():
                found["provenance"] = _provenance(facts)
                found["provenance_after"] = before
            case "begun", None:
                events.append([kind, None])
            case "begun" | "failed", dict():
                events.append([kind, _of_evaluation(kind, facts)])
            case "keep", {"scope": "evaluation", "chosen": list(numbers)}:
                known = {**facts, "chosen": [*map(count, numbers)]}
                found["evaluation_keeps"].append(_known(known, _EVALUATION_KEEP))
            case "keep", {"recorded": list(numbers)}:
                found["kept"] = [*map(count, numbers)]
            case "fault", {"episode_id": int() | None, "what": what, "reason": str()}:
                if what not in get_args(What):
                    raise ValueError(f"unknown kind of fault: {what!r:.80}")
                found["faults"].append([before, _known(facts, _FAULT)])
            case "recovered", _:
                found["was_killed"] = True
    return {**found, "clip_starts": sorted(_clip_starts(journal.facts_of("clip")))}


def _clip_starts(clips: Iterable[Mapping[str, Any]]) -> Iterator[int]:
    """Yield the numbers of the steps at which a trigger started clips."""
    for clip in clips:
        _, marker, number = str(clip.get("video")).rpartition(".step")
        digits = number.removesuffix(".mp4")
        if marker and digits.isdecimal():
            yield int(digits)


def _episodes(
    files: MonitorFiles,
    journal: _Journal,
    environment: Mapping[str, Any] | None,
    arrays: dict[str, NDArray[Any]],
) -> Iterator[dict[str, Any]]:
    """Yield the values of each episode's `EpisodeInputs`."""
    broken, cuts = _broken(files), journal.of_episodes("cut")
    irregular, faults = journal.of_episodes("action"), journal.of_episodes("fault")
    failed = {facts.get("episode_id"): facts for facts in journal.facts_of("failed")}
    is_wrapped = bool(facts_in(environment).get("wrappers"))
    for number in sorted({*journal.entries, *cuts}):
        known: dict[str, Any] = {}
        if number in files.trajectories:
            known = _of_trajectory(
                files.trajectories[number],
                name=f"{files.infix}.{number}",
                irregular=[e for e in irregular.get(number, []) if "step" in e],
                is_wrapped=is_wrapped,
                arrays=arrays,
            )
        if (entry := journal.entries.get(number)) is not None:
            lost = _lost(known, faults.get(number, ()), entry.length)
            known = {"steps": entry.length, **known, **_of_entry(entry), "lost": lost}
        elif number in cuts:
            cut = cuts[number][-1]
            known |= {
                "lost": _lost(known, faults.get(number, ())),
                "cut": str(cut.get("reason")),
                "is_chosen": cut.get("chosen") is True,
            }
            if number in failed:
                known["evaluation"] = _known(failed[number], _UNIT)
        yield {**known, "episode_id": number, "broken": broken.get(number, {})}


def _broken(files: MonitorFiles) -> dict[int, dict[str, list[Any]]]:
    """Return each episode's `EpisodeInputs.broken`, if any, keyed by episode number."""
    found: dict[int, dict[str, list[Any]]] = {}
    details = read_manifest(files.manifest).mjrec if files.manifest else None
    for name in map(base_name, (details or {}).get("broken") or ()):
        path, number = files.paths[0].with_name(name), episode_of(name)
        if number is None or not path.exists():
            continue
        with unreadable(path):
            said = read_object(path)
        # A deferred video is never cut short: its states are kept to render it again.
        if said.get("recording") == LIVE and said.get("broken") is True:
            video = name.removesuffix(".meta.json")
            reason, frames = str(said.get("broken_reason")), said.get("frame_count", 0)
            found.setdefault(number, {})[video] = [reason, count(frames)]
    return found


def _lost(
    trajectory: Mapping[str, Any],
    faults: Iterable[Mapping[str, Any]],
    length: int | None = None,
) -> list[Any] | None:
    """Return an episode's `EpisodeInputs.lost`.

    Args:
        trajectory: what is known from its trajectory.
        faults: the faults in the journal for this episode.
        length: its number of steps; None if it was cut off.
    """
    steps, stated = trajectory.get("steps", 0), facts_in(trajectory.get("exception"))
    missing = 1 if length is None else length - steps
    for fault in faults:
        is_its = not trajectory or stated.get("message") == fault.get("reason")
        if fault.get("what") == "trajectory" and is_its and missing > 0:
            return [str(fault.get("reason")), missing]
    return None


def _of_entry(entry: JournalEntry) -> dict[str, Any]:
    evaluation, facts = entry.evaluation or {}, vars(entry)
    return {
        **_known(facts, _OF_ENTRY),
        "is_chosen": entry.chosen,
        "believed": _known(facts, _ENDS),
        "evaluation": {k: evaluation.get(k) for k in _UNIT} if evaluation else None,
    }


def _of_trajectory(
    path: Path,
    *,
    name: str,
    irregular: list[dict[str, Any]],
    is_wrapped: bool,
    arrays: dict[str, NDArray[Any]],
) -> dict[str, Any]:
    with open_hdf5(path) as reader:
        facts, steps = reader.facts, reader.step_count
        if (actions := reader.actions(0, steps)) is not None:
            arrays[name] = actions
        if reader.kind("state") is not None:
            if facts.get("seed") is None and facts.get("random_state") is None:
                arrays[f"{name}.state"] = reader.read("state", 0, 1)
            if _is_elsewhere(facts):
                arrays[f"{name}.states"] = reader.read("state", 0, reader.row_count)
        for part, values in _steps_taken(reader) if is_wrapped else ():
            arrays[f"{name}.{part}"] = values
        played = _played(reader)
    return {
        **_known(facts, _FACTS),
        "steps": steps,
        "arrays": name,
        "played": played,
        # If no action fits into an array, all actions are in the journal.
        "has_actions": name in arrays or len(irregular) == steps,
        "irregular": irregular,
        "selection": _selection(facts.get("video")),
        "has_trajectory": facts.get("kept") is not False,
    }


def _played(reader: TrajectoryReader) -> str | None:
    """Return the `EpisodeInputs.played` of a trajectory."""
    names = getattr(reader.kind("state"), "names", None) or ()
    if "qpos" not in names:
        return None
    digest = hashlib.sha256(_unsigned(reader.rewards))
    for start in range(0, reader.row_count, _ROWS):
        rows = reader.read("state", start, min(start + _ROWS, reader.row_count))
        for part in (each for each in ("qpos", "qvel") if each in names):
            digest.update(_unsigned(rows[part]))
    return digest.hexdigest()


def _unsigned(values: NDArray[Any]) -> bytes:
    """Return the bytes of numbers without the signs of zeros."""
    return bytes((values + 0.0).tobytes())


def _is_elsewhere(facts: Mapping[str, Any]) -> bool:
    """Return whether the facts claim a different MuJoCo version or machine."""
    version = facts_in(facts.get("versions")).get("mujoco")
    return version != versions().get("mujoco") or (
        facts.get("machine") != machine_fingerprint()
    )


def _steps_taken(reader: TrajectoryReader) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the parts of `RecordedSteps`; none if controls are not recorded."""
    kind = reader.kind("state")
    if kind is not None and "ctrl" in (kind.names or ()):
        yield "controls", reader.read("state", 1, reader.row_count)["ctrl"]
        for part in ("rewards", "terminated", "truncated"):
            yield part, getattr(reader, part)


def _of_evaluation(kind: str, facts: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the recognized keys of an event about an episode of an evaluation."""
    if not all(type(facts.get(name)) is int for name in _UNIT):
        raise ValueError(
            f"{facts!r:.200} does not identify an episode of an evaluation"
        )
    return _known(facts, _UNIT if kind == "begun" else _FAILED)


def _selection(video: Any) -> Mapping[str, Any] | None:
    said = facts_in(facts_in(video).get("selection"))
    return _known(said, _SELECTION) if said.get("scope") == EVALUATION else None


def _provenance(said: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a provenance without the keys that recorders do not write."""
    known: dict[str, Any] = {}
    for key, value in _known(said, _PROVENANCE).items():
        inner = _PROVENANCE[key]
        is_nested = inner and isinstance(value, Mapping)
        known[key] = _known(value, inner) if is_nested else value
    return known


def _known(said: Mapping[str, Any], keys: Collection[str]) -> dict[str, Any]:
    """Return the values of known keys; other values cannot be recreated."""
    return {key: value for key, value in said.items() if key in keys}


def _sources(files: MonitorFiles, environment: Mapping[str, Any] | None) -> str | None:
    if not environment or environment["framework"] != "mjcf" or not files.trajectories:
        return None
    with open_hdf5(files.trajectories[min(files.trajectories)]) as reader:
        name = facts_in(reader.facts.get("model")).get("xml")
    return name if isinstance(name, str) and _SOURCES.fullmatch(name) else None


def _options(said: Any) -> dict[str, Any]:
    if not isinstance(said, Mapping):
        return {}
    for name, value in said.items():
        is_known = name in OPTIONS and type(value) in OPTIONS[name]
        if not is_known or (name in _RATES and not _is_rate(value)):
            raise ValueError(f"the option {name!r:.80} must not be {value!r:.80}")
    return dict(said)


def _is_rate(value: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(asked_rate(value))
    return False
