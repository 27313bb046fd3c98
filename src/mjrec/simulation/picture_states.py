# SPDX-License-Identifier: Apache-2.0
"""Snapshots of one simulation in one episode, and whether they can be trusted."""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..formats.trajectory import RowLayout
from .scene_check import scene_difference
from .scene_view import SceneView, ViewMemory
from .snapshot import SnapshotSource, needs_constraints, snapshot_layout

_TRACKING = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)

# Fields of a model that `snapshot_layout` looks at, which environments leave alone.
_SETTLING_THE_LAYOUT = (
    "tendon_limited",
    "tendon_matid",
    "tendon_plasticadr",
    "sensor_",
)


class CheckedPictures:
    """Remembers what the self-check has been made of, so that it is made once.

    It is made of the first picture, and again of the first one that has a visual
    option, or a changed field of the model, that none before it had.
    """

    def __init__(self) -> None:
        self._options: set[bytes] = set()
        self._fields: set[str] = set()

    def covers(self, option: mujoco.MjvOption, fields: Iterable[str]) -> bool:
        """Tell whether pictures with this option and these fields changed are sound."""
        return _key(option) in self._options and self._fields.issuperset(fields)

    def add(self, option: mujoco.MjvOption, fields: Iterable[str]) -> None:
        """Note that a picture with this option and these fields changed is sound."""
        self._options.add(_key(option))
        self._fields.update(fields)


class KeptCameras:
    """The cameras that each picture leaves in a scene that stays.

    An infinite plane is drawn around the camera of the picture before, and a camera
    that tracks a body is moved by each picture. The positions are those that MuJoCo
    computes, without any drawing.

    Args:
        model: the model of the scene.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._scene = mujoco.MjvScene(model, maxgeom=1)
        self._drawn = False

    @property
    def positions(self) -> list[list[float]] | None:
        """Of both cameras; None where no picture has been made in this scene."""
        if not self._drawn:
            return None
        return [camera.pos.tolist() for camera in self._scene.camera]

    def drawn(self, data: mujoco.MjData, camera: mujoco.MjvCamera) -> None:
        """Note that a picture of `data` has been made.

        Args:
            data: of the picture.
            camera: what it was made with; one that tracks a body is moved.
        """
        mujoco.mjv_updateCamera(self._model, data, camera, self._scene)
        self._drawn = True


class PictureStates:
    """Takes snapshots of one simulation.

    Args:
        model: the model; kept alive, as is the data.
        data: its data.
        view: how the scene is shown.
        changed_fields: of the model, other than in the stored one.
        kept: told of every picture, where one has an influence on the next.
        checked: what is known to be sound.
        watched: the view as it was at the snapshot before; None where there was none.

    Attributes:
        layout: of the snapshots.
        view: as given.
        source: of the snapshots themselves.
        watched: the camera and the options of the view.
        stand_alone: no picture has an influence on the next.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        view: SceneView,
        changed_fields: Iterable[str] = (),
        *,
        kept: KeptCameras | None,
        checked: CheckedPictures,
        watched: ViewMemory | None = None,
    ) -> None:
        self.layout = snapshot_layout(model, view.option)
        self.view = view
        self._model = model
        self._data = data
        self._kept = kept
        self.stand_alone = kept is None
        self._checked = checked
        self.source = SnapshotSource(model, data, self.layout)
        self.watched = watched or ViewMemory(view)
        self._facts = view.facts()
        # Moved as pictures move it; the environment's own stays where it is.
        self._camera = copy.copy(view.camera)
        self._told = self._camera.lookat.tolist()
        self._is_settled_anew = _settle(changed_fields)
        # Whether the camera or an option is other than in the facts.
        self._has_moved = False

    def goes_on(
        self, data: mujoco.MjData, view: SceneView, changed_fields: Iterable[str]
    ) -> bool:
        """Go on with another episode, if nothing but its state is other in it.

        Args:
            data: of this episode.
            view: of this episode.
            changed_fields: of the model, other than in the stored one.

        Returns:
            Whether it does; otherwise this object is of no use any more.
        """
        return (
            data._address == self._data._address
            and _is_same(view, self.view)
            and self.watched.changed() is None
            and not self._has_moved
            and not (self._is_settled_anew or _settle(changed_fields))
        )

    def facts(self) -> dict[str, Any]:
        """Return the facts of the scene, and what the picture before left in it."""
        facts = {**self._facts}
        if self._kept is not None and not self.view.fresh:
            facts["previous_cameras"] = self._kept.positions
        if _tracks(self._camera):
            self._told = self._camera.lookat.tolist()
            facts["camera"] = {**facts["camera"], "lookat": self._told}
        return facts

    def is_sound(self, changed_fields: Iterable[str]) -> bool:
        """Tell whether pictures with these fields changed were checked before."""
        return self._checked.covers(self.view.option, changed_fields)

    def refusal(self, changed_fields: Collection[str]) -> str | None:
        """Say why pictures of this moment cannot be made from snapshots.

        Args:
            changed_fields: of the model, other than in the stored one.
        """
        is_sound = self.is_sound(changed_fields)
        if is_sound and not changed_fields:
            return None
        reason = needs_constraints(self._model, self.view.option)
        if reason is not None or is_sound:
            return reason
        row = np.empty(self.layout.size, np.uint8)
        self.source.take(row)
        return self._difference(row, changed_fields)

    def take(self, out: NDArray[np.uint8]) -> dict[str, NDArray[Any]] | None:
        """Write a snapshot into `out`, and return what of the view has changed."""
        self.source.take(out)
        changed = self.watched.changed()
        if changed is not None:
            self._has_moved = True
            self._camera = copy.copy(self.view.camera)
            self._told = self._camera.lookat.tolist()
        if self._kept is None:
            return changed
        return self._drawn(self._kept, changed)

    def _drawn(
        self, kept: KeptCameras, changed: dict[str, NDArray[Any]] | None
    ) -> dict[str, NDArray[Any]] | None:
        """Let the camera move as a picture moves it.

        A camera that tracks a body goes a fifth of the way to it in each picture, so
        that where it looks depends on all pictures before.
        """
        lookat = self._camera.lookat
        if _tracks(self._camera) and lookat.tolist() != self._told:
            self._told = lookat.tolist()
            changed = {**(changed or {}), "camera.lookat": lookat.copy()}
        kept.drawn(self._data, self._camera)
        return changed

    def objection(self, row: NDArray[np.uint8], changed: Iterable[str]) -> str | None:
        """Say why a snapshot does not suffice any longer, after something has changed.

        Args:
            row: the snapshot of this moment.
            changed: the fields of model and view that have.
        """
        option = self.view.option
        fields = [name for name in changed if not name.startswith("camera.")]
        if self._checked.covers(option, fields):
            return None
        reason = needs_constraints(self._model, option)
        if reason is not None:
            return reason
        missing = _names(snapshot_layout(self._model, option)) - _names(self.layout)
        if missing:
            return (
                f"it now needs {', '.join(sorted(missing))} as well, which the "
                "recording of this episode was not begun with"
            )
        return self._difference(row, fields)

    def _difference(
        self, row: NDArray[np.uint8], changed_fields: Iterable[str]
    ) -> str | None:
        difference = scene_difference(
            self._model, self._data, self.layout, row, self.view
        )
        if difference is None:
            self._checked.add(self.view.option, changed_fields)
            return None
        return f"drawn from its snapshot the scene is another one: {difference}"


def _tracks(camera: mujoco.MjvCamera) -> bool:
    return bool(camera.type == _TRACKING)


def _settle(changed_fields: Iterable[str]) -> bool:
    return any(name.startswith(_SETTLING_THE_LAYOUT) for name in changed_fields)


def _is_same(view: SceneView, other: SceneView) -> bool:
    return (
        view.camera is other.camera
        and view.option is other.option
        and view.max_geom == other.max_geom
        and view.fresh is other.fresh
        and (view.height, view.width) == (other.height, other.width)
        and bool(view.label == other.label)
    )


def moves_cameras(model: mujoco.MjModel, view: SceneView) -> bool:
    """Tell whether a picture has an influence on the next one."""
    return _tracks(view.camera) or (not view.fresh and _has_infinite_plane(model))


def _has_infinite_plane(model: mujoco.MjModel) -> bool:
    """Tell whether the model has a plane without an edge."""
    planes = model.geom_size[model.geom_type == _PLANE]
    return bool((planes[:, :2] <= 0).any())


def _key(option: mujoco.MjvOption) -> bytes:
    numbers = (option.label, option.frame, option.bvh_depth, option.flex_layer)
    groups = (
        *(option.geomgroup, option.sitegroup, option.jointgroup, option.tendongroup),
        *(option.actuatorgroup, option.flexgroup, option.skingroup, option.flags),
    )
    return b"".join((repr(numbers).encode(), *(group.tobytes() for group in groups)))


def _names(layout: RowLayout) -> set[str]:
    return {field.name for field in layout.fields}
