# SPDX-License-Identifier: Apache-2.0
"""By which rule a dead monitor was choosing its videos, after the episodes' ends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ..errors import UnreadableFile
from ..formats.json_fields import read_object
from .known_episodes import KnownEpisodes
from .remains import Remains


def choice_of(
    remains: Remains, known: KnownEpisodes, old_details: Mapping[str, Any]
) -> Mapping[str, Any] | None:
    """Return what a manifest says under `keep`; None where no rule is known.

    Who was killed had not decided: then what is there are candidates. `chosen` are
    those of which it was known for good.

    Args:
        remains: the monitor's files.
        known: what they say of its episodes.
        old_details: of the manifest that is there.
    """
    said = old_details.get("keep")
    old = said if isinstance(said, Mapping) else {}
    is_final = old.get("decided") is True or "failure" in old
    if is_final or old.get("left_open") is True:
        return old
    found = dict(_selections(remains, known))
    rule = old.get("rule") or next((s.get("rule") for s in found.values()), None)
    if rule is None:
        return None
    return {
        "rule": rule,
        "decided": False,
        "chosen": sorted(n for n, s in found.items() if s.get("decided") is True),
        "finished": None,
        "most_bytes_held": None,
    }


def _selections(
    remains: Remains, known: KnownEpisodes
) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """Yield numbers of episodes, and what is said of how each was chosen."""
    for episode_id in remains.files.trajectories:
        try:
            promise = known.facts(episode_id).get("video") or {}
        except UnreadableFile:
            continue
        if isinstance(selection := promise.get("selection"), Mapping):
            yield episode_id, selection
    for episode_id, metadata in remains.files.metadata.items():
        try:
            selection = read_object(metadata).get("selection")
        except (OSError, ValueError):
            continue
        if isinstance(selection, Mapping):
            yield episode_id, selection
