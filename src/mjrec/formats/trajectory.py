# SPDX-License-Identifier: Apache-2.0
"""The content of a trajectory, independent of how it is stored.

A recorded episode is first a span of the monitor's row log (`trajectory_log`), and then
an HDF5 file (`trajectory_hdf5`). Both contain facts, rows and changes to the model. A
NumPy structured dtype describes a row. `docs/reference/trajectories.md` describes the
file.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ClosedError, InvalidArgument

FORMAT_VERSION = 1

# The bits of a row's flags.
TERMINATED, TRUNCATED, STEP, FRAME = 1, 2, 4, 8
# Words before the state: the row's number, the step, the reward and the flags.
HEAD_WORDS = 4
_HEAD = (("row", "<i8"), ("step", "<i8"), ("reward", "<f8"), ("flags", "<u8"))
PARTS = ("state", "snapshot", "action", "observation")

# Names of arrays inside the HDF5 file, where a slash would be a path separator.
_NAME = re.compile(r"(?!\.{1,2}$)[^/\x00-\x1f\x7f\ud800-\udfff]{1,200}")


def packed(members: Iterable[tuple[str, Any]]) -> np.dtype[Any]:
    """Return a structured dtype whose members begin at multiples of 8 bytes.

    Args:
        members: pairs of a name and a dtype, in any form that NumPy accepts.
    """
    names, formats, offsets, size = [], [], [], 0
    for name, kind in members:
        names.append(name)
        formats.append(np.dtype(kind))
        offsets.append(size)
        size += -(-formats[-1].itemsize // 8) * 8
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
    )


def row_dtype(
    *,
    state: np.dtype[Any] | None = None,
    snapshot: np.dtype[Any] | None = None,
    action: np.dtype[Any] | None = None,
    observation: np.dtype[Any] | None = None,
) -> np.dtype[Any]:
    """Return the dtype of a row, leaving out parts that are None or empty.

    Args:
        state: dtype of a state, with a float64 member for each of MuJoCo's components.
        snapshot: dtype of a snapshot, with a member for each MuJoCo array needed to
            render a frame.
        action: dtype and shape of an action.
        observation: dtype and shape of an observation.

    Raises:
        ValueError: the parts cannot be stored in a file.
    """
    parts = zip(PARTS, (state, snapshot, action, observation), strict=True)
    members = [(name, kind) for name, kind in parts if kind is not None and kind != []]
    for name, kind in members:
        if (kind.names is None) != (name in ("action", "observation")):
            raise ValueError(f"the {name} of a row has the wrong type {kind!s:.80}")
        check_dtype(kind.base)
    kinds = [] if state is None else [(n, state[n].shape) for n in state.names or ()]
    if kinds and state != packed((name, ("<f8", shape)) for name, shape in kinds):
        raise ValueError("the state has components that are not float64")
    return packed((*_HEAD, *members))


def dtype_from_json(value: Any) -> np.dtype[Any]:
    """Return a row's dtype from its JSON form, `numpy.dtype.descr`.

    Raises:
        ValueError: the value is not the dtype of a recording's rows.
    """
    return _dtype_from_text(json.dumps(value))


# Cached because all recordings in a log have the same dtype, which is slow to parse.
@functools.lru_cache(maxsize=16)
def _dtype_from_text(text: str) -> np.dtype[Any]:
    try:
        dtype = np.lib.format.descr_to_dtype(json.loads(text))
        names = dtype.names or ()
        own = row_dtype(**{name: dtype[name] for name in PARTS if name in names})
    # NumPy raises many kinds of errors for an invalid dtype.
    except Exception as error:
        raise ValueError(f"the layout of its rows cannot be read: {error}") from error
    if dtype != own:
        raise ValueError("its rows have unknown parts or gaps")
    return own


def check_dtype(dtype: np.dtype[Any]) -> None:
    """Check that a dtype has only plain little-endian numbers and valid names.

    Raises:
        ValueError: the dtype is invalid.
    """
    for name in dtype.names or ():
        if not _NAME.fullmatch(name):
            raise ValueError(f"{name[:200]!r} is not a valid array name")
        check_dtype(dtype[name].base)
    is_plain = dtype.kind in "biuf" and dtype.itemsize <= 8 and dtype.str[0] in "<|"
    if dtype.names is None and not is_plain:
        raise ValueError(f"{dtype.str!r:.80} is not a valid dtype for a trajectory")


def columns_of(state: np.dtype[Any]) -> dict[str, slice]:
    """Return the slice of each state component in the state vector."""
    return {
        name: slice(offset // 8, (offset + kind.itemsize) // 8)
        for name, (kind, offset, *_) in (state.fields or {}).items()
    }


@dataclass(frozen=True, kw_only=True)
class ModelChange:
    """Model fields that have new values from a certain step on.

    Attributes:
        step: the first step that the values apply to; 0 for differences from the stored
            model at the reset.
        fields: the new values, keyed by name. The names are those of `MjModel`'s arrays
            (`geom_rgba`), of members of its structs (`opt.gravity`,
            `vis.headlight.ambient`, `stat.extent`), and of parts of the view
            (`camera.lookat`, `option.flags`).
    """

    step: int
    fields: Mapping[str, NDArray[Any]]


def check_version(version: int) -> None:
    """Raise `ValueError` if this code cannot read a format version."""
    if version != FORMAT_VERSION:
        raise ValueError(
            f"it was written by a newer mjrec in format version {version}, but this "
            f"mjrec reads only versions up to {FORMAT_VERSION}: update mjrec"
            if version > FORMAT_VERSION
            else f"format version {version} does not exist"
        )


def added_up(rewards: ArrayLike) -> float:
    """Return the sum of rewards, adding them one by one as a monitor does.

    Other functions may differ in the last bits: from Python 3.12 on, `sum` compensates
    for rounding errors, and NumPy adds in pairs.
    """
    values = np.asarray(rewards, np.float64)
    # Add the sum to 0.0, as a monitor does, which turns negative zero into zero.
    with np.errstate(all="ignore"):
        return 0.0 + float(np.add.accumulate(values)[-1]) if len(values) else 0.0


@dataclass(kw_only=True, repr=False)
class TrajectoryReader:
    """An open trajectory with T steps and F video frames.

    Rows are read on demand, in ranges `start, stop` as in Python slices. Use a reader
    from only one thread, in the process that opened it.

    Attributes:
        path: the file.
        facts: a JSON object; `docs/reference/trajectories.md` lists the keys.
        dtype: the dtype of a row, from `row_dtype`.
        row_count: number of states: T + 1, including the state after the reset. It is
            0 in the log of a process that was killed before it wrote the first row.
        rewards: `(T,) float64`.
        terminated: `(T,) bool`.
        truncated: `(T,) bool`.
        frame_steps: `(F,) int64`, the step after which each snapshot was taken.
        change_count: number of changes to the model.
        dropped: number of incomplete or damaged rows at the end of the log.
        read: a function that returns one of the `PARTS` for a range of rows.
        read_change: a function that returns a change to the model by its number.
        release: a function that closes the files.
        is_closed: whether the reader was closed.
    """

    path: Path
    facts: Mapping[str, Any]
    dtype: np.dtype[Any]
    row_count: int
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    frame_steps: NDArray[np.int64]
    change_count: int
    dropped: int
    read: Callable[[str, int, int], NDArray[Any]]
    read_change: Callable[[int], ModelChange]
    release: Callable[[], None]
    is_closed: bool = False

    @property
    def step_count(self) -> int:
        """Number of steps, T."""
        return len(self.rewards)

    @property
    def frame_count(self) -> int:
        """Number of video frames, F."""
        return len(self.frame_steps)

    def kind(self, part: str) -> np.dtype[Any] | None:
        """Return the dtype of one of the `PARTS`, or None if rows do not have it."""
        return self.dtype[part] if part in (self.dtype.names or ()) else None

    @property
    def columns(self) -> dict[str, slice]:
        """The slice of each state component in a row of `states`."""
        state = self.kind("state")
        return {} if state is None else columns_of(state)

    def states(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return a range of the `row_count` states, `(stop - start, n) float64`.

        Raises:
            UnreadableFile: the file was damaged after it was opened.
        """
        rows = self._rows("state", start, stop, self.row_count)
        if rows is None:
            return np.empty((stop - start, 0))
        return rows.view(np.float64).reshape(len(rows), rows.itemsize // 8)

    def actions(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return a range of the T actions, or None if they were not recorded.

        The shape is `(stop - start, *shape)`.
        """
        return self._rows("action", start, stop, self.step_count)

    def observations(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return a range of the observations, or None if they were not recorded.

        There are `row_count` observations.

        The shape is `(stop - start, *shape)`.
        """
        return self._rows("observation", start, stop, self.row_count)

    def snapshots(self, start: int, stop: int) -> NDArray[Any]:
        """Return a range of the F snapshots, `(stop - start,)`.

        The members of each snapshot are MuJoCo's arrays.
        """
        rows = self._rows("snapshot", start, stop, self.frame_count)
        return np.empty(stop - start, []) if rows is None else rows

    def iter_model_changes(self) -> Iterator[ModelChange]:
        """Yield the changes to the model in the order of their steps."""
        for index in range(self.change_count):
            self._check_open()
            yield self.read_change(index)

    def close(self) -> None:
        """Close the file. Idempotent. Data that was already read stays available."""
        self.is_closed = True
        self.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return (
            f"<TrajectoryReader {str(self.path)!r} {self.step_count} steps, "
            f"{self.frame_count} frames>"
        )

    def _rows(
        self, part: str, start: int, stop: int, count: int
    ) -> NDArray[Any] | None:
        if not 0 <= start <= stop <= count:
            raise InvalidArgument(
                f"{self.path.name} has {count} {part}s: the range from {start} to "
                f"{stop} is invalid."
            )
        self._check_open()
        return None if self.kind(part) is None else self.read(part, start, stop)

    def _check_open(self) -> None:
        if self.is_closed:
            raise ClosedError(f"The trajectory {self.path} is closed.")
