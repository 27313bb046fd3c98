# SPDX-License-Identifier: Apache-2.0
"""The state of a run, built from the events in its journal.

The monitor adds each event to its `Run` when it writes the event to the journal, and
other processes read the same events from the journal. Therefore, results and manifests
are based on the same facts, whether they are created during the run or years later.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..formats.journal import MOST_EPISODES, JournalEntry, read_journal
from ..formats.json_fields import base_name
from ..formats.manifest import Manifest
from ..formats.monitor_directory import episode_of

# The `scope` of a choice from the episodes of several monitors.
EVALUATION = "evaluation"


@dataclass
class Run:
    """The facts known about a run.

    Attributes:
        facts: the facts in the journal's first line: `env_info`, `schedule` (its name),
            `keep` (`rule`), `first_episode_id`, `versions`, and `views` (the parts
            before the extension in the names of additional cameras' videos).
        provenance: the run's provenance; None if unknown.
        count: number of completed episodes.
        last_episode_id: the highest number of any episode that began; -1 if none did.
        chosen: the episodes that the schedule chose.
        filmed: the episodes that have, or will have, a video of their own.
        deferred: the filmed episodes whose video is rendered from their states.
        clips: the clips, by video name. For a clip that must be rendered, `clip` is the
            name of its first part.
        faults: the parts of the run that could not be recorded.
        keep: the latest choice of the videos to keep; None before the first choice.
        dropped: the episodes whose video was dropped but whose trajectory is kept.
        recovered: whether another process has recovered the run.
    """

    facts: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] | None = None
    count: int = 0
    last_episode_id: int = -1
    chosen: set[int] = field(default_factory=set)
    filmed: set[int] = field(default_factory=set)
    deferred: set[int] = field(default_factory=set)
    clips: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    faults: list[Mapping[str, Any]] = field(default_factory=list)
    keep: Mapping[str, Any] | None = None
    dropped: set[int] = field(default_factory=set)
    recovered: bool = False

    @classmethod
    def read(cls, journal: Path) -> Run:
        """Read a run from its journal.

        Raises:
            UnreadableFile: the journal does not exist or cannot be read.
        """
        run = cls()
        began = functools.partial(run.begin, chosen=False)
        for entry in read_journal(journal, on_event=run.note, on_damage=began):
            run.add(entry)
        return run

    @classmethod
    def of_manifest(cls, manifest: Manifest) -> Run:
        """Rebuild a run from its manifest if the journal is lost."""
        details = manifest.mjrec or {}
        schedule, keep = details.get("schedule") or {}, details.get("keep")
        recorded = schedule.get("recorded") or ()
        run = cls(
            facts={
                "env_info": manifest.env_info,
                "schedule": schedule.get("name"),
                "first_episode_id": details.get("first_episode_id", 0),
                "versions": details.get("versions", {}),
            },
            provenance=details.get("provenance"),
            last_episode_id=(details.get("next_episode_id") or 0) - 1,
            chosen=set(recorded),
            faults=list(details.get("faults") or ()),
            keep=None if keep is None else {**keep, "recorded": recorded},
            recovered=bool(details.get("recovered")),
        )
        for entry in details.get("pending") or ():
            if "clip" in entry:
                run.note("clip", entry)
            elif (number := episode_of(str(entry.get("video")))) is not None:
                run.filmed.add(number)
        run.deferred = set(run.filmed)
        metadata = [
            *(about for _, about in manifest.videos),
            *(details.get("broken") or ()),
        ]
        for name in metadata:
            run.clips.setdefault(f"{name.removesuffix('.meta.json')}.mp4", {})
        return run

    @property
    def with_deferred_video(self) -> set[int]:
        """The episodes whose videos are rendered from their states, now or later."""
        keep = self.keep or {}
        if keep.get("decided") is True:
            return self.deferred & set(keep.get("recorded", ()))
        return self.deferred - self.dropped

    def begin(self, number: int, *, chosen: bool) -> None:
        """Add an episode that has begun. The journal lists it only when it ends."""
        self._add(number, chosen, None)

    def add(self, entry: JournalEntry) -> None:
        """Add a completed episode."""
        self.count += 1
        self._add(entry.episode_id, entry.chosen, entry.recording)

    def note(self, kind: str, facts: Any) -> None:
        """Add any other event. Invalid events are ignored."""
        match kind, facts:
            case "run", dict():
                self.facts = facts
            case "provenance", dict():
                self.provenance = facts
            case "cut", {"episode_id": int(number)}:
                self._add(number, facts.get("chosen"), facts.get("recording"))
            case "clip", {"episode_id": int(number), "video": str(video)}:
                self._add(number, ".step" not in video, None)
                self._add(facts.get("last_episode_id", -1), False, None)
                with contextlib.suppress(ValueError):
                    self.clips[base_name(video)] = facts
            case "dropped", int(number):
                self.dropped.add(number)
            case "fault", dict():
                self.faults.append(facts)
            case "keep", dict():
                self.keep = facts
                if facts.get("scope") == EVALUATION:
                    # These episodes were chosen only after they had ended.
                    for number in facts.get("recorded") or ():
                        self._add(number, None, facts.get("recording"))
            case "closed", {"next_episode_id": int(following)}:
                self._add(following - 1, False, None)
            case "recovered", _:
                self.recovered = True
            case _:
                pass

    def _add(self, number: int, chosen: object, recording: object) -> None:
        if type(number) is not int or not 0 <= number < MOST_EPISODES:
            return
        self.last_episode_id = max(self.last_episode_id, number)
        if chosen:
            self.chosen.add(number)
        if recording:
            self.filmed.add(number)
        if recording == "deferred":
            self.deferred.add(number)
