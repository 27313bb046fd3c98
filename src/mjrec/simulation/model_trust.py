# SPDX-License-Identifier: Apache-2.0
"""Which compiled models are loaded: those that this user has stored.

MuJoCo believes the addresses and types in a compiled model, so that a crafted one can
do anything to whoever loads it. Whoever makes a directory writes its hashes too; what
only this user can write is a seal, which takes a key that nobody else can read::

    $XDG_STATE_HOME/mjrec/model-key        32 random bytes; ~/.local/state by default
    <temporary directory>/mjrec-<uid>/model-key       where that cannot be written

The first model that is stored makes the key. One that others can read, or that is no
key, is neither used nor replaced: only its owner knows who has read it, and a new one
would make all earlier recordings a stranger's. Until it is mended, the other place has
a key.

Workers on other machines, whose homes may be others, are given this user's key in an
environment variable, and use it before their own: what one of them stores, the others
load, and so does this machine.

Needs no simulator.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import hmac
import logging
import os
import pwd
import secrets
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from ..atomic_files import temporary_path

logger = logging.getLogger(__name__)

TRUST_VARIABLE = "MJREC_TRUST_MODELS"

# With the line before, because variables that begin with MJREC_ are recorded.
_KEY_VARIABLE = "_MJREC_MODEL_KEY"
_ONE_BY_ONE = "sha256:"
_KEY_NAME = "model-key"
_KEY_SIZE = 32
# So that no seal is ever one of something else.
_PURPOSE = b"mjrec: a compiled model, sha256 "
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def seal_of(digest: str) -> str | None:
    """Return this user's seal of a model; the first one makes the key.

    Args:
        digest: the sha256 of the compiled model, in hex.

    Returns:
        None, with a warning, where no key can be kept.
    """
    given = _given_key()
    if given is not None:
        return _seal(given, digest)
    reasons = []
    for directory in _directories():
        try:
            return _seal(_made_key(directory), digest)
        except _NoKey as error:
            _warn_once(str(error))
            reasons.append(str(error))
        except OSError as error:
            logger.debug("There is no key in %s.", directory, exc_info=True)
            reasons.append(f"{directory}: {error.strerror or error}")
    _warn_once(
        "Models are stored without this user's seal, because no key for it can be "
        f"kept ({'; '.join(reasons)}). Where it is not known what they were made from, "
        f"rendering will need {TRUST_VARIABLE}=1."
    )
    return None


def environ_with_key() -> dict[str, str]:
    """Return the variable that gives workers elsewhere this user's key.

    It must come to nobody else. Where there is no key it is made; where none can be
    kept, nothing is returned.
    """
    key = _given_key()
    for directory in _directories() if key is None else ():
        with contextlib.suppress(_NoKey, OSError):
            key = _made_key(directory)
            break
    return {} if key is None else {_KEY_VARIABLE: key.hex()}


def is_sealed(seal: object, digest: object) -> bool:
    """Tell whether `seal` is this user's seal of a model.

    Args:
        seal: what a file says; anything.
        digest: the sha256 of the compiled model, as the file says; anything.
    """
    if not isinstance(seal, str) or not isinstance(digest, str):
        return False
    given = seal.encode(errors="replace")
    # The home directory may have been writable only at one time of two.
    return any(
        hmac.compare_digest(_seal(key, digest).encode(), given) for key in _keys()
    )


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


def with_all_models_trusted(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables of a process that loads all models."""
    return {**environ, TRUST_VARIABLE: "1"}


@contextlib.contextmanager
def trusting_all_models() -> Iterator[None]:
    """Let this process, and those that it starts in the block, load all models.

    For a program's own main thread: environment variables belong to the process.
    """
    with _saying("1"):
        yield


@contextlib.contextmanager
def trusting_models(digests: Iterable[str]) -> Iterator[None]:
    """Let this process, and those that it starts in the block, load some models.

    For whoever has made these models too, and knows that nothing crafted has these
    hashes. What was trusted before is not, in the block.

    Args:
        digests: the sha256 of the compiled models, in hex.
    """
    with _saying(",".join(_ONE_BY_ONE + digest for digest in digests) or "0"):
        yield


@contextlib.contextmanager
def _saying(value: str) -> Iterator[None]:
    before = os.environ.get(TRUST_VARIABLE)
    os.environ[TRUST_VARIABLE] = value
    try:
        yield
    finally:
        os.environ.pop(TRUST_VARIABLE)
        if before is not None:
            os.environ[TRUST_VARIABLE] = before


class _NoKey(Exception):
    """What stands in a key's place is none that is used."""


@functools.cache
def _warn_once(message: str) -> None:
    logger.warning(message)


def _seal(key: bytes, digest: str) -> str:
    content = _PURPOSE + digest.encode(errors="replace")
    return hmac.new(key, content, hashlib.sha256).hexdigest()


def _given_key() -> bytes | None:
    with contextlib.suppress(ValueError):
        key = bytes.fromhex(os.environ.get(_KEY_VARIABLE, ""))
        return key if len(key) == _KEY_SIZE else None
    return None


def _keys() -> Iterator[bytes]:
    given = _given_key()
    if given is not None:
        yield given
    for directory in _directories():
        with contextlib.suppress(_NoKey, OSError):
            yield _read_key(directory)


def _directories() -> Iterator[Path]:
    """Yield where a key may be, the best place first."""
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


def _made_key(directory: Path) -> bytes:
    """Return the key in a directory, made where there is none.

    Raises:
        _NoKey: something else stands there.
        OSError: it cannot be made.
    """
    with contextlib.suppress(FileNotFoundError):
        return _read_key(directory)
    _make_directory(directory)
    objection = _objection_to(directory)
    if objection is not None:
        # Some file systems know no owners and no modes.
        raise PermissionError(objection)
    path = directory / _KEY_NAME
    temporary = temporary_path(path)
    try:
        _write_key(temporary)
        # Not renamed: of two processes at once, the second takes the first one's key.
        with contextlib.suppress(FileExistsError):
            os.link(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return _read_key(directory)


def _make_directory(directory: Path) -> None:
    missing = [directory]
    while not missing[-1].parent.exists():
        missing.append(missing[-1].parent)
    base = missing[-1].parent
    if os.geteuid() == 0 and base.stat().st_uid != 0:
        # With `sudo` and somebody's HOME: it would be in that user's way.
        raise PermissionError(f"{base} is not root's")
    for path in reversed(missing):
        with contextlib.suppress(FileExistsError):
            path.mkdir(mode=0o700)


def _write_key(path: Path) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        os.write(descriptor, secrets.token_bytes(_KEY_SIZE))
        # Else a machine that fails now leaves an empty one, for good.
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _read_key(directory: Path) -> bytes:
    """Return the key in a directory.

    Raises:
        FileNotFoundError: there is none.
        _NoKey: something else stands there, or others can read it.
        OSError: it cannot be opened.
    """
    path = directory / _KEY_NAME
    # Not waiting, should it be a pipe.
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY
    descriptor = os.open(path, flags)
    try:
        objection = _objection_to(directory) or _objection_to_key(path, descriptor)
        if objection is not None:
            raise _NoKey(
                f"The key of this user's recordings is not used: {objection}. If "
                "nobody else knows it, mend that; else remove it: then there will be a "
                "new one, and models that were stored before count as a stranger's."
            )
        return os.read(descriptor, _KEY_SIZE)
    finally:
        os.close(descriptor)


def _objection_to(directory: Path) -> str | None:
    facts = directory.lstat()
    if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != os.geteuid():
        return f"{directory} is not a directory of this user's"
    if facts.st_mode & _OTHERS:
        return f"{directory} is open to others (chmod 700 {directory})"
    return None


def _objection_to_key(path: Path, descriptor: int) -> str | None:
    facts = os.fstat(descriptor)
    if not stat.S_ISREG(facts.st_mode) or facts.st_uid != os.geteuid():
        return f"{path} is not a file of this user's"
    if facts.st_mode & _OTHERS:
        return f"{path} can be read by others (chmod 600 {path})"
    if facts.st_size != _KEY_SIZE:
        return f"{path} has {facts.st_size} bytes, and a key has {_KEY_SIZE}"
    return None
