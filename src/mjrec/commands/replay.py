# SPDX-License-Identifier: Apache-2.0
"""`mjrec replay`: write a page that shows a recorded episode from any angle."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from ..simulation.trajectories import load_trajectory
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
    """Show an episode in 3D, in one HTML file that needs no network.

    The page plays all recorded states from any angle and from the model's cameras, with
    the reward and return of each. It is a view, not evidence.

    Args:
        target: a trajectory (openaigym.trajectory.*.h5) or a monitor directory.
        episode: number of the episode, if the target is a directory. Default: the
            last one.
        max_fps: maximum states per second of simulated time. Default: all.
        out: the page to write. An existing file is replaced.
        trust_models: load compiled models that another user or machine wrote. A crafted
            model can run any code, so use it only if you trust the author.
        as_json: print one JSON object at the end.
    """
    # Imported here so that --help works without the optional packages.
    from ..viewing.episodes import trajectory_in
    from ..viewing.replay import write_replay

    path = trajectory_in(target, episode)
    trajectory = load_trajectory(path, trust_models=trust_models)
    made = write_replay(trajectory, out, max_fps=max_fps)
    if as_json:
        shown = {"page": str(made.path), "states": made.states, "bytes": made.size}
        print_json({**shown, "trajectory": str(path), "notes": list(made.notes)})
    else:
        sys.stdout.write(f"{made.path}: {made.states} states, {made.size:,} bytes\n")
    return 0
