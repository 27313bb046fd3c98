# SPDX-License-Identifier: Apache-2.0
"""The video of a trajectory: its frames, drawn by workers, in one file.

The frames come in order, whoever drew them, so the file does not depend on the number
of workers. The metadata comes last: where it is, the video is there and whole.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

from .. import json_text
from ..atomic_files import write_text
from ..blank_frames import BlankFrames
from ..errors import EncoderError, NoPictures, UnreadableFile
from ..formats.monitor_directory import Infix, episode_of, infix_of, video_prefix
from ..formats.trajectory_reader import TrajectoryReader
from ..formats.video_metadata import (
    StepRuns,
    file_facts,
    metadata_path,
    timing_facts,
)
from ..formats.video_writer import VideoFile, VideoWriter
from ..frames import Frame
from ..rates import to_rate
from ..recorder.endings import KILLED
from ..recorder.versions import versions
from .recorded_facts import open_for_rendering
from .recorded_pictures import (
    ChosenFrames,
    chosen_frames,
    recorded_rate,
    warn_of_other_pictures,
)
from .views import View, plain_camera
from .workers import DrawingWorkers

__all__ = ["render_video", "video_path"]

logger = logging.getLogger(__name__)

# Of an episode that ended before its second step: any is as good.
_RATE_OF_ONE_FRAME = Fraction(30)


def render_video(
    trajectory: Path,
    *,
    workers: DrawingWorkers,
    view: View | None = None,
    max_fps: float | Fraction | None = None,
    fps: float | Fraction | None = None,
    out: Path | None = None,
    strict: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> VideoFile | None:
    """Render the video of a trajectory, with its frame hashes and its metadata.

    All three have temporary names until they are whole. Those that are there are
    replaced. If it fails or is interrupted, nothing is left. An encoder that is killed
    or hangs is given a second try.

    Args:
        trajectory: the file, finished or not.
        workers: who draw.
        view: from where, how large and how well; as recorded, if None.
        max_fps: the most frames per second of simulated time: frames 0, n, 2n ... of
            those recorded, with the smallest n that fits, and the last.
        fps: frames per second of the file. If None, a second of the video is as much
            simulated time as when the episode was recorded.
        out: the video; what the trajectory says, in its own directory, if None.
        strict: whether a video that shows nothing is an error; else it is a warning.
        on_frame: called after every frame, once for each.

    Returns:
        What was written; None where the trajectory says that it broke before there was
        a frame, which the metadata now says.

    Raises:
        NoPictures: it has no frames.
        UnreadableFile: it is damaged.
        BlankVideo: `strict`, and the video shows nothing. It is there and stays.
        FileNotWritten: the disk is full.
        Error: its frames cannot be drawn or encoded.
    """
    view = view or View()
    with open_for_rendering(trajectory) as reader:
        facts = reader.header.facts
        out = video_path(trajectory, facts) if out is None else out
        broken = _what_broke(facts)
        if reader.frame_count == 0:
            if broken and facts.get("video"):
                _write_metadata(
                    out, {**_episode_facts(reader), "empty": True, **broken}
                )
                return None
            raise NoPictures(_why_no_pictures(trajectory, facts))
        warn_of_other_pictures(reader)
        chosen = chosen_frames(reader.frame_count, facts, max_fps)
        stride = facts.get("stride", 1) * chosen.every
        steps = reader.frame_steps[chosen.indices].tolist()
        episode = _episode_facts(reader)
    rate = _usual_fps(facts, chosen) if fps is None else to_rate(fps)
    file, blank = _write_video(
        out,
        lambda: workers.frames(trajectory, chosen.indices, view),
        fps=rate,
        on_frame=on_frame,
    )
    metadata = {
        **episode,
        **timing_facts(
            StepRuns(steps, stride=stride),
            fps=file.fps,
            timestep=_fraction(facts.get("timestep")),
            stride=stride,
        ),
        **file_facts(file),
        **blank.facts(),
        **_picture_facts(facts, view),
        **workers.gl_strings,
        **broken,
    }
    _complete(file, metadata)
    blank.judge(out, strict=strict)
    return file


def video_path(trajectory: Path, facts: Mapping[str, Any]) -> Path:
    """Return where the video of a trajectory belongs.

    Raises:
        UnreadableFile: the trajectory names none, or one that is not its own.
    """
    name = (facts.get("video") or {}).get("name")
    infix = Infix.parse(infix_of(trajectory.name) or "")
    number = episode_of(trajectory.name)
    own = infix and number is not None and f"{video_prefix(infix, number)}.mp4"
    if own and name == own:
        return trajectory.with_name(own)
    raise UnreadableFile(
        trajectory,
        f"the video that it names, {name!r:.200}, is not that of its own episode",
    )


def _usual_fps(facts: Mapping[str, Any], chosen: ChosenFrames) -> Fraction:
    """Return the rate at which a second of the file is as long as when recorded."""
    asked = (facts.get("video") or {}).get("fps")
    rate = recorded_rate(facts) if asked is None else Fraction(asked)
    return (_RATE_OF_ONE_FRAME if rate is None else rate) / chosen.every


def _write_video(
    out: Path,
    draw: Callable[[], Iterable[Frame]],
    *,
    fps: Fraction,
    on_frame: Callable[[], object],
) -> tuple[VideoFile, BlankFrames]:
    """Write the frames, a second time where the encoder was ended from outside."""
    most = 0

    def tell(number: int) -> None:
        nonlocal most
        if number > most:
            most = number
            on_frame()

    try:
        return _encode(out, draw(), fps=fps, tell=tell)
    except EncoderError as error:
        if not _was_ended(error):
            raise
        logger.warning("The video %s is begun anew: %s", out.name, error)
    return _encode(out, draw(), fps=fps, tell=tell)


def _was_ended(error: EncoderError) -> bool:
    """Tell whether ffmpeg was killed: by whoever lacked memory, or for hanging."""
    return (error.returncode or 0) < 0


def _encode(
    out: Path,
    frames: Iterable[Frame],
    *,
    fps: Fraction,
    tell: Callable[[int], object],
) -> tuple[VideoFile, BlankFrames]:
    blank = BlankFrames()
    writer = VideoWriter(out, fps=fps, frame_hashes=True)
    try:
        for number, frame in enumerate(frames, 1):
            writer.write(frame)
            blank.add(frame)
            tell(number)
        # An older video's would not be true of this one.
        metadata_path(out).unlink(missing_ok=True)
        writer.close()
    except BaseException:
        # Half a video is of no use: all of it can be rendered again.
        writer.abort()
        raise
    assert writer.result is not None
    return writer.result, blank


def _complete(file: VideoFile, metadata: Mapping[str, Any]) -> None:
    """Write the metadata; without it there is no video, and nothing stays."""
    try:
        _write_metadata(file.path, metadata)
    except BaseException:
        if not metadata_path(file.path).exists():
            for path in filter(None, (file.path, file.frame_hash_path)):
                path.unlink(missing_ok=True)
        raise


def _episode_facts(reader: TrajectoryReader) -> dict[str, Any]:
    """Return what the metadata says of the episode."""
    facts = reader.header.facts
    complete = bool(facts.get("complete"))
    if complete:
        ending = {key: facts.get(key) for key in ("terminated", "truncated")}
    else:
        # Whoever was killed could not say why it ended.
        ending = {"reason": facts.get("reason", KILLED)}
        if "exception" in facts:
            ending["exception"] = facts["exception"]
    so_far = {"length": reader.step_count, "reward": float(reader.rewards.sum())}
    return {
        "episode_id": facts.get("episode_id"),
        "content_type": "video/mp4",
        "complete": complete,
        **ending,
        **{key: facts.get(key, so_far[key]) for key in so_far},
        **{key: facts.get(key) for key in ("type", "env_id", "seed", "options")},
        "recording": "deferred",
        "versions": facts.get("versions"),
        "rendered_with": dict(versions()),
    }


def _what_broke(facts: Mapping[str, Any]) -> dict[str, Any]:
    reason = facts.get("broken_reason")
    return {} if reason is None else {"broken_reason": reason, "broken": True}


def _picture_facts(facts: Mapping[str, Any], view: View) -> dict[str, Any]:
    recorded = facts.get("video") or {}
    scene = facts.get("scene") or {}
    return {
        "pictures": "scene",
        "quality": view.quality or recorded.get("quality", "full"),
        "camera": scene.get("label")
        if view.camera is None
        else plain_camera(view.camera),
    }


def _why_no_pictures(trajectory: Path, facts: Mapping[str, Any]) -> str:
    refusal = facts.get("refusal")
    why = f": {refusal}" if refusal else ""
    return f"{trajectory} holds states, and nothing that pictures can be made of{why}."


def _write_metadata(video: Path, metadata: Mapping[str, Any]) -> None:
    write_text(metadata_path(video), json_text.dumps(metadata))


def _fraction(text: Any) -> Fraction | None:
    return None if text is None else Fraction(text)
