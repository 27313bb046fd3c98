# SPDX-License-Identifier: Apache-2.0
"""The journal of a run, the run that follows from it, and what was lost of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from ..atomic_files import file_sha256
from ..errors import FileNotWritten
from ..formats.journal import JournalEntry, JournalWriter
from ..provenance import look_around
from ..results.run import Run
from .options import WARN, RecorderOptions

logger = logging.getLogger(__name__)

What = Literal["video", "trajectory", "statistics", "journal", "model", "tracker"]


class RunJournal:
    """Writes down what happens in a run.

    With `on_error="raise"` a fault is an error that the caller raises; with "warn" it
    is one warning and a line in the manifest, and the simulation goes on.

    Args:
        path: of the journal.
        facts: of the run.
        options: what was asked for.

    Attributes:
        run: what the journal says so far, also what the disk was too full for.
    """

    def __init__(
        self, path: Path, *, facts: Mapping[str, Any], options: RecorderOptions
    ) -> None:
        self.run = Run(facts)
        self._path = path
        self._writer = JournalWriter(path, run=facts)
        self._warns = options.on_error == WARN
        self._faults: set[tuple[int | None, What, str]] = set()
        # The running one.
        self._episode_id: int | None = None
        self._policy = _policy_facts(options)
        self._statements = options.statements
        self._looking = None if options.statements else look_around()

    def begin(self, episode_id: int) -> None:
        """Take note of an episode that begins: faults are its own from here on."""
        self._episode_id = episode_id
        self.run.begin(episode_id, chosen=False)

    def add(self, entry: JournalEntry) -> None:
        """Write down a completed episode.

        Raises:
            FileNotWritten: the disk is full.
        """
        self.run.add(entry)
        self._write(lambda: self._writer.append(entry))
        self.note_surroundings()

    def note(self, kind: str, facts: Any) -> None:
        """Write down another event, one of `formats.journal.EVENTS`.

        Raises:
            FileNotWritten: the disk is full.
        """
        self.run.note(kind, facts)
        self._write(lambda: self._writer.note(kind, facts))

    def note_surroundings(self, *, wait: bool = False) -> None:
        """Write down what is around the run, once that is known.

        Args:
            wait: wait for it a little.
        """
        if self.run.surroundings is None:
            found = self._found(wait=wait)
            if found is not None:
                self.note("surroundings", found)

    def tolerates(
        self, what: What, error: BaseException, *, of_episode: bool = True
    ) -> bool:
        """Note a fault, and tell whether the simulation may go on.

        Args:
            what: could not be recorded.
            error: why.
            of_episode: False where it is not the running episode's.
        """
        episode_id = self._episode_id if of_episode else None
        if self._warns and self.note_fault(what, str(error), episode_id=episode_id):
            of = "" if episode_id is None else f" of episode {episode_id}"
            logger.warning("Not recorded whole: %s%s. %s", what, of, error)
        return self._warns

    def note_fault(self, what: What, reason: str, *, episode_id: int | None) -> bool:
        """Write a fault down; return whether it is a new one."""
        fault = (episode_id, what, reason)
        if fault in self._faults:
            return False
        self._faults.add(fault)
        facts = {"episode_id": episode_id, "what": what, "reason": reason}
        self.note("fault", facts)
        return True

    def close(self) -> None:
        """Let go of the file; idempotent."""
        self._writer.close()

    def _found(self, *, wait: bool) -> Mapping[str, Any] | None:
        if (stated := self._statements) is not None:
            is_time = wait or self.run.count >= stated.surroundings_after
            return stated.surroundings if is_time else None
        found = None if self._looking is None else self._looking.found(wait=wait)
        return None if found is None else {**found, **self._policy}

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            named = FileNotWritten(self._path, error.strerror or error)
            if not self.tolerates("journal", named):
                raise named from error


def _policy_facts(options: RecorderOptions) -> dict[str, Any]:
    if options.policy_file is None:
        return {"policy": None}
    path = Path(options.policy_file).absolute()
    return {"policy": {"file": str(path), "sha256": file_sha256(path)}}
