# SPDX-License-Identifier: Apache-2.0
"""What a trajectory holds, whichever of its two forms it has.

A recorded episode is first a span of the monitor's row log (`trajectory_log`), then an
HDF5 file (`trajectory_hdf5`). Both hold facts, rows and changes of the model. One NumPy
structured dtype says what a row is. `docs/reference/trajectories.md` has the file.
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

# In the flags of a row.
TERMINATED, TRUNCATED, STEP, FRAME = 1, 2, 4, 8
# Words before the state: the row's number, the step, the reward, the flags.
HEAD_WORDS = 4
_HEAD = (("row", "<i8"), ("step", "<i8"), ("reward", "<f8"), ("flags", "<u8"))
PARTS = ("state", "snapshot", "action", "observation")

# They become names inside the HDF5 file, where a slash would be a path.
_NAME = re.compile(r"(?!\.{1,2}$)[^/\x00-\x1f\x7f\ud800-\udfff]{1,200}")


def packed(members: Iterable[tuple[str, Any]]) -> np.dtype[Any]:
    """Return a structured dtype whose members begin at multiples of 8 bytes.

    Args:
        members: names, and dtypes as NumPy takes them.
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
    """Return what a row consists of; of what is None or empty it has no member.

    Args:
        state: float64 members, MuJoCo's state components by name.
        snapshot: the arrays that frames are drawn from, by MuJoCo's names.
        action: dtype and shape of an action.
        observation: of an observation.

    Raises:
        ValueError: no file could hold such rows.
    """
    parts = zip(PARTS, (state, snapshot, action, observation), strict=True)
    members = [(name, kind) for name, kind in parts if kind is not None and kind != []]
    for name, kind in members:
        if (kind.names is None) != (name in ("action", "observation")):
            raise ValueError(f"the {name} of a row is {kind!s:.80}")
        check_dtype(kind.base)
    kinds = [] if state is None else [(n, state[n].shape) for n in state.names or ()]
    if kinds and state != packed((name, ("<f8", shape)) for name, shape in kinds):
        raise ValueError("a state is not all float64")
    return packed((*_HEAD, *members))


def dtype_from_json(value: Any) -> np.dtype[Any]:
    """Return a row's dtype, given in NumPy's own words, `numpy.dtype.descr`.

    Raises:
        ValueError: it is no row of a recording.
    """
    return _dtype_from_text(json.dumps(value))


# The same for all recordings of a log, and it takes Python long.
@functools.lru_cache(maxsize=16)
def _dtype_from_text(text: str) -> np.dtype[Any]:
    try:
        dtype = np.lib.format.descr_to_dtype(json.loads(text))
        names = dtype.names or ()
        own = row_dtype(**{name: dtype[name] for name in PARTS if name in names})
    # NumPy raises many things at what is no dtype.
    except Exception as error:
        raise ValueError(f"what its rows are cannot be read: {error}") from error
    if dtype != own:
        raise ValueError("the parts of its rows do not lie one behind the other")
    return own


def check_dtype(dtype: np.dtype[Any]) -> None:
    """Raise `ValueError` unless all is plain little-endian numbers, and well named."""
    for name in dtype.names or ():
        if not _NAME.fullmatch(name):
            raise ValueError(f"{name[:200]!r} cannot name an array")
        check_dtype(dtype[name].base)
    is_plain = dtype.kind in "biuf" and dtype.itemsize <= 8 and dtype.str[0] in "<|"
    if dtype.names is None and not is_plain:
        raise ValueError(f"{dtype.str!r:.80} is no dtype of a trajectory")


def columns_of(state: np.dtype[Any]) -> dict[str, slice]:
    """Return where the components of a state are among its numbers."""
    return {
        name: slice(offset // 8, (offset + kind.itemsize) // 8)
        for name, (kind, offset, *_) in (state.fields or {}).items()
    }


@dataclass(frozen=True, kw_only=True)
class ModelChange:
    """Model fields that are other than before, from some step on.

    Attributes:
        step: the first step that they hold for; 0 is what differs from the stored
            model since the reset.
        fields: their new values: arrays of `MjModel` by their names (`geom_rgba`),
            members of its structs as `opt.gravity`, `vis.headlight.ambient`,
            `stat.extent`; and, of the view, `camera.lookat`, `option.flags` ...
    """

    step: int
    fields: Mapping[str, NDArray[Any]]


def check_version(version: int) -> None:
    """Raise `ValueError` for a format version that this code does not read."""
    if version != FORMAT_VERSION:
        raise ValueError(
            f"it was written by a newer mjrec, in format version {version}, and this "
            f"one reads versions up to {FORMAT_VERSION}: update mjrec"
            if version > FORMAT_VERSION
            else f"there is no format version {version}"
        )


def added_up(rewards: ArrayLike) -> float:
    """Return the sum of rewards, one added after the other, as a monitor does.

    `sum` makes up for roundings from Python 3.12 on, and NumPy's adds in pairs.
    """
    values = np.asarray(rewards, np.float64)
    # Zero comes first: it makes the sum of negative zeros a positive one.
    with np.errstate(all="ignore"):
        return 0.0 + float(np.add.accumulate(values)[-1]) if len(values) else 0.0


@dataclass(kw_only=True, repr=False)
class TrajectoryReader:
    """An open trajectory. T is the number of steps, F of video frames.

    Rows are read when they are asked for, in ranges `start, stop` as Python counts
    them. A reader is used by one thread, in the process that opened it.

    Attributes:
        path: of the file.
        facts: what JSON can hold; `docs/reference/trajectories.md` lists the keys.
        dtype: of a row, as `row_dtype` makes it.
        row_count: how many states there are: T + 1, the first after the reset; 0 in
            the log of an episode that was killed before that was written.
        rewards: `(T,) float64`.
        terminated: `(T,) bool`.
        truncated: `(T,) bool`.
        frame_steps: `(F,) int64`, the step that each snapshot was taken after.
        change_count: how often the model changed.
        dropped: how many rows at the end of the log were torn or damaged.
        read: returns some of the `PARTS` of rows, by name and range.
        read_change: returns a change of the model by its number.
        release: closes the files.
        is_closed: nothing can be read any more.
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
        """T."""
        return len(self.rewards)

    @property
    def frame_count(self) -> int:
        """F."""
        return len(self.frame_steps)

    def kind(self, part: str) -> np.dtype[Any] | None:
        """Return the dtype of one of the `PARTS`; None where rows do not have it."""
        return self.dtype[part] if part in (self.dtype.names or ()) else None

    @property
    def columns(self) -> dict[str, slice]:
        """Where the components of a state are in a row of `states`."""
        state = self.kind("state")
        return {} if state is None else columns_of(state)

    def states(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return `(stop - start, n) float64`, of `row_count` rows.

        Raises:
            UnreadableFile: the file was damaged since it was opened.
        """
        rows = self._rows("state", start, stop, self.row_count)
        if rows is None:
            return np.empty((stop - start, 0))
        return rows.view(np.float64).reshape(len(rows), rows.itemsize // 8)

    def actions(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return `(stop - start, *shape)`, of T; None where they are not recorded."""
        return self._rows("action", start, stop, self.step_count)

    def observations(self, start: int, stop: int) -> NDArray[Any] | None:
        """Return `(stop - start, *shape)`, of `row_count`; None as of `actions`."""
        return self._rows("observation", start, stop, self.row_count)

    def snapshots(self, start: int, stop: int) -> NDArray[Any]:
        """Return `(stop - start,)` of F: MuJoCo's arrays are members of each."""
        rows = self._rows("snapshot", start, stop, self.frame_count)
        return np.empty(stop - start, []) if rows is None else rows

    def iter_model_changes(self) -> Iterator[ModelChange]:
        """Yield the changes of the model in the order of their steps."""
        for index in range(self.change_count):
            self._check_open()
            yield self.read_change(index)

    @functools.cached_property
    def model_changes(self) -> tuple[ModelChange, ...]:
        """The changes of the model in the order of their steps; read once."""
        return tuple(self.iter_model_changes())

    def close(self) -> None:
        """Close the file; idempotent. What is in memory stays."""
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
                f"{self.path.name} has {count} {part}s; there are none from {start} to "
                f"{stop}."
            )
        self._check_open()
        return None if self.kind(part) is None else self.read(part, start, stop)

    def _check_open(self) -> None:
        if self.is_closed:
            raise ClosedError(f"The trajectory {self.path} is closed.")
