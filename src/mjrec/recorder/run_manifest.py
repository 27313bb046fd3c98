# SPDX-License-Identifier: Apache-2.0
"""The manifest of a run that goes on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..file_digests import file_sha256
from ..formats.manifest import Manifest, write_manifest
from ..provenance import look_around
from .episode_choice import EpisodeChoice
from .episode_videos import EpisodeVideos
from .faults import Faults
from .kept_videos import KeptVideos
from .options import RecorderOptions
from .versions import versions

_FORMAT_VERSION = 1


class RunManifest:
    """Writes down where a run stands, as often as it is told to.

    Args:
        path: of the manifest.
        env_info: what is recorded, as gym's manifests have it.
        options: what was asked for.
        first_episode_id: the number of the run's first episode.
        choice: which episodes get a video.
        kept: which of them are kept, where that is settled later.
        videos: what has become of them.
        faults: what could not be recorded.
    """

    def __init__(
        self,
        path: Path,
        *,
        env_info: dict[str, str],
        options: RecorderOptions,
        first_episode_id: int,
        choice: EpisodeChoice,
        kept: KeptVideos | None,
        videos: EpisodeVideos,
        faults: Faults,
    ) -> None:
        self._path = path
        self._env_info = env_info
        self._first_episode_id = first_episode_id
        self._choice = choice
        self._kept = kept
        self._videos = videos
        self._faults = faults
        self._policy = _policy_facts(options)
        self._surroundings = look_around()

    def write(
        self,
        *,
        stats: Path,
        next_episode_id: int,
        failures: Mapping[str, str],
        is_last: bool,
    ) -> None:
        """Write it, in place of what was written before.

        Args:
            stats: the file with the statistics.
            next_episode_id: the number that the next episode will have.
            failures: why videos could not be rendered, by their names.
            is_last: the run is over; what is still being found out is waited for.

        Raises:
            FileNotWritten: the disk is full; what was there before still is.
        """
        write_manifest(
            self._path,
            Manifest(
                stats=stats.name,
                videos=tuple(self._videos.finished()),
                env_info=self._env_info,
                mjrec=self._details(next_episode_id, failures, is_last=is_last),
            ),
        )

    def _details(
        self, next_episode_id: int, failures: Mapping[str, str], *, is_last: bool
    ) -> dict[str, Any]:
        """Return what gym's manifests do not say."""
        choice, kept = self._choice, self._kept
        # Nobody waits for it in mid-recording.
        around = self._surroundings.found(wait=is_last)
        return {
            "format_version": _FORMAT_VERSION,
            "schedule": {
                "name": choice.schedule_name,
                # It decided about every number from first to next; these got a yes.
                "recorded": choice.scheduled if kept is None else kept.recorded,
            },
            **({} if kept is None else {"keep": kept.details()}),
            "first_episode_id": self._first_episode_id,
            "next_episode_id": next_episode_id,
            "pending": self._videos.pending(failures),
            "broken": self._videos.broken(),
            "faults": self._faults.listed(),
            "versions": dict(versions()),
            "surroundings": None if around is None else {**around, **self._policy},
        }


def _policy_facts(options: RecorderOptions) -> dict[str, Any]:
    if options.policy_file is None:
        return {"policy": None}
    path = Path(options.policy_file).absolute()
    return {"policy": {"file": str(path), "sha256": file_sha256(path)}}
