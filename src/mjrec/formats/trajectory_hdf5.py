# SPDX-License-Identifier: Apache-2.0
"""The HDF5 file of a recorded episode: as strangers read it, with plain h5py.

`docs/format.md` has every dataset. Snapshots are rows of a compound type, whose
members bear MuJoCo's names: `file["snapshots"]["geom_xpos"]` is an array, and the
shuffle filter, which goes by whole rows there, puts the same byte of one row after the
other side by side, so that what does not change costs nothing. (Of what was measured
that was the smallest form and the fastest to write; `docs/format.md` has numbers.)
"""

from __future__ import annotations

import contextlib
import io
import json
import math
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

from ..atomic_files import replacing
from ..errors import ClosedError, FileNotWritten, UnreadableFile
from ..json_text import dumps
from .json_fields import json_object, unreadable
from .model_changes import LARGEST_CHANGE
from .regular_files import regular_path
from .trajectory import (
    FORMAT_VERSION,
    Array,
    ModelChange,
    RowLayout,
)
from .trajectory_layout import (
    LARGEST_ROW,
    MOST_PARTS,
    array_from_json,
    check_version,
    field_name,
    header_from_json,
    layout_to_json,
)
from .trajectory_reader import TrajectoryReader

# How every HDF5 file begins.
SIGNATURE = b"\x89HDF\r\n\x1a\n"

_FORMAT = b"mjrec trajectory"

# Written so, h5py of 2019 and later reads it; `latest` makes files that h5py of 2025
# cannot open.
_LIBVER = ("v110", "v110")

# Facts that are attributes of their own too, for whoever looks around in a viewer.
_PLAIN_FACTS = (
    *("env_id", "episode_id", "type", "seed", "start_time", "end_time"),
    *("rate", "timestep", "stride"),
    *("complete", "terminated", "truncated", "length", "reward"),
)

# Of rows, so that a video frame's can be had without most of the others.
_SNAPSHOT_CHUNK_BYTES = 1 << 18
_SNAPSHOT_CHUNK_ROWS = 32
_CHUNK_BYTES = 1 << 17
# How much is in memory at a time while it is written.
_BUFFER_BYTES = 1 << 22

_LEVEL = 1
_FILTERS = frozenset((h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE))
# Deflate makes at most 1032 bytes out of one.
_MOST_EXPANSION = 1040
_MOST_CHANGES = 1 << 20
_LONGEST_TEXT = 1 << 26

# What there is once for each step or frame is read when a file is opened, and a file
# of a few kilobytes can claim any number of them. Two weeks at 50 steps a second.
_MOST_STEPS = 1 << 26


def write_hdf5(reader: TrajectoryReader, path: Path) -> None:
    """Write all that `reader` has as the HDF5 file `path`, whole or not at all.

    Raises:
        FileNotWritten: the disk is full, or the directory is gone.
        UnreadableFile: what is read turned out to be damaged.
    """
    try:
        with replacing(path) as temporary, temporary.open("x+b", buffering=0) as output:
            unfailing = _Unfailing(output)
            # Nothing is read any more after Ctrl-C, so that it is soon over.
            with (
                _signals_waiting(reader.close),
                h5py.File(unfailing, "w", libver=_LIBVER) as file,
            ):
                _write(file, reader)
            if unfailing.error is not None:
                raise unfailing.error
            # The log is removed next: what it held must not be in a cache alone.
            os.fsync(output.fileno())
    except OSError as error:
        raise FileNotWritten(path, error.strerror or error) from error


@contextlib.contextmanager
def _signals_waiting(on_signal: Callable[[], object]) -> Iterator[None]:
    """Handle signals after the block: HDF5 crashes where its file raises an exception.

    Args:
        on_signal: called at once, in the block.
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
    """A file in which no write fails, for the HDF5 library.

    It does not survive one: it crashes the process when it closes what is left. So what
    the disk has no room for is held in memory, and `error` says so.
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


class TrajectoryHdf5Reader(TrajectoryReader):
    """Reads the HDF5 file of a finished trajectory.

    Raises:
        UnreadableFile: it is no such file, of a newer version, or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _reading(path):
            # Without any wish about locking: HDF5 refuses a file that is open in this
            # process with another one, in the user's own code, say.
            self._file = h5py.File(regular_path(path), "r")
            try:
                self._open()
            except BaseException:
                self._file.close()
                raise

    def close(self) -> None:
        """Close the file; idempotent. What is in memory stays."""
        self._file.close()

    def _open(self) -> None:
        attributes = self._file.attrs
        if "format" not in attributes or _text(attributes, "format") != _FORMAT:
            raise ValueError("it is an HDF5 file, but no trajectory")
        check_version(_whole_number(attributes, "format_version"))
        facts, layout = _text(attributes, "facts"), _text(attributes, "layout")
        if zlib.crc32(layout, zlib.crc32(facts)) != _whole_number(attributes, "crc32"):
            raise ValueError("its facts or its layout are damaged")
        self.header = header = header_from_json(json_object(facts), json_object(layout))
        self.dropped = _whole_number(attributes, "dropped")
        self._stored_changes = 0
        self._stored_by_change: dict[int, int] = {}
        self.rewards = self._column("rewards", "<f8")
        steps = len(self.rewards)
        self.terminated = self._column("terminated", "|b1", steps)
        self.truncated = self._column("truncated", "|b1", steps)
        self._state_rows = self._dataset("states", "<f8", (header.state_length,))
        self.row_count = self._state_rows.shape[0]
        if self.row_count != steps + 1 and (self.row_count, steps) != (0, 0):
            raise ValueError(f"it has {self.row_count} states for {steps} steps")
        self.frame_steps = self._column("frame_steps", "<i8")
        self._check_frames()
        self._action_rows = self._optional("actions", header.action, steps)
        self._observation_rows = self._optional(
            "observations", header.observation, self.row_count
        )
        self._snapshot_type = _row_type(header.snapshot)
        self._snapshot_rows = (
            self._dataset("snapshots", self._snapshot_type, (), self.frame_count)
            if header.snapshot.size
            else None
        )
        self._changes = self._group(self._file, "model_changes")
        self.change_count = len(self._changes)
        if self.change_count > _MOST_CHANGES:
            raise ValueError("it has too many changes of the model")

    def _states(self, start: int, stop: int) -> NDArray[np.float64]:
        return self._read(self._state_rows, start, stop)

    def _actions(self, start: int, stop: int) -> NDArray[Any]:
        return self._read(self._action_rows, start, stop)

    def _observations(self, start: int, stop: int) -> NDArray[Any]:
        return self._read(self._observation_rows, start, stop)

    def _snapshots(self, start: int, stop: int) -> NDArray[np.uint8]:
        size = self.header.snapshot.size
        if not size:
            return np.empty((stop - start, 0), np.uint8)
        rows = self._read(self._snapshot_rows, start, stop)
        return rows.view(np.uint8).reshape(stop - start, size)

    def _model_change(self, index: int) -> ModelChange:
        self._check_open()
        with _reading(self.path):
            group = self._group(self._changes, str(index))
            step = _whole_number(group.attrs, "step")
            if step < 0:
                raise ValueError("a change of the model is of no step")
            datasets = self._changed(index, group)
            fields = {name: _whole(dataset) for name, dataset in datasets.items()}
            return ModelChange(step=step, fields=fields)

    def _changed(self, index: int, group: h5py.Group) -> dict[str, Any]:
        """Return the datasets of a change, which can all be read at once."""
        if len(group) > MOST_PARTS:
            raise ValueError(f"a change of the model has {len(group)} fields")
        datasets = {
            field_name(name): _checked_dataset(group, name, self.path) for name in group
        }
        if sum(map(_size, datasets.values())) > LARGEST_CHANGE:
            raise ValueError("a change of the model is too large")
        stored = sum(dataset.id.get_storage_size() for dataset in datasets.values())
        self._stored_changes += stored - self._stored_by_change.get(index, 0)
        self._stored_by_change[index] = stored
        # The same data under a million names would be read a million times.
        if self._stored_changes > self.path.stat().st_size:
            raise ValueError("its changes of the model are stored in one another")
        return datasets

    def _check_frames(self) -> None:
        steps = self.frame_steps
        bounds = np.concatenate(([0], steps, [max(self.row_count - 1, 0)]))
        # Compared, because differences of such numbers may overflow.
        if (bounds[1:] < bounds[:-1]).any() or (len(steps) and not self.row_count):
            raise ValueError("its frames are not of its steps, in order")

    def _optional(self, name: str, kind: Array | None, count: int) -> Any:
        return kind and self._dataset(name, kind.dtype, kind.shape, count)

    def _column(self, name: str, dtype: str, count: int | None = None) -> NDArray[Any]:
        dataset = self._dataset(name, dtype, (), count)
        if dataset.shape[0] > _MOST_STEPS:
            raise ValueError(f"it has more than {_MOST_STEPS} {name}")
        return self._read(dataset, 0, dataset.shape[0])

    def _dataset(
        self,
        name: str,
        dtype: Any,
        shape: tuple[int, ...],
        count: int | None = None,
    ) -> Any:
        """Return a dataset with a row of `shape` for each of `count` things."""
        dataset = _checked_dataset(self._file, name, self.path)
        if dataset.dtype != dtype:
            raise ValueError(f"its {name} are of dtype {dataset.dtype}")
        if dataset.shape[:1] + shape != dataset.shape:
            raise ValueError(f"its {name} have the shape {dataset.shape}")
        if count not in (None, dataset.shape[0]):
            raise ValueError(f"it has {dataset.shape[0]} {name}, not {count}")
        return dataset

    def _group(self, parent: h5py.Group, name: str) -> h5py.Group:
        group = _linked(parent, name)
        if not isinstance(group, h5py.Group):
            raise ValueError(f"its {name} is no group")
        return group

    def _read(self, dataset: Any, start: int, stop: int) -> NDArray[Any]:
        self._check_open()
        with _reading(self.path):
            values = np.empty((stop - start, *dataset.shape[1:]), dataset.dtype)
            if values.size:
                dataset.read_direct(values, np.s_[start:stop])
            return values

    def _check_open(self) -> None:
        if not self._file:
            raise ClosedError(f"The trajectory {self.path} is closed.")


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever h5py raises about a damaged file into `UnreadableFile`."""
    try:
        with unreadable(path):
            yield
    except (AttributeError, LookupError, RuntimeError, TypeError) as error:
        raise UnreadableFile(path, _reason(error)) from error


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error) or type(error).__name__


def _linked(group: h5py.Group, name: str) -> Any:
    # Links may lead into other files, of whoever reads this one.
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"it has no {name!r} of its own")
    return group[name]


def _checked_dataset(group: h5py.Group, name: str, path: Path) -> Any:
    """Return a dataset that can be read without harm, whoever made the file."""
    dataset = _linked(group, name)
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"its {name} is no dataset")
    # Before anything else, even its shape: for that, HDF5 opens the other files which
    # a virtual dataset is put together from.
    properties = dataset.id.get_create_plist()
    filters = {
        properties.get_filter(index)[0] for index in range(properties.get_nfilters())
    }
    if (
        properties.get_layout() == h5py.h5d.VIRTUAL
        or properties.get_external_count()
        or filters - _FILTERS
    ):
        raise ValueError(f"its {name} is stored in a way that mjrec does not write")
    if dataset.shape is None:
        raise ValueError(f"its {name} is no dataset")
    item = dataset.dtype.itemsize
    chunk = item * math.prod(dataset.chunks or (0,))
    stored = min(dataset.id.get_storage_size(), path.stat().st_size)
    if chunk > LARGEST_ROW or _size(dataset) > stored * _MOST_EXPANSION:
        raise ValueError(f"its {name} would need more memory than it can hold")
    return dataset


def _size(dataset: Any) -> int:
    return int(dataset.dtype.itemsize * math.prod(dataset.shape))


def _whole(dataset: Any) -> NDArray[Any]:
    kind = array_from_json({"dtype": dataset.dtype.str, "shape": list(dataset.shape)})
    values = np.empty(kind.shape, kind.dtype)
    if values.size:
        dataset.read_direct(values)
    return values


def _attribute(attributes: Any, name: str, kinds: str) -> Any:
    """Return a single value, of one of NumPy's `kinds` of dtypes."""
    identifier = attributes.get_id(name)
    # Asked before anything is read: a text of variable length is in a part of the file
    # that has no checksum, and the HDF5 library may never come back from there.
    if identifier.shape != () or identifier.dtype.kind not in kinds:
        raise ValueError(f"its attribute {name!r} is of another type")
    if identifier.dtype.itemsize > _LONGEST_TEXT:
        raise ValueError(f"its attribute {name!r} is too long")
    return attributes[name]


def _text(attributes: Any, name: str) -> bytes:
    return bytes(_attribute(attributes, name, "S"))


def _whole_number(attributes: Any, name: str) -> int:
    return int(_attribute(attributes, name, "iu"))


def _row_type(layout: RowLayout) -> np.dtype[Any]:
    """Return the type of a row with the fields that have any bytes."""
    fields = [field for field in layout.fields if field.array.size]
    return np.dtype(
        {
            "names": [field.name for field in fields],
            "formats": [(field.array.dtype, field.array.shape) for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": layout.size,
        }
    )


def _write(file: h5py.File, reader: TrajectoryReader) -> None:
    # What is written is what a reader will accept.
    if max(reader.step_count, reader.frame_count) > _MOST_STEPS:
        raise UnreadableFile(reader.path, f"it has more than {_MOST_STEPS} steps")
    _write_attributes(file, reader)
    _write_steps(file, reader)
    _write_frames(file, reader)
    changes = file.create_group("model_changes")
    for index, change in enumerate(reader.iter_model_changes()):
        _write_change(changes.create_group(str(index)), change)


def _write_attributes(file: h5py.File, reader: TrajectoryReader) -> None:
    header = reader.header
    # Of fixed length: see _attribute. Those that only strangers read need not be.
    file.attrs["format"] = np.bytes_(_FORMAT)
    file.attrs["format_version"] = np.int64(FORMAT_VERSION)
    facts = dumps(dict(header.facts)).encode()
    layout = json.dumps(layout_to_json(header)).encode()
    file.attrs["facts"] = np.bytes_(facts)
    file.attrs["layout"] = np.bytes_(layout)
    # HDF5 has checksums of its own for what it thinks of as its structure, and the
    # deflate filter for what it compressed; long texts have neither.
    file.attrs["crc32"] = np.int64(zlib.crc32(layout, zlib.crc32(facts)))
    file.attrs["dropped"] = np.int64(reader.dropped)
    for name, value in _plain_facts(header.facts):
        file.attrs[name] = value


def _plain_facts(facts: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    model = facts.get("model")
    version = model.get("mujoco") if isinstance(model, Mapping) else None
    named = [(name, facts.get(name)) for name in _PLAIN_FACTS]
    for name, value in (*named, ("mujoco_version", version)):
        match value:
            case bool() | float():
                yield name, value
            case int() if -(2**63) <= value < 2**63:
                yield name, np.int64(value)
            case str() if value.isprintable():
                yield name, value


def _write_steps(file: h5py.File, reader: TrajectoryReader) -> None:
    header, steps, rows = reader.header, reader.step_count, reader.row_count
    states = _store(
        file, "states", Array("<f8", (header.state_length,)), rows, reader.states
    )
    states.attrs["components"] = [c.name for c in header.state]
    states.attrs["offsets"] = np.array([c.offset for c in header.state], np.int64)
    states.attrs["lengths"] = np.array([c.length for c in header.state], np.int64)
    _store_all(file, "rewards", reader.rewards)
    _store_all(file, "terminated", reader.terminated)
    _store_all(file, "truncated", reader.truncated)
    for component in header.state:
        if component.name == "time" and component.length == 1:
            _store_all(file, "time", _column_of(reader, component.offset))
    if header.action is not None:
        _store(file, "actions", header.action, steps, reader.actions)
    if header.observation is not None:
        _store(file, "observations", header.observation, rows, reader.observations)


def _write_frames(file: h5py.File, reader: TrajectoryReader) -> None:
    _store_all(file, "frame_steps", reader.frame_steps)
    size = reader.header.snapshot.size
    if not size:
        return
    kind = _row_type(reader.header.snapshot)
    count = reader.frame_count
    rows = min(_SNAPSHOT_CHUNK_ROWS, _SNAPSHOT_CHUNK_BYTES // size, count)
    dataset = _create(file, "snapshots", kind, (count,), max(1, rows))
    for start, stop in _parts(dataset):
        dataset[start:stop] = reader.snapshots(start, stop).view(kind).reshape(-1)


def _write_change(group: h5py.Group, change: ModelChange) -> None:
    group.attrs["step"] = np.int64(change.step)
    for name, values in change.fields.items():
        if values.ndim and values.size:
            group.create_dataset(
                name, data=values, chunks=True, compression=_LEVEL, shuffle=True
            )
        else:
            group.create_dataset(name, data=values)


def _column_of(reader: TrajectoryReader, offset: int) -> NDArray[np.float64]:
    step = _rows_at_once(8 * reader.header.state_length)
    parts = [
        reader.states(start, min(start + step, reader.row_count))[:, offset]
        for start in range(0, reader.row_count, step)
    ]
    return np.concatenate([np.empty(0), *parts])


def _store(
    file: h5py.File,
    name: str,
    kind: Array,
    count: int,
    read: Callable[[int, int], NDArray[Any] | None],
) -> Any:
    """Write `count` rows, which `read(start, stop)` gives."""
    rows = max(1, min(count, _CHUNK_BYTES // (kind.size or 1)))
    dataset = _create(file, name, np.dtype(kind.dtype), (count, *kind.shape), rows)
    for start, stop in _parts(dataset):
        dataset[start:stop] = read(start, stop)
    return dataset


def _store_all(file: h5py.File, name: str, values: NDArray[Any]) -> None:
    kind = Array(values.dtype.str, values.shape[1:])
    _store(file, name, kind, len(values), lambda start, stop: values[start:stop])


def _create(
    file: h5py.File,
    name: str,
    dtype: np.dtype[Any],
    shape: tuple[int, ...],
    chunk_rows: int,
) -> Any:
    if math.prod(shape) == 0:
        # Nothing to be cut into chunks.
        return file.create_dataset(name, shape, dtype)
    return file.create_dataset(
        name,
        shape,
        dtype,
        chunks=(chunk_rows, *shape[1:]),
        compression=_LEVEL,
        shuffle=True,
    )


def _parts(dataset: Any) -> Iterator[tuple[int, int]]:
    """Yield ranges of rows to be written at once: whole chunks."""
    if dataset.chunks is None:
        return
    row = dataset.dtype.itemsize * math.prod(dataset.shape[1:])
    chunk = dataset.chunks[0]
    step = max(1, _rows_at_once(row) // chunk) * chunk
    for start in range(0, dataset.shape[0], step):
        yield start, min(start + step, dataset.shape[0])


def _rows_at_once(size: int) -> int:
    return max(1, _BUFFER_BYTES // max(1, size))
