# SPDX-License-Identifier: Apache-2.0
"""Packing a monitor directory into one zip file that can be verified.

The archive is built in a hidden folder next to its final path. Files are hard-linked
into the folder if possible, so that a run of many gigabytes needs little space. They
are never changed in place: a new version is written to a temporary file and renamed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from ..atomic_files import temporary_path
from ..errors import (
    DirectoryNotWritable,
    Error,
    FileNotWritten,
    IdentityLeft,
    InvalidArgument,
    PackError,
)
from ..formats.monitor_directory import FILE_PREFIX
from ..rendering.jobs import Progress
from .anonymity import make_anonymous
from .bag import TRY_AGAIN, make_bag, write_zip
from .contents import Contents, link_or_copy, look_for_contents
from .descriptions import descriptions, packed_with
from .identity import Identity, identity_of_user
from .identity_matching import remaining_identity
from .layout import MOST_ENTRIES, PAYLOAD, RECORDINGS
from .packed_run import PackedRun, PackingOptions, planned_episodes, read_run
from .size_limit import byte_count, shrinking
from .statements import state

logger = logging.getLogger(__name__)

_ENDING = ".zip"
# The archive's name until it is complete.
_ARCHIVE = "archive.zip"
# Number of files in addition to the recordings: the bag's own and the descriptions.
_DESCRIPTIONS = 9


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
    """Pack a monitor directory into one file that others can verify.

    The zip file contains one folder with the file's name: a BagIt bag with sha512
    checksums, whose payload is an RO-Crate with the monitor directory,
    `environment.json`, the statistics as CSV, a README and `CITATION.cff`. The same
    recordings, options and versions give the same bytes. The directory does not change,
    and if anything fails there is no archive.

    ::

        mjrec.pack("videos", "run.zip", authors=["Ada Lovelace"], license="CC-BY-4.0")
        mjrec.verify("run.zip")

    Args:
        directory: the monitor directory, or a folder with several, such as an
            evaluation's. Its monitors must be closed and its videos rendered.
        path: the archive, a new file that ends in `.zip`.
        title: the run's title. None generates one from the recorded environments.
        authors: each in the form "Name", "Name <address>" or "Name <ORCID>".
        license: SPDX identifier of the license, such as "CC-BY-4.0", or its URL.
        episodes: numbers of the episodes whose videos and states are packed. None means
            all, and must be used for a folder with several directories. The statistics,
            actions and seeds of all episodes are always packed, and the archive records
            the choice.
        anonymous: remove everything that identifies a user, a machine or an author,
            for blind review.
        max_size: size limit in bytes, a number or a string such as `"50M"` (50
            million). If the archive is larger, its videos are rerendered from the
            states at 3/4, 1/2, 3/8 or 1/4 of their width and height, and the archive
            records this.
        on_progress: called with the progress of rerendering.

    Returns:
        The path of the archive.

    Raises:
        MissingDependency: the extra `evidence` is not installed.
        InvalidArgument: an argument is invalid, `directory` is not a monitor
            directory, or `path` exists.
        UnknownName: one of `episodes` does not exist.
        DirectoryInUse: a monitor is open, or a process is rendering.
        UnfinishedRecordings: videos are pending, or a monitor was killed.
        ArchiveTooLarge: `max_size` is too small.
        IdentityLeft: `anonymous` is set, but a name could not be removed.
        PackError: a file is missing or cannot be packed, or there are more files than
            `verify` accepts.
        UnreadableFile: a file is damaged.
        FileNotWritten, DirectoryNotWritable: the disk is full or read-only.
    """
    target, source = _checked_paths(Path(path), Path(directory))
    if authors is not None and not isinstance(authors, str):
        authors = tuple(authors)
    statements = state(title=title, authors=authors, license=license)
    contents = look_for_contents(source, episodes)
    options = PackingOptions(
        name=target.stem,
        title=statements.title,
        authors=() if anonymous else tuple(authors or ()),
        license=license,
        episodes=contents.packed_episodes,
        anonymous=anonymous,
        max_size=None if max_size is None else byte_count(max_size),
        planned=planned_episodes(source),
    )
    identity = None
    if anonymous:
        identity = identity_of_user(contents.provenance, statements.authors)
    with _folder_beside(target) as folder:
        try:
            bag, run = _bag(contents, folder, options, identity, on_progress)
            finished = folder / _ARCHIVE
            if not finished.exists():
                write_zip(bag, finished)
            _publish(finished, target)
        except FileExistsError:
            raise _exists(target) from None
        except Error:
            raise
        except OSError as error:
            reason = error.strerror or error
            raise FileNotWritten(target, reason, then=TRY_AGAIN) from error
    if run.is_unfinished:
        logger.warning(
            "The archive has %d of %d episodes: the evaluation is not finished, "
            "or some of its episodes failed.",
            run.episodes,
            options.planned,
        )
    return target


def pack_folder(directory: Path, folder: Path, options: PackingOptions) -> None:
    """Pack a monitor directory into a new folder, with the same content as an archive.

    If the archive is anonymous, names are not searched for, because the recordings
    contain none.

    Raises:
        Error: packing failed; see `pack`.
    """
    contents = look_for_contents(directory, options.episodes)
    identity = Identity() if options.anonymous else None
    with _folder_beside(folder) as temporary:
        bag, _ = _bag(contents, temporary, options, identity, lambda _: None)
        bag.rename(folder)


def _bag(
    contents: Contents,
    folder: Path,
    options: PackingOptions,
    identity: Identity | None,
    on_progress: Callable[[Progress], object],
) -> tuple[Path, PackedRun]:
    """Make the bag below `folder`; with a size limit, also make the archive there."""
    _check_count(contents)
    staged, bag = folder / "staged", folder / "whole" / options.name
    staged.mkdir()
    for name, write in contents.files.items():
        write(staged / name)
    if options.max_size is None:
        return bag, _make_bag(staged, bag, options, identity)
    archive = folder / _ARCHIVE
    for _ in shrinking(options.max_size, staged, archive, on_progress=on_progress):
        archive.unlink(missing_ok=True)
        run = _make_bag(staged, bag, options, identity)
        write_zip(bag, archive)
    return bag, run


def _make_bag(
    staged: Path, bag: Path, options: PackingOptions, identity: Identity | None
) -> PackedRun:
    """Make a bag from the staged files, replacing any earlier bag."""
    shutil.rmtree(bag, ignore_errors=True)
    recordings = bag / PAYLOAD / RECORDINGS
    recordings.mkdir(parents=True)
    for path in sorted(staged.iterdir()):
        link_or_copy(path, recordings / path.name)
    if identity is not None:
        make_anonymous(recordings, identity=identity)
    run = read_run(recordings, options=options)
    texts = descriptions(run, recordings, packed_with=packed_with())
    for name, text in texts.items():
        (bag / PAYLOAD / name).write_text(text, encoding="utf-8", newline="\n")
    make_bag(bag, date=run.date, title=run.title)
    found = [] if identity is None else remaining_identity(bag.parent, identity)
    if found:
        raise IdentityLeft(found)
    return run


def _checked_paths(path: Path, directory: Path) -> tuple[Path, Path]:
    if not directory.is_dir():
        raise InvalidArgument(f"The directory {directory} does not exist.")
    if path.suffix != _ENDING or path.name.startswith("."):
        raise InvalidArgument(
            f"The archive is a zip file: its name must end in {_ENDING} and must not "
            f"begin with a dot, got {str(path)!r}."
        )
    if not path.name.isprintable() or "\\" in path.name:
        raise InvalidArgument(f"{path.name!r} is not a valid name for an archive.")
    if path.name.startswith(FILE_PREFIX):
        raise InvalidArgument(
            f"{path.name} looks like the name of a monitor's file. Choose another name."
        )
    if os.path.lexists(path):
        raise _exists(path)
    # The working directory may change before the archive is written.
    return path.absolute(), directory.absolute()


def _exists(path: Path) -> InvalidArgument:
    return InvalidArgument(
        f"{path} already exists, and evidence is never replaced. Choose another name, "
        "or move the file away."
    )


def _check_count(contents: Contents) -> None:
    count = len(contents.files)
    if count > MOST_ENTRIES - _DESCRIPTIONS:
        raise PackError(
            f"The archive would contain {count} recorded files, but mjrec verify "
            f"accepts archives of at most {MOST_ENTRIES} files. Choose episodes with "
            "--episodes, or record into several directories."
        )


@contextlib.contextmanager
def _folder_beside(archive: Path) -> Iterator[Path]:
    """Yield a new hidden folder next to `archive`, and remove it at the end."""
    folder = temporary_path(archive)
    try:
        folder.mkdir(mode=0o700)
    except OSError as error:
        raise DirectoryNotWritable(archive.parent, error.strerror) from error
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _publish(finished: Path, path: Path) -> None:
    """Give a finished archive its final name without replacing an existing file."""
    try:
        path.hardlink_to(finished)
    except FileExistsError:
        raise
    except OSError:
        # On a file system without links, a race between check and rename remains.
        if os.path.lexists(path):
            raise FileExistsError(path) from None
        finished.rename(path)
