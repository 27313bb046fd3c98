# SPDX-License-Identifier: Apache-2.0
"""What the metadata of a recording that was cut off says of its episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..errors import UnreadableFile
from .known_episodes import KnownEpisodes


def how_it_ended(episode_id: int | None, known: KnownEpisodes) -> dict[str, Any] | None:
    """Return what is known of an episode's end; None where it was cut off."""
    facts = facts_of(episode_id, known)
    if "complete" in facts and facts.get("reason") != "killed":
        keys = ("complete", "terminated", "truncated", "reason", "exception")
        return {key: facts[key] for key in keys if key in facts}
    entry = None if episode_id is None else known.entry(episode_id)
    if entry is None:
        return None
    return {
        "complete": True,
        "terminated": entry.terminated,
        "truncated": entry.truncated,
    }


def sums_of(episode_id: int | None, known: KnownEpisodes) -> dict[str, Any]:
    """Return length and reward of the episode, as far as they are known."""
    entry = None if episode_id is None else known.entry(episode_id)
    if entry is not None:
        return {"length": entry.length, "reward": entry.reward}
    facts = facts_of(episode_id, known)
    return {key: facts[key] for key in ("length", "reward") if key in facts}


def facts_of(episode_id: int | None, known: KnownEpisodes) -> Mapping[str, Any]:
    """Return what the episode's trajectory says; nothing where it cannot be read."""
    try:
        return {} if episode_id is None else known.facts(episode_id)
    except UnreadableFile:
        # Its trajectory is damaged, which is told elsewhere.
        return {}
