# SPDX-License-Identifier: Apache-2.0
"""Functions that finish the files of a monitor that was killed or closed early.

Recordings in flight become trajectories, live videos get their final names, missing
lines are added to the journal, and the statistics and the manifest are derived from it.
Meanwhile, the monitor's lock is held, so that the monitor looks open to all other
processes.
"""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import Error, UnreadableFile
from ..formats import journal, killed_episodes, spans, trajectory_file
from ..formats.bundle import FINISHED, is_finished
from ..formats.locks import try_lock
from ..formats.monitor_directory import (
    VideoName,
    episode_of,
    final_name,
    journal_name,
    lock_name,
    manifest_name,
)
from ..plain_text import counted
from ..results.journal_or_stats import MonitorResults, locked_run
from ..results.manifest_writing import manifest_lock, write_manifest_and_stats
from ..results.monitor_files import MonitorFiles, files_of
from .jobs import key_of
from .recorded_facts import open_for_rendering, video_path
from .recordings import claim, parts_of
from .recover_live_videos import finish_video
from .recovery_needed import (
    lacks_results,
    live_videos_left,
    logs_left,
    stale_files,
)

logger = logging.getLogger(__name__)

_Line = tuple[str, Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Report:
    """A report of finished files and failures.

    Attributes:
        files: names of files that were finished, and what was done with each.
        failures: names of files that could not be finished, and the reasons.
    """

    files: list[tuple[str, str]] = field(default_factory=list)
    failures: list[tuple[str, str]] = field(default_factory=list)

    def note(self, name: str, what: str) -> None:
        """Note what was done with a file."""
        self.files.append((name, what))

    @contextlib.contextmanager
    def attempt(self, name: str) -> Iterator[None]:
        """Turn an exception inside the block into a failure, and continue."""
        try:
            yield
        except (Error, OSError) as error:
            self.failures.append((name, str(error)))
        except Exception as error:
            logger.exception("%s could not be recovered.", name)
            self.failures.append((name, f"{type(error).__name__}: {error}"))

    def remove(self, stale: Path) -> None:
        """Remove an unfinished file, or a lock file that no process holds."""
        with self.attempt(stale.name):
            if stale.suffix != ".lock":
                stale.unlink(missing_ok=True)
                self.note(stale.name, "unfinished, removed")
            elif (lock := try_lock(stale)) is not None:
                lock.release()
                self.note(stale.name, "left behind, removed")


def recover_monitor(
    directory: Path, infix: str, report: Report, *, bundles: bool
) -> None:
    """Finish all files of one monitor except pending videos, unless it is still open.

    Args:
        directory: the directory that the monitor recorded into.
        infix: the monitor's infix.
        report: collects the results.
        bundles: whether the monitor's trajectories are stored in one file.
    """
    path = directory / lock_name(infix)
    with report.attempt(path.name):
        was_killed = path.exists()
        monitor = _KilledMonitor(
            directory=directory, infix=infix, report=report, bundles=bundles
        )
        # Check before creating a lock file, which would look like a killed monitor's.
        is_behind = lacks_results(files_of(directory, infix))
        lock = try_lock(path)
        if lock is None:
            return
        if was_killed:
            report.note(path.name, "its monitor did not close")
        try:
            monitor.finish(is_behind=is_behind)
        except BaseException:
            # Keep the file, whose facts about the environment may exist nowhere else.
            lock.let_go()
            raise
        lock.release()
        # Processes that rendered in the meantime found the monitor open.
        if (directory / manifest_name(infix)).exists():
            write_manifest_and_stats(directory, infix)


@dataclass(kw_only=True)
class _KilledMonitor:
    """A monitor that is not open; see `recover_monitor`."""

    directory: Path
    infix: str
    report: Report
    bundles: bool

    def finish(self, *, is_behind: bool) -> None:
        """Finish the monitor's files. The caller holds the monitor's lock.

        Args:
            is_behind: whether the statistics and the manifest may be outdated.
        """
        report = self.report
        for log in logs_left(self._files()):
            with report.attempt(log.name):
                self._finish_log(log)
        # Turning logs into trajectories does not change the manifest.
        before = len(report.files)
        for video in live_videos_left(self._files()):
            with report.attempt(video.name):
                known = self._known(episode_of(video.name))
                for name, what in finish_video(video, known):
                    report.note(name, what)
        for stale in stale_files(self._files()):
            with self._claimed(stale) as is_ours:
                if is_ours:
                    report.remove(stale)
        has_news = is_behind or len(report.files) > before
        now = self._files()
        if has_news and any(not path.name.startswith(".") for path in now.paths):
            self._complete_journal(now)
            self._write_results()

    def _files(self) -> MonitorFiles:
        return files_of(self.directory, self.infix)

    def _finish_log(self, log: Path) -> None:
        """Turn the episodes in a log into trajectories; remove the log if it is idle.

        Raises:
            UnreadableFile: the journal does not describe the log. The log stays.
        """
        in_flight = [
            each.path for each in spans.recordings_in(log) if each.is_in_flight
        ]
        episodes = [path for path in in_flight if path.suffix == FINISHED]
        for paths in [episodes] if self.bundles else [[path] for path in episodes]:
            self._finish_trajectories(paths)
        is_idle = not any(each.is_in_flight for each in spans.recordings_in(log))
        if is_idle and any(map(Path.exists, spans.files_beside(log))):
            spans.remove_log(log)
            self.report.note(log.name, "nothing in flight, removed")

    def _finish_trajectories(self, paths: Iterable[Path]) -> None:
        """Write the final trajectories, to separate files or to the bundle."""
        with contextlib.ExitStack() as claims:
            ours = [p for p in paths if claims.enter_context(self._claimed(p))]
            ours = [path for path in ours if not is_finished(path)]
            finish = trajectory_file.finish_trajectories
            if self.bundles:
                finish = trajectory_file.bundle_trajectories
            failures = finish(ours)
            for path in ours:
                with self.report.attempt(path.name):
                    if path in failures:
                        raise failures[path]
                    self.report.note(path.name, _how_long(path))

    @contextlib.contextmanager
    def _claimed(self, path: Path) -> Iterator[bool]:
        """Hold the lock of a file's recording; yield False if it is already held."""
        key = key_of(final_name(path.name) or path.name)
        if key is None:
            yield True
            return
        lock = claim(self.directory, key)
        with contextlib.nullcontext() if lock is None else lock:
            yield lock is not None

    # Known facts about episodes

    @functools.cached_property
    def _entries(self) -> dict[int, journal.JournalEntry | None]:
        """Journal entries of the episodes that have files; None where one was cut off.

        Episodes without files are left out, because there may be millions.
        """
        files, entries = self._files(), dict[int, journal.JournalEntry | None]()
        # An unreadable journal is reported when the statistics are written.
        with contextlib.suppress(UnreadableFile):
            if files.journal is not None:
                numbers = _numbers(files)

                def note(kind: str, facts: Any) -> None:
                    if kind == "cut" and isinstance(facts, Mapping):
                        entries.setdefault(facts.get("episode_id", -1))

                for entry in journal.read_journal(files.journal, on_event=note):
                    if entry.episode_id in numbers:
                        entries[entry.episode_id] = entry
        return entries

    def _facts(self, number: int | None) -> Mapping[str, Any]:
        """Return the facts in an episode's trajectory; empty if missing or damaged."""
        with contextlib.suppress(UnreadableFile):
            if number is not None and (
                path := spans.find_trajectory(self.directory, self.infix, number)
            ):
                return _facts_of(path)
        return {}

    def _known(self, number: int | None) -> dict[str, Any]:
        """Return the available metadata about an episode's end."""
        facts = self._facts(number)
        entry = None if number is None else self._entries.get(number)
        known = {key: facts[key] for key in ("length", "reward") if key in facts}
        if "complete" in facts and facts.get("reason") != killed_episodes.KILLED:
            keys = ("complete", "terminated", "truncated", "reason", "exception")
            known |= {key: facts[key] for key in keys if key in facts}
        if entry is not None:
            names = ("length", "reward", "terminated", "truncated")
            known |= {"complete": True, **{key: getattr(entry, key) for key in names}}
        return known

    # Journal, statistics, manifest

    def _missing_episodes(self, now: MonitorFiles) -> Iterator[_Line]:
        """Yield the lines that the journal lacks for episodes that have other files."""
        is_choosing = bool(MonitorResults(now).run.facts.get("keep"))
        for number in sorted(_numbers(now) - self._entries.keys()):
            facts = self._facts(number)
            is_filmed = number in now.videos or number in now.metadata
            video = facts.get("video") or ({"recording": "live"} if is_filmed else {})
            choice = {
                "episode_id": number,
                "chosen": bool(video) and not is_choosing,
                "recording": video.get("recording"),
            }
            yield killed_episodes.missing_line(facts, choice)

    def _missing_clips(self, now: MonitorFiles) -> Iterator[_Line]:
        """Yield a line for each clip, deferred or live.

        Some may repeat lines of the journal. Unreadable clips are left out; they are
        reported when the directory is rendered.
        """
        in_flight = spans.recordings_in_flight(self.directory, self.infix)
        for key in {key_of(each.name) for each in in_flight}:
            if key is None or not key.is_clip:
                continue
            with contextlib.suppress(UnreadableFile, IndexError):
                parts = parts_of(self.directory, key)
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
            name = VideoName.parse(path.name)
            if name is None or name.first_step is None or name.view:
                continue
            if name.ending == "meta.json":
                yield "clip", {"episode_id": name.episode_id, "video": name.video}

    def _complete_journal(self, now: MonitorFiles) -> None:
        """Add the lines that the monitor could no longer write."""
        lines = [*self._missing_episodes(now), *self._missing_clips(now)]
        path = self.directory / journal_name(self.infix)
        writer = journal.JournalWriter(path, run=self._run_facts(now))
        with contextlib.closing(writer), manifest_lock(self.directory, self.infix):
            for kind, facts in (*lines, ("recovered", {})):
                if kind == "episode":
                    writer.append(journal.entry_of(facts))
                else:
                    writer.note(kind, facts)
        added = sum(kind == "episode" for kind, _ in lines)
        if added:
            self.report.note(path.name, f"{counted(added, 'episode')} added")

    def _run_facts(self, now: MonitorFiles) -> Mapping[str, Any]:
        """Return the facts for the first line of a journal that is lost or missing."""
        with contextlib.suppress(OSError, ValueError):
            if run := locked_run(self.directory / lock_name(self.infix)):
                return run
        results = MonitorResults(now)
        details = results.details
        return {
            "env_info": results.env_info,
            "schedule": (details.get("schedule") or {}).get("name"),
            **{k: details[k] for k in ("keep", "first_episode_id") if k in details},
            "versions": details.get("versions", {}),
        }

    def _write_results(self) -> None:
        written = write_manifest_and_stats(self.directory, self.infix, is_own=True)
        assert written is not None
        manifest, note = written.manifest, self.report.note
        if written.stats is not None and written.is_new_stats:
            note(manifest.stats, counted(len(written.stats.timestamps), "episode"))
        if written.is_new_manifest:
            pending = len(written.pending)
            rest = f", {pending} pending: mjrec render" if pending else ""
            what = f"{counted(len(manifest.videos), 'video')}{rest}"
            note(manifest_name(self.infix), what)


def _how_long(path: Path) -> str:
    with trajectory_file.open_trajectory(path) as reader:
        steps = counted(reader.step_count, "step")
        is_cut = reader.facts.get("reason") == killed_episodes.KILLED
    return f"{steps}, incomplete: killed" if is_cut else steps


def _numbers(files: MonitorFiles) -> set[int]:
    """Return the numbers of the episodes with a trajectory or a video, in any state."""
    named = {number for p in files.paths if (number := episode_of(p.name)) is not None}
    return named | files.trajectories.keys()


def _facts_of(path: Path) -> Mapping[str, Any]:
    with open_for_rendering(path) as reader:
        return reader.facts
