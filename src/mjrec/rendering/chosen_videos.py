# SPDX-License-Identifier: Apache-2.0
"""Which episodes of an evaluation get a video, written down where they were recorded.

Monitors of an evaluation promise no videos: the best episode of a task may be in any of
its chunks. When all episodes of a task have ended, the choice is made, and the
trajectories, journals and manifests of what was chosen say so, as if each monitor had
chosen itself. `finish` then draws these videos, and `mjrec render` what is left.

What can only be drawn while it runs has videos already, and those that were not chosen
are removed.

All of it may be killed at any point and done again.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import FileNotWritten
from ..formats.bundle import FINISHED, is_finished
from ..formats.frame_hashes import frame_hash_path
from ..formats.journal import JournalWriter
from ..formats.monitor_directory import Infix, infix_of, journal_name
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
    """Write down which episodes of a chunk get a video. Idempotent.

    An episode that was chosen before, among fewer, keeps its video.

    Args:
        folder: the chunk's monitor directory, whose monitors are closed.
        chosen: the episodes, each with its roles.
        rule: by which they were chosen.
        finished: among how many.
        among: the infix of the monitor, where others of the directory are no part of
            the chunk.

    Returns:
        Those of the chosen ones that can be drawn.

    Raises:
        UnreadableFile: a trajectory, a journal or metadata is damaged.
        FileNotWritten: the disk is full.
        DirectoryNotWritable: there can be no lock in the directory.
    """
    facts = {"rule": rule, "decided": True, "scope": EVALUATION, "finished": finished}
    drawable: set[RecordingKey] = set()
    for path in sorted(folder.glob(journal_name(among))):
        infix = Infix.parse(infix_of(path.name) or "")
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
            # Drawn live, or chosen before among fewer episodes.
            video = folder / key.video_name
            if metadata_path(video).exists():
                amend_metadata(video, {"selection": selection})
        others = {key: selections[key] for key in selections if key not in filmed}
        can_be_drawn = filmed | _promise_videos(folder, others)
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


def _promise_videos(
    folder: Path, selections: Mapping[RecordingKey, Mapping[str, Any]]
) -> set[RecordingKey]:
    """Let trajectories promise the videos that they could have; return which could."""
    drawable: set[RecordingKey] = set()
    changes: dict[Path, Callable[[Any], Any]] = {}
    for key, selection in selections.items():
        path = folder / f"{key.name}{FINISHED}"
        if not is_finished(path):
            # Drawing it will say so.
            drawable.add(key)
            continue
        with open_hdf5(path) as reader:
            facts = reader.facts
        video, possible = facts.get("video"), facts.get("possible_video")
        if possible is not None and (video or {}).get("selection") != selection:
            promise = {**possible, "selection": selection}
            changes[path] = functools.partial(_with_video, promise)
        if possible is not None or video is not None:
            drawable.add(key)
    amend_trajectories(changes)
    return drawable


def _with_video(video: Mapping[str, Any], known: Mapping[str, Any]) -> Any:
    return {**known, "video": video}


def _remove_videos(video: Path) -> None:
    """Remove the videos of an episode; the metadata, which says they are there, first.

    The first one goes last: it names those of further cameras.
    """
    for name, metadata in reversed(finished_videos(video)):
        path = video.with_name(name)
        video.with_name(metadata).unlink(missing_ok=True)
        for each in (path, path.with_suffix(".json"), frame_hash_path(path)):
            each.unlink(missing_ok=True)


def _note(folder: Path, infix: Infix, events: Iterable[tuple[str, Any]]) -> None:
    path = folder / journal_name(infix)
    with (
        manifest_lock(folder, infix),
        contextlib.closing(JournalWriter(path)) as writer,
    ):
        for kind, facts in events:
            try:
                writer.note(kind, facts)
            except OSError as error:
                raise FileNotWritten(path, error.strerror or error) from error
