# SPDX-License-Identifier: Apache-2.0
"""The models used in a directory's recordings, each stored once.

::

    directory/
    ├── openaigym.model.<16 hex digits>.mjb.gz    the compiled model as is
    └── openaigym.model.<16 hex digits>.zip       its sources, if known

The digits are the beginning of the compiled model's SHA-256. Only the MuJoCo version
that compiled a model can load it. The zip file is for all other versions, and for all
users other than the user who stored the model (see `model_trust`).
"""

from __future__ import annotations

import gzip
import hashlib
import logging
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..atomic_files import replacing
from ..errors import FileNotWritten, UnreadableFile, UntrustedModel
from ..formats.json_fields import unreadable
from ..formats.monitor_directory import FILE_PREFIX
from ..formats.regular_files import open_regular
from ..worker_thread import WorkerThread
from . import model_trust
from .model_sources import AuthoredModel, with_embedded_files, write_authored

logger = logging.getLogger(__name__)

# For dm_control's humanoid (11.8 MB), level 1 gives 686 KB in 37 ms, level 3 529 KB in
# 42 ms, level 6 323 KB in 112 ms. The CPU that compresses is also needed for rendering.
_LEVEL = 3
_CHUNK = 1 << 20

# No real model comes near this size. A file that claims a larger size is malicious.
_LARGEST = 1 << 31

_NAME = re.compile(r"openaigym\.model\.[0-9a-f]{16}\.(mjb\.gz|zip)")


class _Job(NamedTuple):
    stem: str
    compiled: NDArray[np.uint8]
    authored: AuthoredModel | None


class ModelStore:
    """A store for the models of recordings, written in a background thread.

    Files appear complete or not at all, and existing files are never rewritten. So any
    number of processes may store models in one directory.

    Args:
        directory: the recordings' directory, which must exist.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._known: set[str] = set()
        self._failed: list[tuple[_Job, FileNotWritten]] = []
        self._writer: WorkerThread[_Job] | None = None

    def add(
        self, model: mujoco.MjModel, authored: AuthoredModel | None = None
    ) -> dict[str, Any]:
        """Store a copy of a model. Another thread writes it.

        Args:
            model: the model; it is not modified, and it is not used after this call.
            authored: the model's sources. The model may differ from them in the values
                of its fields, but not in its structure. If the structure differs, the
                sources are not stored, and the file named by `xml` will not exist.

        Returns:
            The facts that `load_model` needs to find the model: its `sha256`, its size
            in `bytes`, the base names of its files `mjb` and `xml` (which may be None),
            and the `mujoco` version.
        """
        compiled = saved_model(model)
        digest = hashlib.sha256(compiled.data).hexdigest()
        stem = f"{FILE_PREFIX}.model.{digest[:16]}"
        names = {f"{stem}.mjb.gz", *([] if authored is None else [f"{stem}.zip"])}
        if not names <= self._known:
            self._known |= names
            model_trust.note_models(
                [digest, model_trust.directory_digest(self._directory)]
            )
            if self._writer is None:
                # Models may be large, so at most one may wait.
                self._writer = WorkerThread(self._store, capacity=1, name="model store")
            self._writer.put(_Job(stem, compiled, authored))
        return {
            "sha256": digest,
            "bytes": len(compiled),
            "mjb": f"{stem}.mjb.gz",
            "xml": None if authored is None else f"{stem}.zip",
            "mujoco": mujoco.__version__,
        }

    def finish(self) -> None:
        """Wait until every model is stored. Additional models may be added afterwards.

        Raises:
            FileNotWritten: a model could not be stored. The next call tries again.
        """
        self.settle()
        failed, self._failed = self._failed, []
        for job, _ in failed:
            self._store(job)
        if self._failed:
            raise self._failed[0][1]

    def settle(self) -> None:
        """Wait until no model is left to store; `finish` reports any failures."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def leave(self) -> None:
        """Store waiting models in the background. Never blocks."""
        if self._writer is not None:
            self._writer.leave()

    def _store(self, job: _Job) -> None:
        path = self._directory / f"{job.stem}.mjb.gz"
        try:
            _write(path, lambda part: _write_gzip(part, job.compiled))
            if job.authored is not None:
                authored, model = job.authored, _loaded(job.compiled.tobytes())
                path = path.with_name(f"{job.stem}.zip")
                _write(path, lambda part: write_authored(part, authored, model))
        except ValueError as error:
            logger.debug("%s was not stored: %s", path.name, error)
        except OSError as error:
            failure = FileNotWritten(path, error.strerror or error)
            self._failed.append((job, failure))


def load_model(
    directory: Path, facts: Mapping[str, Any], *, trust_models: bool = False
) -> mujoco.MjModel:
    """Load a stored model.

    The compiled model is loaded if this MuJoCo version compiled it and this user stored
    it (see `model_trust`). Otherwise the model is recompiled from its sources, and no
    files outside the zip file are read.

    Args:
        directory: the recording's directory.
        facts: the facts that `ModelStore.add` returned.
        trust_models: whether to load an untrusted compiled model. MuJoCo does not check
            its content, so a crafted model can run arbitrary code.

    Raises:
        UnreadableFile: the files are missing or damaged, do not match the facts, or
            need a different MuJoCo version.
        UntrustedModel: only a compiled model exists, and it is untrusted.
    """
    compiled, source = (_path(directory, facts.get(key)) for key in ("mjb", "xml"))
    try:
        return _load_compiled(directory, compiled, facts, trust_models)
    except UnreadableFile as error:
        if source is None:
            raise
        objection = error
    logger.info("%s Compiling the model from %s instead.", objection, source.name)
    # Imported here, because it loads h5py, which recording does not need.
    from .foreign_files import compile_sources

    try:
        return compile_sources(source, compiled_size=_recorded_size(source, facts))
    except UnreadableFile as error:
        if compiled is not None and isinstance(objection, UntrustedModel):
            reason = f"cannot be compiled instead ({source.name}: {error.reason})"
            raise _untrusted(compiled, reason) from error
        raise


def saved_model(model: mujoco.MjModel) -> NDArray[np.uint8]:
    """Return a model in the format of `mj_saveModel`, with its textures embedded."""
    whole = with_embedded_files(model)
    buffer = np.empty(mujoco.mj_sizeModel(whole), np.uint8)
    mujoco.mj_saveModel(whole, None, buffer)
    return buffer


def _write(path: Path, write: Callable[[Path], None]) -> None:
    if not path.exists():
        with replacing(path) as temporary:
            write(temporary)


def _write_gzip(path: Path, content: NDArray[np.uint8]) -> None:
    # The header has no name or time, so the same model always yields the same file.
    with (
        path.open("wb") as file,
        gzip.GzipFile(
            filename="", mode="wb", compresslevel=_LEVEL, fileobj=file, mtime=0
        ) as stream,
    ):
        # Write in chunks, because compressing a chunk releases the interpreter lock.
        for start in range(0, len(content), _CHUNK):
            stream.write(content.data[start : start + _CHUNK])


def _path(directory: Path, name: object) -> Path | None:
    """Return the path of a model's file, or None if it does not exist."""
    if name is None:
        return None
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise UnreadableFile(
            directory,
            f"a recording in it refers to a model by {name!r:.200}, which is not a "
            "valid name",
        )
    return directory / name if (directory / name).exists() else None


def _load_compiled(
    directory: Path, path: Path | None, facts: Mapping[str, Any], trust_models: bool
) -> mujoco.MjModel:
    digest = facts.get("sha256")
    if path is None or facts.get("mujoco") != mujoco.__version__:
        raise _not_loadable(directory, facts)
    if not (trust_models or model_trust.is_stored(digest) or model_trust.is_trusted()):
        raise _untrusted(path, "are missing")
    content = _read_gzip(path, _recorded_size(path, facts))
    # MuJoCo trusts the sizes and addresses in the file, so its hash must match.
    found = hashlib.sha256(content).hexdigest()
    if found != digest or f".{found[:16]}." not in path.name:
        raise UnreadableFile(path, "its content is not the recorded model")
    try:
        return _loaded(content)
    except (ValueError, mujoco.FatalError) as error:
        raise UnreadableFile(path, error) from error


def _recorded_size(path: Path, facts: Mapping[str, Any]) -> int:
    size = facts.get("bytes")
    if type(size) is not int or not 0 < size <= _LARGEST:
        raise UnreadableFile(path, f"its recorded size is {size!r:.80}")
    return size


def _read_gzip(path: Path, size: int) -> bytes:
    """Decompress a file of exactly `size` bytes; never decompress more than that."""
    with unreadable(path), open_regular(path) as file:
        # The gzip module would parse a header of any length, and any number of empty
        # streams, byte by byte in Python.
        stream = zlib.decompressobj(wbits=zlib.MAX_WBITS | 16)
        try:
            content = stream.decompress(file.read(size + _CHUNK), size + 1)
        except zlib.error as error:
            raise ValueError(f"it is damaged ({error})") from error
        if len(content) != size or not stream.eof or stream.unused_data:
            is_short = len(content) < size
            there = f"{len(content)} bytes, not" if is_short else "more than"
            raise ValueError(f"it contains {there} the recorded {size} bytes")
        return content


def _loaded(content: bytes) -> mujoco.MjModel:
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": content})


def _untrusted(compiled: Path, what_of_sources: str) -> UntrustedModel:
    return UntrustedModel(
        compiled,
        "it was not written by this user on this machine. A crafted model can run "
        "any code in the process that loads it, and this model's sources "
        f"{what_of_sources}. If you trust its author, use `mjrec render "
        "--trust-models`, mjrec.load_trajectory(path, trust_models=True), or the "
        f"environment variable {model_trust.TRUST_VARIABLE}=1",
    )


def _not_loadable(directory: Path, facts: Mapping[str, Any]) -> UnreadableFile:
    name, version = facts.get("mjb") or facts.get("xml"), facts.get("mujoco")
    if name is None:
        return UnreadableFile(directory, "the recording lacks the name of its model")
    if version == mujoco.__version__:
        return UnreadableFile(
            directory / name,
            "the recording's model is missing; copy it from the directory of the "
            "original recording",
        )
    source = facts.get("xml")
    return UnreadableFile(
        directory / name,
        f"the model requires mujoco {version}, but the installed version is "
        f"{mujoco.__version__}, and the model's sources are missing. Install the "
        f"required version: pip install mujoco=={version}"
        + (f"; or copy {source} to this directory" if source else ""),
    )
