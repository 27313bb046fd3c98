# SPDX-License-Identifier: Apache-2.0
"""Which compiled models are loaded: those that this user has stored.

MuJoCo believes the addresses and types in a compiled model, so that a crafted one can
do anything to the process that loads it. The hashes in a directory prove nothing:
its maker wrote them too. So the models that this user stores are listed where only
this user can write::

    $XDG_STATE_HOME/mjrec/models       their sha256, one a line, and those of the
                                       paths of directories that they were stored in
    ~/.local/state/mjrec/models        by default
    <temporary directory>/mjrec-<uid>/models       where that cannot be written

A list that others can open is neither used nor replaced, because only its owner knows
what they wrote. Until it is mended, the other place has a list.

The list keeps the newest models: beyond 131,072 the older half is forgotten, and
counts as a stranger's from then on.

Workers on other machines, whose homes may be others, are sent the hashes that their
jobs need and list them as their own; what they store, they report, and the machine
that sent the job lists it.

Needs no simulator.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import logging
import os
import pwd
import re
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path

from ..atomic_files import replacing
from ..formats.locks import wait_for_lock
from ..formats.monitor_directory import FILE_PREFIX

logger = logging.getLogger(__name__)

TRUST_VARIABLE = "MJREC_TRUST_MODELS"
ALL_MODELS = "1"

_ONE_BY_ONE = "sha256:"
_LIST_NAME = "models"
_DIGEST = re.compile("[0-9a-f]{64}")
_DIGITS_IN_NAME = 16
# A task may compile a model for each episode. So many are 4.3 MB, read in milliseconds.
_KEPT = 1 << 16
_OTHERS = stat.S_IRWXG | stat.S_IRWXO

# What is listed in this context, for a worker's report.
_noting: ContextVar[list[str] | None] = ContextVar("noting", default=None)


def note_models(digests: Iterable[str]) -> None:
    """List models as this user's; those that are listed already stay where they are.

    Where no list can be kept, a warning says so.

    Args:
        digests: the sha256 of the compiled models, in hex.
    """
    wanted = list(dict.fromkeys(digests))
    noting = _noting.get()
    if noting is not None:
        noting += wanted
    reasons = []
    for directory in _directories() if wanted else ():
        try:
            _add(directory, wanted)
            return
        except _Refused as error:
            _warn_once(str(error))
            reasons.append(str(error))
        except OSError as error:
            reasons.append(f"{directory}: {error.strerror or error}")
    if wanted:
        _warn_once(
            "The models of these recordings count as a stranger's, because no list of "
            f"this user's models can be kept ({'; '.join(reasons)}). Where it is not "
            f"known what they were made from, rendering will need {TRUST_VARIABLE}=1."
        )


@contextlib.contextmanager
def noting_models() -> Iterator[list[str]]:
    """Yield a list that gets the hashes of all models that are stored in the block."""
    noted: list[str] = []
    token = _noting.set(noted)
    try:
        yield noted
    finally:
        _noting.reset(token)


def is_stored(digest: object) -> bool:
    """Tell whether this user has stored a model.

    Args:
        digest: the sha256 of the compiled model, as a file says; anything.
    """
    if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
        return False
    return any(f"\n{digest}\n" in f"\n{content}" for content in _lists())


def directory_digest(directory: Path) -> str:
    """Return what `note_models` notes of a directory that this user records into.

    By its place: what was moved or copied is a stranger's, which costs a moment and
    nothing else.
    """
    place = os.path.realpath(directory)
    return hashlib.sha256(
        f"directory {place}".encode(errors="surrogateescape")
    ).hexdigest()


def is_own_directory(directory: Path) -> bool:
    """Tell whether this user has recorded into a directory."""
    return is_stored(directory_digest(directory))


def stored_models(directories: Iterable[Path]) -> list[str]:
    """Return the hashes of this user's models in some directories.

    Args:
        directories: of recordings; each may be missing.
    """
    pattern = f"{FILE_PREFIX}.model.*.mjb.gz"
    paths = (path for directory in directories for path in directory.glob(pattern))
    found = {path.name.split(".")[2] for path in paths}
    listed = {digest for content in _lists() for digest in content.split()}
    return sorted(digest for digest in listed if digest[:_DIGITS_IN_NAME] in found)


def is_trusted(digest: object) -> bool:
    """Tell whether the environment variable says that a model is to be loaded.

    `1` says it of all models, `sha256:<hex>,sha256:<hex>` of those with these hashes.

    Args:
        digest: the sha256 of the compiled model, as a file says; anything. Whoever
            loads it looks whether that is true.
    """
    said = os.environ.get(TRUST_VARIABLE, "")
    if not said.startswith(_ONE_BY_ONE):
        return said not in ("", "0")
    return isinstance(digest, str) and f"{_ONE_BY_ONE}{digest}" in said.split(",")


@contextlib.contextmanager
def trusting_models(digests: Iterable[str] | None = None) -> Iterator[None]:
    """Let this process, and those that it starts in the block, load some models.

    For whoever knows that nothing crafted has these hashes, in a program's own main
    thread: environment variables belong to the process. What was trusted before is
    not, in the block.

    Args:
        digests: the sha256 of the compiled models, in hex; None is all models.
    """
    before = os.environ.get(TRUST_VARIABLE)
    said = (_ONE_BY_ONE + digest for digest in digests or ())
    os.environ[TRUST_VARIABLE] = ALL_MODELS if digests is None else ",".join(said)
    try:
        yield
    finally:
        os.environ.pop(TRUST_VARIABLE)
        if before is not None:
            os.environ[TRUST_VARIABLE] = before


class _Refused(Exception):
    """What stands in a list's place is not used."""

    def __init__(self, objection: str) -> None:
        super().__init__(
            f"The list of this user's models is not used: {objection}. If nobody else "
            "has written there, mend that; else remove it: models that were stored "
            "before then count as a stranger's."
        )


@functools.cache
def _warn_once(message: str) -> None:
    logger.warning(message)


def _lists() -> Iterator[str]:
    """Yield what this user's lists hold."""
    # The home directory may have been writable only at one time of two.
    for directory in _directories():
        try:
            with _opened(directory, os.O_RDONLY) as descriptor:
                yield _content(descriptor)
        except _Refused as error:
            _warn_once(str(error))
        except OSError:
            continue


def _directories() -> Iterator[Path]:
    """Yield where a list may be, the best place first."""
    state = _state_directory()
    if state is not None:
        yield state / "mjrec"
    with contextlib.suppress(OSError):
        yield Path(tempfile.gettempdir(), f"mjrec-{os.geteuid()}")


def _state_directory() -> Path | None:
    """Return `$XDG_STATE_HOME`, or what stands for it; None for users without home."""
    given = os.environ.get("XDG_STATE_HOME", "")
    # Relative ones are to be ignored, says its specification.
    if given.startswith("/"):
        return Path(given)
    home = os.environ.get("HOME", "")
    if not home.startswith("/"):
        try:
            home = pwd.getpwuid(os.geteuid()).pw_dir
        except KeyError:
            return None
    # Root could make a home directory of what is only a name, such as /nonexistent.
    return Path(home, ".local", "state") if os.access(home, os.F_OK) else None


def _add(directory: Path, digests: Iterable[str]) -> None:
    """Add to the list in a directory, made where there is none.

    Raises:
        _Refused: something else stands there, or others can open it.
        OSError: it cannot be written.
    """
    if not directory.exists():
        _make_directory(directory)
    path = directory / _LIST_NAME
    objection = _objection(directory, directory.lstat(), stat.S_ISDIR)
    if objection is not None and not path.exists():
        # Some file systems know no owners and no modes.
        raise PermissionError(objection)
    if objection is not None:
        raise _Refused(objection)
    # Also where appending is atomic: another process may be forgetting the oldest.
    lock = wait_for_lock(directory / f".{_LIST_NAME}.lock", "")
    try:
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND
        with _opened(directory, flags) as descriptor:
            content = _content(descriptor)
            listed = content.split()
            new = sorted(set(digests).difference(listed))
            if len(listed) + len(new) > 2 * _KEPT:
                with replacing(path) as temporary:
                    temporary.touch(0o600)
                    temporary.write_text(_lines([*listed, *new][-_KEPT:]))
            elif new:
                # After a full disk cut a line off.
                start = "" if content[-1:] in ("", "\n") else "\n"
                text = start + _lines(new)
                if os.write(descriptor, text.encode()) < len(text):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    finally:
        lock.let_go()


def _lines(digests: Iterable[str]) -> str:
    return "".join(f"{digest}\n" for digest in digests)


def _make_directory(directory: Path) -> None:
    base = next(parent for parent in directory.parents if parent.exists())
    if os.geteuid() == 0 and base.stat().st_uid != 0:
        # With `sudo` and somebody's HOME: it would be in that user's way.
        raise PermissionError(f"{base} is not root's")
    for path in reversed((directory, *directory.parents)):
        if not path.exists():
            path.mkdir(mode=0o700, exist_ok=True)


@contextlib.contextmanager
def _opened(directory: Path, flags: int) -> Iterator[int]:
    """Yield the descriptor of the list in a directory.

    Raises:
        _Refused: something else stands there, or others can open it.
        OSError: it cannot be opened, or there is none.
    """
    path = directory / _LIST_NAME
    # Not waiting, should it be a pipe.
    careful = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
    try:
        descriptor = os.open(path, flags | careful, 0o600)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise _Refused(f"{path} is a link") from error
        raise
    try:
        objection = _objection(directory, directory.lstat(), stat.S_ISDIR)
        objection = objection or _objection(path, os.fstat(descriptor), stat.S_ISREG)
        if objection is not None:
            raise _Refused(objection)
        yield descriptor
    finally:
        os.close(descriptor)


def _objection(
    path: Path, facts: os.stat_result, is_kind: Callable[[int], bool]
) -> str | None:
    """Say why what stands at a path may have been written by others."""
    if not is_kind(facts.st_mode) or facts.st_uid != os.geteuid():
        what = "directory" if is_kind is stat.S_ISDIR else "file"
        return f"{path} is not a {what} of this user's"
    if facts.st_mode & _OTHERS:
        mode = 700 if is_kind is stat.S_ISDIR else 600
        return f"{path} is open to others (chmod {mode} {path})"
    return None


def _content(descriptor: int) -> str:
    with open(descriptor, encoding="utf-8", errors="replace", closefd=False) as file:
        return file.read()
