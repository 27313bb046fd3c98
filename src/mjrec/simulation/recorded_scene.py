# SPDX-License-Identifier: Apache-2.0
"""Sources of frames: a recorded episode or given states, restored frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FileNotWritten, InvalidArgument, UnreadableFile
from ..formats.trajectory import TrajectoryReader
from .cameras import check_camera, raw_model
from .fields import apply_fields
from .model_sources import with_embedded_files
from .model_store import load_model
from .renderer import is_kept_by_context
from .snapshot import check_layout, restore_snapshot
from .view import view_from_facts

_BLOCK_BYTES = 1 << 20
_MODEL, _STATES = "model.mjb", "states.npy"


class RecordedScene:
    """A model and its data, restored to a frame of a trajectory.

    Frames are restored in ascending order. Only arrays that the visualizer reads are
    restored, so use the data only for drawing.

    Args:
        reader: the trajectory's reader, which must stay open as long as this object is
            used.

    Raises:
        UnreadableFile: the file's facts about the scene are invalid, or its model is
            missing, damaged or from another MuJoCo version.

    Attributes:
        model: the model as it was at the last restored frame.
        data: the model's data at that frame.
        view: the environment's view of the scene. Its camera and option change with the
            frames.
        previous_cameras: positions of the environment scene's two cameras before the
            first frame, `(2, 3)`.
        count: number of frames.
        is_constant: whether the model and view are the same in all frames.
    """

    def __init__(self, reader: TrajectoryReader) -> None:
        self._reader = reader
        facts = reader.facts
        try:
            self.view = view_from_facts(facts["scene"])
            previous = facts["scene"].get("previous_cameras")
            self.previous_cameras = np.zeros((2, 3))
            if previous is not None:
                self.previous_cameras = np.asarray(previous, np.float64)
            if self.previous_cameras.shape != (2, 3):
                raise ValueError(f"previous_cameras is {previous!r:.200}")
        # NumPy and the bindings may reject values that were not checked beforehand.
        except (AttributeError, TypeError, ValueError, OverflowError) as error:
            raise UnreadableFile(reader.path, f"in its scene: {error}") from error
        if not isinstance(facts.get("model"), dict):
            raise UnreadableFile(reader.path, "the name of its model is missing")
        self.model = load_model(reader.path.parent, facts["model"])
        self.data = mujoco.MjData(self.model)
        self.count = reader.frame_count
        self.is_constant = not reader.change_count
        self._rows = reader.snapshots(0, 0)
        try:
            check_layout(self.model, self.data, self._rows.dtype)
        except InvalidArgument as error:
            raise UnreadableFile(reader.path, error) from error
        self._changes = reader.iter_model_changes()
        self._next = next(self._changes, None)
        self._block = range(0)

    def bring_to(self, index: int) -> bool:
        """Restore frame `index`, from 0 to `count` - 1.

        Returns:
            Whether a model field that an OpenGL context keeps has changed.

        Raises:
            UnreadableFile: the file is damaged, or does not match its model.
        """
        try:
            changed = self._change_model(int(self._reader.frame_steps[index]))
            check_camera(self.model, self.view.camera)
            restore_snapshot(self._row(index), self.model, self.data)
        except InvalidArgument as error:
            raise UnreadableFile(self._reader.path, error) from error
        return any(map(is_kept_by_context, changed))

    def close(self) -> None:
        """Close the trajectory. Idempotent."""
        self._reader.close()

    def _change_model(self, step: int) -> dict[str, NDArray[Any]]:
        """Restore the model as it was after `step`, and return the changed fields."""
        fields: dict[str, NDArray[Any]] = {}
        # Merged one by one, because all changes together may not fit into memory.
        while self._next is not None and self._next.step <= step:
            fields.update(self._next.fields)
            self._next = next(self._changes, None)
        view = self.view
        apply_fields(self.model, fields, camera=view.camera, option=view.option)
        return fields

    def _row(self, index: int) -> Any:
        """Return a snapshot. Snapshots are read in blocks."""
        if index not in self._block:
            rows = max(1, _BLOCK_BYTES // max(1, self._rows.itemsize))
            start = index - index % rows
            self._block = range(start, min(start + rows, self.count))
            self._rows = self._reader.snapshots(self._block.start, self._block.stop)
        return self._rows[index - self._block.start]


def check_states(model: Any, states: ArrayLike, spec: int) -> NDArray[np.float64]:
    """Return `states` as an `(n, size)` array of float64.

    Args:
        model: a `mujoco.MjModel`, or dm_control's wrapper around one.
        states: one row per state.
        spec: the components of a row, a combination of `mujoco.mjtState` flags.

    Raises:
        InvalidArgument: `spec` is not a combination of `mujoco.mjtState` flags, or
            `states` has the wrong type or shape.
    """
    try:
        size = int(mujoco.mj_stateSize(raw_model(model), int(spec)))
    except (TypeError, ValueError, mujoco.FatalError) as error:
        raise InvalidArgument(
            f"spec must be a combination of mujoco.mjtState flags, not {spec!r}: "
            f"{error}."
        ) from error
    rows = np.asarray(states)
    if rows.dtype.kind not in "iuf":
        raise InvalidArgument(f"States must be numbers, not an array of {rows.dtype}.")
    if rows.ndim == 3 and rows.shape[2] == size:
        raise InvalidArgument(
            f"States must have the shape (n, {size}), but this array has the shape "
            f"{rows.shape}, like the runs returned by mujoco.rollout. "
            "Pass a single run, states[k], or all runs concatenated, "
            f"states.reshape(-1, {size})."
        )
    if rows.ndim != 2 or rows.shape[1] != size:
        raise InvalidArgument(
            f"States must have the shape (n, {size}), because "
            f"mujoco.mj_stateSize(model, {int(spec)}) is {size}, but this array has "
            f"the shape {rows.shape}. Pass the spec and the model that produced the "
            "rows."
        )
    return np.ascontiguousarray(rows, np.float64)


def save_states(directory: Path, model: Any, states: NDArray[np.float64]) -> None:
    """Write the files that `GivenStates` reads.

    Raises:
        FileNotWritten: a file cannot be written, for example because the disk is full.
    """
    whole = with_embedded_files(raw_model(model))
    try:
        mujoco.mj_saveModel(whole, str(directory / _MODEL), None)
        np.save(directory / _STATES, states, allow_pickle=False)
    except (OSError, mujoco.FatalError) as error:
        raise FileNotWritten(directory, error) from error


class GivenStates:
    """A model and its data in one of the states that `save_states` wrote.

    All quantities derived from a state are computed with `mj_forward`. Components
    missing from the rows are as in a new `MjData`, so a frame depends only on its row.

    Args:
        directory: the directory to which `save_states` wrote.
        spec: the components of a row.

    Attributes:
        model: the model.
        data: the model's data, in the most recently set state.
        count: number of rows.
    """

    is_constant = True

    def __init__(self, directory: Path, spec: int) -> None:
        self.model = mujoco.MjModel.from_binary_path(str(directory / _MODEL))
        self.data = mujoco.MjData(self.model)
        self._spec = spec
        # Only the rows that are used are read into memory.
        self._states = np.load(directory / _STATES, mmap_mode="r", allow_pickle=False)
        self.count = len(self._states)

    def bring_to(self, index: int) -> bool:
        """Write row `index` into the data. Return False: the model never changes."""
        mujoco.mj_resetData(self.model, self.data)
        # Copied, because mujoco 3.3 does not accept a read-only array.
        state = np.array(self._states[index])
        mujoco.mj_setState(self.model, self.data, state, self._spec)
        mujoco.mj_forward(self.model, self.data)
        return False

    def close(self) -> None:
        """Do nothing, because the files belong to the caller."""
