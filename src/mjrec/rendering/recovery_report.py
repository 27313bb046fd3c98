# SPDX-License-Identifier: Apache-2.0
"""What a recovery did, file by file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RecoveredFile:
    """A file, and its state after a recovery.

    Attributes:
        name: its base name, in the end.
        what: what was done, in words.
    """

    name: str
    what: str

    def __str__(self) -> str:
        return f"{self.name}: {self.what}"


@dataclass(frozen=True)
class Recovery:
    """What `recover` did. It is false where there was nothing to do.

    Attributes:
        directory: the directory.
        files: what was put in order.
        failures: what could not be, and why. It stays as it was.
        open_monitors: infixes of the monitors that are still recording, and whose
            files were left alone.
    """

    directory: Path
    files: tuple[RecoveredFile, ...] = ()
    failures: tuple[RecoveredFile, ...] = ()
    open_monitors: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.files or self.failures)

    def __str__(self) -> str:
        return "\n".join(self._lines())

    def _lines(self) -> list[str]:
        if not self:
            lines = [f"Nothing to recover in {self.directory}."]
        elif not self.files:
            lines = [f"Nothing could be recovered in {self.directory}."]
        else:
            lines = [f"Recovered in {self.directory}:"]
        lines += [f"  {file}" for file in self.files]
        if self.failures:
            lines += ["Not recovered:", *(f"  {file}" for file in self.failures)]
        if self.open_monitors:
            listed = ", ".join(self.open_monitors)
            lines += [f"Still recording, and left alone: {listed}."]
        return lines
