# SPDX-License-Identifier: Apache-2.0
"""How far a rendering is. Here, because monitors load nothing else that renders."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a rendering is.

    Attributes:
        videos_done: how many videos are over, also as failures.
        videos: how many there are, as far as is known.
        frames_done: how many frames of these videos are drawn.
        frames: how many frames these videos have; None where they were not counted:
            the frames of a video that an engine's worker draws are known when it is
            over.
    """

    videos_done: int = 0
    videos: int = 0
    frames_done: int = 0
    frames: int | None = 0
