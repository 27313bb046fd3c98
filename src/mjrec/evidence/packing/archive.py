# SPDX-License-Identifier: Apache-2.0
"""Packing: from a monitor directory to one zip file that can be verified."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ... import json_text
from ...errors import (
    ArchiveTooLarge,
    FileNotWritten,
    IdentityLeft,
    InvalidArgument,
)
from ...formats.monitor_directory import FILE_PREFIX
from ...rendering.progress import Progress
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
from .anonymity import make_anonymous, remaining_identity
from .bag import check_bagit, make_bag
from .citation import citation
from .contents import Contents, look_for_contents
from .crate import crate
from .environment_file import environment
from .identity import Identity, identity_of_user
from .packed_run import PackedRun, read_run
from .readme import readme
from .sizes import byte_count
from .smaller_videos import SCALES, draw_smaller, redrawable
from .staging import TRY_AGAIN, copy_folder, publish, stage, staging_folder
from .statements import Statements, state
from .statistics_table import write_statistics
from .zip_file import STORED, write_zip

__all__ = ["pack"]

_ENDING = ".zip"
# Of the files that an archive that is too large is made of.
_LARGEST = 10


def pack(
    directory: str | os.PathLike[str],
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
    authors: Iterable[str] | None = None,
    license: str | None = None,
    episodes: Iterable[int] | None = None,
    anonymous: bool = False,
    max_size: int | str | None = None,
    on_progress: Callable[[Progress], object] = lambda _: None,
) -> Path:
    """Pack a monitor directory into one file that a stranger can verify.

    It is a zip file with one folder, which is called as the file: a BagIt bag with
    sha512 checksums, whose payload is an RO-Crate with the monitor directory's files,
    `environment.json`, the statistics as CSV, a README and `CITATION.cff`. The same
    recordings, statements and versions give the same bytes. Nothing in the directory
    changes, and where anything fails there is no archive.

    ::

        mjrec.pack("videos", "run.zip", authors=["Ada Lovelace"], license="CC-BY-4.0")
        mjrec.verify("run.zip")

    Args:
        directory: the monitor directory. Its monitors are closed, and its videos
            rendered.
        path: the archive; its name ends in `.zip`, and nothing of that name exists.
        title: of the run; what was recorded, if None.
        authors: each "Name", "Name <address>" or "Name <ORCID>", in their order.
        license: the SPDX identifier of the licence, such as "CC-BY-4.0", or its URL.
        episodes: the numbers of those whose videos and recorded states are packed;
            all, if None. The statistics are of all in any case, and the archive says
            that a choice was made.
        anonymous: whether everything is taken out that names a user, a machine or an
            author; for blind reviews.
        max_size: the most bytes of the archive, as a number or as `"50M"` (50 million).
            If it would be larger, the videos are drawn again from the recorded states
            at 3/4, 1/2, 3/8 and 1/4 of width and height, which the archive says.
        on_progress: told how far that drawing is.

    Returns:
        The path of the archive.

    Raises:
        MissingDependency: the extra `evidence` is not installed.
        InvalidArgument: a value that cannot be, no monitor directory, or a file that
            is there already.
        UnknownName: there is no such episode.
        DirectoryInUse: a monitor is open, or somebody renders.
        UnfinishedRecordings: videos are pending, or a monitor was killed.
        ArchiveTooLarge: `max_size` cannot be kept.
        IdentityLeft: `anonymous`, and a name could not be taken out.
        PackError: a file is missing, or cannot be packed.
        UnreadableFile: a file is damaged.
        FileNotWritten, DirectoryNotWritable: there is no room, or no permission.
    """
    check_bagit()
    target, source = _checked_paths(Path(path), Path(directory))
    limit = None if max_size is None else byte_count(max_size)
    names = list(authors or ()) if not isinstance(authors, str) else authors
    statements = state(title=title, authors=names, license=license, anonymous=anonymous)
    contents = look_for_contents(source, episodes)
    identity = (
        identity_of_user(surroundings=contents.surroundings, authors=names)
        if anonymous
        else None
    )
    with staging_folder(target) as folder:
        packing = _Packing(
            contents=contents,
            folder=folder,
            name=target.stem,
            statements=statements,
            identity=identity,
        )
        try:
            stage(contents, packing.staged)
            finished = (
                packing.archive()
                if limit is None
                else _within(limit, packing, on_progress)
            )
            publish(finished, target)
        except FileExistsError:
            raise _exists(target) from None
        except FileNotWritten:
            raise
        except OSError as error:
            raise FileNotWritten(target, error.strerror, then=TRY_AGAIN) from error
    return target


def _checked_paths(path: Path, directory: Path) -> tuple[Path, Path]:
    if not directory.is_dir():
        raise InvalidArgument(f"There is no directory {directory} to pack.")
    if path.suffix != _ENDING or path.name.startswith("."):
        raise InvalidArgument(
            f"The archive is a zip file: its name ends in {_ENDING} and does not begin "
            f"with a dot, got {str(path)!r}."
        )
    if not path.name.isprintable() or "\\" in path.name:
        raise InvalidArgument(f"{path.name!r} is no name for an archive.")
    if path.name.startswith(FILE_PREFIX):
        raise InvalidArgument(
            f"{path.name} is called as files of monitors are. Choose another name."
        )
    if os.path.lexists(path):
        raise _exists(path)
    # The working directory may be another one by the time it is written.
    return path.absolute(), directory.absolute()


def _exists(path: Path) -> InvalidArgument:
    return InvalidArgument(
        f"{path} exists already, and evidence is never replaced. Choose another name, "
        "or move it away."
    )


@dataclass(frozen=True, kw_only=True)
class _Packing:
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
        archive = self.folder / f"archive{_ENDING}"
        archive.unlink(missing_ok=True)
        write_zip(bag, archive)
        return archive

    def least_size(self) -> int:
        """Return what the archive will certainly have: what is in it uncompressed."""
        return sum(size for name, size in _sizes(self.staged) if name.endswith(STORED))


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


def _within(
    limit: int, packing: _Packing, on_progress: Callable[[Progress], object]
) -> Path:
    """Return an archive of at most `limit` bytes, with smaller videos if need be."""
    size = packing.least_size()
    if size <= limit:
        archive = packing.archive()
        size = archive.stat().st_size
        if size <= limit:
            return archive
    videos = redrawable(packing.contents.videos)
    drawn = sum(video.video.stat().st_size for video in videos)
    for scale in SCALES if size - drawn <= limit else ():
        # No video shrinks more than its pictures do: there is no use in trying.
        if size - drawn + drawn * scale**2 > limit and scale is not SCALES[-1]:
            continue
        draw_smaller(videos, packing.staged, scale, on_progress=on_progress)
        least = packing.least_size()
        if least > limit:
            continue
        archive = packing.archive()
        if archive.stat().st_size <= limit:
            return archive
    raise _too_large(limit, packing, can_draw=bool(videos))


def _too_large(limit: int, packing: _Packing, *, can_draw: bool) -> ArchiveTooLarge:
    sizes = sorted(_sizes(packing.staged), key=lambda item: (-item[1], item[0]))
    return ArchiveTooLarge(
        sum(size for _, size in sizes),
        limit,
        sizes[:_LARGEST],
        reason=(
            "Smaller videos do not help."
            if can_draw
            else "No video in it can be drawn again smaller: there are no recorded "
            "states of them, and what is encoded is never encoded again."
        ),
    )


def _sizes(folder: Path) -> Sequence[tuple[str, int]]:
    return [(path.name, path.stat().st_size) for path in folder.iterdir()]
