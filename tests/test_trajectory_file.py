# SPDX-License-Identifier: Apache-2.0
"""Finished trajectories, alone or bundled, have the content of their log."""

import json
import math
import re
import signal
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
from evaluated_files import datasets_in
from full_disk import file_size_limit
from random_rows import DTYPE, FACTS, INFIX, NAME, SNAPSHOT, STATE, check, write
from trajectories_by_hand import new_logs
from trajectory_contents import content_of

import mjrec
from mjrec.errors import FileNotWritten, InvalidArgument, UnreadableFile
from mjrec.formats import trajectory_file, trajectory_hdf5
from mjrec.formats.bundle import (
    bundle_of,
    file_of,
    finished_trajectories,
    is_finished,
    trajectories_in,
)
from mjrec.formats.monitor_directory import trajectory_prefix
from mjrec.formats.spans import log_paths, recordings_in_flight
from mjrec.formats.trajectory import ModelChange, added_up, packed, row_dtype
from mjrec.formats.trajectory_file import (
    amend_trajectories,
    bundle_trajectories,
    finish_trajectory,
    open_trajectory,
)
from mjrec.results.monitor_files import monitors_of

CHANGES = (
    ModelChange(
        step=0,
        fields={
            "geom_rgba": np.arange(8, dtype=np.float32).reshape(2, 4),
            "opt.timestep": np.array(0.002),
            "hfield_data": np.empty((0, 3), np.float32),
        },
    ),
    ModelChange(step=1, fields={"site_pos": np.array([[1.0, np.nan, 3.0]])}),
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / f"{NAME}.h5"


def names(directory):
    """Return the names of finished files."""
    files = [path.name for path in directory.iterdir() if path.suffix != ".jsonl"]
    return [name for name in files if ".states." not in name]


def record(path, steps=40, *, ended=True, **more):
    """Record an episode whose model changes in its first step."""
    logs = new_logs(path.parent, INFIX)
    span = write(logs, -1, **more)
    for change in CHANGES:
        span.log.add_change(change)
        write(logs, min(change.step, steps), first=change.step, span=span, **more)
    write(logs, steps, first=2, span=span, **more)
    if ended:
        span.end({"complete": True, "length": steps})
    logs.close()


def read(path):
    with open_trajectory(path) as reader:
        return content_of(reader)


def check_changes(content):
    assert [each.step for each in content.model_changes] == [0, 1]
    for change, expected in zip(content.model_changes, CHANGES, strict=True):
        assert sorted(change.fields) == sorted(expected.fields)
        for name, values in expected.fields.items():
            np.testing.assert_array_equal(change.fields[name], values, strict=True)


@pytest.mark.parametrize(
    ("steps", "every", "dtype"),
    [
        (40, 2, DTYPE),
        (0, 1, DTYPE),
        (700, 1, DTYPE),  # Each dataset has several chunks.
        (3, 2, row_dtype()),
        (3, 2, row_dtype(state=STATE, action=np.dtype("<i8"))),
        (3, 2, row_dtype(action=np.dtype(("<f8", (0,))))),
        (3, 2, row_dtype(snapshot=SNAPSHOT)),
    ],
)
def test_finished_file_equals_its_log(path, steps, every, dtype):
    """NaN payloads are kept, and unrecorded arrays are absent."""
    facts = {**FACTS, "long": "x" * 10**5}
    record(path, steps, every=every, dtype=dtype, facts=facts)
    assert finish_trajectory(path) == path
    assert not list(path.parent.glob("*.states.*"))
    assert names(path.parent) == [path.name]
    content = read(path)
    check(content, steps, every=every, dtype=dtype)
    assert content.facts == {**facts, "complete": True, "length": steps}
    if steps:
        check_changes(content)


def test_killed_episode_records_its_reason(path):
    for steps in (-1, 12):
        record(path, steps, ended=False)
        content = read(finish_trajectory(path))
        total = added_up([step / 3 for step in range(1, steps + 1)])
        facts = {"reason": "killed", "length": max(steps, 0), "reward": total}
        assert content.facts == {**FACTS, "complete": False, **facts}
        assert len(content.states) == steps + 1
        path.unlink()
    # The monitor adds up step by step, unlike `sum` since Python 3.12.
    assert added_up([1e16, 1.0, -1e16]) == 0.0
    assert math.copysign(1, added_up([-0.0])) == 1


def test_h5py_reads_every_array_by_name(path):
    """The file uses HDF5 1.10's format and only built-in filters."""
    record(path)
    content = read(path)
    finish_trajectory(path)
    # HDF5 refuses to open one file in two different ways in one process.
    with open_trajectory(path), h5py.File(path) as file, open_trajectory(path):
        assert set(file) == {
            *("states", "actions", "rewards", "terminated", "truncated"),
            *("observations", "frame_steps", "snapshots", "model_changes"),
        }
        for name in ("actions", "rewards", "truncated", "frame_steps", "observations"):
            assert file[name][()].tobytes() == getattr(content, name).tobytes()
        assert file["states"]["qpos"].tobytes() == content.states[:, :2].tobytes()
        for name in SNAPSHOT.names or ():
            values = content.snapshots[name]
            assert file["snapshots"][name].tobytes() == values.tobytes()
        assert file["model_changes/1"].attrs["step"] == 1
        assert file["model_changes/0/opt.timestep"][()] == 0.002
        for dataset in (file["states"], file["snapshots"], file["actions"]):
            properties = dataset.id.get_create_plist()
            count = properties.get_nfilters()
            filters = [properties.get_filter(i)[0] for i in range(count)]
            assert filters == [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]
    assert path.read_bytes()[8] == 3  # This is the superblock version of HDF5 1.10.


def test_examples_of_the_trajectory_reference_run(path, monkeypatch, capsys):
    record(path)
    finish_trajectory(path).rename(path.with_name("episode.h5"))
    docs = Path(__file__).parents[1] / "docs"
    text = (docs / "reference" / "trajectories.md").read_text()
    single, bundled = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(path.parent)
    exec(compile(single, "trajectories.md", "exec"), {})
    assert "E-v0" in capsys.readouterr().out
    record(path)
    bundle_trajectories([path])
    bundle_of(path).rename(path.with_name("episodes.h5"))
    exec(compile(bundled, "trajectories.md", "exec"), {})
    assert capsys.readouterr().out == "episode000027 7 (41, 2)\n"


def test_recording_finished_during_opening_is_read(path, monkeypatch):
    """An open reader keeps its log."""
    real = trajectory_file.open_recording

    def open_late(name):
        monkeypatch.undo()
        finish_trajectory(name)
        return real(name)

    for use in (open_trajectory, lambda name: open_trajectory(finish_trajectory(name))):
        record(path)
        with open_trajectory(path) as before:
            monkeypatch.setattr(trajectory_file, "open_recording", open_late)
            with use(path) as reader:
                assert not list(path.parent.glob("*.states.*"))
                for each in (before, reader):
                    check(content_of(each), 40)
                    check_changes(content_of(each))
        path.unlink()


def test_full_disk_leaves_only_the_log(path):
    record(path)
    for room in (0, 700, 5000):
        error = pytest.raises(FileNotWritten, match=r"\.h5: File too large")
        with file_size_limit(room), error:
            finish_trajectory(path)
        assert names(path.parent) == []
    finish_trajectory(path)


def test_missing_or_damaged_log_is_an_error(path):
    """A damaged journal hides the log, which is kept."""
    with pytest.raises(UnreadableFile, match=r"\.h5: neither the file nor its log"):
        finish_trajectory(path)
    record(path)
    [log], [journal] = log_paths(path.parent), path.parent.glob("*.jsonl")
    journal.write_bytes(b"something else\n")
    with pytest.raises(UnreadableFile, match="nor its log"):
        finish_trajectory(path)
    assert log.exists()


# 600 rows take 24 MB that cannot be compressed.
LONG = row_dtype(snapshot=packed([("geom_xpos", ("<f8", (5000,)))]))


def test_memory_does_not_grow_with_the_episode(path):
    record(path, 600, dtype=LONG)
    tracemalloc.start()
    try:
        finish_trajectory(path)
        assert tracemalloc.get_traced_memory()[1] < 16e6 < path.stat().st_size
    finally:
        tracemalloc.stop()


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_leaves_only_the_log(path, monkeypatch):
    """An exception inside an HDF5 callback would crash the process."""
    record(path, 600, dtype=LONG)
    usual = trajectory_hdf5._Unfailing.write

    def interrupted(self, data):
        signal.raise_signal(signal.SIGINT)
        return usual(self, data)

    with monkeypatch.context() as patch:
        patch.setattr(trajectory_hdf5._Unfailing, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            finish_trajectory(path)
    assert names(path.parent) == []
    finish_trajectory(path)


def record_several(directory, *episodes):
    """Record episodes with as many steps as their number; the last has no end."""
    directory.mkdir(exist_ok=True)
    logs = new_logs(directory, INFIX)
    for episode in episodes:
        span = write(logs, episode, episode=episode)
        if episode != episodes[-1]:
            span.end({"complete": True, "length": episode})
    logs.close()
    return [logs.path_of(trajectory_prefix(INFIX, episode)) for episode in episodes]


def test_bundle_equals_single_files(tmp_path):
    numbers = (3, 4, 5, 9, 12)
    singles, bundled_ones = (record_several(tmp_path / name, *numbers) for name in "ab")
    assert bundle_trajectories(bundled_ones) == {}
    bundle = bundle_of(bundled_ones[0])
    assert not list(bundle.parent.glob("openaigym.states.*"))
    for number, single, bundled in zip(numbers, singles, bundled_ones, strict=True):
        finish_trajectory(single)
        assert is_finished(bundled)
        assert file_of(bundled) == bundle
        assert datasets_in(bundled) == datasets_in(single)
        assert read(bundled).facts == read(single).facts
        check(read(bundled), number)
    assert read(bundled_ones[-1]).facts["reason"] == "killed"
    with h5py.File(bundle) as file:
        assert sorted(file) == [f"episode{number:06d}" for number in numbers]
        assert file["episode000009/states"]["qpos"].shape == (10, 2)
    with bundle.open("rb") as raw:
        assert json.loads(raw.readline())["episodes"] == [[3, 5], [9, 9], [12, 12]]


def test_bundle_takes_more_episodes_and_new_facts(tmp_path):
    """Earlier episodes stay bit-identical, and a full disk keeps the log."""
    paths = record_several(tmp_path, 20, 300, 301)
    assert bundle_trajectories(paths[:1]) == {}
    bundle = bundle_of(paths[0])
    assert [each.path for each in recordings_in_flight(tmp_path)] == paths[1:]
    first, before = datasets_in(paths[0]), bundle.read_bytes()
    with file_size_limit(len(before)):
        failures = bundle_trajectories(paths)
    assert [type(error) for error in failures.values()] == [FileNotWritten] * 2
    assert bundle.read_bytes() == before
    check(read(paths[1]), 300)
    assert bundle_trajectories(paths) == {}
    assert recordings_in_flight(tmp_path) == []
    amend_trajectories({path: lambda facts: {**facts, "new": 1} for path in paths[1:]})
    assert datasets_in(paths[0]) == first
    assert ["new" in read(path).facts for path in paths] == [False, True, True]
    for number, path in zip((20, 300, 301), paths, strict=True):
        check(read(path), number)


def test_directory_lists_bundled_trajectories(tmp_path):
    """A bundle is not itself a trajectory, so its error names one inside."""
    own, *others = record_several(tmp_path, 1, 2, 3)
    finish_trajectory(own)
    bundle_trajectories([own, *others])
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
    ("kind", "episodes"),
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
def test_invalid_bundle_index_names_no_episode(tmp_path, kind, episodes):
    [path] = record_several(tmp_path, 1)
    index = f'{{"format": "{kind}", "version": 1, "episodes": {episodes}}}'
    bundle_of(path).write_bytes((index if kind else episodes).encode("latin-1") + b"\n")
    assert not is_finished(path)
    assert trajectories_in(bundle_of(path)) == []
    check(read(path), 1)
    bundle_of(path).unlink()
    bundle_trajectories([path])
    with h5py.File(bundle_of(path), "r+") as file:
        del file["episode000001"]
        file["episode000001"] = h5py.ExternalLink("elsewhere.h5", "/")
    with pytest.raises(UnreadableFile, match=r"episode000001.* of its own"):
        open_trajectory(path)


@pytest.mark.parametrize("is_written", [False, True])
def test_recovery_bundles_a_killed_run(tmp_path, monkeypatch, is_written):
    """The process may die between writing the bundle and removing the logs."""
    paths = record_several(tmp_path, 4, 5)
    if is_written:
        with monkeypatch.context() as patched:
            patched.setattr(trajectory_file, "remove_if_done", lambda _: None)
            assert bundle_trajectories(paths) == {}
        assert recordings_in_flight(tmp_path) == []
    assert any("states" in path.name for path in tmp_path.iterdir())
    recovery = mjrec.recover(tmp_path, bundle=True)
    assert not recovery.failures
    made = [file.what for file in recovery.files if "trajectory" in file.name]
    assert made == ([] if is_written else ["4 steps", "5 steps, incomplete: killed"])
    assert not any("states" in path.name for path in tmp_path.iterdir())
    assert not any(path.is_file() for path in paths)
    assert [len(mjrec.load_trajectory(path)) for path in paths] == [4, 5]
    assert not mjrec.recover(tmp_path, bundle=True)
