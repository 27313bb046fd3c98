# SPDX-License-Identifier: Apache-2.0
"""Write result files of monitors by hand."""

from mjrec.formats.journal import JournalEntry, JournalWriter
from mjrec.formats.manifest import Manifest, StatsFile, write_manifest, write_stats_file

ENV_INFO = {"gym_version": "mjrec-1", "env_id": "(unknown:Corridor)"}


def entry(episode_id, **facts):
    """Return a journal entry whose values are derived from its number."""
    defaults = {
        "length": 10 + episode_id,
        "reward": float(episode_id),
        "type": "t",
        "start_time": 99.5 + episode_id,
        "end_time": 100.0 + episode_id,
        "seed": episode_id,
        "options": None,
        "terminated": True,
        "truncated": False,
    }
    return JournalEntry(episode_id, **{**defaults, **facts})


def write_journal(directory, infix, *episodes, **options):
    """Write a journal from entries or episode numbers."""
    path = directory / f"openaigym.episodes.{infix}.jsonl"
    writer = JournalWriter(path, **options)
    for each in episodes:
        writer.append(entry(each) if isinstance(each, int) else each)
    writer.close()
    return path


def stats_of(*episodes, start=98.0, types=""):
    """Return the statistics of the episodes with these numbers."""
    entries = [entry(number) for number in episodes]
    return StatsFile(
        initial_reset_timestamp=start,
        timestamps=tuple(each.end_time for each in entries),
        episode_lengths=tuple(each.length for each in entries),
        episode_rewards=tuple(each.reward for each in entries),
        episode_types=None if types is None else tuple(types or "t" * len(entries)),
    )


def write_saved(directory, infix, *episodes, stats=None, **options):
    """Write a statistics file and its manifest."""
    env_info, details = options.pop("env_info", ENV_INFO), options.pop("details", None)
    videos = tuple(options.pop("videos", ()))
    name = f"openaigym.episode_batch.{infix}.stats.json"
    write_stats_file(directory / name, stats or stats_of(*episodes, **options))
    path = directory / f"openaigym.manifest.{infix}.manifest.json"
    write_manifest(path, Manifest(name, videos, env_info, details))
    return path
