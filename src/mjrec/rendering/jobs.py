# SPDX-License-Identifier: Apache-2.0
"""What is to be rendered and what became of it, in plain data.

A job is about one recording, and the same wherever it is done: in this process, in the
one beside a simulation, by a worker of an engine. It can be done twice, also by two at
once: the second finds nothing left to do, or puts the same file in its place.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

from ..formats.video_names import camera_part, name_part
from ..rates import to_rate
from .recordings import RecordingKey, key_of
from .views import View


@dataclass(frozen=True, kw_only=True)
class Variant:
    """What is to be other than recorded; None is as recorded.

    Attributes:
        view: from where, how large and how well it is drawn.
        max_fps: the most frames per second of simulated time: frames 0, n, 2n ... of
            those recorded, with the smallest n that fits, and the last.
        fps: frames per second of the file. If None, a second of the video is as much
            simulated time as when the episode was recorded.
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

    def name_for(self, trajectory: str) -> str:
        """Return the name of the video that shows a trajectory this way.

        It is the original's with what is other before its extension, such as
        `openaigym.video.<infix>.video000027.side.1280x720.draft.mp4`. A camera whose
        name could be another of these parts is there as `camera-draft`, and one that
        has none by a hash of its members. Readers of a directory never take it for the
        original, and those who clear the directory remove it too.
        """
        view, parts = self.view, []
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
        for prefix, rate in (("max", self.max_fps), ("", self.fps)):
            if rate is not None:
                parts.append(f"{prefix}{name_part(f'{float(rate):g}')}fps")
        if self.annotate is not None:
            parts.append("annotated" if self.annotate else "plain")
        key = key_of(trajectory)
        usual = Path(trajectory if key is None else key.video_name)
        return ".".join([usual.stem, *parts, "mp4"])


@dataclass(frozen=True, kw_only=True)
class VideoJob:
    """One recording that is to be rendered.

    Attributes:
        directory: where it is.
        recording: the name of one of its files; with a variant, of its trajectory.
        strict: whether a video that shows nothing is a failure.
        variant: what is to be other, for a video beside the original; None finishes
            what is pending.
        video: the video with a variant.
    """

    directory: Path
    recording: str
    strict: bool = False
    variant: Variant | None = None
    video: Path | None = None

    @classmethod
    def finishing(
        cls, directory: Path, key: RecordingKey, *, strict: bool = False
    ) -> Self:
        """Return the job that finishes what is pending of a recording."""
        return cls(directory=directory, recording=key.told_name, strict=strict)

    @property
    def name(self) -> str:
        """What tells it from other jobs: the path of what it makes, as far as known."""
        return str(self.video or self.directory / self.recording)

    @property
    def key(self) -> RecordingKey:
        """Which recording it finishes."""
        key = key_of(self.recording)
        assert key is not None
        return key

    @property
    def nothing(self) -> Outcome:
        """What became of it as long as nothing did."""
        if self.video is not None:
            return Outcome(name=self.video.name, directory=self.video.parent)
        return Outcome(name=self.key.told_name, directory=self.directory)

    def as_json(self) -> dict[str, Any]:
        """Return what JSON can hold, for `from_json` in another process."""
        variant = self.variant and {
            "view": self.variant.view.as_json(),
            # As texts they stay exact.
            "max_fps": self.variant.max_fps and str(to_rate(self.variant.max_fps)),
            "fps": self.variant.fps and str(to_rate(self.variant.fps)),
            "annotate": self.variant.annotate,
        }
        return {
            "directory": str(self.directory.absolute()),
            "recording": self.recording,
            "strict": self.strict,
            "variant": variant,
            "video": self.video and str(self.video.absolute()),
        }

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> Self:
        """Return what another process of ours said with `as_json`."""
        variant = said["variant"] and Variant(
            view=View(**said["variant"]["view"]),
            max_fps=said["variant"]["max_fps"] and Fraction(said["variant"]["max_fps"]),
            fps=said["variant"]["fps"] and Fraction(said["variant"]["fps"]),
            annotate=said["variant"]["annotate"],
        )
        return cls(
            directory=Path(said["directory"]),
            recording=said["recording"],
            strict=said["strict"],
            variant=variant,
            video=said["video"] and Path(said["video"]),
        )


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a video, or of a trajectory where no video was wanted.

    Attributes:
        name: of the file.
        directory: where it is, or was to be.
        is_video: a video was rendered.
        frame_count: how many frames it has, and each of the further ones.
        further_videos: the names of those that were rendered with it, of further
            cameras.
        blank_video: the name of the one that shows nothing, where that is the failure.
        failure: why it could not be done; None where it was, or needed nothing. Of a
            video that was rendered: that it shows nothing.
        is_elsewhere: another process is at it.
    """

    name: str
    directory: Path
    is_video: bool = False
    frame_count: int = 0
    failure: str | None = None
    is_elsewhere: bool = False
    further_videos: tuple[str, ...] = ()
    blank_video: str | None = None

    @property
    def is_trajectory(self) -> bool:
        """Whether no video was wanted: a trajectory got its final form."""
        return not (self.is_video or self.is_elsewhere or self.failure is not None)

    def as_json(self) -> dict[str, Any]:
        """Return what JSON can hold, for `from_json` in another process."""
        return {**asdict(self), "directory": str(self.directory)}

    @classmethod
    def from_json(cls, said: Mapping[str, Any]) -> Self:
        """Return what another process of ours said with `as_json`."""
        paths = {"directory": Path(said["directory"])}
        return cls(**{**said, **paths, "further_videos": tuple(said["further_videos"])})
