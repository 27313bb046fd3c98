# SPDX-License-Identifier: Apache-2.0
"""Build trajectories without a simulation.

Frame k has the brightness `grey(k)` and a white pixel in a corner. `Painter` renders
frames from the snapshots.
"""

import itertools

import numpy as np

from mjrec.formats.journal import JournalWriter, is_of_spans
from mjrec.formats.manifest import Manifest, write_manifest
from mjrec.formats.monitor_directory import (
    journal_name,
    log_number,
    manifest_name,
    trajectory_prefix,
    video_prefix,
)
from mjrec.formats.row_log import TAIL_BYTES
from mjrec.formats.span_writer import SpanLogs
from mjrec.formats.spans import log_paths
from mjrec.formats.trajectory import packed, row_dtype
from mjrec.formats.trajectory_file import finish_trajectory, open_trajectory
from mjrec.rendering.jobs import View
from mjrec.simulation.model_trust import directory_digest, note_models

INFIX = "0.7"
GREY_ROWS = row_dtype(
    state=packed([("qpos", ("<f8", (1,)))]),
    snapshot=packed([("geom_rgba", ("|u1", (1,)))]),
)


def grey(frame):
    """Return the brightness of a frame by its number."""
    return 10 + 20 * frame


class Painter:
    """A replacement for `WorkerPool` that renders trajectories of this module.

    If a camera is requested, frames are a little brighter; `plain` omits the white
    pixel. `asked` and `tiles` list the requests, and `breaks_at` is called before each
    frame with its trajectory, view and index.
    """

    gl_facts = {"gl_renderer": "a painter"}  # noqa: RUF012  as in WorkerPool

    def __init__(self, size=(16, 24), *, plain=False):
        self.size = size
        self.plain = plain
        self.asked = []
        self.tiles = []
        self.breaks_at = lambda *_: None

    def frames(self, trajectory, indices, view=None, *, cameras=None):
        view = view or View()
        self.asked.append((trajectory, list(indices), view))
        self.tiles.append(cameras)
        with open_trajectory(trajectory) as reader:
            shown = [reader.snapshots(i, i + 1)["geom_rgba"].item() for i in indices]
        for index, brightness in enumerate(shown):
            self.breaks_at(trajectory, view, index)
            brighter = 0 if view.camera is None else 5
            frame = np.full((*self.size, 3), brightness | brighter, np.uint8)
            if not self.plain:
                frame[-1, -1] = 255
            yield frame

    def start(self): ...

    rest = close = start


def new_logs(directory, infix=INFIX, *, tail_bytes=TAIL_BYTES):
    """Return a writer of recordings that continues the existing numbers."""
    used = [log_number(path.name) or 0 for path in log_paths(directory, infix)]
    return SpanLogs(
        directory,
        infix,
        journal=JournalWriter(directory / journal_name(infix)),
        numbers=itertools.count(max(used, default=-1) + 1),
        tail_bytes=tail_bytes,
    )


def add_row(span, step, **values):
    """Add a row with these columns; it counts as a frame if it has a snapshot."""
    slot = span.make_room()
    known = ("reward", "terminated", "truncated", "is_step")
    commit = {key: values.pop(key) for key in known if key in values}
    for name, column in span.log.columns.items():
        if name not in ("row", "step", "reward", "flags"):
            column[slot] = values.get(name, 0)
    span.commit(step, is_frame="snapshot" in values, **commit)


def write_log(
    directory,
    episode_id=0,
    *,
    infix=INFIX,
    steps=4,
    stride=1,
    frames=True,
    video="deferred",
    ended=True,
    over=None,
    fps=None,
    **facts,
):
    """Record an episode; `ended` adds its end event, and `over` marks its last row."""
    logs = new_logs(directory, infix)
    name = trajectory_prefix(infix, episode_id)
    if video:
        file = f"{video_prefix(infix, episode_id)}.mp4"
        rates = {"fps": fps, "max_fps": None}
        video = {"name": file, "quality": "full", "recording": video, **rates}
    usual = {
        "episode_id": episode_id,
        "infix": str(infix),
        "env_id": "Grey-v0",
        "type": "t",
        "seed": 5,
        "options": None,
        "versions": {"mjrec": "0"},
        "scene": {"label": "side"},
        "video": video,
        "rate": "20",
        "timestep": "1/20",
        "stride": stride,
    }
    span = logs.begin(name, {**usual, **facts}, GREY_ROWS)
    taken = 0
    for step in range(steps + 1):
        values = {}
        if frames and (step % stride == 0 or step == steps):
            values["snapshot"] = grey(taken)
            taken += 1
        last = (ended if over is None else over) and step == steps
        add_row(span, step, reward=0.5 * bool(step), truncated=last, **values)
    if ended:
        ending = {"complete": True, "terminated": False, "truncated": True}
        span.end({**ending, "length": steps, "reward": 0.5 * steps})
    logs.close()
    return logs.path_of(name)


def write_finished(directory, episode_id=0, **rest):
    """Write only the finished trajectory of an episode."""
    note_models([directory_digest(directory)])
    path = finish_trajectory(write_log(directory, episode_id, **rest))
    journal = directory / journal_name(rest.get("infix", INFIX))
    is_needed = any(log_paths(directory)) or not all(
        map(is_of_spans, journal.read_bytes().splitlines())
    )
    if not is_needed:
        journal.unlink()
    return path


def write_pending_manifest(directory, *episode_ids, infix=INFIX, **rest):
    """Write the manifest of a closed monitor that has only pending videos."""
    path = directory / manifest_name(infix)
    pending = [
        {
            "episode_id": episode_id,
            "trajectory": trajectory_prefix(infix, episode_id),
            "video": f"{video_prefix(infix, episode_id)}.mp4",
        }
        for episode_id in episode_ids
    ]
    stats = "openaigym.episode_batch.0.7.stats.json"
    env_info = {"gym_version": "mjrec-1", "env_id": "Grey-v0"}
    details = {"format_version": 1, "pending": pending, "broken": [], **rest}
    write_manifest(path, Manifest(stats, (), env_info, details))
    return path
