# SPDX-License-Identifier: Apache-2.0
"""Recorded episodes in HDF5 files, which can be read with plain h5py.

An episode has a file of its own, or a group in a bundle (see `bundle`).

`docs/reference/trajectories.md` describes every dataset. States and snapshots are rows
of a compound type, whose members have MuJoCo's names: `file["states"]["qpos"]` is an
array. The shuffle filter works on whole rows: it stores the same byte of consecutive
rows next to each other, so values that do not change take almost no space.

This module does not limit the memory or time that reading a file takes, but
`foreign_files` does.
"""

from __future__ import annotations

import contextlib
import functools
import io
import os
import signal
import threading
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ..atomic_files import replacing, writing
from ..errors import UnreadableFile
from ..json_text import dumps
from .bundle import file_of, group_of, index_of, index_size, trajectories_in
from .json_fields import json_object, unreadable
from .monitor_directory import episode_of
from .regular_files import regular_path
from .trajectory import (
    FORMAT_VERSION,
    PARTS,
    ModelChange,
    TrajectoryReader,
    check_dtype,
    check_version,
    row_dtype,
)

# The first bytes of every HDF5 file.
SIGNATURE = b"\x89HDF\r\n\x1a\n"

_FORMAT = b"mjrec trajectory"
_BUNDLE = b"mjrec trajectories"

# With these versions, h5py releases from 2019 on can read the files. With `latest`,
# even h5py releases from 2025 cannot open them.
_LIBVER = ("v110", "v110")

_COLUMNS = {
    "rewards": "<f8",
    "terminated": "|b1",
    "truncated": "|b1",
    "frame_steps": "<i8",
}

_NO_STATE = np.dtype(("<f8", (0,)))

_CHUNK_BYTES = 1 << 18
# For snapshots: small chunks, so that reading a frame does not read many others.
_ROWS_IN_CHUNK = 32
# Number of bytes that are buffered while writing.
_BUFFER_BYTES = 1 << 22

_PACKING: Mapping[str, Any] = {"chunks": True, "compression": 1, "shuffle": True}
_FILTERS = frozenset((h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE))


def write_hdf5(reader: TrajectoryReader, path: Path) -> None:
    """Atomically write all data from `reader` to the HDF5 file `path`.

    Raises:
        FileNotWritten: the disk is full, or the directory was removed.
        UnreadableFile: the data from `reader` is damaged.
    """
    # Stop reading on Ctrl-C, so that writing ends soon.
    with _new_file(path, reader.close) as (file, _):
        _write(file, reader)


def write_bundle(
    bundle: Path,
    added: Mapping[Path, Callable[[], TrajectoryReader]],
    amended: Mapping[Path, Callable[[Any], Any]],
) -> dict[Path, UnreadableFile]:
    """Atomically rewrite a bundle with more trajectories or new facts.

    Existing trajectories are copied in compressed form.

    Args:
        bundle: the bundle's file, which need not exist yet.
        added: functions that open the new trajectories, keyed by the path of each
            trajectory's own file.
        amended: functions that take the facts of existing trajectories and return the
            new facts, keyed by path.

    Returns:
        The errors for trajectories that could not be read or added, keyed by path.

    Raises:
        FileNotWritten: the disk is full, or the directory was removed.
        UnreadableFile: the bundle is damaged.
    """
    failures: dict[Path, UnreadableFile] = {}
    reading: list[TrajectoryReader] = []
    before = trajectories_in(bundle)
    size = index_size(len(before) + len(added))

    def stop_reading() -> None:
        for reader in reading:
            reader.close()

    with _new_file(bundle, stop_reading, userblock_size=size) as (file, output):
        file.attrs["format"] = np.bytes_(_BUNDLE)
        if before:
            with _reading(bundle), h5py.File(regular_path(bundle), "r") as old:
                for path in before:
                    old.copy(_group(old, group_of(path)), file, group_of(path))
        for path, change in amended.items():
            _amend(file[group_of(path)].attrs, change)
        written = [*before]
        for path, opened in added.items():
            try:
                with opened() as reader:
                    reading[:] = [reader]
                    _write(file.create_group(group_of(path)), reader)
            except UnreadableFile as error:
                failures[path] = error
                file.pop(group_of(path), None)
            else:
                written.append(path)
        output.seek(0)
        output.write(index_of(int(episode_of(path.name) or 0) for path in written))
    return failures


def _amend(attributes: Any, change: Callable[[Any], Any]) -> None:
    facts = bytes(_attribute(attributes, "facts", "S"))
    _write_facts(attributes, change(json_object(facts)))


@contextlib.contextmanager
def _new_file(
    path: Path, on_signal: Callable[[], object], **options: Any
) -> Iterator[tuple[h5py.File, _Unfailing]]:
    """Yield a new HDF5 file, and the raw file that it is written through.

    Args:
        path: the file's final path, which it gets at the end of the block.
        on_signal: called immediately if a signal arrives during the block.
        **options: additional options for `h5py.File`.

    Raises:
        FileNotWritten: the disk is full, or the directory was removed.
    """
    with (
        writing(path),
        replacing(path) as temporary,
        temporary.open("x+b", buffering=0) as output,
    ):
        unfailing = _Unfailing(output)
        with (
            _signals_waiting(on_signal),
            h5py.File(unfailing, "w", libver=_LIBVER, **options) as file,
        ):
            yield file, unfailing
        if unfailing.error is not None:
            raise unfailing.error
        # The log is removed next, so the data must not be only in a cache.
        os.fsync(output.fileno())


@contextlib.contextmanager
def _signals_waiting(on_signal: Callable[[], object]) -> Iterator[None]:
    """Delay signals until the end of the block, because HDF5 crashes on exceptions.

    Args:
        on_signal: called immediately when a signal arrives.
    """
    came: list[int] = []

    def note(number: int, frame: object) -> None:
        del frame
        came.append(number)
        on_signal()

    handlers: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if callable(handler := signal.getsignal(number)):
                handlers[number] = handler
                signal.signal(number, note)
    try:
        yield
    finally:
        for handled, handler in handlers.items():
            signal.signal(handled, handler)
        for each in came:
            signal.raise_signal(each)


class _Unfailing(io.RawIOBase):
    """A file whose writes never fail, for the HDF5 library.

    The library does not survive a failed write: it crashes the process when it closes
    the remaining objects. Therefore, data that does not fit on the disk is kept in
    memory, and `error` is set.
    """

    def __init__(self, file: io.FileIO) -> None:
        self.error: OSError | None = None
        self._file = file
        self._held: list[tuple[int, bytes]] = []

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def write(self, data: Any) -> int:
        start, view = self._file.tell(), memoryview(data).cast("B")
        done = 0
        while done < len(view) and self.error is None:
            try:
                done += self._file.write(view[done:])
            except OSError as error:
                self.error = error
        if done < len(view):
            self._held.append((start + done, bytes(view[done:])))
            self._file.seek(start + len(view))
        return len(view)

    def readinto(self, buffer: Any) -> int:
        view, start = memoryview(buffer).cast("B"), self._file.tell()
        self._file.readinto(view)
        for offset, data in self._held:
            begin, end = max(offset, start), min(offset + len(data), start + len(view))
            if begin < end:
                view[begin - start : end - start] = data[begin - offset : end - offset]
        self._file.seek(start + len(view))
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        with contextlib.suppress(OSError):
            self._file.truncate(size)
        return size or 0


def open_hdf5(path: Path) -> TrajectoryReader:
    """Open a finished trajectory.

    Args:
        path: the trajectory's own file; the trajectory may be in a bundle instead.

    Raises:
        UnreadableFile: the file is missing or damaged, is not a trajectory, or has a
            newer version.
    """
    with _reading(path), contextlib.ExitStack() as opened:
        # Do not request locking: HDF5 refuses to open a file that is already open in
        # this process, for example in the user's code, with a different locking
        # setting.
        holder = file_of(path)
        file = opened.enter_context(h5py.File(regular_path(holder), "r"))
        group = file if holder == path else _group(file, group_of(path))
        reader = _reader_of(group, path, file.close)
        opened.pop_all()
    return reader


def _reader_of(
    file: h5py.Group, path: Path, release: Callable[[], None]
) -> TrajectoryReader:
    attributes = file.attrs
    if "format" not in attributes or _attribute(attributes, "format", "S") != _FORMAT:
        raise ValueError("it is an HDF5 file, but not a trajectory")
    check_version(int(_attribute(attributes, "format_version", "iu")))
    facts = bytes(_attribute(attributes, "facts", "S"))
    if zlib.crc32(facts) != _attribute(attributes, "crc32", "iu"):
        raise ValueError("its facts are damaged")
    names = {*file}
    there = [part for part in PARTS if part == "state" or f"{part}s" in names]
    datasets = {part: _dataset(file, f"{part}s") for part in there}
    columns = {name: _column(file, name, kind) for name, kind in _COLUMNS.items()}
    rows, steps = len(datasets["state"]), len(columns["rewards"])
    counts = {"action": steps, "snapshot": len(columns["frame_steps"])}
    lengths = [len(each) == counts.get(part, rows) for part, each in datasets.items()]
    lengths += [len(columns[name]) == steps for name in ("terminated", "truncated")]
    if not all(lengths) or (rows != steps + 1 and (rows, steps) != (0, 0)):
        raise ValueError("its datasets do not have the same number of steps")
    last = max(rows - 1, 0)
    # Compare instead of subtracting, because the differences may overflow.
    bounds = np.concatenate(([0], columns["frame_steps"], [last]))
    if (bounds[1:] < bounds[:-1]).any():
        raise ValueError("its frame steps are out of order or out of range")
    kinds = {p: np.dtype((each.dtype, each.shape[1:])) for p, each in datasets.items()}
    if kinds["state"].names is None:
        # There was no simulation.
        del kinds["state"]
    changes = _group(file, "model_changes")

    def read(part: str, start: int, stop: int) -> NDArray[Any]:
        with _reading(path):
            dataset = datasets[part]
            values = np.empty((stop - start, *dataset.shape[1:]), dataset.dtype)
            if values.size:
                dataset.read_direct(values, np.s_[start:stop])
            return values

    def read_change(index: int) -> ModelChange:
        with _reading(path):
            group = _group(changes, str(index))
            step = int(_attribute(group.attrs, "step", "iu"))
            return ModelChange(
                step=step,
                fields={n: np.asarray(_dataset(group, n)[()]) for n in group},
            )

    return TrajectoryReader(
        path=path,
        facts=json_object(facts),
        dtype=row_dtype(**kinds),
        row_count=rows,
        rewards=columns["rewards"],
        terminated=columns["terminated"],
        truncated=columns["truncated"],
        frame_steps=columns["frame_steps"],
        change_count=len(changes),
        dropped=int(_attribute(attributes, "dropped", "iu")),
        read=read,
        read_change=read_change,
        release=release,
    )


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn any error that h5py raises for a damaged file into `UnreadableFile`."""
    try:
        with unreadable(path):
            yield
    except (AttributeError, LookupError, RuntimeError, TypeError) as error:
        raise UnreadableFile(path, str(error) or type(error).__name__) from error


def _linked(group: h5py.Group, name: str) -> Any:
    # Links may point to other files of the user who reads this file.
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"it has no {name!r} of its own")
    return group[name]


def _group(parent: h5py.Group, name: str) -> h5py.Group:
    group = _linked(parent, name)
    if not isinstance(group, h5py.Group):
        raise ValueError(f"its {name} is not a group")
    return group


def _dataset(group: h5py.Group, name: str) -> Any:
    """Return a dataset that is stored in this file itself, with mjrec's filters."""
    dataset = _linked(group, name)
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"its {name} is not a dataset")
    # Check the storage before anything else, even the shape: to find the shape of a
    # virtual dataset, HDF5 opens the files that the dataset refers to.
    properties = dataset.id.get_create_plist()
    filters = {
        properties.get_filter(index)[0] for index in range(properties.get_nfilters())
    }
    if (
        properties.get_layout() == h5py.h5d.VIRTUAL
        or properties.get_external_count()
        or filters - _FILTERS
        or dataset.shape is None
    ):
        raise ValueError(f"its {name} is stored in a way that mjrec does not write")
    check_dtype(dataset.dtype)
    return dataset


def _column(file: h5py.Group, name: str, kind: str) -> NDArray[Any]:
    dataset = _dataset(file, name)
    if dataset.dtype != kind or dataset.ndim != 1:
        raise ValueError(f"its {name} have the wrong dtype {dataset.dtype}")
    return np.asarray(dataset[()])


def _attribute(attributes: Any, name: str, kinds: str) -> Any:
    """Return a scalar attribute whose dtype is of one of NumPy's `kinds`."""
    identifier = attributes.get_id(name)
    # Check before reading: a variable-length string is in a part of the file that has
    # no checksum, and the HDF5 library may hang there.
    if identifier.shape != () or identifier.dtype.kind not in kinds:
        raise ValueError(f"its attribute {name!r} has the wrong type")
    return attributes[name]


def _write_facts(attributes: Any, facts: Mapping[str, Any]) -> None:
    text = dumps(dict(facts)).encode()
    # A string of fixed length; see `_attribute`.
    attributes["facts"] = np.bytes_(text)
    # HDF5 has checksums for its own metadata, and the deflate filter has them for
    # compressed data, but neither covers long strings.
    attributes["crc32"] = np.int64(zlib.crc32(text))


def _write(file: h5py.Group, reader: TrajectoryReader) -> None:
    file.attrs["format"] = np.bytes_(_FORMAT)
    file.attrs["format_version"] = np.int64(FORMAT_VERSION)
    _write_facts(file.attrs, reader.facts)
    file.attrs["dropped"] = np.int64(reader.dropped)
    for name, dtype in _COLUMNS.items():
        values = getattr(reader, name)
        _store(
            file, name, np.dtype(dtype), len(values), functools.partial(_cut, values)
        )
    counts = {"action": reader.step_count, "snapshot": reader.frame_count}
    for part in PARTS:
        kind = reader.kind(part)
        if kind is None and part == "state":
            # There was no simulation, but the number of states is still needed.
            kind = _NO_STATE
        if kind is not None:
            count = counts.get(part, reader.row_count)
            _store(file, f"{part}s", kind, count, functools.partial(reader.read, part))
    changes = file.create_group("model_changes")
    for index, change in enumerate(reader.iter_model_changes()):
        group = changes.create_group(str(index))
        group.attrs["step"] = np.int64(change.step)
        for name, values in change.fields.items():
            packing = _PACKING if values.ndim and values.size else {}
            group.create_dataset(name, data=values, **packing)


def _cut(values: NDArray[Any], start: int, stop: int) -> NDArray[Any]:
    return values[start:stop]


def _store(
    file: h5py.Group,
    name: str,
    kind: np.dtype[Any],
    count: int,
    read: Callable[[int, int], NDArray[Any]],
) -> None:
    """Write a dataset of `count` values that `read(start, stop)` returns."""
    shape, size = (count, *kind.shape), kind.itemsize
    if not count * size:
        # There is nothing to split into chunks.
        file.create_dataset(name, shape, kind.base)
        return
    most = _ROWS_IN_CHUNK if name == "snapshots" else count
    chunk = max(1, min(count, most, _CHUNK_BYTES // size))
    packing = {**_PACKING, "chunks": (chunk, *kind.shape)}
    # Write whole chunks at a time.
    step = max(1, _BUFFER_BYTES // size // chunk) * chunk
    # If all values fit, creating the dataset with them takes only two thirds as long.
    whole = read(0, count) if count <= step else None
    dataset = file.create_dataset(name, shape, kind.base, whole, **packing)
    for start in range(0, count if whole is None else 0, step):
        stop = min(start + step, count)
        dataset[start:stop] = read(start, stop)
