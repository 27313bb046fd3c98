# SPDX-License-Identifier: Apache-2.0
"""What became of something that was to be rendered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self


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
        return cls(
            **{
                **said,
                "directory": Path(said["directory"]),
                "further_videos": tuple(said["further_videos"]),
            }
        )
