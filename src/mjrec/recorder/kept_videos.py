# SPDX-License-Identifier: Apache-2.0
"""The recordings of a run whose videos are chosen after the episodes have ended.

Every episode is recorded as if it got a video. What is not decided yet is held: its
log calls it a candidate, which nobody else touches while the monitor is open, and which
anybody may render once the monitor is gone. What falls out is deleted at once.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import json_text
from ..atomic_files import write_text
from ..errors import DirectoryNotWritable, Error, InvalidArgument
from ..formats.frame_hashes import frame_hash_path
from ..formats.json_fields import read_object, unreadable
from ..formats.second_names import give_second_names
from ..formats.spans import add_facts, drop_recording
from .deferred_video import DeferredVideo
from .keep_rules import Selection, Standing
from .monitored_run import MonitoredRun
from .tracking import FinishedEpisode
from .video_recorder import VideoRecorder

logger = logging.getLogger(__name__)


@dataclass
class _Held:
    """What there is of an episode that is not decided.

    Attributes:
        size: of its files, in bytes.
        trajectory: the file that its recording becomes.
        promise: what the log says of the video.
        stays: the trajectory is kept in any case.
        deferred: its video, where that is to be rendered.
        live: its videos, where they were drawn live.
    """

    size: int = 0
    trajectory: Path | None = None
    promise: Mapping[str, Any] = field(default_factory=dict)
    stays: bool = False
    deferred: DeferredVideo | None = None
    live: list[VideoRecorder] = field(default_factory=list)


class KeptVideos:
    """Holds, hands on or deletes recordings, as a selection has it.

    Each step may be interrupted (Ctrl-C) and is taken up again by the next `settle`.

    Args:
        run: of which they are.
        selection: chooses.
    """

    def __init__(self, run: MonitoredRun, selection: Selection) -> None:
        self._run = run
        self._selection = selection
        # Number of the last episode that was judged, and how it stands.
        self._judged = (-1, Standing.DROPPED)
        self._held: dict[int, _Held] = {}
        self._bytes_held = self._most_bytes_held = 0
        self._is_decided = False
        # Why nothing could be decided, and which episodes stay for that.
        self._failure: str | None = None
        self._left: list[int] = []

    @property
    def is_left_open(self) -> bool:
        """Whether somebody else decides, when the monitor is gone."""
        return self._selection.is_left_open

    def chosen_facts(self) -> dict[str, Any]:
        """Return what is said of a video that is chosen, by which it is known."""
        finished = self._selection.finished
        return {**self._run.selection, "decided": True, "finished": finished}

    def judge(self, episode_id: int, episode: FinishedEpisode | None) -> Standing:
        """Tell how an episode stands that has just ended.

        Args:
            episode_id: its number.
            episode: the episode; None where it was not completed.
        """
        if self._judged[0] != episode_id:
            standing = Standing.DROPPED
            if episode is not None:
                self._selection.add(episode)
            if episode is not None or self.is_left_open:
                standing = self._selection.standing(episode_id)
            if standing is Standing.CANDIDATE:
                # Also where the disk was too full for anything of it.
                self._held.setdefault(episode_id, _Held())
            self._judged = (episode_id, standing)
        return self._judged[1]

    def verdict(self, standing: Standing, promise: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a trajectory says at its end of its episode's standing.

        Args:
            standing: of the episode.
            promise: what the trajectory has said of the video so far.
        """
        if standing is Standing.CANDIDATE:
            return {}
        if standing is Standing.DROPPED:
            return {"candidate": False, "video": None}
        chosen = {**promise, "selection": self.chosen_facts()}
        return {"candidate": False, "video": chosen}

    def hold_trajectory(
        self,
        episode_id: int,
        trajectory: Path,
        *,
        size: int,
        promise: Mapping[str, Any],
        stays: bool,
        deferred: DeferredVideo | None,
    ) -> None:
        """Hold the log of an episode, and the promise of its video.

        Args:
            episode_id: its number.
            trajectory: the file that its recording becomes.
            size: of its rows, in bytes.
            promise: what the log says of the video.
            stays: the trajectory is kept in any case.
            deferred: the video, where it is to be rendered.
        """
        held = self._held.setdefault(episode_id, _Held())
        held.trajectory, held.promise = trajectory, promise
        held.stays, held.deferred = stays, deferred
        self._count(held, size)

    def hold_live(self, episode_id: int, recorder: VideoRecorder) -> None:
        """Hold a video that was drawn live, and is closed."""
        held = self._held.setdefault(episode_id, _Held())
        held.live.append(recorder)
        files = [path for path in _files_of(recorder) if path.exists()]
        self._count(held, sum(path.stat().st_size for path in files))

    def settle(self) -> None:
        """Delete what has fallen out.

        Raises:
            DirectoryNotWritable: it cannot be deleted.
            FileNotWritten: the disk is too full to say of a trajectory that stays that
                there will be no video.
        """
        if len(self._held) > self._selection.undecided:
            self._hand_on(list(self._held))

    def decide(self) -> None:
        """Decide about all that is held: there are no more episodes. Idempotent.

        Where that is left to somebody else, all that is held stays as it is, and its
        videos are pending.

        Raises:
            InvalidArgument: the user's function could not choose. All episodes that
                are held stay, and their videos are pending, or there.
            DirectoryNotWritable: as of `settle`.
            FileNotWritten: as of `settle`, or the disk is too full to say that a video
                is chosen. It is pending all the same.
        """
        if self.is_left_open:
            self._leave_all()
            return
        if self._failure is None:
            try:
                self._selection.close()
            except InvalidArgument as error:
                self._failure = str(error)
                self._leave_all()
                raise
        else:
            self._leave_all()
        self._is_decided = self._failure is None
        # What is wanted first: should this be killed, it has not lost that.
        order = sorted(self._held, key=lambda number: not self._is_chosen(number))
        self._hand_on(order)

    def details(self) -> dict[str, Any]:
        """Return what the journal says of the choice, once it is made."""
        failure = {} if self._failure is None else {"failure": self._failure}
        return {
            "rule": self._selection.name,
            "decided": self._is_decided,
            "chosen": self._selection.chosen,
            "finished": self._selection.finished,
            "most_bytes_held": self._most_bytes_held,
            "recorded": self._left or self._selection.chosen,
            **({"left_open": True} if self.is_left_open else {}),
            **failure,
        }

    def _is_chosen(self, episode_id: int) -> bool:
        return self._selection.standing(episode_id) is Standing.CHOSEN

    def _count(self, held: _Held, size: int) -> None:
        if self._selection.holds_all and not self._most_bytes_held:
            logger.info(
                "Which episodes get a video is decided at the end (keep=%s): until "
                "then the recordings of all of them stay on the disk.",
                self._selection.name,
            )
        held.size += size
        self._bytes_held += size
        self._most_bytes_held = max(self._most_bytes_held, self._bytes_held)

    def _hand_on(self, episode_ids: Iterable[int]) -> None:
        """Do what is to be done about episodes; one that fails is no other's fate."""
        failed: list[Error] = []
        for episode_id in episode_ids:
            held = self._held[episode_id]
            standing = self._selection.standing(episode_id)
            if standing is Standing.CANDIDATE:
                continue
            try:
                if standing is Standing.CHOSEN:
                    self._choose(held)
                else:
                    self._drop(episode_id, held)
            except Error as error:
                failed.append(error)
            self._bytes_held -= held.size
            del self._held[episode_id]
        if failed:
            raise failed[0]

    def _choose(self, held: _Held) -> None:
        try:
            for recorder in held.live:
                _say_in_metadata(recorder, self.chosen_facts())
            if held.trajectory is not None:
                verdict = self.verdict(Standing.CHOSEN, held.promise)
                add_facts(held.trajectory, verdict)
                self._run.finisher.submit(held.trajectory)
        finally:
            self._expect(held)

    def _expect(self, held: _Held) -> None:
        for recorder in held.live:
            if recorder.path is not None and "first_video" not in recorder.metadata:
                self._run.videos.expect(Path(recorder.path))
            if recorder.finished and "also_named" in recorder.metadata:
                give_second_names(Path(str(recorder.path)))
        if held.deferred is not None and held.trajectory is not None:
            self._run.videos.expect(Path(held.deferred.path))

    def _drop(self, episode_id: int, held: _Held) -> None:
        # The last one that was finished is the sign that all are there.
        for recorder in reversed(held.live):
            _remove(_files_of(recorder))
        if held.trajectory is None:
            return
        if held.stays:
            verdict = self.verdict(Standing.DROPPED, held.promise)
            add_facts(held.trajectory, verdict)
            self._run.finisher.submit(held.trajectory)
            self._run.journal.note("dropped", episode_id)
        else:
            drop_recording(held.trajectory)

    def _leave_all(self) -> None:
        for episode_id in list(self._held):
            self._left.append(episode_id)
            self._expect(self._held.pop(episode_id))


def _files_of(recorder: VideoRecorder) -> Iterator[Path]:
    """Yield the files of a live video, the metadata first.

    Where that is there, the video is: so it has to go before the others.
    """
    if recorder.metadata_path is not None and recorder.path is not None:
        yield Path(recorder.metadata_path)
        yield Path(recorder.path)
        yield frame_hash_path(Path(recorder.path))


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise DirectoryNotWritable(path.parent, error) from error


def _say_in_metadata(recorder: VideoRecorder, selection: Mapping[str, Any]) -> None:
    assert recorder.metadata_path is not None
    recorder.metadata["selection"] = dict(selection)
    path = Path(recorder.metadata_path)
    with unreadable(path):
        said = read_object(path)
    write_text(path, json_text.dumps({**said, "selection": selection}))
