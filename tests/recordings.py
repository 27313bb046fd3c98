# SPDX-License-Identifier: Apache-2.0
"""Reads a monitor's directory, and edits its journal."""

import contextlib
import json
import re

import av

from mjrec.formats.journal import JournalWriter
from mjrec.formats.monitor_directory import infix_of, journal_name
from mjrec.formats.spans import recordings_in_flight


def in_flight(directory):
    """Return the paths of recordings that are only in logs, sorted by name."""
    return sorted(each.path for each in recordings_in_flight(directory))


def manifest_of(directory):
    return _json("openaigym.manifest.*", directory)


def stats_of(directory):
    return _json("openaigym.episode_batch.*", directory)


def journal_of(directory):
    """Return the journal's complete episodes."""
    return [line for line in _lines(directory) if "episode_id" in line]


def events_of(directory, kind):
    """Return the facts of the journal's events of a kind."""
    return [line[kind] for line in _lines(directory) if kind in line]


def edit_journal(directory, index, **values):
    """Change values of a complete episode in the journal."""
    [path] = directory.glob("openaigym.episodes.*")
    lines = path.read_text().splitlines()
    episodes = [n for n, line in enumerate(lines) if '"episode_id"' in line[:14]]
    number = episodes[index]
    lines[number] = json.dumps({**json.loads(lines[number]), **values})
    path.write_text("".join(f"{line}\n" for line in lines))


def _lines(directory):
    [path] = directory.glob("openaigym.episodes.*")
    return [json.loads(line) for line in path.read_text().splitlines()]


def metadata_of(directory, episode):
    return _json(f"*.video{episode:06d}.meta.json", directory)


def frames_in(directory, episode):
    [path] = directory.glob(f"*.video{episode:06d}.mp4")
    return frames_of(path)


def frames_of(path):
    """Decode a video with PyAV, which mjrec does not use."""
    with av.open(str(path)) as container:
        return [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]


def hashes_at(path):
    """Return the SHA-256 of each frame from a framehash file."""
    lines = [line for line in path.read_text().splitlines() if line[:1] != "#"]
    return [line.rpartition(",")[2].strip() for line in lines]


def videos_in(directory):
    """Return the numbers of episodes with a video."""
    names = (path.name for path in directory.glob("openaigym.*.mp4"))
    return sorted(int(re.findall(r"video(\d{6})\.mp4", name)[0]) for name in names)


def _json(pattern, directory):
    [path] = directory.glob(pattern)
    return json.loads(path.read_text())


def add_facts(path, facts):
    """Add facts to a recording in flight, as its monitor does."""
    _add_event(path, "note", {"name": path.name.removesuffix(".h5"), "facts": facts})


def drop(path):
    """Drop a recording in flight, as its monitor does."""
    _add_event(path, "drop", path.name.removesuffix(".h5"))


def _add_event(path, kind, facts):
    """Add an event to the journal of a recording's monitor."""
    journal = path.with_name(journal_name(infix_of(path.name) or ""))
    with contextlib.closing(JournalWriter(journal)) as writer:
        writer.note(kind, facts)
