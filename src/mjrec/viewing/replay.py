# SPDX-License-Identifier: Apache-2.0
"""Replay pages: one HTML file that shows a recorded episode in 3D, offline.

viser draws the scene. The page adds the recorded states and its own controls, because
viser's player does not support rewards, cameras, steps or positions in the URL.
"""

from __future__ import annotations

import base64
import html
import json
import logging
import os
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic_files import write_text
from ..errors import UnreadableFile
from ..rates import rate_from_timestep, stride_for
from ..simulation.trajectories import Trajectory
from .geometry import linear, scene_page
from .motion import OWN_LIGHTS, Motion, Stage

_LOG = logging.getLogger(__name__)
_COMPRESSION = 6
# Nothing is loaded from elsewhere: scripts and frames are part of the page.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; "
    "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "worker-src blob: data:; connect-src {connect} data: blob:; base-uri 'none'; "
    "form-action 'none'"
)


@dataclass(frozen=True)
class Replay:
    """A replay page that has been written.

    Attributes:
        path: the page.
        states: number of states that it shows.
        size: size in bytes.
        notes: remarks on features that the page does not show.
    """

    path: Path
    states: int
    size: int
    notes: Sequence[str]


def write_replay(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    *,
    max_fps: float | None = None,
) -> Replay:
    """Write a page that shows a recorded episode in 3D.

    The page is a single file and needs no network. It shows the same geometry as the
    videos, with rewards, in all recorded states, from any direction and from the
    model's cameras. It is only a view of the recorded states, not separate evidence.
    It stores positions as float32, so they equal the recorded ones to 1e-5 only
    within about 100 m of the origin.

    Args:
        trajectory: the episode, from `load_trajectory`.
        path: the page to write; an existing file is replaced.
        max_fps: maximum number of states per second of simulated time; None for all.

    Raises:
        InvalidArgument: `max_fps` is not a valid rate.
        MissingDependency: viser or mjviser is not installed.
        UnreadableFile: the file is damaged, was recorded without a simulation, or has
            no finite state.
        UntrustedModel: see `Trajectory.model`.
        FileNotWritten: the disk is full.
    """
    steps = shown_steps(trajectory, max_fps)
    if not len(steps):
        reason = "none of the states to show is finite"
        raise UnreadableFile(trajectory.path, reason)
    stage = Stage(trajectory, first=int(steps[0]))
    motion = stage.motion(trajectory, steps)
    if left := int((~are_finite(trajectory.states)).sum()):
        stage.notes.append(
            "States left out because they are not finite: "
            f"{left} of {len(trajectory.states)}."
        )
    log_notes(trajectory.path, stage.notes)
    page = replay_page(trajectory, stage, motion)
    write_text(Path(path), page)
    return Replay(
        path=Path(path),
        states=len(motion.steps),
        size=len(page.encode()),
        notes=tuple(stage.notes),
    )


def log_notes(path: Path, notes: Iterable[str]) -> None:
    """Log remarks on features of a trajectory that its page does not show."""
    for note in notes:
        # This one is true of every page, so it is no warning.
        level = logging.INFO if note == OWN_LIGHTS else logging.WARNING
        _LOG.log(level, "%s: %s", path.name, note)


def shown_steps(trajectory: Trajectory, max_fps: float | None) -> NDArray[np.int64]:
    """Return the indices of the states to show: every n-th and the last.

    States with NaN are skipped: the environment had already reset itself, or the
    simulation diverged.
    """
    count, time = len(trajectory.states), trajectory.time
    stride = 1
    if max_fps is not None and time is not None and count > 1:
        timestep = float(np.median(np.diff(time)))
        if timestep > 0:
            stride = stride_for(rate_from_timestep(timestep), max_fps)
    steps = np.arange(0, count, stride)
    if count and steps[-1] != count - 1:
        steps = np.append(steps, count - 1)
    return steps[are_finite(trajectory.states[steps])]


def are_finite(states: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which states contain only finite numbers."""
    return np.asarray(np.isfinite(states).all(axis=1))


def replay_page(
    trajectory: Trajectory,
    stage: Stage,
    motion: Motion,
    *,
    additions: dict[str, Any] | None = None,
) -> str:
    """Return a page that shows a motion.

    Args:
        trajectory: the trajectory that the states belong to.
        stage: the stage with its model.
        motion: the states to show.
        additions: additional data for the page's script; given for live pages only.
    """
    about = {**_about(trajectory, stage, motion), **(additions or {})}
    connect = "'self'" if additions else ""
    head = (
        '<meta http-equiv="Content-Security-Policy" '
        f'content="{_POLICY.format(connect=connect)}">'
        f"<title>{html.escape(about['title'])}</title>"
        f"<style>{_file('replay.css')}</style>"
    )
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in about["notes"])
    options = "".join(
        f'<option value="{number}">{html.escape(name)}</option>'
        for number, name in enumerate(about["cameras"])
    )
    controls = _file("replay.html").format(
        cameras=options, notes=notes, title=html.escape(about["title"])
    )
    # A script element ends at the first `</`, even inside a string.
    data = json.dumps(about, allow_nan=False).replace("<", "\\u003c")
    body = (
        f'{controls}<script type="application/json" id="replay-data">{data}</script>'
        f"<script>{_file('replay.js')}</script>"
    )
    if additions:
        body += f"<script>{_file('live.js')}</script>"
    scene = scene_page(stage, motion)
    # Our title and policy come first, so that they take precedence.
    begin, _, rest = scene.partition("<head>")
    before_end, end, after = rest.rpartition("</body>")
    return f"{begin}<head>{head}{before_end}{body}{end}{after}"


def motion_chunk(motion: Motion, *, keep_all: bool = False) -> dict[str, Any]:
    """Return a motion in the form that the page's script reads.

    Each row is one state, in float32: step, time, reward and return; the tracking
    camera's target; cameras; poses; scales; vertices.

    Args:
        motion: the states.
        keep_all: whether to include objects that do not move in any of the states.
    """
    still = {
        name
        for name, poses in motion.poses.items()
        if not keep_all and name not in motion.scales and (poses == poses[:1]).all()
    }
    names = [name for name in motion.poses if name not in still]
    count = len(motion.steps)
    numbers = (motion.steps, motion.time, motion.rewards, motion.returns)
    columns = [
        np.column_stack(numbers),
        motion.target,
        motion.cameras.reshape(count, -1),
        *(motion.poses[name] for name in names),
        *motion.scales.values(),
        *(vertices.reshape(count, -1) for vertices in motion.vertices.values()),
    ]
    return {
        "count": count,
        "names": names,
        "scaled": list(motion.scales),
        "vertices": {n: v.shape[1] for n, v in motion.vertices.items()},
        "colours": [[at, name, linear(rgba)] for at, name, rgba in motion.colours],
        "data": _packed(np.hstack(columns)),
    }


def _packed(array: NDArray[Any], kind: str = "<f4") -> str:
    raw = np.ascontiguousarray(array, kind).tobytes()
    return base64.b64encode(zlib.compress(raw, _COMPRESSION)).decode()


def _skin(stage: Stage, skin: int) -> dict[str, Any]:
    """Return the weights with which bones move a skin's vertices.

    `bind` is each bone's resting pose, and `counts` is the number of vertices that each
    bone moves. `ids` and `weights` list these vertices, bone by bone.
    """
    model = stage.model
    first, count = model.skin_boneadr[skin], model.skin_bonenum[skin]
    bones = slice(first, first + count)
    counts = model.skin_bonevertnum[bones]
    begin = model.skin_bonevertadr[first]
    moved = slice(begin, begin + counts.sum())
    bind = (model.skin_bonebindpos[bones], model.skin_bonebindquat[bones])
    return {
        "bones": [f"bone/{body}" for body in stage.bones_of(skin)],
        "counts": counts.tolist(),
        "bind": _packed(np.hstack(bind)),
        "ids": _packed(model.skin_bonevertid[moved], "<i4"),
        "weights": _packed(model.skin_bonevertweight[moved]),
    }


def _about(trajectory: Trajectory, stage: Stage, motion: Motion) -> dict[str, Any]:
    model = stage.model
    position, target, fovy = stage.view
    return {
        "title": title_of(trajectory),
        "steps": len(trajectory),
        "ending": ending_of(trajectory),
        "hasRewards": bool(len(trajectory.rewards)),
        "cameras": [model.camera(i).name or str(i) for i in range(model.ncam)],
        "camera": stage.camera,
        "extent": float(model.stat.extent),
        "view": {"position": position, "target": target, "fovy": fovy},
        "start": motion.target[0].tolist(),
        "nodes": [
            s.name for s in (*stage.shapes, *stage.passing.values(), *stage.soft)
        ],
        "rgba": {s.name: linear(s.rgba) for s in stage.shapes},
        "skins": {s.name: _skin(stage, s.object_id) for s in stage.soft if s.is_skin},
        "still": {
            name: poses[0].tolist()
            for name, poses in motion.poses.items()
            if name.startswith("bone/")
        },
        "notes": stage.notes,
        "chunk": motion_chunk(motion),
    }


def title_of(trajectory: Trajectory) -> str:
    """Return the title of an episode's page."""
    return f"{trajectory.env_id or 'Recording'}, episode {trajectory.episode_id}"


def ending_of(trajectory: Trajectory) -> str:
    """Return a short description of how an episode ended."""
    for flags, word in (
        (trajectory.terminated, "terminated"),
        (trajectory.truncated, "truncated"),
    ):
        if len(flags) and flags[-1]:
            return f"Episode {word}"
    return "End of the recording"


def _file(name: str) -> str:
    return (resources.files(__package__) / "page" / name).read_text(encoding="utf-8")
