# SPDX-License-Identifier: Apache-2.0
"""Snapshots of a simulation: taken as one row of bytes, and put back for drawing.

Restored into fresh data they give the same scene, byte for byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument
from ..formats.trajectory import RowLayout
from .captured_arrays import ALWAYS, SNAPSHOT_ARRAYS, TENDON_RGBA, array_kind
from .raw_memory import WORDS, can_be_gathered, words_of
from .tendon_colours import TendonColours

# Indices of geoms and of each other, which the visualiser follows unseen.
_PATHS = ("ten_wrapadr", "ten_wrapnum", "wrap_obj")
# In the place of a geom.
_PULLEY = -2


class SnapshotSource:
    """Takes snapshots of one `MjData`.

    Args:
        model: the model; kept alive, as is the data.
        data: its data.
        layout: what `snapshot_layout` gave for the model.

    Attributes:
        words: what a snapshot consists of in `memory.WORDS`; None where it cannot be
            gathered, or more than the data's own arrays is in it.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, layout: RowLayout
    ) -> None:
        self._layout = layout
        self._colours: TendonColours | None = None
        arrays = []
        for field in layout.fields:
            if field.name == TENDON_RGBA:
                self._colours = TendonColours(model, data)
                arrays.append(self._colours.rgba)
            else:
                arrays.append(getattr(data, field.name))
        # They keep the data alive.
        self._arrays = arrays
        self._words = words_of(arrays) if can_be_gathered(arrays) else None
        self.words = self._words if self._colours is None else None

    def take(self, out: NDArray[np.uint8]) -> None:
        """Write a snapshot of this moment into `out`, `(layout.size,) uint8`.

        It begins at a multiple of 8 bytes.
        """
        if self._colours is not None:
            self._colours.update()
        if self._words is not None:
            WORDS.take(self._words, None, out.view(np.uint64), "clip")
            return
        for field, array in zip(self._layout.fields, self._arrays, strict=True):
            part = out[field.offset : field.offset + field.array.size]
            part[...] = array.reshape(-1).view(np.uint8)


def layout_objection(
    model: mujoco.MjModel, data: mujoco.MjData, layout: RowLayout
) -> str | None:
    """Say why recorded snapshots are none of this model; None if they may be.

    They hold at least what MuJoCo's default option needs.
    """
    for field in layout.fields:
        is_colour = field.name == TENDON_RGBA
        if not is_colour and field.name not in SNAPSHOT_ARRAYS:
            return f"The snapshots hold {field.name!r:.40}, which no frame needs."
        own = array_kind(model if is_colour else data, field.name)
        if field.array != own:
            return (
                f"The snapshots' {field.name} is {field.array.dtype} of the shape "
                f"{field.array.shape}, and in this model {own.dtype} of {own.shape}."
            )
    held = {field.name for field in layout.fields}
    missing = {name for name in ALWAYS if array_kind(data, name).size} - held
    if missing:
        return f"The snapshots hold no {', no '.join(sorted(missing))}."
    return None


def restore_snapshot(
    values: Mapping[str, NDArray[Any]], model: mujoco.MjModel, data: mujoco.MjData
) -> None:
    """Put what a snapshot holds back, ready for `mjv_updateScene`.

    Args:
        values: the arrays by their names, as `RowLayout.unpack` gives them.
        model: the colours of its tendons are set where `values` has them.
        data: its data.

    Raises:
        InvalidArgument: an array is not there, is of another kind, or leads to where
            the model has nothing, which MuJoCo would not notice.
    """
    for name, value in values.items():
        is_known = name in SNAPSHOT_ARRAYS or name == TENDON_RGBA
        target = model if name == TENDON_RGBA else data
        own = array_kind(target, name) if is_known else None
        if own is None or (value.dtype.str, value.shape) != (own.dtype, own.shape):
            raise InvalidArgument(
                f"The snapshot's {name} is {value.dtype} of the shape {value.shape}, "
                f"and here it is {own}: it belongs to another model or version of "
                "MuJoCo."
            )
        getattr(target, name)[...] = value
    if not values.keys().isdisjoint(_PATHS):
        _check_paths(model, data)


def _check_paths(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Check what the visualiser follows, unseen, along a tendon."""
    first, count = data.ten_wrapadr.astype(np.int64), data.ten_wrapnum
    points, wrapped = 2 * model.nwrap, data.wrap_obj
    ends = first + count
    if ((count < 0) | (first < 0) | (ends > points))[count != 0].any():
        raise InvalidArgument(
            f"The snapshot's tendons run over points up to {ends.max()}, and this "
            f"model has {points}."
        )
    if wrapped.size and (wrapped.min() < _PULLEY or wrapped.max() >= model.ngeom):
        raise InvalidArgument(
            f"The snapshot's wrap_obj holds geoms from {_PULLEY} (a pulley) and -1 (a "
            f"site) to {model.ngeom - 1} in this model, and there are some from "
            f"{wrapped.min()} to {wrapped.max()}."
        )
