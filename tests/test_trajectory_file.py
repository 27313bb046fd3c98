# SPDX-License-Identifier: Apache-2.0
"""Finished trajectories, alone or in a bundle, hold what their log held."""

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
    """The file of the episode, which is not there yet."""
    return tmp_path / f"{NAME}.h5"


def names(directory):
    """Return the names of the files there but the journal and what is in flight."""
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
        *((40, 2, DTYPE), (0, 1, DTYPE)),
        # More than fits into one chunk of any dataset.
        (700, 1, DTYPE),
        (3, 2, row_dtype()),
        (3, 2, row_dtype(state=STATE, action=np.dtype("<i8"))),
        (3, 2, row_dtype(action=np.dtype(("<f8", (0,))))),
        (3, 2, row_dtype(snapshot=SNAPSHOT)),
    ],
)
def test_the_finished_file_holds_what_the_log_held(path, steps, every, dtype):
    """Bit for bit, NaNs with their payloads; what is not recorded is not there."""
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


def test_an_episode_that_was_killed_says_so(path):
    """Also before its first row; its rewards are added up one after the other."""
    for steps in (-1, 12):
        record(path, steps, ended=False)
        content = read(finish_trajectory(path))
        total = added_up([step / 3 for step in range(1, steps + 1)])
        facts = {"reason": "killed", "length": max(steps, 0), "reward": total}
        assert content.facts == {**FACTS, "complete": False, **facts}
        assert len(content.states) == steps + 1
        path.unlink()
    # As a monitor does at each step, on every version of Python.
    assert added_up([1e16, 1.0, -1e16]) == 0.0
    assert math.copysign(1, added_up([-0.0])) == 1


def test_plain_h5py_finds_every_array_by_its_name(path):
    """With the format of HDF5 1.10, and no filter that is not built in."""
    record(path)
    content = read(path)
    finish_trajectory(path)
    # HDF5 refuses a file that is open in one process in two different ways.
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
    # The superblock's version: 3 is that of 1.10.
    assert path.read_bytes()[8] == 3


def test_the_example_of_the_specification_runs(path, monkeypatch, capsys):
    """What docs/reference/trajectories.md shows a stranger works on a real file."""
    record(path)
    finish_trajectory(path).rename(path.with_name("episode.h5"))
    docs = Path(__file__).parents[1] / "docs"
    text = (docs / "reference" / "trajectories.md").read_text()
    of_one, of_several = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(path.parent)
    exec(compile(of_one, "trajectories.md", "exec"), {})
    assert "E-v0" in capsys.readouterr().out
    record(path)
    bundle_trajectories([path])
    bundle_of(path).rename(path.with_name("episodes.h5"))
    exec(compile(of_several, "trajectories.md", "exec"), {})
    assert capsys.readouterr().out == "episode000027 7 (41, 2)\n"


def test_what_is_finished_meanwhile_is_read(path, monkeypatch):
    """Who finds it in flight gets what it has become; an open reader keeps its log."""
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


def test_a_full_disk_leaves_the_log_and_nothing_else(path):
    """One error that names the file; with room again it succeeds."""
    record(path)
    for room in (0, 700, 5000):
        said = pytest.raises(FileNotWritten, match=r"\.h5: File too large")
        with file_size_limit(room), said:
            finish_trajectory(path)
        assert names(path.parent) == []
    finish_trajectory(path)


def test_without_a_log_that_can_be_read_there_is_one_clear_error(path):
    """Neither log nor file; or a damaged journal, without which the log stays."""
    with pytest.raises(UnreadableFile, match=r"\.h5: neither the file nor its log"):
        finish_trajectory(path)
    record(path)
    [log], [journal] = log_paths(path.parent), path.parent.glob("*.jsonl")
    journal.write_bytes(b"something else\n")
    with pytest.raises(UnreadableFile, match="nor its log"):
        finish_trajectory(path)
    assert log.exists()


# 24 MB of frames that cannot be compressed.
LONG = row_dtype(snapshot=packed([("geom_xpos", ("<f8", (5000,)))]))


def test_memory_does_not_grow_with_the_episode(path):
    """What was written is in the file, and not in memory as well."""
    record(path, 600, dtype=LONG)
    tracemalloc.start()
    try:
        finish_trajectory(path)
        assert tracemalloc.get_traced_memory()[1] < 16e6 < path.stat().st_size
    finally:
        tracemalloc.stop()


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_leaves_the_log_and_nothing_else(path, monkeypatch):
    """Also between HDF5 and its file, where an exception would crash it."""
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


def replaced(name, *data, **options):
    """Return what puts another dataset in the place of one."""

    def replace(file):
        del file[name]
        file.create_dataset(name, *data, **options)

    return replace


def linked(file):
    del file["rewards"]
    file["rewards"] = h5py.ExternalLink("other.h5", "/x")


HARM = {
    "not a trajectory": lambda file: file.attrs.update(format=np.bytes_(b"robomimic")),
    "has the wrong type": lambda file: file.attrs.update(format="mjrec trajectory"),
    "update mjrec": lambda file: file.attrs.update(format_version=np.int64(2)),
    "its facts are damaged": lambda file: file.attrs.update(facts=np.bytes_(b"{}")),
    "the same number of steps": replaced("actions", data=np.zeros((3, 3), "f4")),
    "components that are not float64": replaced("states", data=np.zeros(41, "f4,f4")),
    "not a valid dtype": replaced("rewards", data=["a"] * 40),
    "rewards have": replaced("rewards", data=np.zeros((40, 2))),
    "the snapshot of a row": replaced("snapshots", data=np.zeros(41)),
    "frame steps are out of order": replaced("frame_steps", data=np.arange(41)[::-1]),
    "a way that mjrec does not write": replaced(
        "rewards", (40,), "<f8", external=[("/etc/passwd", 0, 320)]
    ),
    "rewards is stored in a way": replaced(
        "rewards", data=np.ones(40), chunks=(40,), compression="lzf"
    ),
    "no 'rewards' of its": linked,
    "is not a group": replaced("model_changes", data=np.zeros(3)),
    "no 'truncated' of its own": lambda file: file.__delitem__("truncated"),
    "no '0' of its": lambda file: file.move("model_changes/0", "model_changes/9"),
}


@pytest.mark.parametrize("reason", HARM)
def test_a_file_of_another_making_is_refused(path, reason):
    """One clear error for each thing that is not as mjrec writes it."""
    record(path)
    finish_trajectory(path)
    with h5py.File(path, "r+") as file:
        HARM[reason](file)
    with pytest.raises(UnreadableFile, match=reason) as error:
        read(path)
    assert error.value.path == path


# --- many in one file -----------------------------------------------------------------


def record_several(directory, *episodes):
    """Record episodes of as many steps as their number says, the last one killed."""
    directory.mkdir(exist_ok=True)
    logs = new_logs(directory, INFIX)
    for episode in episodes:
        span = write(logs, episode, episode=episode)
        if episode != episodes[-1]:
            span.end({"complete": True, "length": episode})
    logs.close()
    return [logs.path_of(trajectory_prefix(INFIX, episode)) for episode in episodes]


def test_a_bundle_holds_what_files_would_hold(tmp_path):
    """Dataset by dataset; strangers read it with h5py."""
    numbers = (3, 4, 5, 9, 12)
    apart, together = (record_several(tmp_path / name, *numbers) for name in "ab")
    assert bundle_trajectories(together) == {}
    bundle = bundle_of(together[0])
    assert not list(bundle.parent.glob("openaigym.states.*"))
    for number, single, bundled in zip(numbers, apart, together, strict=True):
        finish_trajectory(single)
        assert is_finished(bundled)
        assert file_of(bundled) == bundle
        assert datasets_in(bundled) == datasets_in(single)
        assert read(bundled).facts == read(single).facts
        check(read(bundled), number)
    assert read(together[-1]).facts["reason"] == "killed"
    with h5py.File(bundle) as file:
        assert sorted(file) == [f"episode{number:06d}" for number in numbers]
        assert file["episode000009/states"]["qpos"].shape == (10, 2)
    with bundle.open("rb") as raw:
        assert json.loads(raw.readline())["episodes"] == [[3, 5], [9, 9], [12, 12]]


def test_more_come_into_a_bundle_and_facts_change(tmp_path):
    """What was there is as before, bit for bit; on a full disk the log stays."""
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


def test_a_directory_lists_what_lies_in_bundles(tmp_path):
    """Beside files of their own; a bundle itself is none, and says what it holds."""
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
    [path] = record_several(tmp_path, 1)
    index = f'{{"format": "{said}", "version": 1, "episodes": {episodes}}}'
    bundle_of(path).write_bytes((index if said else episodes).encode("latin-1") + b"\n")
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
def test_what_a_killed_monitor_left_comes_into_its_bundle(
    tmp_path, monkeypatch, is_written
):
    """Also where it was killed after the bundle was there, before its logs were."""
    paths = record_several(tmp_path, 4, 5)
    if is_written:
        with monkeypatch.context() as patched:
            patched.setattr(trajectory_file, "remove_if_done", lambda _: None)
            assert bundle_trajectories(paths) == {}
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
