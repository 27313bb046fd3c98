# SPDX-License-Identifier: Apache-2.0
"""The journal of a run, and the run that follows from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..errors import FileNotWritten
from ..file_digests import file_sha256
from ..formats.journal import JournalEntry, JournalWriter
from ..provenance import look_around
from ..results.run import Run
from .episode_choice import EpisodeChoice
from .options import RecorderOptions
from .selection import Selection
from .versions import versions


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
