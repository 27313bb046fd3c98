# SPDX-License-Identifier: Apache-2.0
"""The videos of an episode that are drawn while it runs, one for each camera."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import Error
from ..formats.second_names import give_second_names
from .monitored_run import MonitoredRun
from .options import LIVE
from .video_recorder import VideoRecorder


class LiveVideos:
    """The videos of one episode.

    Args:
        recorders: what records them, one or more; the first camera's comes first.
        tolerates: tells whether to go on after an error.
        on_picture_error: called with one that is not tolerated while a picture of a
            step is taken: it may be the environment's own.
    """

    def __init__(
        self,
        recorders: Sequence[VideoRecorder],
        *,
        tolerates: Callable[[Exception], bool],
        on_picture_error: Callable[[Exception], object] = lambda _: None,
    ) -> None:
        self._recorders = recorders
        self._tolerates = tolerates
        self._on_picture_error = on_picture_error

    def begin(self) -> None:
        """Take the frames of a reset."""
        self._each(VideoRecorder.capture_frame)

    def take(self, *, is_there: bool, last: bool) -> None:
        """Take the frames of a step.

        Args:
            is_there: False where the environment has reset itself already.
            last: the episode is over.
        """
        if not is_there:
            for recorder in self._recorders:
                if recorder.functional:
                    recorder.metadata["final_frame"] = "missing"
            return
        try:
            self._each(VideoRecorder.capture_frame)
            if last:
                self.take_last()
        except Exception as error:
            self._on_picture_error(error)
            raise

    def take_last(self) -> None:
        """Take the frames of the last step, where they were left out."""
        self._each(VideoRecorder.capture_last)

    def give_up(self, reason: str) -> None:
        """Take no more pictures, and say why; those that were taken stay."""
        for recorder in self._recorders:
            recorder.give_up(reason)

    def discard(self) -> None:
        """End without a video and without metadata."""
        for recorder in self._recorders:
            recorder.discard()

    def end(
        self,
        facts: Mapping[str, Any],
        on_closed: Callable[[VideoRecorder], object] = lambda _: None,
    ) -> None:
        """Finish the files. Where it was interrupted, the next call goes on.

        The metadata of the first camera's video is the sign that all are there, and
        names the others: it comes last, also where ending another one raises.

        Args:
            facts: what is known of the episode, for the metadata.
            on_closed: called with each that is closed.
        """
        first, *others = self._recorders
        with contextlib.ExitStack() as ends:
            # Run from the last to the first.
            ends.callback(self._end_one, first, facts, on_closed)
            ends.callback(_name_further_videos, first, others)
            for recorder in others:
                ends.callback(self._end_one, recorder, facts, on_closed)

    def name_again(self) -> None:
        """Give the finished videos their second names, if they have any."""
        first = self._recorders[0]
        if first.finished and first.path is not None and "also_named" in first.metadata:
            give_second_names(Path(first.path))

    def _each(self, capture: Callable[[VideoRecorder], None]) -> None:
        for recorder in self._recorders:
            try:
                capture(recorder)
            except Exception as error:
                if not self._tolerates(error):
                    raise
                recorder.give_up(str(error))

    def _end_one(
        self,
        recorder: VideoRecorder,
        facts: Mapping[str, Any],
        on_closed: Callable[[VideoRecorder], object],
    ) -> None:
        if recorder.closed:
            return
        recorder.metadata.update(facts)
        try:
            recorder.close()
        except Error as error:
            if not self._tolerates(error):
                raise
        finally:
            if recorder.closed:
                on_closed(recorder)


def _name_further_videos(first: VideoRecorder, others: Sequence[VideoRecorder]) -> None:
    names = [Path(v.path).name for v in others if v.finished and v.path is not None]
    if names:
        first.metadata["further_videos"] = names


class LiveClip:
    """A video that is counted in steps, drawn while the simulation runs; a `Clip`.

    Args:
        run: of which it is.
        recorders: what records it, of one camera or of each.
    """

    def __init__(self, run: MonitoredRun, recorders: Sequence[VideoRecorder]) -> None:
        self._run = run
        self._recorders = recorders
        self._episode_id = run.episode.episode_id
        self._videos = LiveVideos(
            recorders, tolerates=functools.partial(run.tolerates, "video")
        )
        for recorder in recorders:
            recorder.metadata.update(
                first_step=run.stats.total_steps, last_episode_id=self._episode_id
            )

    def begin(self) -> None:
        """Take the picture of this moment."""
        self._videos.begin()

    def reset(self, episode_id: int) -> None:
        """Take the picture of an episode that has just begun."""
        for recorder in self._recorders:
            recorder.metadata["last_episode_id"] = episode_id
        self._videos.begin()

    def step(
        self, reward: float, *, terminated: bool, truncated: bool, is_there: bool
    ) -> None:
        """Take the picture of a step."""
        del reward, terminated, truncated
        self._videos.take(is_there=is_there, last=False)

    def end(self, facts: Mapping[str, Any]) -> None:
        """Finish the files. Where it was interrupted, the next call goes on."""
        try:
            try:
                self._videos.take_last()
            finally:
                self._videos.end(facts)
        finally:
            self._list()
            self._videos.name_again()

    def _list(self) -> None:
        path = self._recorders[0].path
        if path is not None:
            facts = {"episode_id": self._episode_id, "recording": LIVE}
            self._run.journal.note("clip", {**facts, "video": Path(path).name})
            self._run.videos.expect(Path(path))
