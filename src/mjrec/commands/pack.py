# SPDX-License-Identifier: Apache-2.0
"""`mjrec pack`: pack a monitor directory into one file that others can verify."""

from __future__ import annotations

import re
import shlex
import zipfile
from pathlib import Path
from typing import Annotated

import rich.console
import tyro

from ..atomic_files import file_sha256
from ..errors import InvalidArgument
from ..evidence.pack import pack as pack_directory
from ..evidence.size_limit import shown_size
from ..monitors.progress import render_progress
from .not_finite import not_finite_in, not_finite_lines
from .terminal import print_lines

_NUMBERS = re.compile(r"\d{1,15}(,\d{1,15})*", re.ASCII)


def pack(
    directory: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    author: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    license: str | None = None,
    title: str | None = None,
    anonymous: bool = False,
    episodes: str | None = None,
    max_size: str | None = None,
) -> int:
    """Pack recordings into one file that others can verify.

    The zip file is a BagIt bag around an RO-Crate with the recordings, statistics as
    CSV, versions and machine, a README and a CITATION.cff. The same recordings give the
    same bytes. Readers check it with mjrec verify.

    Args:
        directory: a monitor directory, or one with several, such as an evaluation.
        out: the archive, a new file whose name ends in .zip.
        author: "Name", "Name <address>" or "Name <ORCID>". May be repeated.
        license: SPDX identifier of the license, such as CC-BY-4.0, or its URL.
        title: title of the run. Default: derived from the recordings.
        anonymous: remove everything that identifies a user, a machine or an author.
        episodes: pack videos and states of these episodes only, such as 0,8,27. The
            archive records this choice.
        max_size: size limit, such as 50M. If needed, videos are rerendered at a
            smaller size.
    """
    console = rich.console.Console(stderr=True)
    with render_progress(console, title="rendering smaller videos") as on_progress:
        archive = pack_directory(
            directory,
            out,
            title=title,
            authors=author,
            license=license,
            episodes=None if episodes is None else _numbers(episodes),
            anonymous=anonymous,
            max_size=max_size,
            on_progress=on_progress,
        )
    lines = [*_lines(archive), *not_finite_lines(not_finite_in(directory))]
    print_lines(rich.console.Console(), lines)
    return 0


def _numbers(text: str) -> list[int]:
    """Return the numbers in a list such as "0,8,27".

    Raises:
        InvalidArgument: `text` is not a list of numbers.
    """
    plain = text.replace(" ", "")
    if not _NUMBERS.fullmatch(plain):
        raise InvalidArgument(
            "--episodes must be a comma-separated list of numbers, such as 0,8,27, got "
            f"{text!r}."
        )
    return [int(number) for number in plain.split(",")]


def _lines(archive: Path) -> list[str]:
    size = archive.stat().st_size
    with zipfile.ZipFile(archive) as packed:
        count = len(packed.infolist())
    return [
        str(archive),
        f"  {count} files, {shown_size(size)} ({size} bytes)",
        f"  sha256 {file_sha256(archive)}",
        f"To verify it: mjrec verify {shlex.quote(str(archive))}",
    ]
