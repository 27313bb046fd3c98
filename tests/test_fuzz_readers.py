# SPDX-License-Identifier: Apache-2.0
"""Test that readers of damaged files return valid content or name the bad file.

Hypothesis derives the damage, which is the same in each run.
"""

import contextlib
import copy
import itertools
import json
import os
import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from result_files import entry, write_journal, write_saved
from trajectories_by_hand import INFIX, write_log
from trajectory_contents import content_of

from mjrec import UnreadableFile
from mjrec.formats.journal import JournalWriter, read_journal
from mjrec.formats.manifest import (
    read_manifest,
    read_stats_file,
    write_manifest,
    write_stats_file,
)
from mjrec.formats.monitor_directory import journal_name, log_name, trajectory_prefix
from mjrec.formats.row_log import TAIL_HEAD
from mjrec.formats.trajectory import ModelChange
from mjrec.formats.trajectory_file import open_trajectory
from mjrec.formats.trajectory_log import pack_change
from mjrec.formats.video_metadata import is_broken
from mjrec.json_text import dumps, loads
from mjrec.rendering.recorded_facts import open_for_rendering
from mjrec.results.manifest_writing import update_manifests

FEW = settings(
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=200,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


# These values have broken readers before, so each is tried in every place.
BAD_VALUES = [
    *(None, True, 0, 5, -1, 0.5, 10**400, 2**64, -(2**63), 1e308, float("inf")),
    *("", "5", "..", "../x", "a/b", "\ud800", "a" * 300, "1e999999999"),
    *([], {}, [5], [None], ["../x"], [[]], {"a": 1}, [{}], [{"video": 5}]),
]


def variants(value):
    """Yield variants of `value` with a part removed or replaced by a bad value."""
    if isinstance(value, dict | list):
        for key in [*value] if isinstance(value, dict) else range(len(value)):
            changed = copy.copy(value)
            for inner in variants(value[key]):
                changed[key] = inner
                yield copy.copy(changed)
            del changed[key]
            yield changed
    yield from BAD_VALUES


def write_valid(directory):
    """Write a valid manifest, statistics, a journal line and metadata."""
    pending = [{"episode_id": 2, "trajectory": "t", "video": "c.mp4"}]
    details = {"next_episode_id": 3, "pending": pending, "broken": ["d.meta.json"]}
    videos = [(f"{name}.mp4", f"{name}.meta.json") for name in "ab"]
    write_saved(directory, "0.7", 0, 1, types="te", videos=videos, details=details)
    write_journal(directory, "0.7", entry(0, options={"a": [1]}))
    metadata = {"broken": True, "frame_steps": [[0, 3]], "episode_id": 2}
    path = directory / "openaigym.video.0.7.video000000.meta.json"
    path.write_text(json.dumps(metadata))


def check_manifest(path):
    """Check that a manifest can be rewritten and names only local files."""
    manifest = read_manifest(path)
    names = [manifest.stats, *(name for pair in manifest.videos for name in pair)]
    assert all((path.parent / name).parent == path.parent for name in names)
    assert all(len(os.fsencode(name)) <= 255 for name in names)
    write_manifest(path, manifest)
    # An update uses more of the manifest than reading it checks.
    update_manifests(path.parent)


def check_statistics(path):
    stats = read_stats_file(path)
    write_stats_file(path, stats)
    assert read_stats_file(path).episode_lengths == stats.episode_lengths


def check_journal(path):
    with contextlib.closing(JournalWriter(path.with_name("again"))) as writer:
        for each in read_journal(path):
            writer.append(each)


def check_metadata(path):
    assert is_broken(path) in (True, False)


@pytest.mark.parametrize(
    ("pattern", "check"),
    [
        ("*.manifest.json", check_manifest),
        ("*.stats.json", check_statistics),
        ("*.jsonl", check_journal),
        ("*.meta.json", check_metadata),
    ],
)
def test_json_files_with_one_bad_value(tmp_path, pattern, check):
    valid = tmp_path / "valid"
    valid.mkdir()
    write_valid(valid)
    [file] = valid.glob(pattern)
    path = tmp_path / file.name
    for value in variants(json.loads(file.read_text())):
        path.write_text(json.dumps(value))
        try:
            check(path)
        except UnreadableFile as error:
            check_refusal(error, path)


def check_refusal(error, path):
    assert error.path == path
    assert len(str(error)) < 2000 + len(str(path))


@pytest.mark.parametrize(
    "value",
    [{1: "a", "1": "b"}, {"a": [{None: 1, "null": 2}]}, {np.int64(3): 1, "3": 4}],
)
def test_keys_with_equal_text_are_written_as_repr(value):
    assert "repr" in dumps(value)
    assert dumps(loads(dumps(value))) == dumps(value)


NAME = trajectory_prefix(INFIX, 0)
JOURNAL, LOG = journal_name(INFIX), log_name(INFIX, 0)
LOOKS, TAIL = LOG.replace(".log", ".looks"), LOG.replace(".log", ".tail")

DAMAGE = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True),
        st.sampled_from(["flip", "set", "number", "cut", "insert", "copy"]),
        st.integers(0, 255),
        st.sampled_from([0, 1, -1, 2**31, 2**32, 2**40, 2**63 - 1, -(2**63)]),
    ),
    min_size=1,
    max_size=4,
)


def apply_damage(data, damage):
    for place, what, byte, number in damage:
        if not data:
            break
        at = int(place * len(data))
        eighth = at - at % 8
        data = {
            "flip": data[:at] + bytes([data[at] ^ 1 << byte % 8]) + data[at + 1 :],
            "set": data[:at] + bytes([byte]) + data[at + 1 :],
            "number": data[:eighth] + struct.pack("<q", number) + data[eighth + 8 :],
            "cut": data[:at],
            "insert": data[:at] + bytes([byte] * 8) + data[at:],
            "copy": data[:at] + data[: len(data[at : at + 16])] + data[at + 16 :],
        }[what]
    return data


@pytest.fixture(scope="module")
def valid_log(tmp_path_factory):
    """Return the contents of a recording's files by name."""
    directory = tmp_path_factory.mktemp("log")
    write_log(directory)
    packed = pack_change(1, ModelChange(step=1, fields={"geom_rgba": np.ones((2, 2))}))
    (directory / LOOKS).write_bytes(packed)
    return {name: (directory / name).read_bytes() for name in (JOURNAL, LOG, LOOKS)}


_numbers = itertools.count()


def read_log(tmp_path, files):
    """Return the content, or None after an error that names one of the files."""
    directory = tmp_path / str(next(_numbers))
    directory.mkdir()
    for name, content in files.items():
        (directory / name).write_bytes(content)
    path = directory / f"{NAME}.h5"
    try:
        with open_trajectory(path) as reader:
            content = content_of(reader)
        with contextlib.suppress(UnreadableFile):
            open_for_rendering(path).close()
        return content
    except UnreadableFile as error:
        check_refusal(error, directory / error.path.name)
    return None


@pytest.mark.parametrize("number", range(4))
def test_journal_lines_with_one_bad_value(tmp_path, valid_log, number):
    lines = valid_log[JOURNAL].splitlines()
    assert len(lines) == 4
    for value in variants(json.loads(lines[number])):
        changed = [*lines[:number], json.dumps(value).encode(), *lines[number + 1 :]]
        content = b"".join(line + b"\n" for line in changed)
        read_log(tmp_path, {**valid_log, JOURNAL: content})


@FEW
@given(part=st.sampled_from([JOURNAL, LOG, LOOKS]), damage=DAMAGE)
def test_damaged_log_files(tmp_path, valid_log, part, damage):
    content = apply_damage(valid_log[part], damage)
    found = read_log(tmp_path, {**valid_log, part: content})
    if found is not None:
        assert len(found.states) <= 5
        assert len(found.rewards) == max(0, len(found.states) - 1)
        assert np.isin(found.frame_steps, np.arange(len(found.states))).all()
        assert (np.diff(found.frame_steps) > 0).all()
        assert part == LOG or (found.rewards == 0.5).all()


@FEW
@given(damage=DAMAGE, written=st.integers(0, 4))
def test_damaged_tail(tmp_path, valid_log, damage, written):
    """Rows in the tail are read as long as their numbers are consecutive."""
    rows = valid_log[LOG]
    size = len(rows) // 5
    head = struct.pack("=QQQ", 5, size // 8, 5)
    # The head is short, so aim half of the damage at it.
    placed = [(p / 20 if p < 0.5 else p, *rest) for p, *rest in damage]
    tail = apply_damage(head + rows, placed)
    tail = tail[:24].ljust(TAIL_HEAD, b"\0") + tail[24:]
    files = {**valid_log, LOG: rows[: written * size], TAIL: tail}
    found = read_log(tmp_path, files)
    assert found is None or written <= len(found.states) <= 5
