# SPDX-License-Identifier: Apache-2.0
"""Reads what a monitor wrote, with nothing of mjrec."""

import contextlib
import json
import re

import av

from mjrec.formats.journal import JournalWriter
from mjrec.formats.monitor_directory import infix_of, journal_name
from mjrec.formats.spans import recordings_in_flight


def in_flight(directory):
    """Return what recordings that only logs have are called, sorted by name."""
    return sorted(each.path for each in recordings_in_flight(directory))


def manifest_of(directory):
    return _json("openaigym.manifest.*", directory)


def stats_of(directory):
    return _json("openaigym.episode_batch.*", directory)


def journal_of(directory):
    """Return the complete episodes that the journal has."""
    return [line for line in _lines(directory) if "episode_id" in line]


def events_of(directory, kind):
    """Return the facts of the journal's other events of a kind."""
    return [line[kind] for line in _lines(directory) if kind in line]


def edit_journal(directory, index, **values):
    """Change what the journal says of a complete episode."""
    [path] = directory.glob("openaigym.episodes.*")
    lines = path.read_text().splitlines()
    of_episodes = [n for n, line in enumerate(lines) if '"episode_id"' in line[:14]]
    number = of_episodes[index]
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
    """Decode a video, with another decoder than the one that wrote it."""
    with av.open(str(path)) as container:
        return [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]


def hashes_at(path):
    """Return the SHA-256 of each frame, as a framehash file says them."""
    lines = [line for line in path.read_text().splitlines() if line[:1] != "#"]
    return [line.rpartition(",")[2].strip() for line in lines]


def videos_in(directory):
    """Return the numbers of the episodes that have a video."""
    names = (path.name for path in directory.glob("openaigym.*.mp4"))
    return sorted(int(re.findall(r"video(\d{6})\.mp4", name)[0]) for name in names)


def _json(pattern, directory):
    [path] = directory.glob(pattern)
    return json.loads(path.read_text())


def add_facts(path, facts):
    """Add to the facts of a recording in flight, as its monitor does."""
    say(path, "note", {"name": path.name.removesuffix(".h5"), "facts": facts})


def drop(path):
    """Give up a recording in flight, as its monitor does."""
    say(path, "drop", path.name.removesuffix(".h5"))


def say(path, kind, facts):
    """Add an event to the journal of the monitor that a recording is of."""
    journal = path.with_name(journal_name(infix_of(path.name) or ""))
    with contextlib.closing(JournalWriter(journal)) as writer:
        writer.note(kind, facts)
