# SPDX-License-Identifier: Apache-2.0
"""Pictures of recorded episodes and of given states, for whoever wants arrays."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from ..errors import InvalidArgument
from ..frames import Frame
from .pool import WorkerPool
from .recorded_facts import (
    check_has_frames,
    chosen_frames,
    open_for_rendering,
    warn_of_other_frames,
)
from .views import View, plain_camera

if TYPE_CHECKING:
    from ..simulation.cameras import Camera
    from ..simulation.trajectories import Trajectory


def render(
    trajectory: Trajectory | str | os.PathLike[str],
    *,
    camera: Camera | Mapping[str, Any] | None = None,
    width: int | None = None,
    height: int | None = None,
    max_fps: float | Fraction | None = None,
    quality: str | None = None,
    workers: int = 1,
) -> Iterator[Frame]:
    """Return the pictures of a recorded episode, one after the other.

    With every option None they are, byte for byte, what `env.render()` gave or would
    have given (on the same driver). They are drawn in processes of their own, which
    live until the iterator ends or is dropped; however long the episode is, only a few
    pictures are in memory. The first is drawn before this returns.

    ::

        for frame in mjrec.render("videos/openaigym.trajectory.0.1.episode000027.h5"):
            ...

    Args:
        trajectory: what `mjrec.load_trajectory` returned, or its path. With
            `trust_models=True` there, the compiled model is loaded whoever wrote it.
        camera: the name or number of one of the model's cameras, -1 for the free
            camera in the place that the model gives it, an `mujoco.MjvCamera`, or a
            mapping of its members; None is as recorded.
        width: in pixels; None is as recorded.
        height: in pixels; None is as recorded.
        max_fps: draw pictures 0, n, 2n ... with the smallest n that gives no more than
            so many per second of the simulation, and the last; None draws all that the
            recording has.
        quality: `"full"` or `"draft"` (no multisampling, a shadow map of at most
            1024x1024); None is as recorded.
        workers: how many processes draw. The pictures do not depend on it.

    Returns:
        New arrays of `(height, width, 3) uint8`, the top row first.

    Raises:
        UnreadableFile: the trajectory or its model is missing, damaged, or made by a
            MuJoCo that this one cannot read.
        UntrustedModel: its model was compiled by another user or on another machine,
            and its sources are not there.
        NoPictures: the trajectory has states and no snapshots.
        UnknownName: its model has no camera of that name, or there is no such quality.
        InvalidArgument: another value that cannot be, also a size that the driver
            cannot draw.
        GLError: no OpenGL backend works here.
        Error: a worker died at a picture, and again at the second try.
    """
    path = _path(trajectory)
    view = View(
        camera=None if camera is None else plain_camera(camera),
        height=height,
        width=width,
        quality=quality,
    )
    with open_for_rendering(path) as reader:
        facts = reader.facts
        check_has_frames(reader)
        warn_of_other_frames(path.name, facts)
        chosen = chosen_frames(reader.frame_count, facts, max_fps)
    is_trusted = bool(getattr(trajectory, "trust_models", False))
    pool = WorkerPool(workers, trust_models=is_trusted)
    return _started(pool, lambda: pool.frames(path, chosen.indices, view))


def render_states(
    model: Any,
    states: ArrayLike,
    spec: int,
    *,
    height: int,
    width: int,
    camera: Camera | Mapping[str, Any] = -1,
    quality: str = "full",
    workers: int = 1,
) -> Iterator[Frame]:
    """Return pictures of physics states, one after the other.

    Each is what `mujoco.Renderer` shows of a new `MjData` after `mj_setState` of the
    row and `mj_forward`. So states from anywhere can be drawn: `mujoco.rollout`, MJX,
    Warp. They are drawn in processes of their own, as in `render`; until the iterator
    ends or is dropped, model and states lie in a temporary directory.

    ::

        states, _ = mujoco.rollout.rollout(model, data, initial_state, nstep=100)
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        for frame in mjrec.render_states(
            model, states[0], spec, height=480, width=640
        ):
            ...

    Args:
        model: a `mujoco.MjModel`, or dm_control's wrapper of one.
        states: `(n, size)`, one row for each picture.
        spec: which components a row has: a combination of `mujoco.mjtState`. What it
            leaves out is as in a new `MjData`.
        height: in pixels.
        width: in pixels.
        camera: the name or number of one of the model's cameras, -1 for the free
            camera, an `mujoco.MjvCamera`, or a mapping of its members.
        quality: `"full"` or `"draft"`.
        workers: how many processes draw.

    Returns:
        New arrays of `(height, width, 3) uint8`, the top row first.

    Raises:
        InvalidArgument: the states have another shape; a size or a camera cannot be.
        UnknownName: the model has no camera of that name, or there is no such quality.
        FileNotWritten: the temporary directory has no room.
        GLError, Error: as `render`.
    """
    # Here, because drawing recorded episodes needs no simulator in this process.
    from ..simulation.recorded_scene import check_states, save_states

    view = View(
        camera=plain_camera(camera), height=height, width=width, quality=quality
    )
    rows = check_states(model, states, spec)
    pool = WorkerPool(workers)
    temporary = tempfile.TemporaryDirectory(prefix="mjrec-states-")
    directory = Path(temporary.name)
    drawing = {"states": str(directory), "spec": int(spec), "view": view.as_json()}

    def begin() -> Iterator[Frame]:
        save_states(directory, model, rows)
        return pool.frames_of(drawing, range(len(rows)))

    return _started(pool, begin, temporary)


def _path(trajectory: Any) -> Path:
    path = getattr(trajectory, "path", trajectory)
    if not isinstance(path, str | os.PathLike):
        raise InvalidArgument(
            "A trajectory is a path, or what mjrec.load_trajectory returned, got "
            f"{trajectory!r}."
        )
    return Path(path)


def _started(
    pool: WorkerPool,
    begin: Callable[[], Iterator[Frame]],
    *resources: contextlib.AbstractContextManager[Any],
) -> Iterator[Frame]:
    """Return an iterator that takes its workers and its files with it when it ends."""

    def frames() -> Iterator[Any]:
        with contextlib.ExitStack() as stack:
            for resource in (*resources, pool):
                stack.enter_context(resource)
            drawn = begin()
            # Here it stands when the caller gets it: only what has begun is cleaned up.
            yield None
            yield from drawn

    iterator = frames()
    next(iterator)
    return iterator
