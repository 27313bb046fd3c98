# SPDX-License-Identifier: Apache-2.0
"""Beginning videos that are counted in steps: rendered later where that can be."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..formats.span_writer import SpanLogs
from ..simulation.state_source import EpisodeStart
from .clips import Clip
from .deferred_clip import ClipLogs, DeferredClip
from .ended_trajectories import EndedTrajectories
from .episode_videos import EpisodeVideos
from .live_videos import LiveClip, LiveVideoMaker
from .options import DEFERRED, LIVE
from .subject import Subject
from .trajectory_recorder import Pace
from .video_promises import VideoPromises
from .video_recorder import VideoRecorder


class ClipMaker:
    """Makes what records the clips of a run.

    Args:
        subject: what is recorded.
        promises: where videos will be, and what is said of them.
        live: makes what records those that are drawn at once.
        pace: how simulated time becomes frames.
        episode_facts: returns what is known of the running episode, for the header of
            a log that begins now.
        before: returns what was before that moment in the episode.
        can_be_deferred: tells whether what begins so can be rendered later.
        tolerates: tells whether to go on after an error.
        note: writes down one that is over.
        videos: watches for their videos.
        ended: takes over the recordings of those that are over.
        logs: where clips are recorded.
    """

    def __init__(
        self,
        *,
        subject: Subject,
        promises: VideoPromises,
        live: LiveVideoMaker,
        pace: Pace,
        episode_facts: Callable[[EpisodeStart], Mapping[str, Any]],
        before: Callable[[], Mapping[str, Any]],
        can_be_deferred: Callable[[EpisodeStart], bool],
        tolerates: Callable[[Exception], bool],
        note: Callable[[Mapping[str, Any]], object],
        videos: EpisodeVideos,
        ended: EndedTrajectories,
        logs: SpanLogs,
    ) -> None:
        self._promises = promises
        self._live = live
        self._can_be_deferred = can_be_deferred
        self._tolerates = tolerates
        self._note_clip = note
        self._videos = videos
        self._ended = ended
        self._logs: ClipLogs | None = None
        if subject.clip_states is not None and subject.rendering.mode == DEFERRED:
            self._logs = ClipLogs(
                logs=logs,
                infix=promises.infix,
                states=subject.clip_states,
                pace=pace,
                facts=episode_facts,
                before=before,
                tolerates=tolerates,
                on_end=self._add_deferred,
            )

    def make(self, steps: int | None, *, episode_id: int, total_steps: int) -> Clip:
        """Return what records a clip that begins now.

        Args:
            steps: how many were taken when a step began it; None where it begins with
                an episode.
            episode_id: of the running episode.
            total_steps: how many were taken in any case.
        """
        path = self._promises.clip_path(episode_id, steps)
        named = ("episode", episode_id) if steps is None else ("step", steps)
        second_name = self._promises.second_name(*named)
        if self._logs is not None:
            start = self._logs.states.begin_episode()
            if self._can_be_deferred(start):
                promise = self._promises.of_video(path, DEFERRED)
                return DeferredClip(
                    self._logs,
                    start,
                    first_step=total_steps,
                    episode_id=episode_id,
                    video=path.with_name(f"{path.name}.mp4"),
                    facts={"kept": False, "video": {**promise, **second_name}},
                )
        recorders = self._live.at(path, second_name=second_name)
        for recorder in recorders:
            recorder.metadata.update(first_step=total_steps, last_episode_id=episode_id)
        return LiveClip(
            recorders,
            on_end=self._add_live,
            tolerates=self._tolerates,
        )

    def _add_live(self, recorders: Sequence[VideoRecorder]) -> None:
        first = recorders[0]
        if first.path is not None:
            facts = {"episode_id": first.metadata["episode_id"], "recording": LIVE}
            self._note(Path(first.path), facts)

    def _add_deferred(self, clip: DeferredClip) -> None:
        facts = {"episode_id": clip.episode_id, "clip": clip.first_part.name}
        self._note(clip.video, facts)
        self._ended.add_clip(clip.first_part)

    def _note(self, video: Path, facts: Mapping[str, Any]) -> None:
        self._note_clip({**facts, "video": video.name})
        self._videos.expect(video)
