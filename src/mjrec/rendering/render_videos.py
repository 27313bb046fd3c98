# SPDX-License-Identifier: Apache-2.0
"""Functions that render a directory's pending videos, or rerender episodes."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..annotation import check_annotation
from ..engines.choice import given_engine
from ..errors import InvalidArgument
from ..formats.bundle import trajectories_in
from ..formats.monitor_directory import (
    camera_part,
    is_bundle,
    iter_monitor_files,
    name_part,
    where_recordings_are,
)
from ..formats.spans import is_recorded
from ..machine import check_workers, usable_cpus
from ..simulation.model_trust import trusting_models
from .finish import do_jobs, finish
from .jobs import (
    Progress,
    RecordingKey,
    RenderedVideos,
    Variant,
    VideoJob,
    View,
    key_of,
)
from .recordings import parts_of, recordings

_SHOWN = 20

_OnProgress = Callable[[Progress], object]


def render_videos(
    target: str | os.PathLike[str],
    *,
    episode: int | None = None,
    camera: Any = None,
    height: int | None = None,
    width: int | None = None,
    max_fps: float | Fraction | None = None,
    quality: str | None = None,
    fps: float | Fraction | None = None,
    annotate: bool | None = None,
    out: str | os.PathLike[str] | None = None,
    workers: int | None = None,
    strict: bool = False,
    trust_models: bool = False,
    engine: Executor | str | None = None,
    on_progress: _OnProgress | None = None,
) -> RenderedVideos:
    """Render the pending videos of a directory, or rerender recorded episodes.

    Without options, pending videos are rendered as planned. Several calls, in any
    processes, share the work in a directory. With `camera`, `height`, `width`,
    `max_fps`, `quality`, `fps`, `annotate` or `out`, recorded episodes are rendered
    again to new files next to the originals.

    A failed video does not stop the others, and the result contains the reason. After
    Ctrl-C or another exception, finished videos are kept.

    Args:
        target: a monitor directory, or a trajectory or video in one to select only that
            episode.
        episode: number of the episode. None means all recorded episodes.
        camera: see `mjrec.render`. None means as recorded, here and below.
        height: height in pixels.
        width: width in pixels.
        max_fps: maximum frames per second of simulated time. Every n-th recorded frame
            and the last frame are drawn.
        quality: `"full"` or `"draft"`.
        fps: frames per second of the file. This does not select frames.
        annotate: whether to write the episode, step, time and return on the frames.
        out: the file to write, for one episode. Its suffix chooses the format.
        workers: number of worker processes. None means one per free CPU. If `engine`
            is a name, the number of engine workers.
        strict: whether to list videos that show nothing (black, one color, no movement)
            in `blank`. These videos are kept.
        trust_models: whether to load compiled models from other users or machines. A
            crafted model can run any code. This applies process-wide during the call.
        engine: where to render, if not in this process's workers: an executor, or
            `"local"`, `"ray"` or `"slurm"`. One worker draws each video. All workers
            must see the directory under the same path.
        on_progress: called with the progress after every frame, or with an engine after
            every video.

    Returns:
        The rendered videos, and the reasons for failures.

    Raises:
        InvalidArgument: no such recordings exist, or an argument is invalid.
        MissingDependency: the engine's package, or Pillow for captions, is not
            installed.
        UnreadableFile: a manifest is damaged.
        Error: the engine cannot work.
    """
    variant = Variant(
        view=View(camera=camera, height=height, width=width, quality=quality),
        max_fps=max_fps,
        fps=fps,
        annotate=annotate,
    )
    results = iter_rendered_videos(
        Path(target),
        variant,
        episode=episode,
        out=None if out is None else Path(out),
        workers=workers,
        strict=strict,
        trust_models=trust_models,
        engine=engine,
        on_progress=on_progress,
    )
    path = Path(target)
    return RenderedVideos.joined(results, path if path.is_dir() else path.parent)


def iter_rendered_videos(
    target: Path,
    variant: Variant,
    *,
    episode: int | None = None,
    out: Path | None = None,
    workers: int | None = None,
    strict: bool = False,
    trust_models: bool = False,
    engine: Executor | str | None = None,
    on_progress: _OnProgress | None = None,
) -> Iterator[RenderedVideos]:
    """Work like `render_videos`, but yield each result as soon as it is available.

    Arguments are checked before the iterator is returned.

    Args:
        target: see `render_videos`.
        variant: changes from the recordings. Without any, pending videos are rendered.
        episode: see `render_videos`.
        out: see `render_videos`.
        workers: see `render_videos`.
        strict: see `render_videos`.
        trust_models: see `render_videos`.
        engine: see `render_videos`.
        on_progress: see `render_videos`.

    Raises:
        Error: see `render_videos`.
    """
    check_workers(workers)
    if variant.annotate:
        check_annotation()
    given = given_engine(engine, workers)
    directory, keys = _recordings_of(target, episode)
    on_progress = on_progress or (lambda _: None)
    if variant == Variant() and out is None:
        if not keys and not target.is_dir():
            raise InvalidArgument(
                f"No video of {target.name} is pending: no recording has that name. To "
                "render it again, specify what to change (camera, size, max_fps, "
                "quality, fps, annotate) or where to write it (out, --out)."
            )
        results = finish(
            directory,
            None if target.is_dir() and episode is None else keys,
            workers=workers,
            engine=given,
            strict=strict,
            on_progress=on_progress,
        )
    else:
        jobs = _variant_jobs(target, keys, variant, out, strict=strict)
        results = do_jobs(
            jobs,
            directory,
            workers=workers or usable_cpus(),
            engine=given,
            on_progress=on_progress,
        )
    return _trusting(results) if trust_models else results


def _trusting(results: Iterator[RenderedVideos]) -> Iterator[RenderedVideos]:
    with trusting_models():
        yield from results


def _recordings_of(
    target: Path, episode: int | None
) -> tuple[Path, list[RecordingKey]]:
    """Return the directory, and the episodes and clips in it that were requested.

    Raises:
        InvalidArgument: the target does not exist or has no recordings, or the
            directory lacks the episode.
    """
    if is_bundle(target.name):
        bundled = (key_of(path.name) for path in trajectories_in(target))
        return target.parent, [key for key in bundled if key is not None]
    if not target.exists() and not is_recorded(target):
        raise InvalidArgument(f"{target} does not exist.")
    if not target.is_dir():
        key = key_of(target.name)
        return target.parent, [] if key is None else [key]
    if not any(iter_monitor_files(target)):
        raise InvalidArgument(
            f"{target} contains no recordings. {where_recordings_are(target)}"
        )
    keys = recordings(target)
    if episode is None:
        return target, keys
    chosen = [key for key in keys if key.number == episode and not key.is_clip]
    if not chosen:
        numbers = sorted({key.number for key in keys if not key.is_clip})
        listed = ", ".join(map(str, numbers[:_SHOWN])) or "none"
        raise InvalidArgument(
            f"{target} has no recorded states for episode {episode}. Available: "
            f"{listed}{' ...' * (len(numbers) > _SHOWN)}. Only episodes with a video "
            "keep their states, unless recorded with keep=, trajectory_callable= or "
            'mode="evaluation".'
        )
    return target, chosen


def _variant_jobs(
    target: Path,
    keys: Iterable[RecordingKey],
    variant: Variant,
    out: Path | None,
    *,
    strict: bool,
) -> list[VideoJob]:
    """Return the jobs for rerendering episodes with changes.

    Raises:
        InvalidArgument: there are no trajectories, or `out` is given for several
            episodes or is the name of an original video.
    """
    directory = target if target.is_dir() else target.parent
    if target.suffix == ".h5" and directory != target and not is_bundle(target.name):
        # A trajectory may have any name.
        names = [target.name]
    else:
        episodes = [key for key in keys if not key.is_clip]
        names = [path.name for key in episodes for path in parts_of(directory, key)]
    if not names:
        raise InvalidArgument(
            f"{target} has no recorded states, so it cannot be rendered again."
        )
    if out is not None:
        if len(names) > 1:
            raise InvalidArgument(
                f"{out} is one file, but there are several episodes. Select one."
            )
        # Whatever the suffix, the metadata file would replace the original's.
        name = out.with_suffix(".mp4").name
        key = key_of(name)
        if key is not None and name == key.video_name:
            raise InvalidArgument(
                f"{out} is the name of an episode's original video. Choose a different "
                "name."
            )
    return [
        VideoJob(
            directory=directory,
            recording=name,
            strict=strict,
            variant=variant,
            video=out or directory / name_of_variant(name, variant),
        )
        for name in names
    ]


def name_of_variant(trajectory: str, variant: Variant) -> str:
    """Return the name for a changed version of a trajectory's video.

    The changes are inserted before the extension of the original name, as in
    `openaigym.video.<infix>.video000027.side.1280x720.draft.mp4`. A camera name that
    could be mistaken for one of the other parts gets a prefix, as in `camera-draft`.
    For a camera without a name, a hash of its members is used. Readers of a directory
    never mistake the file for the original, and clearing the directory removes it.
    """
    view, parts = variant.view, []
    if isinstance(view.camera, Mapping):
        members = json.dumps(view.camera, sort_keys=True)
        digest = hashlib.sha256(members.encode()).hexdigest()
        parts.append(f"camera-{digest[:8]}")
    elif view.camera is not None:
        parts.append(camera_part(view.camera))
    if view.width or view.height:
        parts.append(f"{view.width or ''}x{view.height or ''}")
    if view.quality:
        parts.append(view.quality)
    for prefix, rate in (("max", variant.max_fps), ("", variant.fps)):
        if rate is not None:
            parts.append(f"{prefix}{name_part(f'{float(rate):g}')}fps")
    if variant.annotate is not None:
        parts.append("annotated" if variant.annotate else "plain")
    key = key_of(trajectory)
    usual = Path(trajectory if key is None else key.video_name)
    return ".".join([usual.stem, *parts, "mp4"])
