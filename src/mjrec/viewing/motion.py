# SPDX-License-Identifier: Apache-2.0
"""The motion of all drawn shapes: poses and colors in each recorded state.

MuJoCo's own visualizer selects the shapes, using the recorded environment's options. So
the same groups, tendons and sites are hidden as in the environment's videos.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import InvalidArgument, UnreadableFile
from ..formats.trajectory import ModelChange, TrajectoryReader
from ..simulation.cameras import check_camera, default_camera, resolve_camera
from ..simulation.fields import apply_fields
from ..simulation.foreign_files import open_vetted_trajectory
from ..simulation.trajectories import Trajectory
from ..simulation.view import view_from_facts

_MOST_GEOMS = 20_000
# The farthest that a geom moves in a substep, in units of the model's extent.
_LAG = 0.02
_EVERYTHING = int(mujoco.mjtCatBit.mjCAT_ALL)
_DECOR = int(mujoco.mjtCatBit.mjCAT_DECOR)
_GEOM, _SITE = int(mujoco.mjtObj.mjOBJ_GEOM), int(mujoco.mjtObj.mjOBJ_SITE)
_TENDON = int(mujoco.mjtObj.mjOBJ_TENDON)
_FIXED_CAMERA = int(mujoco.mjtCamera.mjCAMERA_FIXED)
_TRACKING = int(mujoco.mjtCamera.mjCAMERA_TRACKING)
_SKIN, _FLEX = int(mujoco.mjtGeom.mjGEOM_SKIN), int(mujoco.mjtGeom.mjGEOM_FLEX)
# A note of every page.
OWN_LIGHTS = (
    "The page has its own lights; the model's lights and reflections are not shown."
)
# Fields whose changes a page does not show.
_FIXED = {
    "Sizes and meshes": (
        *("geom_size", "geom_type", "geom_dataid", "site_size"),
        *("mesh_vert", "hfield_data", "hfield_size"),
    ),
    "Textures": ("tex_data", "mat_texid", "mat_texrepeat", "geom_matid"),
}
FIXED_FIELDS = tuple(name for names in _FIXED.values() for name in names)


@dataclass(frozen=True)
class Shape:
    """A drawn object.

    Attributes:
        name: name of its node in the page's scene, such as `/geom/3`.
        object_type: the object's `mjtObj`, such as a geom, site or tendon.
        object_id: the object's id in the model.
        geom_type: the shape's `mjtGeom`.
        rgba: color from MuJoCo's visualizer, including materials.
    """

    name: str
    object_type: int
    object_id: int
    geom_type: int
    rgba: tuple[float, float, float, float]

    @property
    def is_skin(self) -> bool:
        """Whether the shape is a skin, whose vertices are moved by bones."""
        return self.geom_type == _SKIN


@dataclass(frozen=True, kw_only=True)
class Motion:
    """N states of a recorded episode, in the form that a page uses.

    Attributes:
        steps: `(N,)`, number of steps before each state.
        time: `(N,)`, simulated time in seconds; the step numbers if it is unknown.
        rewards: `(N,)`, reward of the step that led to the state; 0 for the reset.
        returns: `(N,)`, sum of the rewards up to the state.
        vertices: `(N, vertices, 3)`, vertices of flexible bodies, keyed by name.
        poses: `(N, 7)`, position and quaternion (wxyz), keyed by the name of a shape or
            bone.
        scales: `(N, 3)`, scales of shapes that change size; zero while a shape is
            absent.
        cameras: `(N, cameras, 8)`, poses of the model's cameras, which look along -z,
            and their `fovy`.
        target: `(N, 3)`, the point that the tracking camera follows.
        colours: color changes: index of the state, name of the shape, and RGBA from
            that state on.
    """

    steps: NDArray[np.int64]
    time: NDArray[np.float64]
    rewards: NDArray[np.float64]
    returns: NDArray[np.float64]
    vertices: dict[str, NDArray[np.float64]]
    poses: dict[str, NDArray[np.float64]]
    scales: dict[str, NDArray[np.float64]]
    cameras: NDArray[np.float64]
    target: NDArray[np.float64]
    colours: list[tuple[int, str, list[float]]]


class Stage:
    """A model that is moved through recorded states, and its drawn shapes.

    It must be used on one thread, and states must be requested in ascending order.

    Args:
        trajectory: the trajectory with the model and the options to draw it with.
        first: index of the first state to show.

    Attributes:
        model: the model, as in the last requested state.
        data: the model's data, as in the last requested state.
        shapes: shapes of constant size that are drawn in some state.
        passing: shapes seen in only some states, with a different size in each, such as
            tendons.
        soft: skins and flexible bodies.
        notes: remarks on features that cannot be shown.
        view: the recorded camera's initial position, the point it looks at, and its
            `fovy`.

    Raises:
        UnreadableFile, UntrustedModel: see `Trajectory.model`.
    """

    def __init__(self, trajectory: Trajectory, *, first: int = 0) -> None:
        self.model = trajectory.model()
        self.data = mujoco.MjData(self.model)
        self.passing: dict[str, Shape] = {}
        self.notes = [OWN_LIGHTS]
        self._camera, self._option = _recorded_view(trajectory, self.model)
        self._scene = mujoco.MjvScene(self.model, maxgeom=_MOST_GEOMS)
        self._changes_seen = 0
        with open_vetted_trajectory(trajectory.path) as reader:
            # Up to the reset, this is for the camera and the options only.
            self._change_model(reader, first)
            self._enter(trajectory, first)
            drawn = list(self._drawn())
            if self._scene.ngeom > len(drawn):
                self.notes.append("Labels, contacts and other marks are not shown.")
            self.view = self._view()
            self.soft = [_shape(geom) for geom in drawn if geom.type in (_SKIN, _FLEX)]
            self.shapes = [_shape(geom) for geom in drawn if _is_fixed_size(geom)]
            is_more = len(drawn) > len(self.soft) + len(self.shapes)
            self.shapes += self._hidden_at_first(reader)
            if self._is_drawn_elsewhere(reader, first):
                self.notes.append(
                    "The videos show some objects in other places, because the "
                    "environment moves them only to draw them."
                )
        self._names, self._moving = self._moving_objects()
        self._rgba = {shape.name: shape.rgba for shape in self.shapes}
        self._has_passing = is_more or self.model.ntendon > 0
        shown = [
            s for s in self.soft if s.is_skin or self.model.flex_dim[s.object_id] != 1
        ]
        if len(shown) < len(self.soft):
            self.soft = shown
            self.notes.append("One-dimensional flexible bodies are not shown.")
        self._tracked = _tracked_body(self.model)

    @property
    def camera(self) -> str:
        """The camera used in the videos: its index, "track" or "free"."""
        kinds = {_FIXED_CAMERA: str(self._camera.fixedcamid), _TRACKING: "track"}
        return kinds.get(int(self._camera.type), "free")

    def _is_drawn_elsewhere(self, reader: TrajectoryReader, step: int) -> bool:
        """Return whether a state's frame shows geoms away from their places in it.

        Goal markers are an example. A frame may lag behind its state by a substep.
        """
        frame = int(np.searchsorted(reader.frame_steps, step))
        rows = reader.snapshots(frame, min(frame + 1, reader.frame_count))
        places = rows["geom_xpos"] if "geom_xpos" in (rows.dtype.names or ()) else None
        if places is None or places.shape != (1, *self.data.geom_xpos.shape):
            return False
        ids = [shape.object_id for shape in self.shapes if shape.object_type == _GEOM]
        moved = places[0, ids] - self.data.geom_xpos[ids]
        return bool(np.abs(moved).max(initial=0) > _LAG * self.model.stat.extent)

    def _view(self) -> tuple[list[float], list[float], float]:
        cameras = self._scene.camera
        position = np.mean([camera.pos for camera in cameras], axis=0)
        distance = self.model.stat.extent
        if self._camera.type != _FIXED_CAMERA:
            distance, fovy = self._camera.distance, self.model.vis.global_.fovy
        else:
            fovy = self.model.cam_fovy[self._camera.fixedcamid]
        target = position + distance * np.array(cameras[0].forward)
        return position.tolist(), target.tolist(), float(fovy)

    def bones_of(self, skin: int) -> list[int]:
        """Return the bodies that are a skin's bones, in the skin's order."""
        first, count = self.model.skin_boneadr[skin], self.model.skin_bonenum[skin]
        bodies: list[int] = self.model.skin_bonebodyid[first : first + count].tolist()
        return bodies

    def motion(self, trajectory: Trajectory, steps: NDArray[np.int64]) -> Motion:
        """Return the motion of all shapes in some states of the same episode.

        Args:
            trajectory: the trajectory that contains these states; it may have grown
                since the stage was created.
            steps: `(N,)`, ascending indices of the states. They must not precede
                any state that was requested before.

        Raises:
            UnreadableFile: the file is missing or damaged.
        """
        placed, target, fovy = [], [], []
        colours: list[tuple[int, str, list[float]]] = []
        passing: list[dict[str, NDArray[np.float64]]] = []
        first, number = self.model.flex_vertadr, self.model.flex_vertnum
        flexes = {
            s.name: slice(first[s.object_id], first[s.object_id] + number[s.object_id])
            for s in self.soft
            if not s.is_skin
        }
        vertices: dict[str, list[NDArray[np.float64]]] = {name: [] for name in flexes}
        with open_vetted_trajectory(trajectory.path) as reader:
            for index, step in enumerate(map(int, steps)):
                if self._change_model(reader, step):
                    colours += self._new_colours(trajectory, step, index)
                self._enter(trajectory, step)
                moving = (
                    [positions[ids], matrices[ids].reshape(-1, 9)]
                    for positions, matrices, ids in self._moving
                )
                placed.append(np.vstack([np.hstack(each) for each in moving]))
                target.append(self.data.subtree_com[self._tracked].copy())
                fovy.append(self.model.cam_fovy.copy())
                for name, own in flexes.items():
                    vertices[name].append(self.data.flexvert_xpos[own].copy())
                passing.append(self._passing_now() if self._has_passing else {})
        named = len(self._names)
        shape = len(steps), named + self.model.ncam, 12
        every_pose = _quaternions(np.reshape(placed, shape))
        poses = dict(zip(self._names, np.moveaxis(every_pose, 1, 0), strict=False))
        scales = {}
        nowhere = np.concatenate([np.zeros(3), np.eye(3).ravel(), np.zeros(3)])
        for name in self.passing:
            rows = np.array([each.get(name, nowhere) for each in passing])
            poses[name] = _quaternions(rows[:, :12])
            scales[name] = rows[:, 12:]
        rewards = np.concatenate([[0.0], trajectory.rewards])
        time = trajectory.time
        return Motion(
            steps=steps,
            time=steps.astype(float) if time is None else time[steps],
            rewards=rewards[steps],
            returns=np.cumsum(rewards)[steps],
            vertices={name: np.array(each) for name, each in vertices.items()},
            poses=poses,
            scales=scales,
            cameras=np.dstack([every_pose[:, named:], fovy]),
            target=np.reshape(target, (len(steps), 3)),
            colours=colours,
        )

    def _moving_objects(self) -> tuple[list[str], list[tuple[Any, Any, list[int]]]]:
        """Return the names, and each kind's positions, rotations and indices.

        Cameras come last and have no names.
        """
        data = self.data
        geoms, sites = (
            [shape for shape in self.shapes if shape.object_type == kind]
            for kind in (_GEOM, _SITE)
        )
        skins = [shape.object_id for shape in self.soft if shape.is_skin]
        bones = sorted({body for skin in skins for body in self.bones_of(skin)})
        names = [shape.name for shape in (*geoms, *sites)]
        return [*names, *(f"bone/{body}" for body in bones)], [
            (data.geom_xpos, data.geom_xmat, [shape.object_id for shape in geoms]),
            (data.site_xpos, data.site_xmat, [shape.object_id for shape in sites]),
            (data.xpos, data.xmat, bones),
            (data.cam_xpos, data.cam_xmat, [*range(self.model.ncam)]),
        ]

    def _enter(self, trajectory: Trajectory, step: int) -> None:
        try:
            trajectory.set_state(self.data, step)
        except InvalidArgument as error:
            raise UnreadableFile(trajectory.path, error) from error
        # Computes only what depends on positions, without contacts.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_flex(self.model, self.data)
        mujoco.mj_tendon(self.model, self.data)

    def _change_model(self, reader: TrajectoryReader, step: int) -> bool:
        """Apply the model changes up to `step`; return whether there were any."""
        before = self._changes_seen
        while self._changes_seen < reader.change_count:
            change = reader.read_change(self._changes_seen)
            if change.step > step:
                break
            self._note(change.fields)
            self._apply(reader.path, change)
            self._changes_seen += 1
        return self._changes_seen > before

    def _apply(self, path: Path, change: ModelChange) -> None:
        try:
            view = {"camera": self._camera, "option": self._option}
            apply_fields(self.model, change.fields, **view)
        except InvalidArgument as error:
            raise UnreadableFile(path, error) from error

    def _note(self, fields: Mapping[str, NDArray[Any]]) -> None:
        for kind, names in _FIXED.items():
            note = f"{kind} change during the episode but not on this page."
            if note not in self.notes and any(
                not np.array_equal(getattr(self.model, name), fields[name])
                for name in names
                if name in fields
            ):
                self.notes.append(note)

    def _hidden_at_first(self, reader: TrajectoryReader) -> list[Shape]:
        """Return what is drawn only after later changes, as transparent shapes."""
        if self._changes_seen == reader.change_count:
            return []
        known = {_name(geom) for geom in self._drawn()}
        now = self.model, self._camera, self._option
        self.model, self._camera, self._option = map(copy.copy, now)
        found: dict[str, Shape] = {}
        for number in range(self._changes_seen, reader.change_count):
            self._apply(reader.path, reader.read_change(number))
            for geom in self._drawn():
                if _is_fixed_size(geom) and _name(geom) not in known:
                    shape = _shape(geom)
                    hidden = (*shape.rgba[:3], 0.0)
                    found.setdefault(shape.name, replace(shape, rgba=hidden))
        self.model, self._camera, self._option = now
        return list(found.values())

    def _new_colours(
        self, trajectory: Trajectory, step: int, index: int
    ) -> Iterator[tuple[int, str, list[float]]]:
        self._enter(trajectory, step)
        drawn = {_name(geom): _rgba(geom) for geom in self._drawn()}
        for name, before in self._rgba.items():
            # A fully transparent shape is not drawn.
            rgba = drawn.get(name, (*before[:3], 0.0))
            if rgba != before:
                self._rgba[name] = rgba
                yield index, name, list(rgba)

    def _drawn(self) -> Iterator[Any]:
        mujoco.mjv_updateScene(
            *(self.model, self.data, self._option, None, self._camera),
            *(_EVERYTHING, self._scene),
        )
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == _TENDON or geom.category != _DECOR:
                yield geom

    def _passing_now(self) -> dict[str, NDArray[np.float64]]:
        found: dict[str, NDArray[np.float64]] = {}
        for geom in self._drawn():
            if _is_fixed_size(geom) or geom.type in (_SKIN, _FLEX):
                continue
            stem, count = _name(geom), 0
            while (name := f"{stem}-{count}") in found:
                count += 1
            found[name] = np.concatenate([geom.pos, geom.mat.ravel(), geom.size])
            self.passing.setdefault(name, _shape(geom, name))
        return found


def _recorded_view(
    trajectory: Trajectory, model: mujoco.MjModel
) -> tuple[mujoco.MjvCamera, mujoco.MjvOption]:
    scene = trajectory.facts.get("scene")
    if not scene:
        return resolve_camera(model, default_camera(model)), mujoco.MjvOption()
    try:
        view = view_from_facts(scene)
        check_camera(model, view.camera)
    # NumPy and the bindings reject more invalid values than are checked explicitly.
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise UnreadableFile(trajectory.path, f"in its scene: {error}") from error
    return view.camera, view.option


def _is_fixed_size(geom: Any) -> bool:
    return geom.objtype in (_GEOM, _SITE)


def _name(geom: Any) -> str:
    kind = mujoco.mjtObj(geom.objtype).name.removeprefix("mjOBJ_").lower()
    return f"/{kind}/{geom.objid}"


def _rgba(geom: Any) -> tuple[float, float, float, float]:
    red, green, blue, alpha = geom.rgba.tolist()
    return red, green, blue, alpha


def _shape(geom: Any, name: str | None = None) -> Shape:
    return Shape(
        name or _name(geom), geom.objtype, geom.objid, int(geom.type), _rgba(geom)
    )


def _quaternions(placed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert `(..., 12)` positions and matrices to `(..., 7)` with quaternions."""
    poses = np.empty((*placed.shape[:-1], 7))
    poses[..., :3] = placed[..., :3]
    for matrix, out in zip(
        placed[..., 3:].reshape(-1, 9), poses.reshape(-1, 7), strict=True
    ):
        mujoco.mju_mat2Quat(out[3:], matrix)
    return poses


def _tracked_body(model: mujoco.MjModel) -> int:
    """Return the root of the tree that the first joint moves; the world without joints.

    Mocap bodies do not count: they may jump, or be far away.
    """
    if model.njnt == 0:
        return 0
    body = int(model.jnt_bodyid[0])
    while model.body_weldid[parent := int(model.body_parentid[body])] != 0:
        body = parent
    return body
