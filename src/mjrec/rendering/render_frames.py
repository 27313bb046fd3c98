# SPDX-License-Identifier: Apache-2.0
"""Frames of recorded episodes and of given states, as arrays."""

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
from ..formats.json_fields import to_json
from ..frames import Frame
from . import recorded_facts
from .jobs import View, plain_camera
from .pool import WorkerPool

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
    """Return the frames of a recorded episode, one at a time.

    By default, the frames are byte-for-byte those that `env.render()` returned, or
    would have returned, on the same driver. Worker processes draw them until the
    iterator ends or is dropped. Only a few frames are in memory at a time. The first
    frame is drawn before this function returns.

    ::

        for frame in mjrec.render("videos/openaigym.trajectory.0.1.episode000027.h5"):
            ...

    Args:
        trajectory: a result of `mjrec.load_trajectory`, or a path. If it was loaded
            with `trust_models=True`, its compiled model is loaded too.
        camera: name or number of one of the model's cameras, -1 for the free camera
            where the model places it, a `mujoco.MjvCamera`, or a mapping of its
            members. None means as recorded.
        width: width in pixels. None means as recorded.
        height: height in pixels. None means as recorded.
        max_fps: maximum frames per second of simulated time. Every n-th recorded frame
            and the last frame are drawn. None draws all frames.
        quality: `"full"` or `"draft"` (no multisampling, shadow maps of at most
            1024x1024). None means as recorded.
        workers: number of worker processes. It does not affect the frames.

    Returns:
        New arrays, `(height, width, 3) uint8`, top row first.

    Raises:
        UnreadableFile: the trajectory or its model is missing, damaged, or from a
            MuJoCo version that the installed one cannot read.
        UntrustedModel: another user or machine compiled the model, and its sources are
            missing.
        NoPictures: the trajectory has states but no snapshots.
        UnknownName: the camera or quality does not exist.
        InvalidArgument: another argument is invalid, or the driver cannot draw frames
            of this size.
        GLError: no OpenGL backend works on this machine.
        Error: workers died twice at the same frame.
    """
    path = _path(trajectory)
    view = View(
        camera=None if camera is None else plain_camera(camera),
        height=height,
        width=width,
        quality=quality,
    )
    with recorded_facts.open_for_rendering(path) as reader:
        facts = reader.facts
        recorded_facts.check_has_frames(reader)
        recorded_facts.warn_of_other_frames(path.name, facts)
        chosen = recorded_facts.chosen_frames(reader.frame_count, facts, max_fps)
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
    """Return frames drawn from physics states, one at a time.

    Each frame is what `mujoco.Renderer` draws for a new `MjData` after `mj_setState`
    with the row and `mj_forward`. States can come from anywhere: `mujoco.rollout`, MJX,
    Warp. Worker processes draw them, as in `render`. The model and the states stay in a
    temporary directory until the iterator ends or is dropped.

    ::

        states, _ = mujoco.rollout.rollout(model, data, initial_state, nstep=100)
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        for frame in mjrec.render_states(
            model, states[0], spec, height=480, width=640
        ):
            ...

    Args:
        model: a `mujoco.MjModel`, or dm_control's wrapper of one.
        states: `(n, size)`, one row per frame.
        spec: the components of a row, a combination of `mujoco.mjtState` flags. All
            other components are as in a new `MjData`.
        height: height in pixels.
        width: width in pixels.
        camera: name or number of one of the model's cameras, -1 for the free camera, a
            `mujoco.MjvCamera`, or a mapping of its members.
        quality: `"full"` or `"draft"`.
        workers: number of worker processes.

    Returns:
        New arrays, `(height, width, 3) uint8`, top row first.

    Raises:
        InvalidArgument: the states have the wrong shape, or the size or camera is
            invalid.
        UnknownName: the camera or quality does not exist.
        FileNotWritten: the disk with the temporary directory is full.
        GLError, Error: see `render`.
    """
    # Imported here because `render` needs no simulator in this process.
    from ..simulation.recorded_scene import check_states, save_states

    view = View(
        camera=plain_camera(camera), height=height, width=width, quality=quality
    )
    rows = check_states(model, states, spec)
    pool = WorkerPool(workers)
    temporary = tempfile.TemporaryDirectory(prefix="mjrec-states-")
    directory = Path(temporary.name)
    drawing = {"states": str(directory), "spec": int(spec), "view": to_json(view)}

    def begin() -> Iterator[Frame]:
        save_states(directory, model, rows)
        return pool.frames_of(drawing, range(len(rows)))

    return _started(pool, begin, temporary)


def _path(trajectory: Any) -> Path:
    path = getattr(trajectory, "path", trajectory)
    if not isinstance(path, str | os.PathLike):
        raise InvalidArgument(
            "A trajectory must be a path or a result of mjrec.load_trajectory, got "
            f"{trajectory!r}."
        )
    return Path(path)


def _started(
    pool: WorkerPool,
    begin: Callable[[], Iterator[Frame]],
    *resources: contextlib.AbstractContextManager[Any],
) -> Iterator[Frame]:
    """Return an iterator that closes its workers and resources at its end."""

    def frames() -> Iterator[Any]:
        with contextlib.ExitStack() as stack:
            for resource in (*resources, pool):
                stack.enter_context(resource)
            drawn = begin()
            # The caller gets the iterator at this point. A generator that was never
            # started would not be cleaned up.
            yield None
            yield from drawn

    iterator = frames()
    next(iterator)
    return iterator
