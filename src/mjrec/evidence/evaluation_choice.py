# SPDX-License-Identifier: Apache-2.0
"""The videos that an evaluation chose among the episodes of many recordings.

Most of these may not be in the archive: the choice is not recreated.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..formats.journal import JournalWriter
from ..formats.monitor_directory import Infix, journal_name
from ..formats.spans import find_trajectory
from ..formats.trajectory_file import amend_trajectories
from ..results.manifest_writing import write_manifest_and_stats
from .inputs import RecordingInputs
from .notes import Notes


def choose_for_evaluation(
    recording: RecordingInputs, directory: Path, notes: Notes
) -> None:
    """Let the trajectories that were chosen promise their videos.

    Args:
        recording: its inputs.
        directory: where it was played; its monitor is closed.
        notes: that the choice is believed.
    """
    infix, keep = Infix.parse(recording.infix), recording.evaluation_keep
    assert infix is not None
    assert keep is not None
    amend_trajectories(
        {
            path: functools.partial(_with_promise, dict(episode.selection))
            for episode in recording.episodes
            if episode.selection is not None
            and (path := find_trajectory(directory, infix, episode.episode_id))
        }
    )
    with contextlib.closing(JournalWriter(directory / journal_name(infix))) as journal:
        journal.note("keep", dict(keep))
    write_manifest_and_stats(directory, infix, is_own=True)
    notes.add(
        recording.name,
        "rule",
        "its videos were chosen among all episodes of an evaluation: that is believed",
        count=len(recording.episodes),
    )


def _with_promise(
    selection: Mapping[str, Any], known: Mapping[str, Any]
) -> Mapping[str, Any]:
    video = {**known["possible_video"], "selection": selection}
    return {**known, "video": video}
