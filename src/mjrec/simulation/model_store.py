# SPDX-License-Identifier: Apache-2.0
"""The models of a directory's recordings, each stored once.

::

    directory/
    ├── openaigym.model.<16 hex digits>.mjb.gz    the compiled model, exactly
    └── openaigym.model.<16 hex digits>.zip       what it was made from, where known

The digits are the beginning of the sha256 of the compiled model. Only the MuJoCo
version that compiled a model can load it; the zip is for all others, and for whoever
is not the user who has stored it (`model_trust`).
"""

from __future__ import annotations

import gzip
import hashlib
import logging
import re
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..atomic_files import replacing
from ..errors import FileNotWritten, UnreadableFile, UntrustedModel
from ..formats.json_fields import unreadable
from ..formats.monitor_directory import FILE_PREFIX
from ..formats.regular_files import open_regular
from ..worker_thread import WorkerThread
from .authored_model import (
    AuthoredModel,
    with_embedded_files,
    write_authored,
)
from .model_trust import (
    TRUST_VARIABLE,
    directory_digest,
    is_stored,
    is_trusted,
    note_models,
)
from .source_compiler import compile_within

logger = logging.getLogger(__name__)

# Of dm_control's humanoid (11.8 MB) level 3 makes 529 KB in 42 ms, level 6 323 KB in
# 112 ms, level 1 686 KB in 37 ms; what it saves is time of a CPU that renders.
_LEVEL = 3
_CHUNK = 1 << 20

# Nothing that was recorded comes near; a file that claims more is made to hurt.
_LARGEST = 1 << 31

# Of models that could not be written, until there is room for them.
_MOST_KEPT = 1 << 28

_NAME = re.compile(r"openaigym\.model\.(?P<digits>[0-9a-f]{16})\.(mjb\.gz|zip)")


@dataclass(frozen=True)
class _Job:
    stem: str
    compiled: NDArray[np.uint8]
    authored: AuthoredModel | None


class ModelStore:
    """Stores models beside recordings, off the caller's thread.

    Files appear whole or not at all, and one that is there is not written again, so
    that any number of processes may store into one directory.

    Args:
        directory: of the recordings; it must be there.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._known: set[str] = set()
        # What could not be written, and the job, unless that is kept no longer.
        self._failed: dict[str, tuple[FileNotWritten, _Job | None]] = {}
        self._writer: WorkerThread[_Job] | None = None

    def add(
        self, model: mujoco.MjModel, authored: AuthoredModel | None = None
    ) -> dict[str, Any]:
        """Store a model as it is now; the writing is done on another thread.

        Args:
            model: not changed, and not referred to later.
            authored: what it was made from. The model may be other than that in the
                values of its fields, not in what it consists of; where it is, what it
                was made from is not stored, and the name of it stands for nothing.

        Returns:
            The facts by which `load_model` finds it: `sha256` of the compiled model,
            `bytes` of it, `mjb` and `xml` (base names; `xml` may be None), `mujoco`
            (the version).
        """
        compiled = saved_model(model)
        digest = hashlib.sha256(compiled.data).hexdigest()
        stem = f"{FILE_PREFIX}.model.{digest[:16]}"
        facts = {
            "sha256": digest,
            "bytes": len(compiled),
            "mjb": f"{stem}.mjb.gz",
            "xml": None if authored is None else f"{stem}.zip",
            "mujoco": mujoco.__version__,
        }
        names = {name for name in (facts["mjb"], facts["xml"]) if name is not None}
        if not names <= self._known:
            self._known |= names
            note_models([digest, directory_digest(self._directory)])
            self._queue(_Job(stem, compiled, authored))
        return facts

    def finish(self) -> None:
        """Wait until every model is stored. More may be added afterwards.

        Raises:
            FileNotWritten: one could not be. It is tried again by the next call, and
                when it is added again.
        """
        self._wait()
        failed, self._failed = self._failed, {}
        for stem, (error, job) in failed.items():
            if job is None:
                self._failed[stem] = error, None
            else:
                self._queue(job)
        self._wait()
        errors = [error for error, _ in self._failed.values()]
        # What is kept fails again, if it does.
        self._failed = {k: v for k, v in self._failed.items() if v[1] is not None}
        if errors:
            raise errors[0]

    def leave(self) -> None:
        """Let what waits be stored in the background. Never blocks."""
        if self._writer is not None:
            self._writer.leave()

    def _wait(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def _queue(self, job: _Job) -> None:
        if self._writer is None:
            # Models may be large, and more than one waiting would add up.
            self._writer = WorkerThread(self._store, capacity=1, name="model store")
        self._writer.put(job)

    def _store(self, job: _Job) -> None:
        self._write(job, ".mjb.gz", lambda path: _write_gzip(path, job.compiled))
        authored = job.authored
        if authored is None:
            return
        limit = _source_limit(len(job.compiled))
        model = _loaded(job.compiled.tobytes())
        self._write(
            job, ".zip", lambda path: write_authored(path, authored, model, limit=limit)
        )

    def _write(self, job: _Job, suffix: str, write: Callable[[Path], None]) -> None:
        path = self._directory / f"{job.stem}{suffix}"
        if path.exists():
            return
        try:
            with replacing(path) as temporary:
                write(temporary)
        except ValueError as error:
            logger.debug("%s is not stored: %s", path.name, error)
        except OSError as error:
            self._known.discard(path.name)
            jobs = [kept for _, kept in self._failed.values() if kept is not None]
            size = sum(len(kept.compiled) for kept in (*jobs, job))
            failure = FileNotWritten(path, error.strerror or error)
            self._failed[job.stem] = failure, job if size <= _MOST_KEPT else None


def load_model(
    directory: Path, facts: Mapping[str, Any], *, trust_models: bool = False
) -> mujoco.MjModel:
    """Return a stored model.

    It is loaded as it was compiled, where this is the MuJoCo version that compiled it
    and this user has stored it (`model_trust`). Else it is compiled again from what
    it was made from; of that, only files from the zip are read.

    Args:
        directory: of the recording.
        facts: as `ModelStore.add` returned them.
        trust_models: whether to load a stranger's compiled model too. MuJoCo
            believes what stands in it: a crafted one can do anything.

    Raises:
        UnreadableFile: the files are missing, damaged or not what the facts say, or
            another MuJoCo version is needed.
        UntrustedModel: there is only a stranger's compiled model.
    """
    compiled, source = (
        path if path is not None and path.exists() else None
        for path in (_path(directory, facts.get(key)) for key in ("mjb", "xml"))
    )
    is_same_version = facts.get("mujoco") == mujoco.__version__
    if compiled is None or not is_same_version:
        if source is None:
            raise _not_loadable(directory, facts, is_same_version=is_same_version)
        return _compile(source, facts)
    digest = facts.get("sha256")
    if not (trust_models or is_stored(digest) or is_trusted(digest)):
        return _compile_instead_of(compiled, source, facts)
    try:
        return _load_compiled(compiled, facts)
    except UnreadableFile as error:
        if source is None:
            raise
        logger.warning("%s It is compiled from %s again.", error, source.name)
        return _compile(source, facts)


def _compile(source: Path, facts: Mapping[str, Any]) -> mujoco.MjModel:
    size = _recorded_size(source, facts)
    return compile_within(source, limit=_source_limit(size), compiled_size=size)


def _compile_instead_of(
    compiled: Path, source: Path | None, facts: Mapping[str, Any]
) -> mujoco.MjModel:
    """Return the model from its sources, because a stranger has compiled it."""
    if source is None:
        raise _untrusted(compiled, "is not there")
    logger.info("%s is a stranger's. %s is compiled.", compiled, source.name)
    try:
        return _compile(source, facts)
    except UnreadableFile as error:
        reason = f"cannot be compiled instead ({source.name}: {error.reason})"
        raise _untrusted(compiled, reason) from error


def _untrusted(compiled: Path, what_of_sources: str) -> UntrustedModel:
    return UntrustedModel(
        compiled,
        "it was not written by this user on this machine, and a crafted one can do "
        f"anything to whoever loads it; and what it was made from {what_of_sources}. "
        "If you trust whoever recorded it: `mjrec render --trust-models`, "
        "mjrec.load_trajectory(path, trust_models=True), or the environment variable "
        f"{TRUST_VARIABLE}=1",
    )


def _not_loadable(
    directory: Path, facts: Mapping[str, Any], *, is_same_version: bool
) -> UnreadableFile:
    name = facts.get("mjb") or facts.get("xml")
    if not isinstance(name, str):
        return UnreadableFile(directory, "the recording says nothing of its model")
    if is_same_version:
        return UnreadableFile(
            directory / name,
            "the model of the recording is missing; it belongs beside the recording, "
            "and whatever was copied without it needs it too",
        )
    source = facts.get("xml")
    return UnreadableFile(
        directory / name,
        f"the model was written by mujoco {facts.get('mujoco')}, this is "
        f"{mujoco.__version__}, and what it was made from is not there. Install that "
        f"version: pip install mujoco=={facts.get('mujoco')}"
        + (f"; or put {source} beside it" if source else ""),
    )


def saved_model(model: mujoco.MjModel) -> NDArray[np.uint8]:
    """Return a model as `mj_saveModel` writes it, with all that it refers to."""
    whole = with_embedded_files(model)
    buffer = np.empty(mujoco.mj_sizeModel(whole), np.uint8)
    mujoco.mj_saveModel(whole, None, buffer)
    return buffer


def model_digest(model: mujoco.MjModel) -> str:
    """Return the sha256 of a saved model, as recordings say it."""
    return hashlib.sha256(saved_model(model).data).hexdigest()


def _write_gzip(path: Path, content: NDArray[np.uint8]) -> None:
    # No name and no time in it: the same model makes the same file.
    with (
        path.open("wb") as file,
        gzip.GzipFile(
            filename="", mode="wb", compresslevel=_LEVEL, fileobj=file, mtime=0
        ) as stream,
    ):
        # In pieces: the interpreter's lock is let go while each is compressed.
        for start in range(0, len(content), _CHUNK):
            stream.write(content.data[start : start + _CHUNK])


def _path(directory: Path, name: object) -> Path | None:
    if name is None:
        return None
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise UnreadableFile(
            directory,
            f"a recording in it calls a model {name!r:.200}, which is no name",
        )
    return directory / name


def _load_compiled(path: Path, facts: Mapping[str, Any]) -> mujoco.MjModel:
    content = _read_gzip(path, _recorded_size(path, facts))
    # MuJoCo trusts the sizes and addresses in such a file.
    digest = hashlib.sha256(content).hexdigest()
    name = _NAME.fullmatch(path.name)
    if digest != facts.get("sha256") or name is None or name["digits"] != digest[:16]:
        raise UnreadableFile(path, "its content is not what was recorded")
    try:
        return _loaded(content)
    except (ValueError, mujoco.FatalError) as error:
        raise UnreadableFile(path, error) from error


def _recorded_size(path: Path, facts: Mapping[str, Any]) -> int:
    size = facts.get("bytes")
    if type(size) is not int or not 0 < size <= _LARGEST:
        raise UnreadableFile(path, f"its recorded size is {size!r:.80}")
    return size


def _source_limit(compiled_size: int) -> int:
    """Return how many bytes a model that compiles to so many may be made from."""
    return min((64 << 20) + 8 * compiled_size, _LARGEST)


def _read_gzip(path: Path, size: int) -> bytes:
    """Return the `size` bytes that the file holds, and never read more."""
    with unreadable(path), open_regular(path) as file:
        # Not with the module `gzip`, which goes through a header of any length, and
        # through any number of empty streams, byte by byte in Python.
        stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
        try:
            content = stream.decompress(file.read(size + _CHUNK), size + 1)
        except zlib.error as error:
            raise ValueError(f"it is damaged ({error})") from error
        if len(content) != size or not stream.eof or stream.unused_data:
            there = "more" if len(content) >= size else f"{len(content)} bytes"
            raise ValueError(f"it holds {there}, not the recorded {size} bytes")
        return content


def _loaded(content: bytes) -> mujoco.MjModel:
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": content})
