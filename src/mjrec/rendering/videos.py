# SPDX-License-Identifier: Apache-2.0
"""The videos of a trajectory: its frames, drawn by workers, in a file for each camera.

The frames come in order, whoever drew them, so a file does not depend on the number
of workers. The metadata comes last: where it is, the video is there and whole. The
video of the first camera comes last of all: where it is, all are.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..annotation import Caption, check_annotation
from ..errors import EncoderError, NoPictures, UnreadableFile
from ..formats.monitor_directory import (
    ClipPart,
    Infix,
    clip_video_prefix,
    episode_of,
    infix_of,
    video_prefix,
)
from ..formats.second_names import give_second_names, take_second_names
from ..formats.trajectory import TrajectoryReader, added_up
from ..formats.unfinished_video import VideoFile
from ..formats.video_metadata import StepRuns, timing_facts, write_metadata
from ..formats.video_names import further_parts, second_name_of, with_part
from ..formats.video_sink import VideoSink
from ..frames import Frame, grid_shape
from ..machine import machine_fingerprint
from ..rates import to_rate
from ..recorder.endings import KILLED
from ..recorder.versions import versions
from .captions import Captions
from .pool import WorkerPool
from .recorded_facts import open_for_rendering
from .recorded_pictures import (
    ChosenFrames,
    chosen_frames,
    recorded_rate,
    warn_of_other_pictures,
)
from .views import PlainCamera, View, plain_camera

logger = logging.getLogger(__name__)

# Of an episode that ended before its second step: any is as good.
_RATE_OF_ONE_FRAME = Fraction(30)


@dataclass(frozen=True, kw_only=True)
class _Shot:
    """One video of an episode.

    Attributes:
        path: the file.
        view: how it is drawn.
        cameras: all of them, where they are in one video.
        facts: what its metadata says that others' does not.
    """

    path: Path
    view: View
    cameras: tuple[PlainCamera | None, ...] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Footage:
    """What there is to be drawn.

    Attributes:
        runs: recordings, and the numbers of their pictures that are wanted.
        facts: of the first recording, among them what is said of the video.
        metadata: what the metadata says of whatever was recorded.
        steps: of the pictures.
        stride: the usual number of steps from one picture to the next.
        timestep: simulated seconds of a step, as text, where they are known.
        fps: of the file.
        captions: what is written on the pictures; None where nothing is.
    """

    runs: Sequence[tuple[Path, Sequence[int]]]
    facts: Mapping[str, Any]
    metadata: Mapping[str, Any]
    steps: Sequence[int]
    stride: int
    timestep: str | None
    fps: Fraction
    captions: Iterable[Caption] | None


def render_video(
    trajectory: Path,
    *,
    workers: WorkerPool,
    view: View | None = None,
    max_fps: float | Fraction | None = None,
    fps: float | Fraction | None = None,
    annotate: bool | None = None,
    out: Path | None = None,
    strict: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> VideoFile | None:
    """Render the video of a trajectory, with its frame hashes and its metadata.

    Where several cameras were recorded, so many videos, or one of all side by side. All
    files have temporary names until they are whole. Those that are there are replaced.
    If it fails or is interrupted, nothing is left. An encoder that is killed or hangs
    is given a second try.

    Args:
        trajectory: the file, finished or not.
        workers: who draw.
        view: from where, how large and how well; as recorded, if None. With a camera,
            there is one video, of what that one shows.
        max_fps: the most frames per second of simulated time: frames 0, n, 2n ... of
            those recorded, with the smallest n that fits, and the last.
        fps: frames per second of the file. If None, a second of the video is as much
            simulated time as when the episode was recorded.
        annotate: whether episode, step, time and return are written on the frames; as
            recorded, if None.
        out: the video, of the first camera or of all side by side; what the trajectory
            says, in its own directory, if None.
        strict: whether a video that shows nothing is an error; else it is a warning.
        on_frame: called after every frame, once for each of every video.

    Returns:
        What was written, of the first camera; None where the trajectory says that it
        broke before there was a frame, which the metadata now says.

    Raises:
        NoPictures: it has no frames.
        UnreadableFile: it is damaged.
        MissingDependency: frames are to be written on, and there is no Pillow.
        BlankVideo: `strict`, and a video shows nothing. All are there and stay.
        FileNotWritten: the disk is full.
        Error: its frames cannot be drawn or encoded.
    """
    with open_for_rendering(trajectory) as reader:
        facts = reader.header.facts
        if reader.frame_count == 0:
            if "broken_reason" in facts and facts.get("video"):
                write_that_it_broke(out or video_path(trajectory, facts), _told(reader))
                return None
            raise NoPictures(_why_no_pictures(trajectory, facts))
        warn_of_other_pictures(reader)
        chosen = chosen_frames(reader.frame_count, facts, max_fps)
        footage = Footage(
            runs=[(trajectory, chosen.indices)],
            facts=facts,
            metadata=_told(reader),
            steps=reader.frame_steps[chosen.indices].tolist(),
            stride=facts.get("stride", 1) * chosen.every,
            timestep=facts.get("timestep"),
            fps=usual_fps(facts, chosen) if fps is None else to_rate(fps),
            captions=_captions(reader, chosen, annotate),
        )
    return render_footage(
        footage,
        workers=workers,
        view=view or View(),
        out=out,
        strict=strict,
        on_frame=on_frame,
    )


def render_footage(
    footage: Footage,
    *,
    workers: WorkerPool,
    view: View,
    out: Path | None = None,
    strict: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> VideoFile:
    """Render the video of what was recorded, or the video of each camera.

    See `render_video`, also for what it raises.

    Returns:
        What was written, of the first camera.
    """
    shots = _shots(footage.runs[0][0], footage.facts, view, out)
    if out is None:
        # They would go on leading to what is replaced now.
        take_second_names(shots[-1].path)
    said = {
        **timing_facts(
            StepRuns(footage.steps, stride=footage.stride),
            fps=footage.fps,
            timestep=_fraction(footage.timestep),
            stride=footage.stride,
        ),
        "pictures": "scene",
        "quality": view.quality or _recorded(footage.facts).get("quality", "full"),
    }

    def render(shot: _Shot) -> VideoSink:
        return _render_shot(
            shot,
            footage,
            lambda: _drawn(workers, footage.runs, shot),
            lambda: {**footage.metadata, **said, **shot.facts, **workers.gl_facts},
            on_frame=on_frame,
        )

    videos = _all_or_none(map(render, shots))
    if out is None:
        give_second_names(shots[-1].path)
    _judge(videos, strict=strict)
    assert videos[-1].file is not None
    return videos[-1].file


def further_video_paths(trajectory: Path, facts: Mapping[str, Any]) -> list[Path]:
    """Return where the videos of a trajectory belong, but that of its first camera.

    Raises:
        UnreadableFile: as `video_path`.
    """
    video = _recorded(facts)
    cameras = video.get("cameras") or ()
    if video.get("tiled") or len(cameras) < 2:
        return []
    first = video_path(trajectory, facts)
    return [
        first.with_name(with_part(first.name, part)) for part in further_parts(cameras)
    ]


def video_path(trajectory: Path, facts: Mapping[str, Any]) -> Path:
    """Return where the video of a trajectory, or of a part of a clip, belongs.

    Raises:
        UnreadableFile: the trajectory names none, or one that is not its own.
    """
    name = _recorded(facts).get("name")
    for own in _own_names(trajectory.name, str(name)):
        if name == own:
            return trajectory.with_name(own)
    raise UnreadableFile(
        trajectory,
        f"the video that it names, {name!r:.200}, is not that of its own episode",
    )


def _own_names(recording: str, video: str) -> Iterator[str]:
    """Yield what the video of a recording may be called.

    Args:
        recording: the base name of the file.
        video: the name that it gives. Of a clip it tells in which episode it began.
    """
    clip = ClipPart.parse(recording)
    number = episode_of(video if clip else recording)
    infix = clip.infix if clip else Infix.parse(infix_of(recording) or "")
    if infix is None or number is None:
        return
    yield f"{video_prefix(infix, number)}.mp4"
    if clip is not None:
        yield f"{clip_video_prefix(infix, number, clip.first_step)}.mp4"


def _shots(
    trajectory: Path, facts: Mapping[str, Any], view: View, out: Path | None
) -> list[_Shot]:
    """Return the videos that are to be rendered, the first camera's last."""
    video = _recorded(facts)
    label = (facts.get("scene") or {}).get("label")
    cameras = list(video.get("cameras") or ())
    first = video_path(trajectory, facts) if out is None else out
    if view.camera is not None:
        camera = plain_camera(view.camera)
        return [_Shot(path=first, view=view, facts={"camera": camera})]
    names = {} if out is not None else _second_name(video, first, first)
    if video.get("tiled") and len(cameras) > 1:
        # The first one is as recorded, which is more than its name.
        tiles = (None, *map(plain_camera, cameras[1:]))
        rows, columns = grid_shape(len(tiles))
        said = {
            "camera": [label, *cameras[1:]],
            "tiled": True,
            "rows": rows,
            "columns": columns,
            **names,
        }
        return [_Shot(path=first, view=view, cameras=tiles, facts=said)]
    paths = further_video_paths(trajectory, facts) if out is None else []
    further = [
        _Shot(
            path=path,
            view=replace(view, camera=plain_camera(camera)),
            facts={
                "camera": camera,
                "first_video": first.name,
                **_second_name(video, path, first),
            },
        )
        for path, camera in zip(paths, cameras[1:], strict=False)
    ]
    said = {"camera": label, **names}
    if further:
        said["further_videos"] = [shot.path.name for shot in further]
    return [*further, _Shot(path=first, view=view, facts=said)]


def _second_name(video: Mapping[str, Any], path: Path, first: Path) -> dict[str, str]:
    second = video.get("also_named")
    name = second and second_name_of(path.name, second, first=first.name)
    return {"also_named": name} if name else {}


def _captions(
    reader: TrajectoryReader, chosen: ChosenFrames, annotate: bool | None
) -> Captions | None:
    """Return what is to be written on the frames; None where nothing is."""
    if annotate is None:
        annotate = is_annotated(reader.header.facts)
    if not annotate:
        return None
    check_annotation()
    return Captions(reader, chosen.indices)


def is_annotated(facts: Mapping[str, Any]) -> bool:
    """Tell whether something was to be written on the pictures."""
    return bool(_recorded(facts).get("annotate", False))


def _drawn(
    workers: WorkerPool,
    runs: Sequence[tuple[Path, Sequence[int]]],
    shot: _Shot,
) -> Iterable[Frame]:
    """Return the pictures of all runs; the first is drawn before this returns."""
    drawn = (_run(workers, *run, shot) for run in runs)
    return itertools.chain(next(drawn), itertools.chain.from_iterable(drawn))


def _run(
    workers: WorkerPool, trajectory: Path, indices: Sequence[int], shot: _Shot
) -> Iterable[Frame]:
    if shot.cameras is None:
        return workers.frames(trajectory, indices, shot.view)
    return workers.frames(trajectory, indices, shot.view, cameras=shot.cameras)


def _all_or_none(videos: Iterable[VideoSink]) -> list[VideoSink]:
    """Return the videos as they come; after a failure none of them stays."""
    written: list[VideoSink] = []
    try:
        for video in videos:
            written.append(video)
    except BaseException:
        for video in written:
            video.discard()
        raise
    return written


def _judge(videos: Iterable[VideoSink], *, strict: bool) -> None:
    """Warn of those that show nothing; with `strict` the first of them is an error."""
    suspects = [video for video in videos if video.blank.suspicion() is not None]
    for video in suspects[1:] if strict else suspects:
        video.blank.judge(video.path, strict=False)
    for video in suspects[:1] if strict else ():
        video.blank.judge(video.path, strict=True)


def usual_fps(facts: Mapping[str, Any], chosen: ChosenFrames) -> Fraction:
    """Return the rate at which a second of the file is as long as when recorded."""
    asked = _recorded(facts).get("fps")
    rate = recorded_rate(facts) if asked is None else Fraction(asked)
    return (_RATE_OF_ONE_FRAME if rate is None else rate) / chosen.every


def _render_shot(
    shot: _Shot,
    footage: Footage,
    draw: Callable[[], Iterable[Frame]],
    metadata: Callable[[], Mapping[str, Any]],
    *,
    on_frame: Callable[[], object],
) -> VideoSink:
    """Write a video, a second time where the encoder was ended from outside.

    Args:
        shot: the video.
        footage: what is drawn.
        draw: draws it.
        metadata: returns what is known of it, once it is drawn.
        on_frame: called after every frame, once for each.
    """
    most = 0

    def film() -> VideoSink:
        nonlocal most
        sink = VideoSink(shot.path, fps=footage.fps)
        try:
            # As many captions as frames, or none at all.
            captions: Iterable[Caption | None]
            captions = footage.captions or itertools.repeat(None)
            frames = zip(draw(), captions, strict=False)
            for number, (frame, caption) in enumerate(frames, 1):
                sink.write(frame, caption)
                if number > most:
                    most = number
                    on_frame()
            sink.finish()
            sink.describe(metadata())
        except BaseException:
            # Half a video is of no use: all of it can be rendered again.
            sink.discard()
            raise
        return sink

    try:
        return film()
    except EncoderError as error:
        # Killed, by whoever lacked memory, or for hanging.
        if (error.returncode or 0) >= 0:
            raise
        logger.warning("The video %s is begun anew: %s", shot.path.name, error)
    return film()


def _told(reader: TrajectoryReader) -> dict[str, Any]:
    """Return what the metadata says of the episode."""
    facts = reader.header.facts
    so_far = {"length": reader.step_count, "reward": added_up(reader.rewards)}
    over = {key: facts.get(key) for key in ("terminated", "truncated")}
    return {
        **known_facts(facts),
        **(over if facts.get("complete") else {}),
        **ending_facts(facts, so_far),
        **_selection(facts),
        **what_broke(facts),
    }


def known_facts(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the metadata says that was known when the recording began."""
    keys = ("episode_id", "type", "env_id", "seed", "options", "versions")
    return {
        "content_type": "video/mp4",
        **{key: facts.get(key) for key in keys},
        "recording": "deferred",
        "rendered_with": dict(versions()),
        # Software rasterisers round as their CPU does.
        "machine": dict(machine_fingerprint()),
    }


def ending_facts(facts: Mapping[str, Any], so_far: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the metadata says of the end.

    Args:
        facts: of the recording, or of its last part.
        so_far: `length` and `reward`, where nobody could say them.
    """
    complete = bool(facts.get("complete"))
    ending = {key: facts.get(key, so_far[key]) for key in so_far}
    if not complete:
        # Whoever was killed could not say why it ended.
        ending["reason"] = facts.get("reason", KILLED)
        if "exception" in facts:
            ending["exception"] = facts["exception"]
    return {"complete": complete, **ending}


def _selection(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return by which rule the episode was chosen, where it was after its end."""
    selection = _recorded(facts).get("selection")
    return {} if selection is None else {"selection": selection}


def what_broke(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the metadata says where a recording ended early by an error."""
    reason = facts.get("broken_reason")
    return {} if reason is None else {"broken_reason": reason, "broken": True}


def _recorded(facts: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a trajectory says of its video; nothing where it has none."""
    video: Mapping[str, Any] = facts.get("video") or {}
    return video


def write_that_it_broke(video: Path, metadata: Mapping[str, Any]) -> None:
    """Write the metadata of a video that there will never be."""
    write_metadata(video, {**metadata, "empty": True, "broken": True})


def _why_no_pictures(trajectory: Path, facts: Mapping[str, Any]) -> str:
    refusal = facts.get("refusal")
    why = f": {refusal}" if refusal else ""
    return f"{trajectory} holds states, and nothing that pictures can be made of{why}."


def _fraction(text: Any) -> Fraction | None:
    return None if text is None else Fraction(text)
