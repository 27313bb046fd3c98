# SPDX-License-Identifier: Apache-2.0
"""Reading of a run's inputs from an unpacked, untrusted archive.

It is done in a sandbox, because journals and HDF5 files are parsed.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from .. import json_text
from ..errors import Error, UnreadableFile
from ..formats.journal import JournalEntry, read_journal
from ..formats.json_fields import base_name, from_json, read_object, unreadable
from ..formats.manifest import read_manifest
from ..formats.monitor_directory import FILE_PREFIX, episode_of
from ..formats.regular_files import open_regular
from ..formats.trajectory import TrajectoryReader
from ..formats.trajectory_hdf5 import open_hdf5
from ..machine import machine_fingerprint
from ..provenance import versions
from ..recorder.options import LIVE
from ..results.monitor_files import MonitorFiles, monitors_of
from ..results.run import EVALUATION
from .inputs import OPTIONS, EpisodeInputs, Inputs, RecordingInputs
from .layout import ENVIRONMENT, RECORDINGS
from .packed_run import PackingOptions
from .portable_names import portable_parts

_SOURCES = re.compile(r"openaigym\.model\.[0-9a-f]{16}\.zip", re.ASCII)
_UNREADABLE = "Its inputs cannot be read"
_LONGEST_HEADER = 10_000
_MOST_EPISODES = 1_000_000
# The keys of the journal's events of an evaluation's episodes.
_UNIT = ("seed", "episode")
_FAILED = (*_UNIT, "episode_id", "failure", "length", "start_time", "seconds")
# The keys of a provenance that a recorder writes, and those below them if they are
# always the same.
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
_FAULT = ("episode_id", "what", "reason")
_DTYPES = frozenset(
    f"{kind}{bits}" for kind in ("float", "int", "uint") for bits in (8, 16, 32, 64)
) | {"bool"}


def read_inputs(data: Path) -> tuple[Inputs, dict[str, NDArray[Any]]]:
    """Return the inputs of a run and the arrays that they name.

    Args:
        data: the folder that contains the recordings and, for a packed run, its
            descriptions.

    Raises:
        Error: a file is damaged or contains invalid values.
    """
    arrays: dict[str, NDArray[Any]] = {}
    try:
        packing = _packing(data / ENVIRONMENT)
        monitors = monitors_of(data / RECORDINGS)
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
        packed_with = read_object(path).get("packed_with")
        said = packed_with.get("options") if isinstance(packed_with, Mapping) else None
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
    run = journal.run
    env_info, keep = run.get("env_info"), run.get("keep")
    environment = run.get("environment")
    return RecordingInputs(
        infix=files.infix,
        env_id=str(env_info.get("env_id")) if isinstance(env_info, Mapping) else "",
        environment=environment if isinstance(environment, Mapping) else None,
        sources=_sources(files, environment),
        options=_options(run.get("options")),
        schedule=_text(run.get("schedule")),
        rule=_text(keep.get("rule")) if isinstance(keep, Mapping) else None,
        first_episode_id=_count(run.get("first_episode_id", 0)),
        kept=journal.kept,
        clip_starts=tuple(sorted(journal.clip_starts())),
        episodes=tuple(_episodes(files, journal, arrays)),
        evaluation_events=tuple(journal.evaluation_events),
        evaluation_keeps=tuple(journal.evaluation_keeps),
        faults=tuple(journal.faults),
        monitor_csv_start=_monitor_csv_start(files),
        provenance=journal.provenance,
        provenance_after=journal.provenance_after,
        was_killed=journal.was_killed,
        has_sources=any(
            path.suffix == ".zip"
            for path in (files.journal or Path()).parent.glob("openaigym.model.*")
        ),
    )


def _monitor_csv_start(files: MonitorFiles) -> float | None:
    name = f"{FILE_PREFIX}.results.{files.infix}.monitor.csv"
    if files.journal is None or not (path := files.journal.with_name(name)).is_file():
        return None
    with open_regular(path) as file:
        header = file.readline(_LONGEST_HEADER).decode()
    return _time(json_text.loads(header.removeprefix("#")).get("t_start"))


class _Journal:
    """The content of a journal.

    Args:
        path: the journal, or None if it is missing.
    """

    def __init__(self, path: Path | None) -> None:
        self.run: Mapping[str, Any] = {}
        self.provenance: Mapping[str, Any] | None = None
        self.provenance_after = self._lines = 0
        self.entries: dict[int, JournalEntry] = {}
        self.cuts: dict[int, Mapping[str, Any]] = {}
        self.irregular: dict[int, list[Mapping[str, Any]]] = {}
        self.clips: list[Mapping[str, Any]] = []
        self.evaluation_events: list[tuple[str, Mapping[str, Any] | None]] = []
        self.evaluation_keeps: list[Mapping[str, Any]] = []
        self.faults: list[tuple[int, Mapping[str, Any]]] = []
        self.kept: tuple[int, ...] = ()
        self.was_killed = False
        if path is None:
            return
        for entry in read_journal(path, on_event=self._note):
            self._lines += 1
            self.entries[entry.episode_id] = entry
            if len(self.entries) > _MOST_EPISODES:
                raise ValueError(f"more than {_MOST_EPISODES} episodes")

    def clip_starts(self) -> Iterator[int]:
        """Yield the numbers of the steps at which a trigger started clips."""
        for clip in self.clips:
            _, marker, number = str(clip.get("video")).rpartition(".step")
            digits = number.removesuffix(".mp4")
            if marker and digits.isdecimal():
                yield int(digits)

    def failed_unit(self, number: int) -> Mapping[str, Any] | None:
        """Return the seed and episode of an evaluation's failed episode, or None."""
        for kind, facts in self.evaluation_events:
            if kind == "failed" and facts and facts.get("episode_id") == number:
                return {name: facts[name] for name in _UNIT}
        return None

    def _note(self, kind: str, facts: Any) -> None:
        self._note_facts(kind, facts)
        self._lines += kind != "run"

    def _note_facts(self, kind: str, facts: Any) -> None:
        match kind, facts:
            case "run", dict():
                self.run = facts
            case "provenance", dict():
                self.provenance = _provenance(facts)
                self.provenance_after = self._lines
            case "cut", {"episode_id": int(number)}:
                self.cuts[number] = facts
            case "action", {"episode_id": int(number), "step": int()}:
                self.irregular.setdefault(number, []).append(facts)
            case "clip", dict():
                self.clips.append(facts)
            case "begun", None:
                self.evaluation_events.append((kind, None))
            case "begun" | "failed", dict():
                self.evaluation_events.append((kind, _of_evaluation(kind, facts)))
            case "keep", {"scope": "evaluation", "chosen": list(numbers)}:
                known = {**facts, "chosen": [*map(_count, numbers)]}
                self.evaluation_keeps.append(_known(known, _EVALUATION_KEEP))
            case "keep", {"recorded": list(numbers)}:
                self.kept = tuple(map(_count, numbers))
            case "fault", {"episode_id": int() | None, "what": str(), "reason": str()}:
                self.faults.append((self._lines, _known(facts, _FAULT)))
            case "recovered", _:
                self.was_killed = True
            case _:
                pass


def _episodes(
    files: MonitorFiles, journal: _Journal, arrays: dict[str, NDArray[Any]]
) -> Iterator[EpisodeInputs]:
    broken = _broken(files)
    for number in sorted({*journal.entries, *journal.cuts}):
        entry, cut = journal.entries.get(number), journal.cuts.get(number)
        episode = EpisodeInputs(episode_id=number)
        if number in files.trajectories:
            episode = _with_trajectory(
                episode,
                files.trajectories[number],
                name=f"{files.infix}.{number}",
                irregular=journal.irregular.get(number, []),
                is_wrapped=bool((journal.run.get("environment") or {}).get("wrappers")),
                arrays=arrays,
            )
        if entry is not None:
            episode = _with_entry(episode, entry)
        elif cut is not None:
            episode = dataclasses.replace(
                episode,
                cut=str(cut.get("reason")),
                is_chosen=cut.get("chosen") is True,
                evaluation=journal.failed_unit(number),
            )
        yield dataclasses.replace(episode, broken=broken.get(number, {}))


def _broken(files: MonitorFiles) -> dict[int, dict[str, tuple[str, int]]]:
    """Return the inputs `broken` of the episodes that have them, by number."""
    found: dict[int, dict[str, tuple[str, int]]] = {}
    details = read_manifest(files.manifest).mjrec if files.manifest else None
    for name in map(base_name, (details or {}).get("broken") or ()):
        path, number = files.paths[0].with_name(name), episode_of(name)
        if number is None or not path.exists():
            continue
        with unreadable(path):
            said = read_object(path)
        # A deferred video cannot break off: its states are kept to render it again.
        if said.get("recording") == LIVE and said.get("broken") is True:
            video = name.removesuffix(".meta.json")
            broken = str(said.get("broken_reason")), _count(said.get("frame_count", 0))
            found.setdefault(number, {})[video] = broken
    return found


def _with_entry(episode: EpisodeInputs, entry: JournalEntry) -> EpisodeInputs:
    evaluation = entry.evaluation or {}
    return dataclasses.replace(
        episode,
        type=entry.type,
        seed=entry.seed,
        options=entry.options,
        steps=episode.steps if episode.has_trajectory else entry.length,
        is_chosen=entry.chosen,
        start_time=entry.start_time,
        end_time=entry.end_time,
        believed={
            "reward": entry.reward,
            "terminated": entry.terminated,
            "truncated": entry.truncated,
            "success": entry.success,
        },
        evaluation={k: evaluation.get(k) for k in ("seed", "episode")}
        if evaluation
        else None,
    )


def _with_trajectory(
    episode: EpisodeInputs,
    path: Path,
    *,
    name: str,
    irregular: list[Mapping[str, Any]],
    is_wrapped: bool,
    arrays: dict[str, NDArray[Any]],
) -> EpisodeInputs:
    found: dict[str, NDArray[Any] | None] = {}
    with open_hdf5(path) as reader:
        facts, steps = reader.facts, reader.step_count
        found[name] = reader.actions(0, steps)
        if reader.kind("state") is not None:
            if facts.get("seed") is None and facts.get("random_state") is None:
                found[f"{name}.state"] = reader.read("state", 0, 1)
            if _is_elsewhere(facts):
                found[f"{name}.states"] = reader.read("state", 0, reader.row_count)
        taken = _steps_taken(reader) if is_wrapped else {}
        found |= {f"{name}.{part}": values for part, values in taken.items()}
    known = {key: values for key, values in found.items() if values is not None}
    arrays |= known
    parts = facts.get("action_parts")
    exception = facts.get("exception")
    # If no action fits into an array, all of them are in the journal.
    is_whole = name in known or len(irregular) == steps
    return dataclasses.replace(
        episode,
        type=str(facts.get("type")),
        seed=facts.get("seed"),
        options=facts.get("options"),
        random_state=facts.get("random_state"),
        first_state=f"{name}.state" if f"{name}.state" in known else None,
        states=f"{name}.states" if f"{name}.states" in known else None,
        steps=steps,
        steps_taken=name if taken else None,
        actions=name if is_whole else None,
        dtypes=tuple(_dtypes(facts.get("action_dtypes"))),
        parts=None if parts is None else tuple(_parts(parts)),
        irregular=tuple(irregular),
        exception=exception if isinstance(exception, Mapping) else None,
        selection=_selection(facts.get("video")),
        has_trajectory=facts.get("kept") is not False,
        start_time=_time(facts.get("start_time")),
        end_time=_time(facts.get("end_time")),
    )


def _is_elsewhere(facts: Mapping[str, Any]) -> bool:
    """Return whether the facts claim a different MuJoCo version or machine."""
    said = facts.get("versions")
    version = said.get("mujoco") if isinstance(said, Mapping) else None
    return version != versions().get("mujoco") or (
        facts.get("machine") != machine_fingerprint()
    )


def _steps_taken(reader: TrajectoryReader) -> dict[str, NDArray[Any]]:
    """Return the parts of `RecordedSteps`; empty if controls are not recorded."""
    kind = reader.kind("state")
    if kind is None or "ctrl" not in (kind.names or ()):
        return {}
    return {
        "controls": reader.read("state", 1, reader.row_count)["ctrl"],
        "rewards": reader.rewards,
        "terminated": reader.terminated,
        "truncated": reader.truncated,
    }


def _of_evaluation(kind: str, facts: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the known facts of an evaluation's event."""
    if not all(type(facts.get(name)) is int for name in _UNIT):
        raise ValueError(f"{facts!r:.200} does not name an evaluation's episode")
    return _known(facts, _UNIT if kind == "begun" else _FAILED)


def _selection(video: Any) -> Mapping[str, Any] | None:
    said = video.get("selection") if isinstance(video, Mapping) else None
    if not isinstance(said, Mapping) or said.get("scope") != EVALUATION:
        return None
    return _known(said, _SELECTION)


def _provenance(said: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a provenance without the keys that recorders do not write."""
    known: dict[str, Any] = {}
    for key, value in _known(said, _PROVENANCE).items():
        inner = _PROVENANCE[key]
        is_nested = inner and isinstance(value, Mapping)
        known[key] = _known(value, inner) if is_nested else value
    return known


def _known(said: Mapping[str, Any], keys: Collection[str]) -> dict[str, Any]:
    """Return the values of known keys; the others cannot be recreated."""
    return {key: value for key, value in said.items() if key in keys}


def _sources(files: MonitorFiles, environment: Any) -> str | None:
    is_mjcf = isinstance(environment, Mapping) and environment["framework"] == "mjcf"
    if not is_mjcf or not files.trajectories:
        return None
    with open_hdf5(files.trajectories[min(files.trajectories)]) as reader:
        model = reader.facts.get("model")
    name = model.get("xml") if isinstance(model, Mapping) else None
    return name if isinstance(name, str) and _SOURCES.fullmatch(name) else None


def _options(said: Any) -> dict[str, Any]:
    if not isinstance(said, Mapping):
        return {}
    for name, value in said.items():
        if name not in OPTIONS or type(value) not in OPTIONS[name]:
            raise ValueError(f"the option {name!r:.80} must not be {value!r:.80}")
    return dict(said)


def _dtypes(said: Any) -> Iterator[tuple[int, str]]:
    for step, name in said or ():
        if name not in _DTYPES:
            raise ValueError(f"actions cannot have the dtype {name!r:.80}")
        yield _count(step), name


def _parts(said: Any) -> Iterator[tuple[str, tuple[int, ...]]]:
    for name, shape in said:
        yield str(name), tuple(map(_count, shape))


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def _count(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r:.80} is not a valid count")
    return value


def _time(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None
