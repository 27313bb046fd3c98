# SPDX-License-Identifier: Apache-2.0
"""Comparison of two trajectories, dataset by dataset and attribute by attribute.

Rows are read in blocks, so memory use does not grow with an episode's length.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from ..errors import UnreadableFile
from ..formats.trajectory_hdf5 import open_hdf5
from .compare_json import Rules, text_differences
from .differences import STORED_DIFFERENTLY, Aspect, Difference, Same, differs, unlike
from .findings import Topic
from .hidden_bytes import hidden_in_trajectory

_Key: TypeAlias = tuple[Topic, Aspect]

_BLOCK_BYTES: Final = 1 << 22
# `model_changes/<n>/<field>`.
_DEEPEST: Final = 3

# The datasets' topics, and how their numbers may differ.
_DATASETS: Final = {
    "states": (Topic.PHYSICS, Aspect.STATE),
    "snapshots": (Topic.PICTURES, Aspect.STATE),
    "model_changes": (Topic.PHYSICS, Aspect.STATE),
    "observations": (Topic.REWARDS, Aspect.OBSERVED),
    "rewards": (Topic.REWARDS, Aspect.DERIVED),
    "terminated": (Topic.REWARDS, Aspect.EXACT),
    "truncated": (Topic.REWARDS, Aspect.EXACT),
    "frame_steps": (Topic.VIDEOS, Aspect.EXACT),
    "actions": (Topic.PHYSICS, Aspect.EXACT),
}
_MEMBERS: Final = {"warmstart": Aspect.SOLVER, "qvel": Aspect.VELOCITY}
_UNITS: Final = {"snapshots": "snapshot", "model_changes": "change"}
_FACTS: Final = "facts"
# Derived from the facts, and checked whenever a trajectory is read.
_CHECKSUM: Final = "crc32"


def compare_trajectories(
    given: Path, made: Path, rules: Rules
) -> Iterator[Same | Difference]:
    """Compare two trajectories; yield differences and equal items.

    Args:
        given: the archive's trajectory.
        made: the recreated trajectory.
        rules: the rules for comparing their facts.

    Raises:
        UnreadableFile: a trajectory is damaged.
        FileNotWritten: the disk is full.
    """
    differs = False
    try:
        # Raises for anything that is not a trajectory.
        open_hdf5(given).close()
        with h5py.File(given, "r") as one, h5py.File(made, "r") as other:
            for found in _compare_groups(one, other, rules):
                differs |= isinstance(found, Difference)
                yield found
    except (AttributeError, LookupError, OSError, RuntimeError, ValueError) as error:
        raise UnreadableFile(given, error) from error
    hidden = [*hidden_in_trajectory(given)]
    yield from hidden
    if not differs and not hidden:
        yield STORED_DIFFERENTLY


def same_trajectory(path: Path) -> Iterator[Same]:
    """Yield the equal items of a trajectory whose bytes equal the other's."""
    with h5py.File(path, "r") as trajectory:
        for name in ("rewards", "states"):
            yield from _same(name, trajectory.get(name), {})


def _compare_groups(
    one: h5py.File, other: h5py.File, rules: Rules
) -> Iterator[Same | Difference]:
    named = [_objects(each) for each in (one, other)]
    before = [f"{each.userblock_size} bytes" for each in (one, other)]
    if before[0] != before[1]:
        yield differs(Topic.FILES, "the bytes before the HDF5 data", *before)
    yield from _compare_attributes(one, other, rules)
    for name in sorted(named[0] | named[1]):
        dataset = name.partition("/")[0]
        topic, _ = _DATASETS.get(dataset, (Topic.FILES, Aspect.EXACT))
        if name not in named[0] or name not in named[1]:
            where = ["it" if name in each else "none" for each in named]
            yield differs(topic, name, *where)
            continue
        a, b = one[name], other[name]
        yield from _compare_attributes(a, b, rules, name)
        if isinstance(a, h5py.Dataset) and isinstance(b, h5py.Dataset):
            yield from _compare_datasets(name, a, b)
        elif type(a) is not type(b):
            yield differs(topic, name, type(a).__name__, type(b).__name__)


def _objects(file: h5py.File) -> set[str]:
    """Return the paths of all objects in a file, which must all be hard links."""
    found: set[str] = set()
    open_groups = [""]
    while open_groups:
        path = open_groups.pop()
        group = file[path] if path else file
        for name in group:
            inner = f"{path}/{name}" if path else name
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"its {inner} is a soft or external link")
            found.add(inner)
            if group.get(name, getclass=True) is h5py.Group:
                if inner.count("/") >= _DEEPEST:
                    raise ValueError("its groups are nested too deeply")
                open_groups.append(inner)
    return found


def _compare_attributes(
    a: Any, b: Any, rules: Rules, name: str = ""
) -> Iterator[Difference]:
    where = f"{name}: attribute " if name else "attribute "
    for key in sorted({*a.attrs, *b.attrs}):
        if key not in a.attrs or key not in b.attrs:
            values = ["one" if key in each.attrs else "none" for each in (a, b)]
            yield differs(Topic.FILES, f"{where}{key}", *values)
            continue
        left, right = (_raw_attribute(each, key) for each in (a, b))
        if left == right or (key == _CHECKSUM and not name):
            continue
        if key == _FACTS and not name:
            yield from text_differences(bytes(a.attrs[key]), bytes(b.attrs[key]), rules)
        else:
            yield differs(Topic.FILES, f"{where}{key}", left[-1], right[-1])


def _raw_attribute(owner: Any, key: str) -> tuple[Any, ...]:
    identifier = owner.attrs.get_id(key)
    if identifier.dtype.kind not in "Siuf":
        raise ValueError(f"its attribute {key!r} has the wrong type")
    value = np.asarray(owner.attrs[key])
    return identifier.dtype.str, value.shape, value.tobytes()


def _compare_datasets(
    name: str, a: h5py.Dataset, b: h5py.Dataset
) -> Iterator[Same | Difference]:
    topic, aspect = _DATASETS.get(name.partition("/")[0], (Topic.FILES, Aspect.EXACT))
    if a.is_virtual or a.external:
        raise ValueError(f"its {name} is stored in another file")
    kinds = [f"{each.dtype} of {each.shape}" for each in (a, b)]
    if kinds[0] != kinds[1]:
        other = differs(topic, name, *kinds)
        # A wrapper may change the shape of observations.
        yield replace(other, aspect=aspect) if aspect is Aspect.OBSERVED else other
        return
    found = _Rows(name, topic, aspect)
    rows = a.shape[0] if a.shape else 0
    step = max(1, _BLOCK_BYTES // max(1, a.nbytes // rows)) if rows else 1
    # A single value has no rows.
    for start in range(0, max(rows, 1), step):
        key = np.s_[start : start + step] if a.shape else ()
        left, right = (np.atleast_1d(each[key]) for each in (a, b))
        if left.tobytes() != right.tobytes():
            found.add(start, left, right)
    for which, worst in found.worst.items():
        yield replace(worst, count=found.counts[which])
    yield from _same(name, a, found.worst)


def _same(name: str, item: Any, worst: Mapping[_Key, Difference]) -> Iterator[Same]:
    """Yield the items that are proved equal by the equal rows of a dataset."""
    if not isinstance(item, h5py.Dataset):
        return
    if name == "rewards" and not worst:
        yield Same(Topic.REWARDS, unit="trajectory")
    if name == "states" and item.shape[0] and item.dtype.names:
        if not any(topic is Topic.BEGINNING for topic, _ in worst):
            yield Same(Topic.BEGINNING, unit="episode")
        if not worst:
            yield Same(Topic.PHYSICS, count=item.shape[0] - 1, unit="step")


class _Rows:
    """The differing rows of a dataset.

    The first state is counted separately: it is the episode's initial state.

    Args:
        name: the dataset's name.
        topic: the dataset's topic.
        aspect: the aspect of its numbers.

    Attributes:
        counts: the number of differing rows, keyed by topic and aspect.
        worst: the largest difference, keyed by topic and aspect.
    """

    def __init__(self, name: str, topic: Topic, aspect: Aspect) -> None:
        self._name, self._topic, self._aspect = name, topic, aspect
        self.counts: Counter[_Key] = Counter()
        self.worst: dict[_Key, Difference] = {}

    def add(self, start: int, a: NDArray[Any], b: NDArray[Any]) -> None:
        """Add a block of rows that differ; the first has the index `start`."""
        if start == 0 and self._name in ("states", "observations"):
            self._add(Topic.BEGINNING, 0, a[:1], b[:1])
            start, a, b = 1, a[1:], b[1:]
        self._add(self._topic, start, a, b)

    def _add(self, topic: Topic, start: int, a: NDArray[Any], b: NDArray[Any]) -> None:
        rows: dict[Aspect, NDArray[np.bool_]] = {}
        for member in a.dtype.names or ("",):
            left, right = (_table(each[member] if member else each) for each in (a, b))
            is_other = _bits(left) != _bits(right)
            if not is_other.any():
                continue
            aspect = self._aspect
            if aspect is Aspect.STATE:
                aspect = _MEMBERS.get(member, aspect)
            rows[aspect] = rows.get(aspect, False) | is_other.any(axis=1)
            errors = np.where(is_other, _errors(left, right), -1.0)
            row, column = map(int, np.unravel_index(np.argmax(errors), errors.shape))
            size, known = float(errors[row, column]), self.worst.get((topic, aspect))
            if known is None or size > (np.inf if known.size is None else known.size):
                is_finite = bool(np.isfinite(size))
                may_be_any = is_finite or aspect is Aspect.OBSERVED
                self.worst[topic, aspect] = Difference(
                    topic,
                    unit=self._unit(topic, aspect),
                    aspect=aspect if may_be_any else Aspect.EXACT,
                    where=f"{self._name}[{start + row}]" + f".{member}" * bool(member),
                    how=unlike(left[row, column].item(), right[row, column].item()),
                    size=size if is_finite else None,
                )
        for aspect, differing in rows.items():
            self.counts[topic, aspect] += int(differing.sum())

    def _unit(self, topic: Topic, aspect: Aspect) -> str:
        if aspect is Aspect.SOLVER:
            return "warm start"
        if topic is Topic.BEGINNING:
            return "episode"
        return _UNITS.get(self._name, "step")


def _table(values: NDArray[Any]) -> NDArray[Any]:
    """Return values as rows of numbers."""
    rows = np.atleast_1d(values)
    return rows.reshape(len(rows), -1)


def _errors(left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.float64]:
    """Return `abs(x - y) / (1 + abs(x))`; infinite if not finite or not floats."""
    if left.dtype.kind != "f":
        return np.full(left.shape, np.inf)
    with np.errstate(all="ignore"):
        x, y = left.astype(np.float64), right.astype(np.float64)
        errors = np.abs(x - y) / (1 + np.abs(x))
    return np.where(np.isfinite(errors), errors, np.inf)


def _bits(values: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(values).view(f"u{values.dtype.itemsize}")
