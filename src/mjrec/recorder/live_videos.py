# SPDX-License-Identifier: Apache-2.0
"""The videos of an episode that are drawn while it runs, one for each camera."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import Error
from ..formats.second_names import give_second_names
from .video_recorder import VideoRecorder


class LiveVideos:
    """The videos of one episode.

    Args:
        recorders: what records them, one or more; the first camera's comes first.
        tolerates: tells whether to go on after an error.
        on_picture_error: called with one that is not tolerated while a picture of a
            step is taken: it may be the environment's own.

    Attributes:
        recorders: as given.
    """

    def __init__(
        self,
        recorders: Sequence[VideoRecorder],
        *,
        tolerates: Callable[[Exception], bool],
        on_picture_error: Callable[[Exception], object] = lambda _: None,
    ) -> None:
        self.recorders = recorders
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
            for recorder in self.recorders:
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
        for recorder in self.recorders:
            recorder.give_up(reason)

    def discard(self) -> None:
        """End without a video and without metadata."""
        for recorder in self.recorders:
            recorder.discard()

    def leave(self) -> None:
        """Let go of the files as SIGKILL would; recovery finishes them."""
        for recorder in self.recorders:
            recorder.leave()

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
        first, *others = self.recorders
        with contextlib.ExitStack() as ends:
            # Run from the last to the first.
            ends.callback(self._end_one, first, facts, on_closed)
            ends.callback(_name_further_videos, first, others)
            for recorder in others:
                ends.callback(self._end_one, recorder, facts, on_closed)

    def name_again(self) -> None:
        """Give the finished videos their second names, if they have any."""
        first = self.recorders[0]
        if first.finished and first.path is not None and "also_named" in first.metadata:
            give_second_names(Path(first.path))

    def _each(self, capture: Callable[[VideoRecorder], None]) -> None:
        for recorder in self.recorders:
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
