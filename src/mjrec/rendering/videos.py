# SPDX-License-Identifier: Apache-2.0
"""The video of a trajectory: its frames, drawn by workers, in one file.

The frames come in order, whoever drew them, so the file does not depend on the number
of workers. The metadata comes last: where it is, the video is there and whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from .. import json_text
from ..atomic_files import write_text
from ..errors import NoPictures, UnreadableFile
from ..formats.monitor_directory import episode_of, infix_of
from ..formats.trajectory_file import TrajectoryReader, open_trajectory
from ..formats.video_metadata import StepRuns, file_facts, timing_facts
from ..formats.video_writer import VideoFile, VideoWriter
from ..frames import Frame
from ..rates import stride_for, to_rate
from ..recorder.versions import versions
from .views import View, plain_camera
from .workers import DrawingWorkers

__all__ = ["metadata_path", "render_video", "video_path"]

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
    on_frame: Callable[[], object] = lambda: None,
) -> VideoFile | None:
    """Render the video of a trajectory, with its frame hashes and its metadata.

    All three have temporary names until they are whole. Those that are there are
    replaced. If it fails or is interrupted, nothing is left.

    Args:
        trajectory: the file, finished or not.
        workers: who draw.
        view: from where, how large and how well; as recorded, if None.
        max_fps: the most frames per second of simulated time: frames 0, n, 2n ... of
            those recorded, with the smallest n that fits, and the last.
        fps: frames per second of the file. If None, a second of the video is as much
            simulated time as when the episode was recorded.
        out: the video; what the trajectory says, in its own directory, if None.
        on_frame: called after every frame.

    Returns:
        What was written; None where the trajectory says that it broke before there was
        a frame, which the metadata now says.

    Raises:
        NoPictures: it has no frames.
        UnreadableFile: it is damaged.
        Error: its frames cannot be drawn or encoded.
    """
    view = view or View()
    with open_trajectory(trajectory) as reader:
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
        chosen = _choose_frames(reader, max_fps=max_fps, fps=fps)
        episode = _episode_facts(reader)
    frames = workers.frames(trajectory, chosen.indices, view)
    file = _write_video(out, frames, fps=chosen.fps, on_frame=on_frame)
    _write_metadata(
        out,
        {
            **episode,
            **timing_facts(
                StepRuns(chosen.steps, stride=chosen.stride),
                fps=file.fps,
                timestep=_fraction(facts.get("timestep")),
                stride=chosen.stride,
            ),
            **file_facts(file),
            **_picture_facts(facts, view),
            **workers.gl_strings,
            **broken,
        },
    )
    return file


def video_path(trajectory: Path, facts: Mapping[str, Any]) -> Path:
    """Return where the video of a trajectory belongs.

    Raises:
        UnreadableFile: the trajectory names none, or one that is not its own.
    """
    name = (facts.get("video") or {}).get("name")
    if isinstance(name, str) and (
        Path(name).suffix == ".mp4"
        and infix_of(name) is not None
        and infix_of(name) == infix_of(trajectory.name)
        and episode_of(name) == episode_of(trajectory.name)
    ):
        return trajectory.with_name(name)
    raise UnreadableFile(
        trajectory,
        f"the video that it names, {name!r}, is not that of its own episode",
    )


def metadata_path(video: Path) -> Path:
    """Return the name of the metadata file of a video."""
    return video.with_suffix(".meta.json")


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """Which frames of a trajectory are drawn, and how fast they are played.

    Attributes:
        indices: their numbers among the trajectory's frames.
        steps: the steps that they were taken after.
        stride: the usual number of steps from one to the next.
        fps: of the file.
    """

    indices: Sequence[int]
    steps: Sequence[int]
    stride: int
    fps: Fraction


def _choose_frames(
    reader: TrajectoryReader,
    *,
    max_fps: float | Fraction | None,
    fps: float | Fraction | None,
) -> _Choice:
    facts = reader.header.facts
    stride = int(facts.get("stride") or 1)
    rate = _fraction(facts.get("rate"))
    every = 1 if rate is None else stride_for(rate / stride, max_fps)
    last = reader.frame_count - 1
    indices = [*range(0, last, every), last]
    steps = reader.frame_steps
    usual = _usual_fps(facts, rate, stride) / every
    return _Choice(
        indices=indices,
        steps=[int(steps[index]) for index in indices],
        stride=stride * every,
        fps=usual if fps is None else to_rate(fps),
    )


def _usual_fps(
    facts: Mapping[str, Any], rate: Fraction | None, stride: int
) -> Fraction:
    """Return the rate of a file of all frames."""
    asked = (facts.get("video") or {}).get("fps")
    if asked is not None:
        return Fraction(asked)
    return _RATE_OF_ONE_FRAME if rate is None else rate / stride


def _write_video(
    out: Path,
    frames: Iterable[Frame],
    *,
    fps: Fraction,
    on_frame: Callable[[], object],
) -> VideoFile:
    writer = VideoWriter(out, fps=fps, frame_hashes=True)
    try:
        for frame in frames:
            writer.write(frame)
            on_frame()
        # An older video's would not be true of this one.
        metadata_path(out).unlink(missing_ok=True)
        writer.close()
    except BaseException:
        # Half a video is of no use: all of it can be rendered again.
        writer.abort()
        raise
    assert writer.result is not None
    return writer.result


def _episode_facts(reader: TrajectoryReader) -> dict[str, Any]:
    """Return what the metadata says of the episode."""
    facts = reader.header.facts
    complete = bool(facts.get("complete"))
    if complete:
        ending = {key: facts.get(key) for key in ("terminated", "truncated")}
    else:
        # Whoever was killed could not say why it ended.
        ending = {"reason": facts.get("reason", "died")}
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
