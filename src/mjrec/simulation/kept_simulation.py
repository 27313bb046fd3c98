# SPDX-License-Identifier: Apache-2.0
"""Leaving a simulation as it was, around code that changes it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import mujoco

# What an environment moves or colours to show a goal or a touch.
_FIELDS = (
    *("site_pos", "site_quat", "site_size", "site_rgba"),
    *("geom_pos", "geom_quat", "geom_size", "geom_rgba"),
    *("body_pos", "body_quat", "mat_rgba"),
)


class KeptSimulation:
    """Puts a simulation back as it was before a block.

    All of the data is put back, and of the model what places, sizes and colours sites,
    geoms and bodies. The arrays stay where they are in memory.
    """

    def __init__(self) -> None:
        self._model: mujoco.MjModel | None = None
        self._scratch: mujoco.MjData | None = None

    @contextlib.contextmanager
    def around(self, model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[None]:
        """Keep `model` and `data` for the block, also if it raises.

        Not reentrant.
        """
        if self._model is not model:
            # Making one costs as much as a hundred copies.
            self._scratch, self._model = mujoco.MjData(model), model
        fields = [getattr(model, name) for name in _FIELDS]
        before = [field.copy() for field in fields]
        mujoco.mj_copyData(self._scratch, model, data)
        try:
            yield
        finally:
            mujoco.mj_copyData(data, model, self._scratch)
            for field, values in zip(fields, before, strict=True):
                field[...] = values
