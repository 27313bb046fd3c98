# SPDX-License-Identifier: Apache-2.0
"""The simulation of a recorded episode, brought back picture by picture."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument, UnreadableFile
from ..formats.trajectory import ModelChange, TrajectoryReader
from .baked_fields import is_kept_by_context
from .cameras import check_camera
from .model_fields import apply_fields
from .model_store import load_model
from .scene_view import SceneView, scene_view_from_facts
from .snapshot import restore_snapshot
from .struct_memory import read_member

_BLOCK_BYTES = 1 << 20


class RecordedScene:
    """A model and its data, as they were at a picture of a trajectory.

    Only what the visualiser reads is put back into the data; it is for drawing.

    Args:
        reader: of the trajectory; used as long as this object is.

    Raises:
        UnreadableFile: what it says of its scene cannot be, or its model is missing,
            damaged or of another MuJoCo.

    Attributes:
        model: the model, as it was at the picture last brought back.
        data: its data, likewise.
        view: how the environment showed it. The camera and the option change with the
            pictures.
        previous_cameras: where the two cameras of the environment's scene stood before
            the first picture, `(2, 3)`.
    """

    def __init__(self, reader: TrajectoryReader) -> None:
        self._reader = reader
        facts = reader.header.facts
        try:
            self.view: SceneView = scene_view_from_facts(facts["scene"])
            self.previous_cameras = _positions(facts["scene"].get("previous_cameras"))
        # Not all that NumPy and the bindings refuse is looked for.
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            raise UnreadableFile(reader.path, f"of its scene: {error}") from error
        if not isinstance(facts.get("model"), dict):
            raise UnreadableFile(reader.path, "it does not say which model it is of")
        self.model = load_model(reader.path.parent, facts["model"])
        self.data = mujoco.MjData(self.model)
        self._changes = _Changes(reader)
        self._originals: dict[str, NDArray[Any]] = {}
        self._block = range(0)
        self._values: dict[str, NDArray[Any]] = {}

    @property
    def count(self) -> int:
        """How many pictures there are."""
        return self._reader.frame_count

    def bring_to(self, index: int) -> bool:
        """Bring back what was there at picture `index`, one of `count`.

        Returns:
            Whether something has changed in the model that an OpenGL context keeps.

        Raises:
            UnreadableFile: the file is damaged, or does not fit its model.
        """
        try:
            changed = self._change_model(int(self._reader.frame_steps[index]))
            check_camera(self.model, self.view.camera)
            restore_snapshot(self._values_of(index), self.model, self.data)
        except InvalidArgument as error:
            raise UnreadableFile(self._reader.path, error) from error
        return any(map(is_kept_by_context, changed))

    def _change_model(self, step: int) -> set[str]:
        """Make the model what it was after `step`; return the names of what changed."""
        fields: dict[str, NDArray[Any]] = {}
        if step < self._changes.step:
            fields.update(self._originals)
            self._changes = _Changes(self._reader)
        fields.update(self._changes.until(step))
        for name in fields.keys() - self._originals.keys():
            # One that there is not is an error of `apply_fields`.
            with contextlib.suppress(AttributeError):
                self._originals[name] = self._read(name)
        apply_fields(
            self.model, fields, camera=self.view.camera, option=self.view.option
        )
        return set(fields)

    def _read(self, name: str) -> NDArray[Any]:
        struct, _, member = name.partition(".")
        if struct == "camera":
            return read_member(self.view.camera, member)
        if struct == "option":
            return read_member(self.view.option, member)
        return read_member(self.model, name)

    def _values_of(self, index: int) -> dict[str, NDArray[Any]]:
        """Return the arrays of a snapshot, read in blocks."""
        if index not in self._block:
            rows = max(1, _BLOCK_BYTES // max(1, self._reader.header.snapshot.size))
            start = index - index % rows
            self._block = range(start, min(start + rows, self._reader.frame_count))
            packed = self._reader.snapshots(self._block.start, self._block.stop)
            self._values = self._reader.header.snapshot.unpack(packed)
        place = index - self._block.start
        return {name: values[place] for name, values in self._values.items()}


class _Changes:
    """The changes of a model, in order, without having all of them in memory."""

    def __init__(self, reader: TrajectoryReader) -> None:
        self._coming: Iterator[ModelChange] = reader.iter_model_changes()
        # The last step that was asked for.
        self.step = -1

    def until(self, step: int) -> dict[str, NDArray[Any]]:
        """Return what has changed since the step asked for before, up to this one."""
        self.step = step
        fields: dict[str, NDArray[Any]] = {}
        for change in self._coming:
            if change.step > step:
                self._coming = itertools.chain([change], self._coming)
                break
            fields.update(change.fields)
        return fields


def _positions(previous: Any) -> NDArray[np.float64]:
    if previous is None:
        return np.zeros((2, 3))
    positions = np.asarray(previous, np.float64)
    if positions.shape != (2, 3):
        raise InvalidArgument(f"previous_cameras is {previous!r:.200}")
    return positions
