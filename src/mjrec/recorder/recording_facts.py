# SPDX-License-Identifier: Apache-2.0
"""What logs and metadata say of an episode besides what was recorded of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ..machine import machine_fingerprint
from .begun_episode import BegunEpisode
from .options import LIVE
from .subject import Subject
from .versions import versions

if TYPE_CHECKING:
    from ..simulation.capture import EpisodeStart


@dataclass(frozen=True, kw_only=True)
class RecordingFacts:
    """What is said of every episode of a run.

    Attributes:
        infix: what the names of the monitor's files have in the middle.
        subject: what is recorded.
        selection: `selection` of a video that is chosen after its episode's end; empty
            where it is chosen before.
    """

    infix: str
    subject: Subject
    selection: Mapping[str, Any] = field(default_factory=dict)

    def of_log(
        self, episode: BegunEpisode, start: EpisodeStart | None
    ) -> dict[str, Any]:
        """Return what any log of states says.

        Args:
            episode: of which it is.
            start: of the states; None where there are none.
        """
        return {
            "episode_id": episode.episode_id,
            "infix": self.infix,
            "env_id": self.subject.env_id,
            "type": episode.type,
            "start_time": episode.start_time,
            "seed": episode.seed,
            "options": episode.options,
            "environment": self.subject.environment,
            "versions": dict(versions()),
            "machine": dict(machine_fingerprint()),
            "model": None if start is None else start.model,
            "scene": None if start is None else start.scene,
            "refusal": None if start is None else start.refusal,
        }

    def of_trajectory(
        self,
        episode: BegunEpisode,
        start: EpisodeStart | None,
        *,
        video: Mapping[str, Any] | None,
        is_kept: bool,
    ) -> dict[str, Any]:
        """Return what the log of a whole episode says.

        Args:
            episode: of which it is.
            start: of the states; None where there are none.
            video: what is promised of its video; None where it gets none.
            is_kept: it stays when the video is there.
        """
        return {
            **self.of_log(episode, start),
            "random_state": episode.random_state,
            "kept": is_kept,
            "video": video,
            **({"candidate": video is not None} if self.selection else {}),
        }

    def of_live_video(self, episode: BegunEpisode) -> dict[str, Any]:
        """Return what the metadata of a video says that is drawn as it goes."""
        reason = self.subject.rendering.reason
        return {
            "episode_id": episode.episode_id,
            **({} if reason is None else {"recording_reason": reason}),
            "type": episode.type,
            "env_id": self.subject.env_id,
            "seed": episode.seed,
            "options": episode.options,
            "recording": LIVE,
            "versions": dict(versions()),
            "machine": dict(machine_fingerprint()),
            **({"selection": self.selection} if self.selection else {}),
        }
