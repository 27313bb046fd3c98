# SPDX-License-Identifier: Apache-2.0
"""Putting the files of dead monitors in order, one monitor after the other.

While it is at it, it holds the dead monitor's lock, as the monitor did: nobody else
takes the files for abandoned, and its manifest for one to be rewritten.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..errors import Error, UnreadableFile
from ..formats.in_flight import remove_list
from ..formats.locks import try_lock
from ..formats.monitor_directory import Infix
from ..rendering.recordings import claim, key_of
from ..rendering.rendered_manifests import update_manifest
from .known_episodes import KnownEpisodes
from .live_videos import finish_video
from .manifests import write_results
from .remains import (
    Remains,
    lacks_results,
    look_through,
    model_leftovers,
    unfinished_logs,
)
from .report import RecoveredFile
from .text_recordings import finish_text
from .unfinished_logs import finish_log_of_dead, set_aside

logger = logging.getLogger(__name__)

_MOMENT = 0.05
_LONGEST_LOCK = 1 << 16


class Mending:
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

    def mend(self, infix: Infix) -> None:
        """Put the files of one monitor in order, unless it is open."""
        remains = look_through(self._directory, infix)
        with self._noting_failure(remains.lock.name):
            lock = try_lock(remains.lock, _content(remains.lock))
            if lock is None:
                return
            if remains.lock in remains.paths:
                self._note(RecoveredFile(remains.lock.name, "its monitor was killed"))
            try:
                self._mend(remains)
            except BaseException:
                # What it says of the environment may not be written anywhere else.
                lock.let_go()
                raise
            lock.release()
            # Whoever rendered meanwhile took the monitor for open.
            update_manifest(self._directory, infix)

    def sweep_models(self) -> None:
        """Remove unfinished files of models."""
        for part in model_leftovers(self._directory):
            with self._noting_failure(part.name):
                self._remove(part)

    def _mend(self, remains: Remains) -> None:
        known = KnownEpisodes(remains)
        for spans in remains.damaged_lists:
            with self._noting_failure(spans.name):
                self._note(set_aside(spans))
        for log in unfinished_logs(remains):
            with self._noting_failure(log.name), self._claimed(log) as is_ours:
                if is_ours:
                    self._note(finish_log_of_dead(log, known))
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
        if has_news or lacks_results(remains):
            for file in write_results(self._directory, remains.infix, known):
                self._note(file)

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
