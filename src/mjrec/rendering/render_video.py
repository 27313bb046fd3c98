# SPDX-License-Identifier: Apache-2.0
"""Functions that render the videos of one recording, one for each camera.

Frames arrive in order, whichever worker drew them, so the files do not depend on the
number of workers. A video's metadata is written last, so if it exists, the video is
complete. The first camera's video is written last, so if it exists, all videos do.
"""

from __future__ import annotations

import functools
import itertools
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..annotation import Caption, check_annotation
from ..errors import BlankVideo, EncoderError, NoPictures
from ..formats.killed_episodes import KILLED
from ..formats.monitor_directory import second_name_of
from ..formats.second_names import give_second_names, take_second_names
from ..formats.video_metadata import (
    StepRuns,
    recording_facts,
    timing_facts,
    write_metadata,
)
from ..formats.video_sink import VideoSink
from ..frames import Frame, grid_shape
from ..machine import machine_fingerprint
from ..provenance import versions
from ..rates import to_rate
from .jobs import PlainCamera, RenderedVideos, Variant, View, plain_camera
from .pool import WorkerPool
from .recorded_facts import (
    captions,
    further_video_paths,
    open_for_rendering,
    video_facts,
    video_path,
    warn_of_other_frames,
)
from .recordings import Recorded, read_recording

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Shot:
    """One of the videos of a recording.

    Attributes:
        path: the video's path.
        view: the video's camera, size and quality.
        facts: the metadata that only this video has.
        cameras: all cameras, if this video shows them side by side.
    """

    path: Path
    view: View
    facts: Mapping[str, Any]
    cameras: tuple[PlainCamera | None, ...] | None = None


def render_video(
    parts: Sequence[Path],
    variant: Variant | None = None,
    *,
    workers: WorkerPool,
    out: Path | None = None,
    strict: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> RenderedVideos:
    """Render the videos of a recording, with frame hashes and metadata.

    If several cameras were recorded, each gets a video, or a single video shows all of
    them side by side. Files have temporary names until they are complete, and replace
    existing files. If rendering fails or is interrupted, nothing is left behind. If the
    encoder is killed or hangs, the video is rendered a second time.

    Args:
        parts: the trajectory of an episode, finished or not, or the parts of a clip.
        variant: changes from the recording. If it names a camera, only one video is
            rendered, from that camera.
        workers: the workers that draw the frames.
        out: the path for the video from the first camera, or from all cameras side by
            side. None means the recorded name, next to the recording.
        strict: whether a blank video is listed in the result's `blank`. Otherwise there
            is only a warning.
        on_frame: called once for every frame of every video.

    Returns:
        The videos. If the recording stopped before its first frame, there are no
        videos, only the trajectory's name, and the metadata says so.

    Raises:
        NoPictures: the recording has no frames.
        UnreadableFile: the recording is damaged.
        MissingDependency: captions are needed, but Pillow is not installed.
        FileNotWritten: the disk is full.
        Error: the frames cannot be drawn or encoded.
    """
    recorded = read_recording(parts)
    facts, variant = recorded.facts[0], variant or Variant()
    if not sum(recorded.frame_counts):
        _note_that_it_broke(recorded, out)
        return RenderedVideos(directory=parts[0].parent, trajectories=(parts[0].name,))
    warn_of_other_frames(parts[0].name, facts)
    chosen = recorded.chosen(variant.max_fps)
    runs = list(_runs(recorded, chosen.indices))
    annotate = variant.annotate
    if annotate is None:
        annotate = bool(video_facts(facts).get("annotate", False))
    if annotate:
        check_annotation()
    fps = variant.fps
    rate = recorded.usual_fps(chosen) if fps is None else to_rate(fps)
    stride = facts.get("stride", 1) * chosen.every
    timestep = recorded.timing.get("timestep")
    description = {
        **_metadata(recorded),
        **timing_facts(
            StepRuns(recorded.frame_steps[chosen.indices].tolist(), stride=stride),
            fps=rate,
            timestep=None if timestep is None else Fraction(timestep),
            stride=stride,
        ),
        "pictures": "scene",
        "quality": variant.view.quality or video_facts(facts).get("quality", "full"),
    }
    shots = _shots(parts[0], facts, variant.view, out)
    if out is None:
        # Otherwise, the second names would still point to the replaced videos.
        take_second_names(shots[-1].path)
    sinks: list[VideoSink] = []
    videos: dict[str, int] = {}
    try:
        for shot in shots:
            draw = functools.partial(_drawn, workers, shot, runs, annotate=annotate)
            sink = _film(shot.path, rate, draw, on_frame)
            sinks.append(sink)
            facts = sink.describe({**description, **shot.facts, **workers.gl_facts})
            videos[sink.path.name] = facts["frame_count"]
    except BaseException:
        for sink in sinks:
            sink.discard()
        raise
    if out is None:
        give_second_names(shots[-1].path)
    blank: dict[str, str] = {}
    for sink in sinks:
        try:
            sink.blank.judge(sink.path, strict=strict)
        except BlankVideo as error:
            blank[sink.path.name] = str(error)
    first = shots[-1].path
    videos = {first.name: videos[first.name], **videos}
    return RenderedVideos(directory=first.parent, videos=videos, blank=blank)


def _note_that_it_broke(recorded: Recorded, out: Path | None) -> None:
    """Write metadata that marks a recording's missing video as broken.

    Raises:
        NoPictures: the reason is unknown, the recording has no video, or `out` is
            given.
    """
    path, facts = recorded.parts[0], recorded.facts[0]
    reason = facts.get("broken_reason")
    if recorded.is_clip:
        reason = "the process was killed before its first frame"
    if reason is None or out is not None or not video_facts(facts):
        refusal = facts.get("refusal")
        why = f": {refusal}" if refusal else ""
        raise NoPictures(
            f"{path} contains states, but nothing to draw frames from{why}."
        )
    broken = {"broken_reason": reason, "empty": True, "broken": True}
    write_metadata(video_path(path, facts), {**_metadata(recorded), **broken})


def _runs(
    recorded: Recorded, indices: Sequence[int]
) -> Iterator[tuple[Path, list[int]]]:
    """Yield each part with the indices of its selected frames, relative to the part.

    Parts without selected frames are left out.
    """
    begin = 0
    for path, count in zip(recorded.parts, recorded.frame_counts, strict=True):
        own = [index - begin for index in indices if begin <= index < begin + count]
        begin += count
        if own:
            yield path, own


def _drawn(
    workers: WorkerPool,
    shot: _Shot,
    runs: Sequence[tuple[Path, Sequence[int]]],
    *,
    annotate: bool,
) -> Iterator[tuple[Frame, Caption | None]]:
    """Yield the frames of all parts with their captions, or None without captions."""
    tiles = {} if shot.cameras is None else {"cameras": shot.cameras}
    for path, indices in runs:
        frames = workers.frames(path, indices, shot.view, **tiles)
        if annotate:
            with open_for_rendering(path) as reader:
                yield from zip(frames, captions(reader, indices), strict=True)
        else:
            yield from zip(frames, itertools.repeat(None))


def _metadata(recorded: Recorded) -> dict[str, Any]:
    """Return the metadata that describes the recording."""
    first, last = recorded.facts[0], recorded.facts[-1]
    complete = bool(last.get("complete"))
    description = {
        "content_type": "video/mp4",
        **recording_facts(first, recording="deferred"),
        "rendered_with": dict(versions()),
        # Software rasterizers round the way the CPU does.
        "machine": dict(machine_fingerprint()),
        "complete": complete,
        "length": last.get("length", recorded.step_count),
        "reward": last.get("reward", recorded.reward),
    }
    if recorded.is_clip:
        description["first_step"] = (first.get("clip") or {}).get("first_step")
        description["last_episode_id"] = last.get(
            "last_episode_id", last.get("episode_id")
        )
        if any("final_frame" in facts for facts in recorded.facts):
            description["final_frame"] = "missing"
    elif complete:
        description |= {key: last.get(key) for key in ("terminated", "truncated")}
    if not complete:
        # A killed process could not record why it ended.
        description["reason"] = last.get("reason", KILLED)
        if "exception" in last:
            description["exception"] = last["exception"]
    if (broken := last.get("broken_reason")) is not None:
        description |= {"broken_reason": broken, "broken": True}
    return description


def _shots(
    recording: Path, facts: Mapping[str, Any], view: View, out: Path | None
) -> list[_Shot]:
    """Return the videos to render, with the first camera's video last."""
    video = video_facts(facts)
    label = (facts.get("scene") or {}).get("label")
    further = list(video.get("cameras") or ())[1:]
    first = video_path(recording, facts) if out is None else out
    if view.camera is not None:
        return [_Shot(first, view, {"camera": view.camera})]

    def second_name(path: Path) -> dict[str, str]:
        second = None if out is not None else video.get("also_named")
        name = second and second_name_of(path.name, second, first=first.name)
        return {"also_named": name} if name else {}

    if video.get("tiled") and further:
        # None draws the first camera as recorded, which a name alone cannot describe.
        tiles = (None, *map(plain_camera, further))
        rows, columns = grid_shape(len(tiles))
        description = {"camera": [label, *further], "tiled": True, **second_name(first)}
        return [
            _Shot(first, view, {**description, "rows": rows, "columns": columns}, tiles)
        ]
    paths = further_video_paths(recording, facts) if out is None else []
    shots = [
        _Shot(
            path,
            replace(view, camera=camera),
            {"camera": camera, "first_video": first.name, **second_name(path)},
        )
        for path, camera in zip(paths, further, strict=False)
    ]
    description = {"camera": label, **second_name(first)}
    if shots:
        description["further_videos"] = [shot.path.name for shot in shots]
    return [*shots, _Shot(first, view, description)]


def _film(
    path: Path,
    fps: Fraction,
    draw: Callable[[], Iterable[tuple[Frame, Caption | None]]],
    on_frame: Callable[[], object],
) -> VideoSink:
    """Write a video, retrying once if the encoder was killed.

    Returns:
        The sink that wrote the video. The metadata is still missing.
    """
    most = 0
    for is_last in (False, True):
        sink = VideoSink(path, fps=fps)
        try:
            for number, (frame, caption) in enumerate(draw(), 1):
                sink.write(frame, caption)
                if number > most:
                    most = number
                    on_frame()
            sink.finish()
            break
        except BaseException as error:
            # Half a video is useless, because the whole video can be rendered again.
            sink.discard()
            # The encoder was killed, because memory ran out or because it hung.
            is_killed = isinstance(error, EncoderError) and (error.returncode or 0) < 0
            if is_last or not is_killed:
                raise
            logger.warning("Restarting the video %s: %s", path.name, error)
    return sink
