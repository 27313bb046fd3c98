# SPDX-License-Identifier: Apache-2.0
"""Putting the files of a dead monitor in order.

Recordings in flight become trajectories, live videos get their names, the journal gets
the lines that it lacks, and statistics and manifest follow from it. Meanwhile the dead
monitor's lock is held, as the monitor did: to all others it is open.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import Error, FileNotWritten, UnreadableFile
from ..formats.journal import (
    KILLED,
    JournalEntry,
    JournalReader,
    JournalWriter,
    entry_of,
)
from ..formats.locks import try_lock
from ..formats.monitor_directory import (
    episode_of,
    journal_name,
    manifest_name,
)
from ..formats.spans import drop_recording, remove_list
from ..formats.trajectory_file import (
    find_trajectory,
    finish_trajectory,
    open_trajectory,
)
from ..formats.video_metadata import is_done
from ..results.journal_or_stats import MonitorResults, locked_run
from ..results.manifest_writing import (
    Written,
    manifest_lock,
    write_manifest_and_stats,
)
from .cut_videos import finish_text, finish_video
from .jobs import key_of
from .leftovers import Leftovers, leftovers_of
from .recorded_facts import open_for_rendering, video_path
from .recordings import claim, parts_of

logger = logging.getLogger(__name__)

_MOMENT = 0.05
_CLIP_METADATA = re.compile(
    r"(?P<video>.*\.video(?P<episode>\d{6,18})\.step\d+)\.meta\.json", re.ASCII
)
_FIRST_NOTE = re.compile(r"\.video\d{6,}\.[a-z0-9]+\.note\.part$")

_Line = tuple[str, Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Report:
    """What was done, and what failed.

    Attributes:
        deadline: until when to wait for others, by `time.monotonic`.
        files: names, and what was done.
        failures: names, and why it could not be.
    """

    deadline: float
    files: list[tuple[str, str]] = field(default_factory=list)
    failures: list[tuple[str, str]] = field(default_factory=list)

    def note(self, name: str, what: str) -> None:
        """Note what was done about a file."""
        self.files.append((name, what))

    @contextlib.contextmanager
    def attempt(self, name: str) -> Iterator[None]:
        """Note what fails inside the block, and go on."""
        try:
            yield
        except (Error, OSError) as error:
            self.failures.append((name, str(error)))
        except Exception as error:
            logger.exception("%s cannot be recovered.", name)
            what = f"{type(error).__name__}: {error}"
            self.failures.append((name, what))

    def remove(self, part: Path) -> None:
        """Remove an unfinished file."""
        with self.attempt(part.name):
            part.unlink(missing_ok=True)
            self.note(part.name, "unfinished, removed")


def put_in_order(leftovers: Leftovers, report: Report) -> None:
    """Put the files of one monitor in order, unless it is open.

    Args:
        leftovers: what was found of it.
        report: takes what was done.
    """
    directory, infix, path = leftovers.directory, leftovers.infix, leftovers.lock
    with report.attempt(path.name):
        try:
            content = path.read_text() if path.is_file() else ""
        except (OSError, ValueError):
            content = ""
        lock = try_lock(path, content or json.dumps({"pid": os.getpid()}))
        if lock is None:
            return
        if path in leftovers.paths:
            report.note(path.name, "its monitor was killed")
        try:
            _DeadMonitor(leftovers, report).put_in_order()
        except BaseException:
            # What it says of the environment may not be written anywhere else.
            lock.let_go()
            raise
        lock.release()
        # A process that rendered meanwhile took the monitor for open.
        if (directory / manifest_name(infix)).exists():
            write_manifest_and_stats(directory, infix)


class _DeadMonitor:
    """A monitor whose lock this process holds."""

    def __init__(self, leftovers: Leftovers, report: Report) -> None:
        self._directory = leftovers.directory
        self._infix = leftovers.infix
        self._found = leftovers
        self._report = report
        # Of episodes with a trajectory or a video: of the others there may be millions.
        names = [path.name for path in leftovers.paths]
        names += [recording.path.name for recording in leftovers.in_flight]
        self._numbers = {number for n in names if (number := episode_of(n)) is not None}
        self._entries: dict[int, JournalEntry] = {}
        self._journaled: set[int] = set()
        # One that cannot be read is reported when the statistics are made.
        with contextlib.suppress(UnreadableFile):
            if leftovers.files.journal is not None:
                self._read(leftovers.files.journal)

    def put_in_order(self) -> None:
        found, report = self._found, self._report
        is_behind = found.lacks_results
        for path, why in found.damaged_lists.items():
            report.failures.append((path.name, why))
        for log in found.unfinished_logs:
            with report.attempt(log.name), self._claimed(log) as is_ours:
                if is_ours and not log.exists():
                    report.note(log.name, self._finish_log(log))
        for path in self._now().idle_lists:
            with report.attempt(path.name):
                remove_list(path)
                report.note(path.name, "nothing in flight, removed")
        # Of logs a manifest says nothing that is not so of trajectories.
        before = len(report.files)
        self._finish_live()
        has_news = is_behind or len(report.files) > before
        for part, rule in self._now().unfinished_files.items():
            if rule == "remove":
                with self._claimed(part) as is_ours:
                    if is_ours:
                        report.remove(part)
        now = self._now()
        has_recordings = any(not path.name.startswith(".") for path in now.paths)
        if has_news and has_recordings:
            self._complete_journal([*self._missing_episodes(now), *_clips(now)])
            written = write_manifest_and_stats(
                self._directory, self._infix, is_own=True
            )
            assert written is not None
            self._note_results(written)

    def _now(self) -> Leftovers:
        return leftovers_of(self._directory, self._infix)

    def _read(self, journal: Path) -> None:
        def note(kind: str, facts: Any) -> None:
            if kind == "cut" and isinstance(facts, Mapping):
                self._journaled.add(facts.get("episode_id", -1))

        for entry in JournalReader(journal, on_event=note):
            if entry.episode_id in self._numbers:
                self._entries[entry.episode_id] = entry
                self._journaled.add(entry.episode_id)

    def _facts(self, number: int | None) -> Mapping[str, Any]:
        """Return what an episode's trajectory says; nothing without, or of damaged."""
        with contextlib.suppress(UnreadableFile):
            if number is None:
                return {}
            path = find_trajectory(self._directory, self._infix, number)
            if path is not None:
                with open_for_rendering(path) as reader:
                    return reader.facts
        return {}

    def _known(self, number: int | None) -> dict[str, Any]:
        """Return what metadata says of an episode's end, as far as its files say it."""
        facts, entry = (
            self._facts(number),
            self._entries.get(-1 if number is None else number),
        )
        known = {key: facts[key] for key in ("length", "reward") if key in facts}
        if "complete" in facts and facts.get("reason") != KILLED:
            keys = ("complete", "terminated", "truncated", "reason", "exception")
            known |= {key: facts[key] for key in keys if key in facts}
        elif entry is not None:
            known["complete"] = True
            known |= {key: getattr(entry, key) for key in ("terminated", "truncated")}
        if entry is not None:
            known |= {key: getattr(entry, key) for key in ("length", "reward")}
        return known

    def _finish_log(self, path: Path) -> str:
        """Give a recording in flight its final form; return what was done."""
        with open_trajectory(path) as reader:
            facts, steps = dict(reader.facts), reader.step_count
        if not facts.get("kept", True) and is_done(video_path(path, facts)):
            # Its renderer died between the two.
            drop_recording(path)
            return "its video is there, removed"
        number = episode_of(path.name)
        entry = None if number is None else self._entries.get(number)
        what = f"{steps} {'step' if steps == 1 else 'steps'}"
        if entry is not None and entry.length == steps and "complete" not in facts:
            # All of it is there but the last words.
            ending = {**self._known(entry.episode_id), "end_time": entry.end_time}
            finish_trajectory(path, facts=ending)
            return what
        finish_trajectory(path)
        return what if "complete" in facts else f"{what}, incomplete: killed"

    def _finish_live(self) -> None:
        """Finish live videos and text recordings."""
        report = self._report
        unfinished = self._found.unfinished_files
        notes = [part for part, rule in unfinished.items() if rule == "video"]
        texts = [part for part, rule in unfinished.items() if rule == "text"]
        # The first video's metadata names those of further cameras.
        for note in sorted(notes, key=lambda note: bool(_FIRST_NOTE.search(note.name))):
            video = note.name.removeprefix(".").removesuffix(".note.part")
            with report.attempt(video):
                known = self._known(episode_of(video))
                for name, what in finish_video(note, known, deadline=report.deadline):
                    report.note(name, what)
        for part in texts:
            path = part.with_name(part.name.removeprefix(".").rsplit(".", 2)[0])
            number = episode_of(path.name)
            with report.attempt(path.name):
                facts, known = self._facts(number), self._known(number)
                for name, what in finish_text(part, path, facts, known):
                    report.note(name, what)

    @contextlib.contextmanager
    def _claimed(self, path: Path) -> Iterator[bool]:
        """Hold the lock of a file's recording; False where another process keeps it."""
        final = path.name.removeprefix(".").removesuffix(".part").rpartition(".")[0]
        key = key_of(path.name) or key_of(final)
        if key is None:
            yield True
            return
        # A renderer that outlived its monitor is about to end.
        while (lock := claim(self._directory, key)) is None:
            if time.monotonic() >= self._report.deadline:
                break
            time.sleep(_MOMENT)
        try:
            yield lock is not None
        finally:
            if lock is not None:
                lock.release()

    def _missing_episodes(self, now: Leftovers) -> Iterator[_Line]:
        """Yield what the journal lacks of episodes with a trajectory or a video."""
        is_choosing = bool(MonitorResults(now.files).run.facts.get("keep"))
        filmed = {*now.files.videos, *now.files.metadata}
        for number in sorted(self._numbers - self._journaled):
            facts = self._facts(number)
            live = {"recording": "live"} if number in filmed else {}
            video = facts.get("video") or live
            line = {
                "episode_id": number,
                "chosen": bool(video) and not is_choosing,
                "recording": video.get("recording"),
            }
            try:
                entry_of({**facts, **line})
                is_complete = facts.get("complete") is True
            except ValueError:
                is_complete = False
            if is_complete:
                yield "episode", {**facts, **line}
            else:
                yield "cut", {**line, "reason": facts.get("reason", KILLED)}

    def _complete_journal(self, lines: list[_Line]) -> None:
        """Write down what the monitor did not live to write down."""
        path = self._directory / journal_name(self._infix)
        writer = JournalWriter(path, run=self._run_facts())
        try:
            with manifest_lock(self._directory, self._infix):
                for kind, facts in (*lines, ("recovered", {})):
                    if kind == "episode":
                        writer.append(entry_of(facts))
                    else:
                        writer.note(kind, facts)
        except OSError as error:
            raise FileNotWritten(path, error.strerror or error) from error
        finally:
            writer.close()
        added = sum(kind == "episode" for kind, _ in lines)
        if added:
            what = f"{added} {'episode' if added == 1 else 'episodes'} added"
            self._report.note(path.name, what)

    def _run_facts(self) -> Mapping[str, Any]:
        """Return what the first line says of a journal that is gone, or never was."""
        with contextlib.suppress(OSError, ValueError):
            if run := locked_run(self._found.lock):
                return run
        results = MonitorResults(self._found.files)
        details = results.details
        return {
            "env_info": results.env_info,
            "schedule": (details.get("schedule") or {}).get("name"),
            **{k: details[k] for k in ("keep", "first_episode_id") if k in details},
            "versions": details.get("versions", {}),
        }

    def _note_results(self, written: Written) -> None:
        manifest = written.manifest
        if written.stats is not None and written.is_new_stats:
            count = len(written.stats.timestamps)
            what = f"{count} {'episode' if count == 1 else 'episodes'}"
            self._report.note(manifest.stats, what)
        if written.is_new_manifest:
            count, pending = len(manifest.videos), len(written.pending)
            rest = f", {pending} pending: mjrec render" if pending else ""
            what = f"{count} {'video' if count == 1 else 'videos'}{rest}"
            self._report.note(manifest_name(self._infix), what)


def _clips(now: Leftovers) -> Iterator[_Line]:
    """Yield the clips, deferred and live; those that the journal has say the same.

    One that cannot be read is left out; rendering the directory reports it.
    """
    for key in {key_of(recording.path.name) for recording in now.in_flight}:
        if key is None or not key.is_clip:
            continue
        with contextlib.suppress(UnreadableFile, IndexError):
            parts = parts_of(now.directory, key)
            facts, last = _facts_of(parts[0]), _facts_of(parts[-1])
            yield (
                "clip",
                {
                    "episode_id": facts.get("episode_id") or 0,
                    "last_episode_id": last.get("episode_id") or 0,
                    "clip": parts[0].name,
                    "video": video_path(parts[0], facts).name,
                },
            )
    for path in now.paths:
        if (match := _CLIP_METADATA.fullmatch(path.name)) is not None:
            number, video = int(match["episode"]), f"{match['video']}.mp4"
            yield "clip", {"episode_id": number, "video": video}


def _facts_of(path: Path) -> Mapping[str, Any]:
    with open_for_rendering(path) as reader:
        return reader.facts
