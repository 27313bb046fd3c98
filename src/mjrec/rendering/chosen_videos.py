# SPDX-License-Identifier: Apache-2.0
"""Functions that record which episodes of an evaluation get a video.

The monitors of an evaluation do not plan videos, because a task's best episode may be
in any chunk. The choice is made when all episodes of a task have ended. It is then
written into the chosen episodes' trajectories, journals and manifests, as if each
monitor had made it. These videos are rendered by `finish`, or later by `mjrec render`.

Episodes that can only be recorded live already have videos. The videos of episodes that
were not chosen are removed.

The process may be killed at any point, and every function may be called again.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..formats.bundle import FINISHED, is_finished
from ..formats.frame_hashes import frame_hash_path
from ..formats.journal import JournalWriter
from ..formats.monitor_directory import infix_of, journal_name
from ..formats.trajectory_file import amend_trajectories
from ..formats.trajectory_hdf5 import open_hdf5
from ..formats.video_metadata import amend_metadata, finished_videos, metadata_path
from ..results.manifest_writing import manifest_lock, write_manifest_and_stats
from ..results.run import EVALUATION, Run
from .jobs import RecordingKey

Chosen = Mapping[RecordingKey, Sequence[str]]


def write_choice(
    folder: Path, chosen: Chosen, *, rule: str, finished: int, among: str = "*"
) -> set[RecordingKey]:
    """Record which episodes of a chunk get a video. Idempotent.

    An episode that was chosen earlier from fewer episodes keeps its video.

    Args:
        folder: the chunk's monitor directory. Its monitors must be closed.
        chosen: the chosen episodes and their roles.
        rule: the rule that chose them.
        finished: number of finished episodes from which they were chosen.
        among: the monitor's infix, if other monitors in the directory do not belong to
            the chunk.

    Returns:
        The chosen episodes that can be rendered.

    Raises:
        UnreadableFile: a trajectory, a journal or metadata is damaged.
        FileNotWritten: the disk is full.
        DirectoryNotWritable: a lock cannot be created in the directory.
    """
    facts = {"rule": rule, "decided": True, "scope": EVALUATION, "finished": finished}
    drawable: set[RecordingKey] = set()
    for path in sorted(folder.glob(journal_name(among))):
        infix = infix_of(path.name)
        if infix is None:
            continue
        run = Run.read(path)
        live = run.filmed - run.deferred - run.dropped
        selections = {
            key: {**facts, "roles": list(roles)}
            for key, roles in chosen.items()
            if key.infix == infix
        }
        filmed = {key for key in selections if key.number in live}
        for key, selection in selections.items():
            # The episode was recorded live, or chosen earlier from fewer episodes.
            video = folder / key.video_name
            if metadata_path(video).exists():
                amend_metadata(video, {"selection": selection})
        others = {key: selections[key] for key in selections if key not in filmed}
        can_be_drawn = filmed | _make_pending(folder, others)
        drawable |= can_be_drawn
        own = {key.number for key in can_be_drawn}
        before = set((run.keep or {}).get("recorded", ()))
        recorded = sorted(before | own - run.dropped)
        losers = sorted(live.difference(recorded))
        for number in losers:
            _remove_videos(folder / RecordingKey(infix, number).video_name)
        keep = {
            **facts,
            "chosen": recorded,
            "recorded": recorded,
            "recording": "live" if live else "deferred",
        }
        if (recorded or live) and keep != run.keep:
            events = [("dropped", number) for number in losers]
            _note(folder, infix, [*events, ("keep", keep)])
            write_manifest_and_stats(folder, infix)
    return drawable


def _make_pending(
    folder: Path, selections: Mapping[RecordingKey, Mapping[str, Any]]
) -> set[RecordingKey]:
    """Mark videos as pending in trajectories; return the episodes that can have one.

    The result includes episodes without a finished trajectory.
    """
    drawable: set[RecordingKey] = set()
    changes: dict[Path, Callable[[Any], Any]] = {}
    for key, selection in selections.items():
        path = folder / f"{key.name}{FINISHED}"
        if not is_finished(path):
            # Rendering it will report the problem.
            drawable.add(key)
            continue
        with open_hdf5(path) as reader:
            facts = reader.facts
        video, possible = facts.get("video"), facts.get("possible_video")
        if possible is not None and (video or {}).get("selection") != selection:
            pending = {**possible, "selection": selection}
            changes[path] = functools.partial(_with_video, pending)
        if possible is not None or video is not None:
            drawable.add(key)
    amend_trajectories(changes)
    return drawable


def _with_video(video: Mapping[str, Any], known: Mapping[str, Any]) -> Any:
    return {**known, "video": video}


def _remove_videos(video: Path) -> None:
    """Remove the videos of an episode, removing the metadata of each one first.

    The first camera's video is removed last, because its metadata lists the others.
    """
    for name, metadata in reversed(finished_videos(video)):
        path = video.with_name(name)
        video.with_name(metadata).unlink(missing_ok=True)
        for each in (path, path.with_suffix(".json"), frame_hash_path(path)):
            each.unlink(missing_ok=True)


def _note(folder: Path, infix: str, events: Iterable[tuple[str, Any]]) -> None:
    path = folder / journal_name(infix)
    with (
        manifest_lock(folder, infix),
        contextlib.closing(JournalWriter(path)) as writer,
    ):
        for kind, facts in events:
            writer.note(kind, facts)
