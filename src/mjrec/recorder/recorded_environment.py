# SPDX-License-Identifier: Apache-2.0
"""What is recorded, as far as a recorder knows it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Protocol

from ..errors import NoPictures, PicturesDiffer
from ..formats.monitor_directory import further_parts
from .options import RenderingChoice
from .video_recorder import FrameSource, can_give_frames

if TYPE_CHECKING:
    from ..simulation.capture import Capture


class EpisodeFrames(FrameSource, Protocol):
    """Where the live frames of a run come from."""

    def facts(self) -> Mapping[str, Any]:
        """Return what the metadata of a video says about its frames."""


@dataclass(frozen=True, kw_only=True)
class RecordedEnvironment:
    """What is recorded, as far as a recorder knows it.

    Attributes:
        env_id: the environment's name.
        env_index: which sub-environment of a vector environment it is; None for an
            environment of its own.
        frames: where live frames come from.
        further_frames: from further cameras, by what the names of their videos have
            in the end.
        clock: returns the simulated time in seconds, or None.
        declared: returns the rate to take where there is no simulated time.
        rendering: when frames are drawn.
        cameras: all of them, for JSON, where there are several.
        states: of its simulation; None where there is none that can be seen.
        clip_states: the same once more, for videos that are counted in steps: they
            run beside episodes, and a source has one reader only. None where there
            are no such videos.
        environment: what it can be made from again, for the trajectories.
        view: the cameras and sizes that were asked for, and how the environment is
            shown by itself, for JSON; what is not said is the default.
        random_state: returns the state of its random generator, for JSON, or None.
    """

    env_id: str
    frames: EpisodeFrames
    clock: Callable[[], float | None]
    declared: Callable[[], Fraction]
    rendering: RenderingChoice
    env_index: int | None = None
    further_frames: Mapping[str, EpisodeFrames] = field(default_factory=dict)
    cameras: tuple[Any, ...] = ()
    states: Capture | None = None
    clip_states: Capture | None = None
    environment: Mapping[str, Any] | None = None
    view: Mapping[str, Any] = field(default_factory=dict)
    random_state: Callable[[], Any] = lambda: None

    @property
    def further_views(self) -> list[str]:
        """What the names of further cameras' videos have before their ending."""
        return further_parts(self.cameras) or list(self.further_frames)


def check_frames(env: RecordedEnvironment) -> None:
    """Check that live frames can be had.

    Raises:
        NoPictures: they cannot.
    """
    if can_give_frames(env.frames):
        return
    why = "" if env.rendering.reason is None else f" ({env.rendering.reason})"
    raise NoPictures(
        f"Videos were asked for, and {env.env_id} gives no frames{why}: "
        f"{what_is_missing(env.frames)}, or record statistics only with "
        "video_callable=False."
    )


def check_refusal(env: RecordedEnvironment, refusal: str) -> None:
    """Check that videos can be drawn live that cannot be rendered later.

    Args:
        env: what is recorded.
        refusal: why they cannot be rendered later.

    Raises:
        PicturesDiffer: nothing else was asked for.
        NoPictures: they cannot be drawn live either.
    """
    if env.rendering.is_forced:
        raise PicturesDiffer(
            f"The videos of {env.env_id} were to be rendered later, from recorded "
            f'states, and cannot be: {refusal}. Use render="live".'
        )
    if not can_give_frames(env.frames):
        raise NoPictures(
            f"The videos of {env.env_id} cannot be rendered from its states: "
            f"{refusal}. They cannot be drawn live either: "
            f"{what_is_missing(env.frames)}."
        )


def what_is_missing(frames: FrameSource) -> str:
    """Return why there are no frames, and what would help."""
    mode = getattr(frames, "render_mode", None)
    return getattr(
        frames,
        "missing",
        f"its render_mode is {mode!r}. Make the environment with "
        'render_mode="rgb_array"',
    )
