# SPDX-License-Identifier: Apache-2.0
"""The recorded environment, as the recorder sees it."""

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
    """A source of a run's live frames."""

    def facts(self) -> Mapping[str, Any]:
        """Return the facts about the frames for a video's metadata."""


@dataclass(frozen=True, kw_only=True)
class RecordedEnvironment:
    """The recorded environment, as the recorder sees it.

    Attributes:
        env_id: the environment's name.
        env_index: index of a sub-environment in a vector environment; None for a single
            environment.
        frames: the source of live frames.
        further_frames: sources of live frames from further cameras, keyed by the
            endings of their videos' names.
        clock: returns the simulated time in seconds, or None.
        declared: returns the rate to use without simulated time.
        rendering: when frames are drawn.
        cameras: all cameras, for JSON, if there are several.
        states: captures the states of its simulation; None if no simulation is
            accessible.
        clip_states: a second capture of the same states, for clips. They overlap with
            episodes, and a capture can have only one reader. None without clips.
        environment: the facts needed to recreate it, for the trajectories.
        view: the requested cameras and sizes, and the environment's own view, for JSON;
            defaults are left out.
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
        """The parts of further cameras' video names before the extension."""
        return further_parts(self.cameras) or list(self.further_frames)


def check_frames(env: RecordedEnvironment) -> None:
    """Check that live frames are available.

    Raises:
        NoPictures: the environment gives no frames.
    """
    if can_give_frames(env.frames):
        return
    why = "" if env.rendering.reason is None else f" ({env.rendering.reason})"
    raise NoPictures(
        f"Videos were requested, but {env.env_id} gives no frames{why}: "
        f"{what_is_missing(env.frames)}, or record statistics only with "
        "video_callable=False."
    )


def check_refusal(env: RecordedEnvironment, refusal: str) -> None:
    """Check that videos that cannot be rendered later can be drawn live.

    Args:
        env: the recorded environment.
        refusal: why the videos cannot be rendered later.

    Raises:
        PicturesDiffer: the user requested deferred rendering.
        NoPictures: the videos cannot be drawn live either.
    """
    if env.rendering.is_forced:
        raise PicturesDiffer(
            f"The videos of {env.env_id} cannot be rendered later from recorded "
            f'states, as requested: {refusal}. Use render="live".'
        )
    if not can_give_frames(env.frames):
        raise NoPictures(
            f"The videos of {env.env_id} cannot be rendered from its states: "
            f"{refusal}. They cannot be drawn live either: "
            f"{what_is_missing(env.frames)}."
        )


def what_is_missing(frames: FrameSource) -> str:
    """Return why there are no frames and how to get them."""
    mode = getattr(frames, "render_mode", None)
    return getattr(
        frames,
        "missing",
        f"its render_mode is {mode!r}. Create the environment with "
        'render_mode="rgb_array"',
    )
