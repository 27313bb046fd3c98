# SPDX-License-Identifier: Apache-2.0
"""Putting the files of dead monitors in order, one monitor after the other.

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
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import Error, FileNotWritten, UnreadableFile
from ..formats.journal import KILLED, JournalWriter, entry_of, run_facts
from ..formats.locks import try_lock
from ..formats.monitor_directory import Infix, episode_of, journal_name, manifest_name
from ..formats.spans import FORMAT, drop_recording, remove_list
from ..formats.trajectory import FORMAT_VERSION
from ..formats.trajectory_file import finish_trajectory, open_trajectory
from ..formats.video_metadata import is_done
from ..json_text import loads
from ..results.journal_or_stats import MonitorResults
from ..results.manifest_and_stats import (
    Written,
    manifest_lock,
    write_manifest_and_stats,
)
from ..results.recorded_environment import locked_run
from .killed_episodes import KnownEpisodes
from .killed_leftovers import (
    Remains,
    lacks_results,
    look_through,
    model_leftovers,
    unfinished_logs,
)
from .killed_videos import finish_text, finish_video
from .recorded_facts import open_for_rendering, video_path
from .recordings import claim, key_of, parts_of
from .recovery_report import RecoveredFile

logger = logging.getLogger(__name__)

_MOMENT = 0.05
_LONGEST_LOCK = 1 << 16
_LONGEST_LINE = 1 << 26
_CLIP_METADATA = re.compile(
    r"(?P<video>.*\.video(?P<episode>\d{6,18})\.step\d+)\.meta\.json", re.ASCII
)


class KilledMonitors:
    """Puts monitors in order, and says what it did.

    Args:
        directory: the monitor directory.
        seconds: how long to wait, in all, for others to finish what they are at.

    Attributes:
        files: what was done.
        failures: what could not be, and why.
    """

    def __init__(self, directory: Path, *, seconds: float) -> None:
        self.files: list[RecoveredFile] = []
        self.failures: list[RecoveredFile] = []
        self._directory = directory
        self._end = time.monotonic() + seconds

    def put_in_order(self, infix: Infix) -> None:
        """Put the files of one monitor in order, unless it is open."""
        remains = look_through(self._directory, infix)
        with self._noting_failure(remains.lock.name):
            lock = try_lock(remains.lock, _content(remains.lock))
            if lock is None:
                return
            if remains.lock in remains.paths:
                self._note(RecoveredFile(remains.lock.name, "its monitor was killed"))
            try:
                self._put_in_order(remains)
            except BaseException:
                # What it says of the environment may not be written anywhere else.
                lock.let_go()
                raise
            lock.release()
            # A process that rendered meanwhile took the monitor for open.
            if (self._directory / manifest_name(infix)).exists():
                write_manifest_and_stats(self._directory, infix)

    def sweep_models(self) -> None:
        """Remove unfinished files of models."""
        for part in model_leftovers(self._directory):
            with self._noting_failure(part.name):
                self._remove(part)

    def _put_in_order(self, remains: Remains) -> None:
        known = KnownEpisodes(remains)
        lines = [*_missing_episodes(remains, known), *_missing_clips(remains)]
        for spans in remains.damaged_lists:
            with self._noting_failure(spans.name):
                self._note(_set_aside(spans))
        for log in unfinished_logs(remains):
            with self._noting_failure(log.name), self._claimed(log) as is_ours:
                if is_ours:
                    self._note(_finish_log(log, known))
        for spans in look_through(self._directory, remains.infix).idle_lists:
            with self._noting_failure(spans.name):
                remove_list(spans)
                self._note(RecoveredFile(spans.name, "nothing in flight, removed"))
        # Of logs a manifest says nothing that is not so of trajectories.
        before = len(self.files)
        for note in sorted(remains.notes, key=remains.is_first_video):
            with self._noting_failure(_video_of(note)):
                self._note(finish_video(note, known, is_over=self._is_over))
        kept = [text for text in remains.texts if not self._finish_text(text, known)]
        has_news = len(self.files) > before
        self._sweep(look_through(self._directory, remains.infix), kept)
        if _has_recordings(remains) and (has_news or lacks_results(remains)):
            lines += _missing_live_clips(look_through(self._directory, remains.infix))
            self._complete_journal(remains, lines)
            listing = write_manifest_and_stats(
                self._directory, remains.infix, is_own=True
            )
            assert listing is not None
            for file in _listed(remains.infix, listing):
                self._note(file)

    def _complete_journal(
        self, remains: Remains, lines: Sequence[tuple[str, Mapping[str, Any]]]
    ) -> None:
        """Write down what the monitor did not live to write down."""
        path = self._directory / journal_name(remains.infix)
        writer = JournalWriter(path, run=_run_facts(remains))
        try:
            with manifest_lock(self._directory, remains.infix):
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
            self._note(RecoveredFile(path.name, what))

    def _finish_text(self, text: Path, known: KnownEpisodes) -> bool:
        """Finish a text recording; False where that failed and its frames stay."""
        try:
            self._note(finish_text(text, known))
        except UnreadableFile:
            # There is no whole frame in it.
            return True
        except (Error, OSError) as error:
            self.failures.append(RecoveredFile(text.name, str(error)))
            return False
        return True

    def _sweep(self, remains: Remains, kept: Sequence[Path]) -> None:
        for part in remains.leftovers:
            if part in kept:
                continue
            with self._noting_failure(part.name), self._claimed(part) as is_ours:
                if is_ours:
                    self._remove(part)

    def _remove(self, part: Path) -> None:
        part.unlink(missing_ok=True)
        self._note(RecoveredFile(part.name, "unfinished, removed"))

    @contextlib.contextmanager
    def _claimed(self, path: Path) -> Iterator[bool]:
        """Hold the lock of a file's episode; False where somebody keeps it."""
        key = key_of(path.name) or key_of(_final_name(path.name))
        if key is None:
            yield True
            return
        # A renderer that outlived its monitor is about to end.
        while (lock := claim(self._directory, key)) is None and not self._is_over():
            time.sleep(_MOMENT)
        try:
            yield lock is not None
        finally:
            if lock is not None:
                lock.release()

    @contextlib.contextmanager
    def _noting_failure(self, name: str) -> Iterator[None]:
        try:
            yield
        except (Error, OSError) as error:
            self.failures.append(RecoveredFile(name, str(error)))
        except Exception as error:
            logger.exception("%s cannot be recovered.", name)
            self.failures.append(
                RecoveredFile(name, f"{type(error).__name__}: {error}")
            )

    def _note(self, file: RecoveredFile | None) -> None:
        if file is not None:
            self.files.append(file)

    def _is_over(self) -> bool:
        """Tell whether there is no more time to wait."""
        return time.monotonic() >= self._end


def _content(lock: Path) -> str:
    """Return what a dead monitor wrote into its lock, to leave it as it is."""
    with contextlib.suppress(OSError, ValueError):
        descriptor = os.open(lock, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            return os.read(descriptor, _LONGEST_LOCK).decode()
        finally:
            os.close(descriptor)
    return json.dumps({"pid": os.getpid(), "since": time.time()})


def _video_of(note: Path) -> str:
    return note.name.removeprefix(".").removesuffix(".note.part")


def _final_name(part: str) -> str:
    return part.removeprefix(".").removesuffix(".part").rpartition(".")[0]


def _has_recordings(remains: Remains) -> bool:
    files = remains.files
    return any(
        (
            *(files.journal, files.manifest, files.stats, files.trajectories),
            *(files.videos, files.metadata, remains.clip_parts),
        )
    )


def _missing_episodes(
    remains: Remains, known: KnownEpisodes
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield what the journal lacks of episodes with a trajectory or a video."""
    journal = remains.files.journal
    is_choosing = bool(journal and (run_facts(journal) or {}).get("keep"))
    names = (path.name.removeprefix(".") for path in remains.paths)
    filmed = {episode_of(n) for n in names if n.startswith("openaigym.video.")}
    for number in sorted(known.numbers - known.journaled):
        facts = known.facts(number)
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


def _missing_clips(remains: Remains) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the clips in flight; those that the journal has say the same there.

    One that cannot be read is left out; whoever renders the directory hears of it.
    """
    keys = {key_of(path.name) for path in remains.clip_parts}
    for key in keys - {None}:
        assert key is not None
        with contextlib.suppress(UnreadableFile, IndexError):
            parts = parts_of(remains.directory, key)
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


def _missing_live_clips(
    remains: Remains,
) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the clips of which there is metadata; most of them the journal has."""
    for path in remains.paths:
        match = _CLIP_METADATA.fullmatch(path.name)
        if match is not None:
            number = int(match["episode"])
            yield "clip", {"episode_id": number, "video": f"{match['video']}.mp4"}


def _facts_of(path: Path) -> Mapping[str, Any]:
    with open_for_rendering(path) as reader:
        return reader.facts


def _run_facts(remains: Remains) -> Mapping[str, Any]:
    """Return what the first line says of a journal that is gone, or never was."""
    with contextlib.suppress(OSError, ValueError):
        if run := locked_run(remains.lock):
            return run
    results = MonitorResults(remains.files)
    details = results.details
    return {
        "env_info": results.env_info,
        "schedule": (details.get("schedule") or {}).get("name"),
        **{k: details[k] for k in ("keep", "first_episode_id") if k in details},
        "versions": details.get("versions", {}),
    }


def _finish_log(path: Path, known: KnownEpisodes) -> RecoveredFile | None:
    """Give a recording in flight its final form, as far as it goes.

    One that was only to be kept until its video is there, and the video is, is dropped.

    Args:
        path: of the file that it becomes.
        known: what is known of the episodes.

    Returns:
        What was done; None where it is finished already.

    Raises:
        UnreadableFile: it may not be read; it stays.
        Error: as `finish_trajectory`.
    """
    if path.exists():
        return None
    with open_trajectory(path) as reader:
        facts, steps = dict(reader.facts), reader.step_count
    if not facts.get("kept", True) and is_done(video_path(path, facts)):
        # Its renderer died between the two.
        drop_recording(path)
        return RecoveredFile(path.name, "its video is there, removed")
    number = episode_of(path.name)
    entry = None if number is None else known.entry(number)
    is_whole = entry is not None and entry.length == steps
    what = f"{steps} {'step' if steps == 1 else 'steps'}"
    if "complete" in facts or entry is None or not is_whole:
        path = finish_trajectory(path)
        cut = "" if "complete" in facts else ", incomplete: killed"
        return RecoveredFile(path.name, what + cut)
    # All of it is there but the last words.
    ending = {
        **(known.ending(number) or {}),
        **known.sums(number),
        "end_time": entry.end_time,
    }
    return RecoveredFile(finish_trajectory(path, facts=ending).name, what)


def _set_aside(spans: Path) -> RecoveredFile:
    """Give a list of spans that cannot be read a name that nobody looks for.

    Raises:
        UnreadableFile: it is of a newer format; it stays.
    """
    with spans.open("rb") as file:
        line = file.readline(_LONGEST_LINE)
    if _is_newer(line):
        raise UnreadableFile(spans, "it was written by a newer mjrec: update mjrec")
    damaged = spans.with_name(f"{spans.name}.damaged")
    spans.replace(damaged)
    return RecoveredFile(damaged.name, "cannot be read, set aside")


def _is_newer(line: bytes) -> bool:
    try:
        values = loads(line)
    except ValueError:
        return False
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        return False
    version = values.get("version")
    return isinstance(version, int) and version > FORMAT_VERSION


def _listed(infix: Infix, listing: Written) -> Iterator[RecoveredFile]:
    """Yield the statistics and the manifest, as far as they were written."""
    if listing.stats is not None and listing.is_new_stats:
        count = len(listing.stats.timestamps)
        what = f"{count} {'episode' if count == 1 else 'episodes'}"
        yield RecoveredFile(listing.manifest.stats, what)
    if listing.is_new_manifest:
        count, pending = len(listing.manifest.videos), len(listing.pending)
        rest = f", {pending} pending: mjrec render" if pending else ""
        what = f"{count} {'video' if count == 1 else 'videos'}{rest}"
        yield RecoveredFile(manifest_name(infix), what)
