# SPDX-License-Identifier: Apache-2.0
"""Settling which episodes of an evaluation get a video, after all of them.

The monitors of an evaluation record every episode as a candidate and decide nothing
(`recorder.selection.UNDECIDED`): the best of a task may be in any of them. When all
episodes of a task are there, somebody chooses, and what was chosen is written down
here, into trajectories and manifests, as if each monitor had done it when it closed:
logs become trajectories, of which the chosen ones promise a video and the others none,
and manifests say by which rule, and what is pending. `mjrec render` does the rest.

All of it may be killed at any point and done again.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import Error, FileNotWritten
from ..formats.journal import JournalWriter
from ..formats.locks import is_locked
from ..formats.manifest import Manifest, read_manifest
from ..formats.monitor_directory import (
    Infix,
    journal_name,
    lock_name,
    manifest_name,
    video_prefix,
)
from ..formats.spans import FINISHED, add_facts, is_in_flight
from ..formats.trajectory_file import (
    amend_trajectory,
    find_trajectory,
    finish_trajectory,
)
from ..formats.video_metadata import is_done
from ..rendering.jobs import RecordingKey
from ..rendering.recorded_facts import open_for_rendering
from ..rendering.recordings import claim, recorded_episodes
from ..results.manifest_writing import manifest_lock, write_manifest_and_stats
from ..results.run import Run

# Under `scope`, in a manifest: the choice was made over all monitors of one.
EVALUATION = "evaluation"

_SECONDS = 60.0
_MOMENT = 0.05
_MOST_ASKED_FOR = 10_000


def settle(
    folder: Path,
    chosen: Mapping[tuple[str, int], Mapping[str, Any]],
    *,
    rule: str,
) -> None:
    """Settle all monitors of a task that are closed.

    `recover` comes before it, for what killed workers have left.

    Args:
        folder: the monitor directory.
        chosen: by infix and number of the episodes that get a video, what is said of
            how they were chosen, such as `{"finished": 50}`.
        rule: by which they were.

    Raises:
        Error: see `settle_monitor`.
    """
    own: dict[str, dict[int, Mapping[str, Any]]] = {}
    for (infix, number), facts in chosen.items():
        own.setdefault(infix, {})[number] = facts
    for infix in unsettled_monitors(folder):
        settle_monitor(folder, infix, own.get(infix, {}), rule=rule)


def unsettled_monitors(folder: Path) -> list[str]:
    """Return the infixes of those of an evaluation's monitors that are left to settle.

    Monitors that are open are not among them; nor are those that were killed, before
    `recover` has put them in order.

    Raises:
        UnreadableFile: a manifest is damaged.
    """
    infixes = {str(key.infix): key.infix for key in recorded_episodes(folder)}
    return [name for name, infix in infixes.items() if _is_unsettled(folder, infix)]


def settle_monitor(
    folder: Path,
    monitor: str,
    chosen: Mapping[int, Mapping[str, Any]],
    *,
    rule: str,
) -> None:
    """Write down which episodes of a monitor get a video. Idempotent.

    Nothing is done about a monitor that is open, or whose choice is settled. An episode
    of which there is a video already, because somebody rendered it meanwhile, keeps it.

    Args:
        folder: the monitor directory.
        monitor: the monitor's infix.
        chosen: as of `settle`, by number.
        rule: likewise.

    Raises:
        UnreadableFile: a trajectory or the manifest is damaged.
        FileNotWritten: the disk is full.
        DirectoryNotWritable: there can be no lock in the directory.
        Error: somebody else was at an episode for too long.
    """
    infix = Infix.parse(monitor)
    if infix is None or not _is_unsettled(folder, infix):
        return
    verdicts = _Verdicts(folder, infix, chosen, rule)
    promised: list[int] = []
    for key in _episodes_of(folder, infix):
        with _claimed(folder, key):
            if _settle_episode(folder, key, verdicts):
                promised.append(key.number)
    _journal_choice(folder, infix, rule, promised)
    write_manifest_and_stats(folder, infix)


def finish_logs(folder: Path, monitor: str) -> None:
    """Give the recordings of a closed monitor's episodes their final form.

    Raises:
        Error: as `settle_monitor`.
    """
    infix = Infix.parse(monitor)
    for key in () if infix is None else _episodes_of(folder, infix):
        path = folder / f"{key.name}{FINISHED}"
        if is_in_flight(path):
            with _claimed(folder, key):
                finish_trajectory(path)


@dataclasses.dataclass(frozen=True)
class _Verdicts:
    """What is said of the episodes of a monitor."""

    folder: Path
    infix: Infix
    chosen: Mapping[int, Mapping[str, Any]]
    rule: str

    def facts(self, episode_id: int, promise: Mapping[str, Any]) -> dict[str, Any]:
        """Return what the trajectory of a candidate is to say."""
        if self.has_video(episode_id):
            return {"candidate": False}
        if episode_id not in self.chosen:
            return {"candidate": False, "video": None}
        selection = {
            **self.chosen[episode_id],
            "rule": self.rule,
            "decided": True,
            "scope": EVALUATION,
        }
        return {"candidate": False, "video": {**promise, "selection": selection}}

    def has_video(self, episode_id: int) -> bool:
        """Tell whether there is a video of an episode already."""
        return is_done(self.folder / f"{video_prefix(self.infix, episode_id)}.mp4")


def _episodes_of(folder: Path, infix: Infix) -> list[RecordingKey]:
    """Return the episodes of a monitor that have a trajectory, in order.

    Its manifest says which numbers it gave: thousands of monitors may have recorded
    into a folder, and each of them is settled by itself.
    """
    path = folder / manifest_name(infix)
    numbers = _numbers_of(read_manifest(path)) if path.exists() else None
    if numbers is None:
        return [key for key in recorded_episodes(folder) if key.infix == infix]
    return [
        RecordingKey(infix, number)
        for number in numbers
        if find_trajectory(folder, infix, number) is not None
    ]


def _numbers_of(manifest: Manifest) -> range | None:
    details = manifest.mjrec or {}
    first, following = (
        details.get(key) for key in ("first_episode_id", "next_episode_id")
    )
    if type(first) is not int or type(following) is not int:
        return None
    # To be asked for one after the other; a manifest may also be anybody's.
    is_few = 0 <= following - first <= _MOST_ASKED_FOR
    return range(first, following) if first >= 0 and is_few else None


def _settle_episode(folder: Path, key: RecordingKey, verdicts: _Verdicts) -> bool:
    """Settle an episode, and return whether it has a video, or will have."""
    path = folder / f"{key.name}{FINISHED}"
    with open_for_rendering(path) as reader:
        facts = dict(reader.facts)
    if facts.get("candidate") is True:
        verdict = verdicts.facts(key.number, facts.get("video") or {})
        if path.exists():
            amend_trajectory(path, lambda known: {**known, **verdict})
        else:
            add_facts(path, verdict)
        facts.update(verdict)
    if is_in_flight(path):
        finish_trajectory(path)
    return bool(facts.get("video"))


def _journal_choice(
    folder: Path, infix: Infix, rule: str, promised: Sequence[int]
) -> None:
    path = folder / journal_name(infix)
    # How many episodes were finished, and the like, the monitor has said.
    begun = Run.read(path).keep or {}
    keep = {
        **begun,
        "rule": rule,
        "decided": True,
        "scope": EVALUATION,
        "chosen": list(promised),
        "recorded": list(promised),
    }
    keep.pop("left_open", None)
    with (
        manifest_lock(folder, infix),
        contextlib.closing(JournalWriter(path)) as writer,
    ):
        try:
            writer.note("keep", keep)
        except OSError as error:
            raise FileNotWritten(path, error.strerror or error) from error


def _is_unsettled(folder: Path, infix: Infix) -> bool:
    path = folder / manifest_name(infix)
    if is_locked(folder / lock_name(infix)) or not path.exists():
        return False
    keep = (read_manifest(path).mjrec or {}).get("keep")
    return isinstance(keep, Mapping) and keep.get("decided") is not True


@contextlib.contextmanager
def _claimed(folder: Path, key: RecordingKey) -> Iterator[None]:
    """Hold the lock of an episode, once whoever renders it is done."""
    end = time.monotonic() + _SECONDS
    while (lock := claim(folder, key)) is None:
        if time.monotonic() > end:
            raise Error(
                f"Another process has been at {folder / key.name} for "
                f"{_SECONDS:g} seconds, rendering it perhaps. When it has ended, do "
                "this again: nothing is lost."
            )
        time.sleep(_MOMENT)
    try:
        yield
    finally:
        lock.release()
