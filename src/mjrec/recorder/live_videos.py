# SPDX-License-Identifier: Apache-2.0
"""The videos of an episode that are drawn while it runs, one for each camera."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..annotation import Caption
from ..errors import DirectoryNotWritable, Error
from ..formats.frame_hashes import frame_hash_path
from ..formats.monitor_directory import second_name_of
from ..formats.second_names import give_second_names
from ..formats.video_metadata import amend_metadata
from .endings import Failures
from .monitored_run import MonitoredRun
from .recorded_environment import EpisodeFrames
from .video_recorder import VideoRecorder


class LiveVideos:
    """The live videos of one episode.

    Args:
        run: the monitored run.
        recorders: the video recorders, in the order of the cameras. There must be at
            least one.
        tolerates: a function that returns whether to continue after an error; None for
            the run's own function.

    Attributes:
        recorders: the video recorders.
    """

    def __init__(
        self,
        run: MonitoredRun,
        recorders: Sequence[VideoRecorder],
        *,
        tolerates: Callable[[Exception], bool] | None = None,
    ) -> None:
        self.recorders = recorders
        self._run = run
        self._tolerates = tolerates or functools.partial(run.tolerates, "video")

    @property
    def path(self) -> Path:
        """The first camera's video."""
        return Path(str(self.recorders[0].path))

    def begin(self) -> None:
        """Take the frames for the reset."""
        self._each(VideoRecorder.capture_frame)

    def take(self, *, is_there: bool, last: bool) -> None:
        """Take the frames for a step.

        Args:
            is_there: whether the frames still exist. False if the environment has
                already reset itself.
            last: whether the episode is over.
        """
        if not is_there:
            for recorder in self.recorders:
                if recorder.functional:
                    recorder.metadata["final_frame"] = "missing"
            return
        self._each(VideoRecorder.capture_frame)
        if last:
            self.take_last()

    def take_last(self) -> None:
        """Take the last step's frames if `max_fps` left them out."""
        self._each(VideoRecorder.capture_last)

    def say(self, **facts: Any) -> None:
        """Add facts to the metadata."""
        for recorder in self.recorders:
            recorder.metadata.update(facts)

    def give_up(self, reason: str) -> None:
        """Stop taking frames and log the reason. Earlier frames are kept."""
        for recorder in self.recorders:
            recorder.give_up(reason)

    def discard(self) -> None:
        """Discard the videos and write no metadata."""
        for recorder in self.recorders:
            recorder.discard()

    def leave(self) -> None:
        """Release the files as if killed by SIGKILL, so that recovery finishes them."""
        for recorder in self.recorders:
            recorder.leave()

    def end(self, facts: Mapping[str, Any]) -> None:
        """Finish the files.

        The metadata of the first camera's video lists the other videos and implies that
        all of them exist. Therefore, it is written last, even if an error occurs while
        finishing another video.

        Args:
            facts: the facts about the episode for the metadata.
        """
        self.say(**facts)
        first, *others = self.recorders
        failures = Failures()
        for recorder in (*others, first):
            if recorder is first:
                names = [Path(str(each.path)).name for each in others if each.finished]
                first.metadata.update({"further_videos": names} if names else {})
            try:
                recorder.close()
            except Error as error:
                if not self._tolerates(error):
                    failures.note(error)
        if not all(recorder.closed for recorder in self.recorders):

            def retry_end() -> None:
                self.end(facts)
                self.give_second_names()

            # The disk had no room for some of the metadata.
            self._run.retry_at_close(retry_end)
        failures.raise_first()

    def give_second_names(self) -> None:
        """Give the finished videos their second names, if they have any."""
        first = self.recorders[0]
        if first.finished and "also_named" in first.metadata:
            give_second_names(self.path)

    def amend(self, facts: Mapping[str, Any]) -> None:
        """Add facts to the metadata of finished videos.

        Raises:
            FileNotWritten: the disk is full.
        """
        self.say(**facts)
        for recorder in self.recorders:
            # A recorder that is not closed has not written its metadata yet.
            if recorder.closed:
                amend_metadata(Path(str(recorder.path)), facts)

    def remove(self) -> None:
        """Remove finished videos.

        Raises:
            DirectoryNotWritable: the files cannot be removed.
        """
        # The first camera's metadata implies that all videos exist, so it is removed
        # last.
        for recorder in reversed(self.recorders):
            recorder.discard()
            video = Path(str(recorder.path))
            about = Path(str(recorder.metadata_path))
            for path in (about, video, frame_hash_path(video)):
                try:
                    path.unlink(missing_ok=True)
                except OSError as error:
                    raise DirectoryNotWritable(path.parent, error) from error

    def _each(self, capture: Callable[[VideoRecorder], None]) -> None:
        for recorder in self.recorders:
            try:
                capture(recorder)
            except Exception as error:
                if not self._tolerates(error):
                    raise
                recorder.give_up(str(error))


def live_videos(run: MonitoredRun, path: Path) -> LiveVideos:
    """Create the live videos of the running episode, one for each camera.

    Args:
        run: the monitored run.
        path: the path of the first camera's video, without the extension.
    """
    sources = {"": run.env.frames, **run.env.further_frames}
    recorders = [
        live_recorder(
            run,
            path.with_name(f"{path.name}.{name}" if name else path.name),
            frames,
            caption=run.caption if run.options.annotate else None,
        )
        for name, frames in sources.items()
    ]
    first, *others = recorders
    if first.path is not None:
        second_name = run.second_name(path.name)
        first.metadata.update(second_name)
        first_name = Path(first.path).name
        for other in others:
            other.metadata["first_video"] = first_name
            for second in second_name.values():
                name = Path(str(other.path)).name
                other.metadata["also_named"] = second_name_of(
                    name, second, first=first_name
                )
    return LiveVideos(run, recorders)


def live_recorder(
    run: MonitoredRun,
    base_path: Path,
    frames: EpisodeFrames,
    *,
    caption: Callable[[], Caption] | None = None,
    **facts: Any,
) -> VideoRecorder:
    """Create the recorder for one live video with the run's options.

    Args:
        run: the monitored run.
        base_path: path of the video, without the extension.
        frames: the source of the frames.
        caption: a function that returns the text for the current frame, or None.
        **facts: additional facts for the metadata.
    """
    return VideoRecorder(
        frames,
        base_path=base_path,
        metadata={**run.live_facts(), **facts},
        fps=run.options.fps,
        max_fps=run.options.max_fps,
        frame_hashes=True,
        clock=run.env.clock,
        declared=run.env.declared,
        facts=frames.facts,
        strict=run.options.strict,
        caption=caption,
    )
