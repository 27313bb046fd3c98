# SPDX-License-Identifier: Apache-2.0
"""Many trajectories of one monitor in one file, each called as if it had its own."""

import json

import h5py
import pytest
from evaluated_files import datasets_in
from full_disk import file_size_limit
from random_rows import INFIX, check, write
from trajectories_by_hand import new_logs
from trajectory_contents import content_of

import mjrec
from mjrec.errors import FileNotWritten, InvalidArgument, UnreadableFile
from mjrec.formats import trajectory_file
from mjrec.formats.bundle import (
    bundle_of,
    file_of,
    finished_trajectories,
    is_finished,
    trajectories_in,
)
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.spans import recordings_in_flight
from mjrec.results.monitor_files import monitors_of


def record(directory, *episodes):
    """Record episodes of as many steps as their number says, the last one killed."""
    directory.mkdir(exist_ok=True)
    logs = new_logs(directory, INFIX)
    for episode in episodes:
        span = write(logs, episode, episode=episode)
        if episode != episodes[-1]:
            span.end({"complete": True, "length": episode})
    logs.close()
    return [logs.path_of(trajectory_prefix(INFIX, episode)) for episode in episodes]


def content(path):
    with trajectory_file.open_trajectory(path) as reader:
        return content_of(reader)


def test_a_bundle_holds_what_files_would_hold(tmp_path):
    """Dataset by dataset; strangers read it with h5py."""
    numbers = (3, 4, 5, 9, 12)
    apart, together = (record(tmp_path / name, *numbers) for name in "ab")
    assert trajectory_file.bundle_trajectories(together) == {}
    bundle = bundle_of(together[0])
    assert not list(bundle.parent.glob("openaigym.states.*"))
    for number, single, bundled in zip(numbers, apart, together, strict=True):
        trajectory_file.finish_trajectory(single)
        assert is_finished(bundled)
        assert file_of(bundled) == bundle
        assert datasets_in(bundled) == datasets_in(single)
        assert content(bundled).facts == content(single).facts
        check(content(bundled), number)
    assert content(together[-1]).facts["reason"] == "killed"
    with h5py.File(bundle) as file:
        assert sorted(file) == [f"episode{number:06d}" for number in numbers]
        assert file["episode000009/states"]["qpos"].shape == (10, 2)
    with bundle.open("rb") as raw:
        assert json.loads(raw.readline())["episodes"] == [[3, 5], [9, 9], [12, 12]]


def test_more_come_into_a_bundle_and_facts_change(tmp_path):
    """What was there is as before, bit for bit; on a full disk the log stays."""
    paths = record(tmp_path, 20, 300, 301)
    assert trajectory_file.bundle_trajectories(paths[:1]) == {}
    bundle = bundle_of(paths[0])
    assert [each.path for each in recordings_in_flight(tmp_path)] == paths[1:]
    first, before = datasets_in(paths[0]), bundle.read_bytes()
    with file_size_limit(len(before)):
        failures = trajectory_file.bundle_trajectories(paths)
    assert [type(error) for error in failures.values()] == [FileNotWritten] * 2
    assert bundle.read_bytes() == before
    check(content(paths[1]), 300)
    assert trajectory_file.bundle_trajectories(paths) == {}
    assert recordings_in_flight(tmp_path) == []
    trajectory_file.amend_trajectories(
        {path: lambda facts: {**facts, "new": 1} for path in paths[1:]}
    )
    assert datasets_in(paths[0]) == first
    assert ["new" in content(path).facts for path in paths] == [False, True, True]
    for number, path in zip((20, 300, 301), paths, strict=True):
        check(content(path), number)


def test_a_directory_lists_what_lies_in_bundles(tmp_path):
    """Beside files of their own; a bundle itself is none, and says what it holds."""
    own, *others = record(tmp_path, 1, 2, 3)
    trajectory_file.finish_trajectory(own)
    trajectory_file.bundle_trajectories([own, *others])
    bundle = bundle_of(own)
    assert trajectories_in(bundle) == others
    assert list(finished_trajectories(tmp_path)) == [own, *others]
    [files] = monitors_of(tmp_path)
    assert files.trajectories == dict(enumerate([own, *others], start=1))
    assert files.last_episode_id == 3
    assert len(mjrec.load_trajectory(others[0])) == 2
    with pytest.raises(InvalidArgument, match=r"is a bundle.*episode000002\.h5"):
        mjrec.load_trajectory(bundle)
    with pytest.raises(UnreadableFile, match="No such file"):
        mjrec.load_trajectory(own.with_name(f"{trajectory_prefix(INFIX, 4)}.h5"))


@pytest.mark.parametrize(
    ("said", "episodes"),
    [
        ("mjrec trajectories", "[[0, 9999999]]"),
        ("mjrec trajectories", "[[5, 4]]"),
        ("mjrec trajectories", "[[1, 1], [1, 1]]"),
        ("mjrec trajectories", "[[1]]"),
        ("another", "[[1, 1]]"),
        (None, "\x89HDF\r\n\x1a"),
        (None, ""),
    ],
)
def test_an_index_that_lies_names_no_episode(tmp_path, said, episodes):
    """One without episodes takes no memory, and no group leads elsewhere."""
    [path] = record(tmp_path, 1)
    index = f'{{"format": "{said}", "version": 1, "episodes": {episodes}}}'
    bundle_of(path).write_bytes((index if said else episodes).encode("latin-1") + b"\n")
    assert not is_finished(path)
    assert trajectories_in(bundle_of(path)) == []
    check(content(path), 1)
    bundle_of(path).unlink()
    trajectory_file.bundle_trajectories([path])
    with h5py.File(bundle_of(path), "r+") as file:
        del file["episode000001"]
        file["episode000001"] = h5py.ExternalLink("elsewhere.h5", "/")
    with pytest.raises(UnreadableFile, match=r"episode000001.* of its own"):
        trajectory_file.open_trajectory(path)


@pytest.mark.parametrize("is_written", [False, True])
def test_what_a_killed_monitor_left_comes_into_its_bundle(
    tmp_path, monkeypatch, is_written
):
    """Also where it was killed after the bundle was there, before its logs were."""
    paths = record(tmp_path, 4, 5)
    if is_written:
        with monkeypatch.context() as patched:
            patched.setattr(trajectory_file, "remove_if_done", lambda _: None)
            assert trajectory_file.bundle_trajectories(paths) == {}
        assert recordings_in_flight(tmp_path) == []
    assert any("states" in path.name for path in tmp_path.iterdir())
    recovery = mjrec.recover(tmp_path, bundle=True)
    assert not recovery.failures
    said = [file.what for file in recovery.files if "trajectory" in file.name]
    assert said == ([] if is_written else ["4 steps", "5 steps, incomplete: killed"])
    assert not any("states" in path.name for path in tmp_path.iterdir())
    assert not any(path.is_file() for path in paths)
    assert [len(mjrec.load_trajectory(path)) for path in paths] == [4, 5]
    assert not mjrec.recover(tmp_path, bundle=True)
