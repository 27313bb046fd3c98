# SPDX-License-Identifier: Apache-2.0
"""Rendering recorded episodes again, another way, beside the originals."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

from ..errors import BlankVideo, Error, GLError, InvalidArgument
from ..formats.video_names import camera_part, name_part
from ..rates import to_rate
from .outcomes import Outcome
from .pending import EpisodeKey
from .pool import WorkerPool
from .progress import Progress
from .recorded_facts import open_for_rendering
from .recorded_pictures import chosen_frames
from .videos import further_video_paths, render_video
from .views import PlainCamera, View, plain_camera

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What is to be other than recorded; None is as recorded.

    Attributes:
        view: from where, how large and how well it is drawn.
        max_fps: the most frames per second of simulated time.
        fps: frames per second of the file.
        annotate: whether episode, step, time and return are written on the frames.

    Raises:
        InvalidArgument: one is no rate.
    """

    view: View = field(default_factory=View)
    max_fps: float | Fraction | None = None
    fps: float | Fraction | None = None
    annotate: bool | None = None

    def __post_init__(self) -> None:
        for rate in (self.max_fps, self.fps):
            if rate is not None:
                to_rate(rate)

    def name_for(self, trajectory: Path) -> str:
        """Return the name of the video that shows an episode this way.

        It is the original's with what is other before its extension, such as
        `openaigym.video.<infix>.video000027.side.1280x720.draft.mp4`. A camera whose
        name could be another of these parts is there as `camera-draft`, and one that
        has none by a hash of its members. Readers of a directory never take it for the
        original, and those who clear the directory remove it too.
        """
        view = self.view
        size = "x".join(str(side or "") for side in (view.width, view.height))
        parts = (
            "" if view.camera is None else _camera_name(view.camera),
            "" if size == "x" else size,
            view.quality or "",
            "" if self.max_fps is None else f"max{_rate_name(self.max_fps)}fps",
            "" if self.fps is None else f"{_rate_name(self.fps)}fps",
            {None: "", True: "annotated", False: "plain"}[self.annotate],
        )
        key = EpisodeKey.of(trajectory.name)
        stem = trajectory.stem if key is None else Path(key.video_name).stem
        return ".".join([stem, *filter(None, parts), "mp4"])

    def as_json(self) -> dict[str, Any]:
        """Return what JSON can hold, for `from_json` in another process."""
        return {
            "view": self.view.as_json(),
            "max_fps": _plain_rate(self.max_fps),
            "fps": _plain_rate(self.fps),
            "annotate": self.annotate,
        }

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> Self:
        """Return what another process of ours said with `as_json`."""
        rates = {name: _rate_of(said[name]) for name in ("max_fps", "fps")}
        return cls(view=View(**said["view"]), annotate=said["annotate"], **rates)


def render_again(
    trajectories: Iterable[Path],
    variant: Variant,
    *,
    workers: int,
    out: Path | None = None,
    strict: bool = False,
    on_progress: Callable[[Progress], object] = lambda _: None,
) -> Iterator[Outcome]:
    """Render recorded episodes another way, and yield what became of each.

    Neither the originals nor the manifests change. A video of an earlier call with the
    same variant is replaced. Of an episode that was recorded with several cameras,
    each with a video of its own, and without one in the variant, the first is drawn.

    Args:
        trajectories: of the episodes.
        variant: what is to be other.
        workers: how many processes draw.
        out: the video, where there is one trajectory only; `Variant.name_for` beside
            each trajectory, if None.
        strict: whether a video that shows nothing is a failure, though it is there.
        on_progress: called after every frame, and when a video is over.

    Raises:
        InvalidArgument: nothing would be other, `out` is the name of an original, or
            stands for several.
    """
    paths = list(trajectories)
    outs = videos_of_variant(paths, variant, out)
    counts = [_frame_count(path, variant) for path in paths]
    now = Progress(videos=len(paths), frames=sum(counts))

    def count_frame() -> None:
        nonlocal now
        now = replace(now, frames_done=now.frames_done + 1)
        on_progress(now)

    gl_failure: str | None = None
    with WorkerPool(workers) as pool:
        for place, (trajectory, video) in enumerate(zip(paths, outs, strict=True), 1):
            outcome = Outcome(
                name=video.name, directory=video.parent, failure=gl_failure
            )
            # Where nothing can be drawn, each would take as long to find that out.
            if gl_failure is None:
                try:
                    outcome = render_one_again(
                        trajectory,
                        variant,
                        video,
                        workers=pool,
                        strict=strict,
                        on_frame=count_frame,
                    )
                except GLError as error:
                    gl_failure = str(error)
                    outcome = replace(outcome, failure=gl_failure)
            # Also the frames that were not drawn: nobody waits for them any more.
            now = replace(now, videos_done=place, frames_done=sum(counts[:place]))
            on_progress(now)
            yield outcome


def videos_of_variant(
    trajectories: Sequence[Path], variant: Variant, out: Path | None
) -> list[Path]:
    """Return the videos that `render_again` would write.

    Args:
        trajectories: of the episodes.
        variant: what is to be other.
        out: as of `render_again`.

    Raises:
        InvalidArgument: as `render_again`.
    """
    alone = len(trajectories) == 1
    return [_out_for(path, variant, out, alone=alone) for path in trajectories]


def render_one_again(
    trajectory: Path,
    variant: Variant,
    video: Path,
    *,
    workers: WorkerPool,
    strict: bool,
    on_frame: Callable[[], object] = lambda: None,
) -> Outcome:
    """Render one recorded episode another way, and return what became of it.

    Args:
        trajectory: of the episode.
        variant: what is to be other.
        video: what is written, as `videos_of_variant` says.
        workers: who draws.
        strict: as of `render_again`.
        on_frame: called after every frame.

    Raises:
        GLError: nothing can be drawn here.
    """
    outcome = Outcome(name=video.name, directory=video.parent)
    try:
        _check_is_no_original(trajectory, video)
        file = render_video(
            trajectory,
            workers=workers,
            view=variant.view,
            max_fps=variant.max_fps,
            fps=variant.fps,
            annotate=variant.annotate,
            out=video,
            strict=strict,
            on_frame=on_frame,
        )
    except BlankVideo as error:
        return replace(
            outcome,
            is_video=True,
            frame_count=error.frame_count,
            failure=str(error),
            blank_video=error.path.name,
        )
    except GLError:
        raise
    except (Error, OSError) as error:
        return replace(outcome, failure=str(error))
    except Exception as error:
        logger.exception("%s cannot be rendered.", trajectory.name)
        return replace(outcome, failure=f"{type(error).__name__}: {error}")
    frame_count = 0 if file is None else file.frame_count
    return replace(outcome, is_video=True, frame_count=frame_count)


def _out_for(
    trajectory: Path, variant: Variant, out: Path | None, *, alone: bool
) -> Path:
    if out is None:
        if variant == Variant():
            raise InvalidArgument(
                f"The video of {trajectory.name} would be as the original. Say what is "
                "to be other (camera, size, quality, max_fps, fps, annotate), or where "
                "to write it."
            )
        return trajectory.with_name(variant.name_for(trajectory))
    if not alone:
        raise InvalidArgument(
            f"{out} is one file, and several episodes were asked for: choose one."
        )
    # By whatever ending: the metadata would have the original's name.
    name = out.with_suffix(".mp4").name
    key = EpisodeKey.of(name)
    if key is not None and name == key.video_name:
        raise InvalidArgument(
            f"{out} is the name of a recorded video, which shows what its recording "
            "saw. Choose another name."
        )
    return out


def _check_is_no_original(trajectory: Path, video: Path) -> None:
    """Raise an error if a video would replace one of a further camera.

    Raises:
        InvalidArgument: it would.
    """
    if video.parent.resolve() != trajectory.parent.resolve():
        return
    with open_for_rendering(trajectory) as reader:
        facts = reader.header.facts
        originals = further_video_paths(trajectory, facts) if facts.get("video") else []
    if video.with_suffix(".mp4").name in {path.name for path in originals}:
        raise InvalidArgument(
            f"{video.name} is a recorded video: this camera was recorded too. If it is "
            "not there yet, render what is pending; else say what is to be other "
            "besides the camera, or where to write it."
        )


def _frame_count(trajectory: Path, variant: Variant) -> int:
    try:
        with open_for_rendering(trajectory) as reader:
            facts = reader.header.facts
            chosen = chosen_frames(reader.frame_count, facts, variant.max_fps)
            return len(chosen.indices)
    except Error:
        # It is told when its turn comes.
        return 0


def _camera_name(camera: PlainCamera) -> str:
    if not isinstance(camera, Mapping):
        return camera_part(camera)
    members = json.dumps(plain_camera(camera), sort_keys=True)
    return f"camera-{hashlib.sha256(members.encode()).hexdigest()[:8]}"


def _plain_rate(rate: float | Fraction | None) -> str | None:
    # As a text it stays exact.
    return rate if rate is None else str(to_rate(rate))


def _rate_of(said: str | None) -> Fraction | None:
    return said if said is None else Fraction(said)


def _rate_name(rate: float | Fraction) -> str:
    return name_part(f"{float(rate):g}")
