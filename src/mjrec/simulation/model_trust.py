# SPDX-License-Identifier: Apache-2.0
"""The list of compiled models that this user has stored; no other models are loaded.

MuJoCo trusts the addresses and types in a compiled model, so loading a crafted model
can run any code. The hashes in a directory prove nothing, because anyone can write
them. So the models that this user stores are listed where only this user can write::

    $XDG_STATE_HOME/mjrec/models       the sha256 of each model and of the path of its
                                       directory, one per line
    ~/.local/state/mjrec/models        by default
    <temporary directory>/mjrec-<uid>/models       if that is not writable

A list that others can open is neither used nor replaced, because only its owner can
judge its content. Until its permissions are fixed, new models are listed in the other
location.

A list that reaches 65,536 lines becomes `models.old` and replaces the previous
`models.old`, whose models are then no longer trusted.

Workers on other machines may have different home directories. They receive the hashes
that their jobs need, and list them as their own. They report the models that they
store, and the machine that sent the job lists these models.

This module needs no simulator.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import functools
import hashlib
import logging
import os
import re
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path

from ..formats.monitor_directory import FILE_PREFIX

logger = logging.getLogger(__name__)

TRUST_VARIABLE = "MJREC_TRUST_MODELS"
ALL_MODELS = "1"

_DIGEST = re.compile("[0-9a-f]{64}")
_DIGITS_IN_NAME = 16
# A task may compile a model for each episode. A list of this size (4.3 MB) is read
# within milliseconds.
_MOST_BYTES = 65_536 * 66
# Do not follow links, and do not block on a pipe.
_CAREFULLY = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC

# The models listed in this context, for a worker's report.
_noting: ContextVar[list[str] | None] = ContextVar("noting", default=None)


def note_models(digests: Iterable[str]) -> None:
    """List models as this user's own. Models that are already listed are skipped.

    If no list can be written, a warning is logged.

    Args:
        digests: the SHA-256 hashes of the compiled models, in hex.
    """
    wanted = list(dict.fromkeys(digests))
    noting = _noting.get()
    if noting is not None:
        noting += wanted
    listed = _listed() if wanted else ""
    new = [digest for digest in wanted if f"\n{digest}\n" not in listed]
    reasons = []
    for directory in _directories() if new else ():
        try:
            _append(directory, new)
            return
        except OSError as error:
            reasons.append(f"{directory}: {error.strerror or error}")
    if new:
        _warn_once(
            "The list of this user's models cannot be written "
            f"({'; '.join(reasons)}), so the models of these recordings will not be "
            f"trusted. If their sources are not stored, set {TRUST_VARIABLE}=1 to "
            "render them."
        )


@contextlib.contextmanager
def noting_models() -> Iterator[list[str]]:
    """Yield a list that collects the hashes of all models stored inside the block."""
    noted: list[str] = []
    token = _noting.set(noted)
    try:
        yield noted
    finally:
        _noting.reset(token)


def is_stored(digest: object) -> bool:
    """Return whether this user has stored a model.

    Args:
        digest: the SHA-256 of the compiled model, as read from a file. Any value is
            accepted; a malformed value counts as not stored.
    """
    if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
        return False
    return f"\n{digest}\n" in _listed()


def directory_digest(directory: Path) -> str:
    """Return the digest that represents a directory in the list of models.

    The digest identifies the directory by its path. A directory that was moved or
    copied is untrusted, which only slows down reading.
    """
    place = f"directory {os.path.realpath(directory)}"
    return hashlib.sha256(place.encode(errors="surrogateescape")).hexdigest()


def is_own_directory(directory: Path) -> bool:
    """Return whether this user has recorded into a directory."""
    return is_stored(directory_digest(directory))


def stored_models(directories: Iterable[Path]) -> list[str]:
    """Return the hashes of this user's models in some directories.

    Args:
        directories: directories of recordings, which need not exist.
    """
    pattern = f"{FILE_PREFIX}.model.*.mjb.gz"
    paths = (path for directory in directories for path in directory.glob(pattern))
    found = {path.name.split(".")[2] for path in paths}
    listed = set(_listed().split())
    return sorted(digest for digest in listed if digest[:_DIGITS_IN_NAME] in found)


def is_trusted() -> bool:
    """Return whether the environment variable allows loading all models."""
    return os.environ.get(TRUST_VARIABLE, "") not in ("", "0")


@contextlib.contextmanager
def trusting_models() -> Iterator[None]:
    """Allow this process, and those that it starts in the block, to load any model.

    Use this only in a program's own main thread, because environment variables are
    global.
    """
    before = os.environ.get(TRUST_VARIABLE)
    os.environ[TRUST_VARIABLE] = ALL_MODELS
    try:
        yield
    finally:
        os.environ.pop(TRUST_VARIABLE)
        if before is not None:
            os.environ[TRUST_VARIABLE] = before


@functools.cache
def _warn_once(message: str) -> None:
    logger.warning(message)


def _directories() -> Iterator[Path]:
    """Yield the possible directories for a list, best first."""
    state, home = os.environ.get("XDG_STATE_HOME", ""), os.path.expanduser("~")  # noqa: PTH111  `Path.home` raises for users without one
    # The XDG specification says to ignore relative paths.
    if state.startswith("/"):
        yield Path(state, "mjrec")
    # A home directory may be a placeholder like /nonexistent, which root could create.
    elif home.startswith("/") and os.access(home, os.F_OK):
        yield Path(home, ".local", "state", "mjrec")
    yield Path(tempfile.gettempdir(), f"mjrec-{os.geteuid()}")


def _listed() -> str:
    """Return the content of this user's lists: each hash between newlines."""
    content = ""
    # All lists are read, because the home directory may not always be writable.
    for directory in _directories():
        for name in ("models.old", "models"):
            try:
                with _opened(directory / name, os.O_RDONLY) as descriptor:
                    size = os.fstat(descriptor).st_size
                    content += (
                        f"\n{os.read(descriptor, size).decode('ascii', 'replace')}"
                    )
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as error:
                _warn_once(
                    f"The list of this user's models is not used: {error}. If no one "
                    "else has written to it, fix its permissions; otherwise delete it. "
                    "Models listed in it are then no longer trusted."
                )
    return content


def _append(directory: Path, digests: Iterable[str]) -> None:
    """Append to the list in a directory, creating the list if necessary.

    Raises:
        OSError: the list cannot be written, or others can open it.
    """
    path = directory / "models"
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    with _opened(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND) as descriptor:
        # Appending is not atomic on network file systems.
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        # The first newline ends a line that a full disk may have truncated.
        text = "".join(f"\n{digest}" for digest in digests).encode() + b"\n"
        if os.write(descriptor, text) < len(text):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if os.fstat(descriptor).st_size >= _MOST_BYTES:
            path.replace(path.with_name("models.old"))


@contextlib.contextmanager
def _opened(path: Path, flags: int) -> Iterator[int]:
    """Yield the file descriptor of a list.

    Raises:
        OSError: the list cannot be opened, or others can open it or have created it.
    """
    _check(path.parent, path.parent.lstat(), stat.S_IFDIR, mode=700)
    descriptor = os.open(path, flags | _CAREFULLY, 0o600)
    try:
        _check(path, os.fstat(descriptor), stat.S_IFREG, mode=600)
        yield descriptor
    finally:
        os.close(descriptor)


def _check(path: Path, facts: os.stat_result, kind: int, *, mode: int) -> None:
    """Raise PermissionError if other users may have written to a path."""
    if stat.S_IFMT(facts.st_mode) != kind or facts.st_uid != os.geteuid():
        raise PermissionError(f"{path} belongs to another user, or is a link or pipe")
    if facts.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise PermissionError(f"{path} is open to other users (chmod {mode} {path})")
