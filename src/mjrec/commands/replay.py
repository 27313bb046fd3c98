# SPDX-License-Identifier: Apache-2.0
"""`mjrec replay`: a page that shows a recorded episode from every side."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from ..simulation.trajectories import load_trajectory
from ..viewing.episodes import trajectory_in
from ..viewing.replay import write_replay
from .options import AsJson
from .terminal import print_json


def replay(
    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE|DIR")],
    /,
    *,
    episode: int | None = None,
    max_fps: float | None = None,
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("replay.html"),
    trust_models: bool = False,
    as_json: AsJson = False,
) -> int:
    """Write one HTML file that shows a recorded episode in 3D, without a network.

    It plays all recorded states, from any side and from the model's cameras, with the
    reward and the return of each. It is a view of the recorded states and no evidence
    of its own.

    Args:
        target: a trajectory (openaigym.trajectory.*.h5), or a monitor directory.
        episode: of a directory: its number; the last one that is recorded, if it is not
            given.
        max_fps: the most states per second of simulated time; all, if it is not given.
        out: the page to write; a file that is there is replaced.
        trust_models: load compiled models also where another user, or another machine,
            has written them. A crafted one can do anything to whoever loads it.
        as_json: print one JSON object at the end.
    """
    path = trajectory_in(target, episode)
    trajectory = load_trajectory(path, trust_models=trust_models)
    made = write_replay(trajectory, out, max_fps=max_fps)
    if as_json:
        shown = {"page": str(made.path), "states": made.states, "bytes": made.size}
        print_json({**shown, "trajectory": str(path), "notes": list(made.notes)})
    else:
        sys.stdout.write(f"{made.path}: {made.states} states, {made.size:,} bytes\n")
    return 0
