# SPDX-License-Identifier: Apache-2.0
"""The videos of one recording: its frames, drawn by workers, in a file for each camera.

The frames come in order, whichever worker drew them, so a file does not depend on the
number of workers. The metadata comes last: where it is, the video is there and whole.
The video of the first camera comes last of all: where it is, all are.
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
from ..formats.journal import KILLED
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
from .jobs import RenderedVideos
from .pool import WorkerPool
from .recorded_facts import (
    ChosenFrames,
    captions,
    further_video_paths,
    open_for_rendering,
    usual_fps,
    video_facts,
    video_path,
    warn_of_other_frames,
)
from .recordings import Recorded, read_recording
from .views import PlainCamera, Variant, View, plain_camera

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Shot:
    """One of the videos of a recording.

    Attributes:
        path: the file.
        view: how it is drawn.
        facts: what its metadata says that others' does not.
        cameras: all of them, where they are in one video.
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
    """Render the video of a recording, with its frame hashes and its metadata.

    Where several cameras were recorded, a video of each, or one of all side by side.
    All files have temporary names until they are whole. Those that are there are
    replaced. If it fails or is interrupted, nothing is left. An encoder that is killed
    or hangs is given a second try.

    Args:
        parts: the trajectory of an episode, finished or not; or the parts of a clip.
        variant: what is to be other than recorded. With a camera, there is one video,
            of what that one shows.
        workers: draw the frames.
        out: the video, of the first camera or of all side by side; as the recording
            says, beside it, if None.
        strict: whether a video that shows nothing is among the `blank` of the result;
            else it is a warning.
        on_frame: called after every frame, once for each of every video.

    Returns:
        The videos; none, and the name of the trajectory, where the recording broke
        before there was a frame, which the metadata now says.

    Raises:
        NoPictures: it has no frames.
        UnreadableFile: it is damaged.
        MissingDependency: frames are to be written on, and there is no Pillow.
        FileNotWritten: the disk is full.
        Error: its frames cannot be drawn or encoded.
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
    rate = _fps(recorded, chosen) if variant.fps is None else to_rate(variant.fps)
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
        # They would go on leading to what is replaced now.
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
    """Write the metadata of a video that there will never be.

    Raises:
        NoPictures: nothing says that there will not.
    """
    path, facts = recorded.parts[0], recorded.facts[0]
    reason = facts.get("broken_reason")
    if recorded.is_clip:
        reason = "the process was killed before its first frame"
    if reason is None or out is not None or not video_facts(facts):
        refusal = facts.get("refusal")
        why = f": {refusal}" if refusal else ""
        raise NoPictures(
            f"{path} holds states, and nothing that frames can be made of{why}."
        )
    broken = {"broken_reason": reason, "empty": True, "broken": True}
    write_metadata(video_path(path, facts), {**_metadata(recorded), **broken})


def _runs(
    recorded: Recorded, indices: Sequence[int]
) -> Iterator[tuple[Path, list[int]]]:
    """Yield the parts, each with the numbers of those of its frames that are wanted."""
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
    """Yield the frames of all parts, with what is written on them."""
    tiles = {} if shot.cameras is None else {"cameras": shot.cameras}
    for path, indices in runs:
        frames = workers.frames(path, indices, shot.view, **tiles)
        if annotate:
            with open_for_rendering(path) as reader:
                yield from zip(frames, captions(reader, indices), strict=True)
        else:
            yield from zip(frames, itertools.repeat(None))


def _fps(recorded: Recorded, chosen: ChosenFrames) -> Fraction:
    asked = video_facts(recorded.facts[0]).get("fps")
    if recorded.is_clip and asked is not None:
        # All frames are recorded: `max_fps` has no part in the rate that was asked for.
        return Fraction(asked)
    return usual_fps(recorded.timing, chosen)


def _metadata(recorded: Recorded) -> dict[str, Any]:
    """Return what the metadata says of what was recorded."""
    first, last = recorded.facts[0], recorded.facts[-1]
    complete = bool(last.get("complete"))
    description = {
        "content_type": "video/mp4",
        **recording_facts(first, recording="deferred"),
        "rendered_with": dict(versions()),
        # Software rasterisers round as their CPU does.
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
        # A process that was killed could not say why it ended.
        description["reason"] = last.get("reason", KILLED)
        if "exception" in last:
            description["exception"] = last["exception"]
    if (broken := last.get("broken_reason")) is not None:
        description |= {"broken_reason": broken, "broken": True}
    return description


def _shots(
    recording: Path, facts: Mapping[str, Any], view: View, out: Path | None
) -> list[_Shot]:
    """Return the videos that are to be rendered, the first camera's last."""
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
        # The first one is as recorded, which is more than its name.
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
    """Write a video, a second time where the encoder was ended from outside.

    Returns:
        What has written it; its metadata is still missing.
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
            # Half a video is of no use: all of it can be rendered again.
            sink.discard()
            # Killed, for lack of memory or for hanging.
            is_killed = isinstance(error, EncoderError) and (error.returncode or 0) < 0
            if is_last or not is_killed:
                raise
            logger.warning("The video %s is begun anew: %s", path.name, error)
    return sink
