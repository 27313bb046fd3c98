# SPDX-License-Identifier: Apache-2.0
"""The HDF5 file of a recorded episode: as strangers read it, with plain h5py.

`docs/format.md` has every dataset. Snapshots are rows of a compound type, whose
members bear MuJoCo's names: `file["snapshots"]["geom_xpos"]` is an array, and the
shuffle filter, which goes by whole rows there, puts the same byte of one row after the
other side by side, so that what does not change costs nothing. (Of what was measured
that was the smallest form and the fastest to write; `docs/format.md` has numbers.)

Nothing here bounds the memory or time that a file asks for: `trajectory_file` does.
"""

from __future__ import annotations

import contextlib
import io
import json
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
from .regular_files import regular_path
from .trajectory import (
    FORMAT_VERSION,
    Array,
    ModelChange,
    RowLayout,
    TrajectoryReader,
    array_from_json,
    check_version,
    field_name,
    header_from_json,
    layout_to_json,
)

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

_PACKING: Mapping[str, Any] = {"chunks": True, "compression": 1, "shuffle": True}
_FILTERS = frozenset((h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE))


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
        self.rewards = self._column("rewards", "<f8")
        steps = self.step_count
        self.terminated = self._column("terminated", "|b1", steps)
        self.truncated = self._column("truncated", "|b1", steps)
        self.frame_steps = self._column("frame_steps", "<i8")
        state = Array("<f8", (header.state_length,)).numpy
        self._datasets = {"states": self._dataset("states", state)}
        self.row_count = rows = len(self._datasets["states"])
        if rows != steps + 1 and (rows, steps) != (0, 0):
            raise ValueError(f"it has {rows} states for {steps} steps")
        bounds = np.concatenate(([0], self.frame_steps, [max(rows - 1, 0)]))
        # Compared, because differences of such numbers may overflow.
        if (bounds[1:] < bounds[:-1]).any() or (self.frame_count and not rows):
            raise ValueError("its frames are not of its steps, in order")
        if header.action is not None:
            self._datasets["actions"] = self._dataset(
                "actions", header.action.numpy, steps
            )
        if header.observation is not None:
            self._datasets["observations"] = self._dataset(
                "observations", header.observation.numpy, rows
            )
        if header.snapshot.size:
            self._datasets["snapshots"] = self._dataset(
                "snapshots", _row_type(header.snapshot), self.frame_count
            )
        self._changes = _group(self._file, "model_changes")
        self.change_count = len(self._changes)

    def _rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        size = self.header.snapshot.size
        if name != "snapshots":
            return self._read(self._datasets[name], start, stop)
        if not size:
            return np.empty((stop - start, 0), np.uint8)
        rows = self._read(self._datasets[name], start, stop)
        return rows.view(np.uint8).reshape(stop - start, size)

    def _model_change(self, index: int) -> ModelChange:
        self._check_open()
        with _reading(self.path):
            group = _group(self._changes, str(index))
            step = _whole_number(group.attrs, "step")
            if step < 0:
                raise ValueError("a change of the model is of no step")
            datasets = {field_name(name): _own_dataset(group, name) for name in group}
            return ModelChange(
                step=step,
                fields={name: _whole(dataset) for name, dataset in datasets.items()},
            )

    def _column(self, name: str, dtype: str, count: int | None = None) -> NDArray[Any]:
        dataset = self._dataset(name, np.dtype(dtype), count)
        return self._read(dataset, 0, len(dataset))

    def _dataset(self, name: str, kind: np.dtype[Any], count: int | None = None) -> Any:
        """Return a dataset with one of a kind for each of `count` things."""
        dataset = _own_dataset(self._file, name)
        # Memory is made for what the layout says, and HDF5 fills it as the file says.
        if dataset.dtype != kind.base:
            raise ValueError(f"its {name} are of dtype {dataset.dtype}")
        if dataset.shape[:1] + kind.shape != dataset.shape:
            raise ValueError(f"its {name} have the shape {dataset.shape}")
        if count not in (None, dataset.shape[0]):
            raise ValueError(f"it has {dataset.shape[0]} {name}, not {count}")
        return dataset

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
        raise UnreadableFile(path, str(error) or type(error).__name__) from error


def _linked(group: h5py.Group, name: str) -> Any:
    # Links may lead into other files, of whoever reads this one.
    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"it has no {name!r} of its own")
    return group[name]


def _group(parent: h5py.Group, name: str) -> h5py.Group:
    group = _linked(parent, name)
    if not isinstance(group, h5py.Group):
        raise ValueError(f"its {name} is no group")
    return group


def _own_dataset(group: h5py.Group, name: str) -> Any:
    """Return a dataset whose data is in this file, packed as mjrec packs it."""
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
    return dataset


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
    _write_attributes(file, reader)
    _write_rows(file, reader)
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


def _write_rows(file: h5py.File, reader: TrajectoryReader) -> None:
    header, steps, rows = reader.header, reader.step_count, reader.row_count
    state = Array("<f8", (header.state_length,)).numpy
    states = _store(file, "states", state, rows, reader.states)
    states.attrs["components"] = [c.name for c in header.state]
    states.attrs["offsets"] = np.array([c.offset for c in header.state], np.int64)
    states.attrs["lengths"] = np.array([c.length for c in header.state], np.int64)
    columns = {
        name: getattr(reader, name)
        for name in ("rewards", "terminated", "truncated", "frame_steps")
    }
    for c in header.state:
        if c.name == "time" and c.length == 1:
            columns["time"] = states[:, c.offset] if rows else np.empty(0)
    for name, values in columns.items():
        _store(file, name, values.dtype, len(values), _slices_of(values))
    if header.action is not None:
        _store(file, "actions", header.action.numpy, steps, reader.actions)
    if header.observation is not None:
        kind = header.observation.numpy
        _store(file, "observations", kind, rows, reader.observations)
    if size := header.snapshot.size:
        kind = _row_type(header.snapshot)
        _store(
            *(file, "snapshots", kind, reader.frame_count),
            lambda start, stop: reader.snapshots(start, stop).view(kind).reshape(-1),
            chunk_bytes=min(_SNAPSHOT_CHUNK_BYTES, _SNAPSHOT_CHUNK_ROWS * size),
        )


def _write_change(group: h5py.Group, change: ModelChange) -> None:
    group.attrs["step"] = np.int64(change.step)
    for name, values in change.fields.items():
        packing = _PACKING if values.ndim and values.size else {}
        group.create_dataset(name, data=values, **packing)


def _store(
    file: h5py.File,
    name: str,
    kind: np.dtype[Any],
    count: int,
    read: Callable[[int, int], NDArray[Any] | None],
    *,
    chunk_bytes: int = _CHUNK_BYTES,
) -> Any:
    """Write `count` of a kind, which `read(start, stop)` gives."""
    shape, size = (count, *kind.shape), kind.itemsize
    if not count * size:
        # Nothing to be cut into chunks.
        return file.create_dataset(name, shape, kind.base)
    chunk = max(1, min(count, chunk_bytes // size))
    packing = {**_PACKING, "chunks": (chunk, *kind.shape)}
    dataset = file.create_dataset(name, shape, kind.base, **packing)
    # Whole chunks.
    step = max(1, _BUFFER_BYTES // size // chunk) * chunk
    for start in range(0, count, step):
        stop = min(start + step, count)
        dataset[start:stop] = read(start, stop)
    return dataset


def _slices_of(values: NDArray[Any]) -> Callable[[int, int], NDArray[Any]]:
    return lambda start, stop: values[start:stop]
