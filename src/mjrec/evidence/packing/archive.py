# SPDX-License-Identifier: Apache-2.0
"""Packing: from a monitor directory to one zip file that can be verified."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from ...errors import Error, FileNotWritten, InvalidArgument
from ...formats.monitor_directory import FILE_PREFIX
from ...rendering.jobs import Progress
from .assembly import Assembly
from .bag import check_bagit
from .contents import look_for_contents
from .identity import identity_of_user
from .size_limit import archive_within
from .sizes import byte_count
from .staging import TRY_AGAIN, publish, stage, staging_folder
from .statements import state

_ENDING = ".zip"


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
        assembly = Assembly(
            contents=contents,
            folder=folder,
            name=target.stem,
            statements=statements,
            identity=identity,
        )
        try:
            stage(contents, assembly.staged)
            finished = (
                assembly.archive()
                if limit is None
                else archive_within(limit, assembly, on_progress=on_progress)
            )
            publish(finished, target)
        except FileExistsError:
            raise _exists(target) from None
        except Error:
            raise
        except OSError as error:
            reason = error.strerror or error
            raise FileNotWritten(target, reason, then=TRY_AGAIN) from error
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
