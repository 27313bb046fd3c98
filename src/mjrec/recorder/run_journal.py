# SPDX-License-Identifier: Apache-2.0
"""The journal of a run, the run that follows from it, and what was lost of it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..atomic_files import file_sha256
from ..errors import FileNotWritten
from ..formats.journal import JournalEntry, JournalWriter
from ..provenance import look_around, versions
from ..results.run import Run
from .episode_choice import EpisodeChoice
from .keep_rules import Selection
from .options import WARN, RecorderOptions

logger = logging.getLogger(__name__)


class RunJournal:
    """Writes down what happens in a run.

    Args:
        path: of the journal.
        facts: of the run.
        options: what was asked for.
        tolerates: tells whether to go on without a line that cannot be written.

    Attributes:
        run: what the journal says so far, also what the disk was too full for.
    """

    def __init__(
        self,
        path: Path,
        *,
        facts: Mapping[str, Any],
        options: RecorderOptions,
        tolerates: Callable[[FileNotWritten], bool],
    ) -> None:
        self.run = Run(facts)
        self._path = path
        self._writer = JournalWriter(path, run=facts)
        self._tolerates = tolerates
        self._policy = _policy_facts(options)
        self._surroundings = look_around()

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
            found = self._surroundings.found(wait=wait)
            if found is not None:
                self.note("surroundings", {**found, **self._policy})

    def close(self) -> None:
        """Let go of the file; idempotent."""
        self._writer.close()

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            named = FileNotWritten(self._path, error.strerror or error)
            if not self._tolerates(named):
                raise named from error


def facts_of(choice: EpisodeChoice) -> dict[str, Any]:
    """Return what is said of a run besides what is recorded."""
    return {
        "schedule": choice.schedule_name,
        "keep": _rule(choice.selection),
        "versions": dict(versions()),
    }


def _rule(selection: Selection | None) -> dict[str, Any] | None:
    if selection is None:
        return None
    left_open = {"left_open": True} if selection.is_left_open else {}
    return {"rule": selection.name, **left_open}


def _policy_facts(options: RecorderOptions) -> dict[str, Any]:
    if options.policy_file is None:
        return {"policy": None}
    path = Path(options.policy_file).absolute()
    return {"policy": {"file": str(path), "sha256": file_sha256(path)}}


What = Literal["video", "trajectory", "statistics", "journal", "model", "tracker"]


@dataclass(frozen=True)
class _Fault:
    episode_id: int | None
    what: What
    reason: str


class Faults:
    """The faults of one run.

    With `on_error="raise"` a fault is an error that the caller raises; with "warn" it
    is one warning and a line in the manifest, and the simulation goes on.

    Args:
        on_error: "raise" or "warn".
        write: writes a new one into the journal.
    """

    def __init__(self, on_error: str, write: Callable[[Any], object]) -> None:
        self._warns = on_error == WARN
        self._write = write
        self._faults: set[_Fault] = set()

    def tolerates(
        self, what: What, error: BaseException, *, episode_id: int | None
    ) -> bool:
        """Note a fault, and tell whether the simulation may go on.

        Args:
            what: could not be recorded.
            error: why.
            episode_id: of which episode; None for what belongs to none.
        """
        if not self._warns:
            return False
        if self.note(what, str(error), episode_id=episode_id):
            of = "" if episode_id is None else f" of episode {episode_id}"
            logger.warning("Not recorded whole: %s%s. %s", what, of, error)
        return True

    def note(self, what: What, reason: str, *, episode_id: int | None) -> bool:
        """Write a fault down; return whether it is a new one."""
        fault = _Fault(episode_id, what, reason)
        if fault in self._faults:
            return False
        self._faults.add(fault)
        self._write(vars(fault))
        return True
