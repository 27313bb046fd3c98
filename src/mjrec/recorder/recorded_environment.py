# SPDX-License-Identifier: Apache-2.0
"""The recorder's interface to the recorded environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Protocol

from ..errors import NoPictures, PicturesDiffer
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
        env_index: index of the sub-environment in a vector environment; None for a
            single environment.
        frames: the source of live frames.
        further_frames: sources of live frames from additional cameras, keyed by the
            endings of the video names.
        clock: a function that returns the simulated time in seconds, or None.
        declared: a function that returns the frame rate to use if there is no simulated
            time.
        rendering: the choice of when frames are drawn.
        cameras: all cameras as JSON values, if there are several cameras.
        states: captures the simulation's states; None if no simulation is accessible.
        clip_states: a second capture of the same states for clips; None without clips.
            It is needed because clips overlap with episodes and a capture can have only
            one reader.
        environment: the facts needed to recreate the environment, which are stored in
            trajectories.
        view: the requested cameras and sizes, and the environment's own view, as JSON
            values. Defaults are left out.
        random_state: a function that returns the state of the environment's random
            number generator as JSON values, or None.
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


def check_frames(env: RecordedEnvironment) -> None:
    """Check that live frames are available.

    Raises:
        NoPictures: the environment does not provide frames.
    """
    if can_give_frames(env.frames):
        return
    why = "" if env.rendering.reason is None else f" ({env.rendering.reason})"
    raise NoPictures(
        f"Videos were requested, but {env.env_id} provides no frames{why}: "
        f"{_what_is_missing(env)}, or record only statistics with "
        "video_callable=False."
    )


def check_refusal(env: RecordedEnvironment, refusal: str) -> None:
    """Check that videos that cannot be rendered later can be drawn live.

    Args:
        env: the recorded environment.
        refusal: the reason why the videos cannot be rendered later.

    Raises:
        PicturesDiffer: the user requested deferred rendering.
        NoPictures: the videos cannot be drawn live either.
    """
    if env.rendering.is_forced:
        raise PicturesDiffer(
            f"The videos of {env.env_id} cannot be rendered later from recorded "
            f'states, as you requested: {refusal}. Use render="live".'
        )
    if not can_give_frames(env.frames):
        raise NoPictures(
            f"The videos of {env.env_id} cannot be rendered from its states: "
            f"{refusal}. They cannot be drawn live either: "
            f"{_what_is_missing(env)}."
        )


def _what_is_missing(env: RecordedEnvironment) -> str:
    mode = getattr(env.frames, "render_mode", None)
    otherwise = f"its render_mode is {mode!r}. Create the environment with "
    return getattr(env.frames, "missing", f'{otherwise}render_mode="rgb_array"')
