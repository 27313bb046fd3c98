# SPDX-License-Identifier: Apache-2.0
"""An archive being put together, of recordings that are staged."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from ... import json_text
from ...errors import IdentityLeft
from ..layout import (
    CITATION,
    CRATE,
    ENVIRONMENT,
    FORMAT_KEY,
    FORMAT_VERSION,
    PAYLOAD,
    README,
    RECORDINGS,
    STATISTICS,
)
from .anonymity import make_anonymous
from .bag import make_bag
from .citation import citation
from .contents import Contents
from .crate import crate
from .environment_file import environment
from .identity import Identity
from .identity_traces import remaining_identity
from .packed_run import PackedRun, read_run
from .readme import readme
from .staging import copy_folder
from .statements import Statements
from .statistics_table import write_statistics
from .zip_file import STORED, write_zip


@dataclass(frozen=True, kw_only=True)
class Assembly:
    """What an archive is made of, and where.

    Attributes:
        contents: what is packed.
        folder: where it is put together.
        name: of the archive, without its ending.
        statements: what its author states.
        identity: what is to be taken out; None where it may stay.
    """

    contents: Contents
    folder: Path
    name: str
    statements: Statements
    identity: Identity | None

    @property
    def staged(self) -> Path:
        """The recordings as they are to be packed, but for what names somebody."""
        return self.folder / "staged"

    def archive(self) -> Path:
        """Return the archive of what is staged, still without its final name."""
        whole = self.folder / "whole"
        shutil.rmtree(whole, ignore_errors=True)
        bag = whole / self.name
        recordings = bag / PAYLOAD / RECORDINGS
        copy_folder(self.staged, recordings)
        if self.identity is not None:
            make_anonymous(recordings, identity=self.identity)
        run = read_run(
            recordings,
            name=self.name,
            statements=self.statements,
            packed_episodes=self.contents.packed_episodes,
        )
        _describe(run, bag / PAYLOAD)
        make_bag(bag, _bag_info(run))
        if self.identity is not None:
            found = remaining_identity(whole, self.identity)
            if found:
                raise IdentityLeft(found)
        archive = self.folder / "archive.zip"
        archive.unlink(missing_ok=True)
        write_zip(bag, archive)
        return archive

    def archive_within(self, limit: int) -> tuple[Path | None, int]:
        """Return the archive if it is not too large; and its size, or a lesser one."""
        # What will stand in it as it is.
        least = sum(s for name, s in self.sizes() if name.endswith(STORED))
        if least > limit:
            return None, least
        archive = self.archive()
        size = archive.stat().st_size
        return (archive if size <= limit else None), size

    def sizes(self) -> list[tuple[str, int]]:
        """Return the names and sizes of the recordings' files."""
        return [(path.name, path.stat().st_size) for path in self.staged.iterdir()]


def _describe(run: PackedRun, payload: Path) -> None:
    """Write what says what the recordings are; the crate last, which names the rest."""
    write_statistics(payload / RECORDINGS, payload / STATISTICS)
    _write(payload / ENVIRONMENT, json_text.dumps(environment(run), indent=2) + "\n")
    _write(payload / README, readme(run))
    _write(payload / CITATION, citation(run))
    _write(payload / CRATE, json_text.dumps(crate(run, payload), indent=2) + "\n")


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


def _bag_info(run: PackedRun) -> dict[str, str]:
    return {
        FORMAT_KEY: str(FORMAT_VERSION),
        "Bagging-Date": run.date,
        "External-Description": run.title,
        "Bag-Software-Agent": "mjrec <https://pypi.org/project/mjrec/>",
    }
