# SPDX-License-Identifier: Apache-2.0
"""TensorBoard tracker: curves of episode results, and videos as animations."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import optional_module
from ..formats.ffmpeg import run_ffmpeg
from ..formats.json_fields import field, integer, read_object, text, unreadable
from ..recorder.tracking import FinishedEpisode, FinishedVideo, Run, Tracker
from ..worker_thread import WorkerThread
from .services import group_of, name_of, scalars_of

if TYPE_CHECKING:
    from .event_file import EventFile

# The maximum number of videos waiting for a preview.
_MOST_WAITING = 100
_MOST_BYTES = 2 << 20
# Lengths of a preview's longer side in pixels, tried in order until the GIF is small
# enough. With the last length, any 100 frames fit.
_SIDES = (320, 160, 80)
_MOST_PICTURES = 100
# The shortest time per frame, in the format's unit of 1/100 s.
_SHORTEST_DELAY = 5
# A video with this many frames has at least 40 key frames. Decoding only these is fast.
_MANY_FRAMES = 10_000


class TensorBoardTracker(Tracker):
    """A tracker that writes event files for TensorBoard.

    Scalars are logged against the run's steps: `training/return`, `training/length`
    and, if the environment reports it, `training/success`. Evaluation episodes use
    `evaluation/`. TensorBoard cannot play videos (its issue 39), so each mp4 is shown
    as a small animated GIF, `training/video` under Images, with its file name under
    Text. The GIFs are created on a separate thread.

    Each monitor, and thus each sub-environment, is a TensorBoard run with its own
    directory, because TensorBoard reads only one of several growing files in a
    directory. Events are written to disk immediately.

    Args:
        log_dir: parent of the runs' directories. None means `tensorboard` in the
            monitor directory. A run is named `<infix>` there, and `<monitor directory's
            name>.<infix>` in a `log_dir`, followed by `.env<i>` for a sub-environment.

    Raises:
        MissingDependency: tensorboard is not installed.
    """

    def __init__(self, log_dir: str | os.PathLike[str] | None = None) -> None:
        optional_module(
            "tensorboard", purpose="TensorBoardTracker", install="mjrec[tensorboard]"
        )
        # Absolute, because the working directory may change before the path is used.
        self._log_dir = None if log_dir is None else Path(log_dir).absolute()
        self._files: dict[Run, EventFile] = {}
        self._last_episodes: dict[Run, FinishedEpisode] = {}
        # Threads that create previews. A thread is started by the run's first video,
        # because most runs of a vector environment have no video.
        self._previews: dict[Run, WorkerThread[Callable[[], None]]] = {}

    def begin(self, run: Run) -> None:
        """Create the run's event file.

        Raises:
            DirectoryNotWritable: the run's directory cannot be created.
            FileNotWritten: the disk is full.
        """
        # Imported late, because it imports tensorboard.
        from .event_file import EventFile

        self._files[run] = EventFile(self._directory(run))

    def episode(self, run: Run, episode: FinishedEpisode) -> None:
        """Write the episode's scalars.

        Raises:
            FileNotWritten: the disk is full.
        """
        self._last_episodes[run] = episode
        group = group_of(episode)
        values = {f"{group}/{k}": v for k, v in scalars_of(episode).items()}
        self._files[run].write_scalars(
            values, step=episode.total_steps, wall_time=episode.end_time
        )

    def video(self, run: Run, video: FinishedVideo) -> None:
        """Write the video's name, and start creating its preview.

        Raises:
            FileNotWritten: the disk is full.
            EncoderError: ffmpeg failed to create this or an earlier video's preview.
            UnreadableFile: the video's metadata is damaged.
        """
        file = self._files[run]
        episode = video.episode or self._last_episodes.get(run)
        tag = f"{group_of(episode)}/{name_of(video)}"
        step = episode.total_steps if episode else 0
        with unreadable(video.metadata_path):
            metadata = read_object(video.metadata_path)
            fps = Fraction(field(metadata, "fps", text))
            frame_count = field(metadata, "frame_count", integer)
        file.write_text(
            f"{tag}_file",
            f"episode {video.episode_id}: `{video.path.name}`, {frame_count} frames "
            f"at {float(fps):g} fps, in `{video.path.parent}`",
            step=step,
            wall_time=time.time(),
        )

        def write_preview() -> None:
            gif = animated_gif(video.path, frame_count=frame_count, fps=fps)
            file.write_gif(tag, gif, step=step, wall_time=time.time())

        if run not in self._previews:
            self._previews[run] = WorkerThread(
                lambda write: write(), capacity=_MOST_WAITING, name="previews"
            )
        self._previews[run].put(write_preview)

    def end(self, run: Run) -> None:
        """Wait for the previews, and close the run's event file.

        Raises:
            Error: one of the remaining previews failed; see `video`.
        """
        self._last_episodes.pop(run, None)
        file, previews = self._files.pop(run), self._previews.pop(run, None)
        try:
            if previews is not None:
                previews.close()
        finally:
            file.close()

    def _directory(self, run: Run) -> Path:
        name = run.infix if run.env_index is None else f"{run.infix}.env{run.env_index}"
        if self._log_dir is None:
            return run.directory / "tensorboard" / name
        # Monitors in one process may have the same infix in different directories.
        return self._log_dir / f"{run.directory.name}.{name}"


def animated_gif(path: Path, *, frame_count: int, fps: Fraction) -> bytes:
    """Convert a video to a looping GIF of at most 100 frames and two megabytes.

    The GIF has the video's duration, so if the video is long, the GIF shows few frames
    per second. Its longer side has at most 320 pixels.

    Args:
        path: the video.
        frame_count: number of frames in the video.
        fps: the video's frames per second.

    Raises:
        EncoderError: ffmpeg failed or hung.
    """
    delay = _delay(frame_count, fps)
    for side in _SIDES:
        gif = _convert(path, side=side, delay=delay, frame_count=frame_count)
        if len(gif) <= _MOST_BYTES:
            break
    return gif


def _delay(frame_count: int, fps: Fraction) -> int:
    longest = math.ceil(100 * frame_count / fps / _MOST_PICTURES)
    return max(_SHORTEST_DELAY, math.ceil(100 / fps), longest)


def _convert(path: Path, *, side: int, delay: int, frame_count: int) -> bytes:
    skipping = ["-skip_frame", "nokey"] if frame_count >= _MANY_FRAMES else []
    # Use a palette computed from the video, and store only changes.
    filters = (
        # Rounded up, so that even the shortest video has a frame.
        f"fps=100/{delay}:round=up,"
        f"scale=min(iw\\,{side}):min(ih\\,{side})"
        ":force_original_aspect_ratio=decrease:flags=area,"
        "split[frames][counted];[counted]palettegen=stats_mode=diff[palette];"
        "[frames][palette]paletteuse=dither=bayer:bayer_scale=4:diff_mode=rectangle"
    )
    return run_ffmpeg(
        [
            *("-hide_banner", "-loglevel", "error", "-nostdin"),
            *(*skipping, "-threads", "1", "-i", f"file:{path}"),
            *("-an", "-filter_complex", filters, "-frames:v", str(_MOST_PICTURES)),
            *("-loop", "0", "-f", "gif", "pipe:1"),
        ],
        what=f"Could not create a preview of {path}.",
    )
