# SPDX-License-Identifier: Apache-2.0
"""A finished trajectory holds what its log held, for mjrec and for plain h5py."""

from __future__ import annotations

import dataclasses
import math
import random
import re
import shutil
import signal
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from full_disk import file_size_limit
from trajectories_by_hand import add_row, new_logs
from trajectory_contents import TrajectoryContent, content_of

import mjrec.formats.trajectory_file as trajectory_file
from mjrec.errors import ClosedError, FileNotWritten, InvalidArgument, UnreadableFile
from mjrec.formats import trajectory_hdf5
from mjrec.formats.in_flight import list_paths
from mjrec.formats.monitor_directory import Infix, trajectory_prefix
from mjrec.formats.trajectory import (
    Array,
    ModelChange,
    RowLayout,
    StateComponent,
    TrajectoryHeader,
    added_up,
)
from mjrec.formats.trajectory_file import (
    find_trajectory,
    finish_trajectory,
    open_trajectory,
)

HEADER = TrajectoryHeader(
    facts={
        "env_id": "E-v0",
        "episode_id": 27,
        "seed": 7,
        "model": {"mujoco": "3.17.0"},
        "limit": float("inf"),
        "rate": "20",
    },
    state=(StateComponent("qpos", 0, 2), StateComponent("time", 2, 1)),
    snapshot=RowLayout.packed(
        [
            ("geom_xpos", Array("<f8", (2, 3))),
            ("wrap_obj", Array("<i4", (3,))),
            ("flexvert_xpos", Array("<f8", (0, 3))),
            ("eq_active", Array("|b1", (1,))),
        ]
    ),
    action=Array("<f4", (3,)),
    observation=Array("|u1", (2, 2)),
)
INFIX = Infix(0, "1")
NAME = trajectory_prefix(INFIX, 27)
CHANGES = (
    ModelChange(
        step=0,
        fields={
            "geom_rgba": np.arange(8, dtype=np.float32).reshape(2, 4),
            "opt.timestep": np.array(0.002),
            "hfield_data": np.empty((0, 3), np.float32),
        },
    ),
    ModelChange(step=5, fields={"site_pos": np.array([[1.0, np.nan, 3.0]])}),
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file of the episode, which is not there yet."""
    return tmp_path / f"{NAME}.h5"


def row_log(path: Path) -> Path:
    """Return the log that has the rows of the episode."""
    [spans] = list_paths(path.parent, INFIX)
    return spans.with_suffix(".log")


def random_array(chance: random.Random, kind: Array | None) -> Any:
    data = b"" if kind is None else chance.randbytes(kind.size)
    return 0 if kind is None else np.frombuffer(data, kind.dtype).reshape(kind.shape)


def write(
    path: Path,
    steps: int = 40,
    *,
    every: int = 2,
    header: TrajectoryHeader = HEADER,
    ended: bool = True,
) -> None:
    """Write rows of random bytes: NaNs of every kind are among the numbers."""
    chance = random.Random(1)
    logs = new_logs(path.parent, INFIX)
    span = logs.begin(path.stem, header)
    for step in range(steps + 1):
        for change in CHANGES:
            if change.step == step:
                span.add_change(change)
        state = Array("<f8", (header.state_length,))
        values = {"state": random_array(chance, state)}
        for name in ("action", "observation"):
            values[name] = random_array(chance, getattr(header, name))
        if step % every == 0 and header.snapshot.fields:
            size = header.snapshot.size
            values["snapshot"] = random_array(chance, Array("|u1", (size,)))
        add_row(span, step, reward=step / 3, truncated=step == steps, **values)
    if ended:
        span.end({"complete": True, "length": steps})
    logs.close()


def read(path: Path) -> TrajectoryContent:
    with open_trajectory(path) as reader:
        return content_of(reader)


def killed(content: TrajectoryContent) -> TrajectoryContent:
    """Add what is said of an episode whose log does not say how it ended."""
    facts = {
        **content.header.facts,
        "complete": False,
        "reason": "killed",
        "length": len(content.rewards),
        "reward": float(sum(content.rewards.tolist())),
    }
    header = dataclasses.replace(content.header, facts=facts)
    return dataclasses.replace(content, header=header)


def assert_same(one: TrajectoryContent, other: TrajectoryContent) -> None:
    """Check that two are equal bit for bit."""
    for field in dataclasses.fields(TrajectoryContent):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray):
            assert (a.dtype, a.shape) == (b.dtype, b.shape), field.name
            assert a.tobytes() == b.tobytes(), field.name
        elif field.name != "model_changes":
            assert a == b, field.name
    assert len(one.model_changes) == len(other.model_changes)
    for change, again in zip(one.model_changes, other.model_changes, strict=True):
        assert change.step == again.step
        assert sorted(change.fields) == sorted(again.fields)
        for name, values in change.fields.items():
            np.testing.assert_array_equal(values, again.fields[name], strict=True)


NOTHING = TrajectoryHeader(facts={})


@pytest.mark.parametrize(
    ("steps", "every", "header"),
    [
        *((40, 2, HEADER), (0, 1, HEADER), (1, 1, HEADER)),
        # More than fits into one chunk of any dataset.
        (700, 1, HEADER),
        (3, 2, NOTHING),
        *(
            (3, 2, dataclasses.replace(NOTHING, state=HEADER.state, action=action))
            for action in (Array("<i8", ()), Array("<f8", (0,)))
        ),
        (3, 2, TrajectoryHeader(facts={"x": "x" * 10**6}, snapshot=HEADER.snapshot)),
    ],
)
def test_the_finished_file_holds_what_the_log_held(
    path: Path, steps: int, every: int, header: TrajectoryHeader
) -> None:
    """Bit for bit, NaNs with their payloads; what is not recorded is not there."""
    write(path, steps, every=every, header=header)
    content = read(path)
    assert finish_trajectory(path) == path
    assert list(path.parent.iterdir()) == [path]
    assert_same(read(path), content)
    known = {"complete": True, "length": steps}
    assert content.header.facts == {**header.facts, **known}


def test_an_episode_killed_at_its_beginning_is_finished(path: Path) -> None:
    """Not even the state after the reset was written."""
    write(path, -1, ended=False)
    content = read(path)
    assert content.states.shape == (0, 3)
    assert_same(read(finish_trajectory(path)), killed(content))


def test_whoever_knows_more_of_an_end_than_the_log_is_believed(path: Path) -> None:
    """A journal may have the episode whose log lacks the end."""
    write(path, ended=False)
    facts = {"complete": True, "truncated": True, "seed": 8}
    known = read(finish_trajectory(path, facts=facts)).header.facts
    assert {key: known[key] for key in facts} == facts
    assert "reason" not in known


def test_ranges_of_snapshots_are_packed_rows(path: Path) -> None:
    """A render worker gets the same bytes from the log and from the file."""
    write(path, 200, every=1)
    with open_trajectory(path) as reader:
        rows = reader.snapshots(0, 201)
    with open_trajectory(finish_trajectory(path)) as reader:
        for start, stop in [(0, 0), (0, 8), (30, 34), (70, 102), (200, 201)]:
            part = reader.snapshots(start, stop)
            assert part.dtype == np.uint8
            np.testing.assert_array_equal(part, rows[start:stop])
        with pytest.raises(InvalidArgument, match="has 201 snapshots"):
            reader.snapshots(200, 202)


def test_plain_h5py_finds_every_array_by_its_name(path: Path) -> None:
    """Without mjrec: names, shapes and the facts that one looks for first."""
    write(path)
    content = read(path)
    fields = HEADER.snapshot.unpack(content.snapshots)
    with h5py.File(finish_trajectory(path)) as file:
        assert set(file) == {
            *("states", "actions", "rewards", "terminated", "truncated", "time"),
            *("observations", "frame_steps", "snapshots", "model_changes"),
        }
        for name in ("states", "actions", "rewards", "truncated", "frame_steps"):
            assert file[name][()].tobytes() == getattr(content, name).tobytes()
        assert file["time"][()].tobytes() == content.states[:, 2].tobytes()
        assert file["snapshots"].dtype.names == ("geom_xpos", "wrap_obj", "eq_active")
        for name in file["snapshots"].dtype.names:
            assert file["snapshots"][name].tobytes() == fields[name].tobytes()
        assert list(file["states"].attrs["components"]) == ["qpos", "time"]
        assert file["states"].attrs["offsets"].tolist() == [0, 2]
        assert file["model_changes/1"].attrs["step"] == 5
        assert file["model_changes/0/opt.timestep"][()] == 0.002
        assert file.attrs["env_id"] == "E-v0"
        assert file.attrs["mujoco_version"] == "3.17.0"
        assert (file.attrs["episode_id"], file.attrs["seed"]) == (27, 7)
        assert file.attrs["complete"]


def test_old_hdf5_libraries_can_read_it(path: Path) -> None:
    """The format of HDF5 1.10, and no filter that is not built in."""
    write(path)
    finish_trajectory(path)
    # The superblock's version: 3 is that of 1.10.
    assert path.read_bytes()[8] == 3
    with h5py.File(path) as file:
        for dataset in (file["states"], file["snapshots"], file["actions"]):
            properties = dataset.id.get_create_plist()
            filters = [
                properties.get_filter(i)[0] for i in range(properties.get_nfilters())
            ]
            assert filters == [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]


def test_the_same_log_makes_the_same_file(path: Path, tmp_path: Path) -> None:
    """No time and no chance gets into it."""
    write(path)
    other = shutil.copytree(tmp_path, tmp_path / "copy") / path.name
    assert finish_trajectory(path).read_bytes() == finish_trajectory(other).read_bytes()


def test_the_user_may_have_the_file_open_as_well(path: Path) -> None:
    """HDF5 refuses a file that is open in one process in two different ways."""
    write(path)
    finish_trajectory(path)
    with h5py.File(path), open_trajectory(path) as reader:
        assert reader.frame_count == 21
    with open_trajectory(path), h5py.File(path) as file:
        assert len(file["frame_steps"]) == 21


def test_the_example_of_the_specification_runs(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What docs/format.md shows a stranger works on a real file."""
    write(path)
    finish_trajectory(path).rename(path.with_name("episode.h5"))
    text = Path(__file__).parents[1].joinpath("docs", "format.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(path.parent)
    exec(compile(code, "docs/format.md", "exec"), {})
    assert "E-v0" in capsys.readouterr().out


def test_finishing_again_changes_nothing(path: Path, tmp_path: Path) -> None:
    """Nor where the log is there still: killed between rename and removal."""
    write(path)
    kept = shutil.copytree(tmp_path, tmp_path / "kept")
    before = finish_trajectory(path).stat()
    for file in kept.iterdir():
        shutil.move(file, tmp_path)
    kept.rmdir()
    for _ in range(2):
        assert finish_trajectory(path) == path
        assert list(tmp_path.iterdir()) == [path]
        assert path.stat() == before


def finish_late(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have somebody else finish what is opened next, just before it is."""
    reader = trajectory_file.SpanReader

    def open_late(path: Path) -> Any:
        monkeypatch.setattr(trajectory_file, "SpanReader", reader)
        finish_trajectory(path)
        return reader(path)

    monkeypatch.setattr(trajectory_file, "SpanReader", open_late)


@pytest.mark.parametrize("use", [read, lambda path: read(finish_trajectory(path))])
def test_what_is_finished_meanwhile_is_read(
    path: Path, monkeypatch: pytest.MonkeyPatch, use: Any
) -> None:
    """Whoever finds it in flight gets what it has become."""
    write(path)
    content = read(path)
    finish_late(monkeypatch)
    assert_same(use(path), content)
    assert list(path.parent.iterdir()) == [path]


def test_a_reader_keeps_what_somebody_finishes(path: Path) -> None:
    """Rows and changes of the model are read from the log that is removed."""
    write(path)
    content = read(path)
    with open_trajectory(path) as reader:
        finish_trajectory(path)
        assert_same(content_of(reader), content)


def test_nothing_to_finish_is_one_clear_error(path: Path) -> None:
    """Neither log nor file; or a log that cannot be read, which stays."""
    with pytest.raises(
        UnreadableFile, match=r"\.h5: there is no such file, and no log"
    ):
        finish_trajectory(path)
    write(path)
    [spans] = list_paths(path.parent)
    spans.write_bytes(b"something else\n")
    for _ in range(3):
        with pytest.raises(UnreadableFile, match=r"\.spans: it is not whole JSON"):
            finish_trajectory(path)
    assert spans.read_bytes() == b"something else\n"
    assert row_log(path).exists()


@pytest.mark.parametrize("room", [0, 700, 5000])
def test_a_full_disk_leaves_the_log_and_nothing_else(path: Path, room: int) -> None:
    """One error that names the file; with room again it succeeds."""
    write(path)
    with (
        file_size_limit(room),
        pytest.raises(FileNotWritten, match=r"\.h5: File too large"),
    ):
        finish_trajectory(path)
    assert not [name for name in path.parent.iterdir() if ".states." not in name.name]
    finish_trajectory(path)


def write_long(path: Path) -> None:
    """Write 24 MB of frames that cannot be compressed."""
    frames = RowLayout.packed([("geom_xpos", Array("<f8", (5000,)))])
    write(path, 600, every=1, header=dataclasses.replace(HEADER, snapshot=frames))


def test_memory_does_not_grow_with_the_episode(path: Path) -> None:
    """What was written is in the file, and not in memory as well."""
    write_long(path)
    tracemalloc.start()
    try:
        finish_trajectory(path)
        assert tracemalloc.get_traced_memory()[1] < 16e6 < path.stat().st_size
    finally:
        tracemalloc.stop()


@pytest.mark.usefixtures("default_signals")
def test_ctrl_c_leaves_the_log_and_nothing_else(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also between HDF5 and its file, where an exception would crash it."""
    write_long(path)
    unfailing = trajectory_hdf5._Unfailing

    def interrupted(self: Any, data: Any) -> int:
        signal.raise_signal(signal.SIGINT)
        return usual(self, data)

    usual = unfailing.write
    monkeypatch.setattr(unfailing, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        finish_trajectory(path)
    monkeypatch.undo()
    assert not [name for name in path.parent.iterdir() if ".states." not in name.name]
    finish_trajectory(path)


KILLED = """
import os, signal, sys
from pathlib import Path
import mjrec.formats.trajectory_file as trajectory_file
where, path = sys.argv[1], Path(sys.argv[2])
die = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
if where == "before the name":
    os.fsync = die
else:
    Path.unlink = die
trajectory_file.finish_trajectory(path)
"""


@pytest.mark.parametrize("where", ["before the name", "before the removal"])
def test_a_killed_finish_is_done_again(path: Path, where: str) -> None:
    """There is always the log or the whole file, and never half of one."""
    write(path)
    content = read(path)
    process = subprocess.run(
        [sys.executable, "-c", KILLED, where, str(path)], check=False
    )
    assert process.returncode == -signal.SIGKILL
    assert row_log(path).exists()
    assert path.exists() == (where == "before the removal")
    assert_same(read(finish_trajectory(path)), content)


def test_the_file_of_an_episode_is_found(path: Path, tmp_path: Path) -> None:
    """Whether it is in flight still or finished; else nothing."""
    assert find_trajectory(tmp_path, INFIX, 27) is None
    write(path)
    assert find_trajectory(tmp_path, INFIX, 27) == path
    finish_trajectory(path)
    assert find_trajectory(tmp_path, INFIX, 27) == path
    assert find_trajectory(tmp_path, "0.1", 27) == path
    assert find_trajectory(tmp_path, INFIX, 28) is None
    assert find_trajectory(tmp_path, "nonsense", 27) is None


def test_what_a_file_is_its_content_says(path: Path, tmp_path: Path) -> None:
    """A name may be anything."""
    write(path)
    content = read(path)
    copy = shutil.copy(finish_trajectory(path), tmp_path / "renamed")
    assert_same(read(Path(copy)), content)


@pytest.mark.parametrize("is_finished", [True, False])
def test_a_closed_file_says_so(path: Path, is_finished: bool) -> None:
    """Closing is idempotent; what is in memory stays."""
    write(path)
    if is_finished:
        finish_trajectory(path)
    reader = open_trajectory(path)
    reader.close()
    reader.close()
    assert reader.step_count == 40
    for use in (
        lambda: reader.states(0, 1),
        lambda: reader.snapshots(0, 1),
        lambda: reader.model_changes,
    ):
        with pytest.raises(ClosedError, match="is closed"):
            use()


def replace_attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    return lambda file: file.attrs.__setitem__(name, value)


def replace_dataset(name: str, **options: Any) -> Callable[[h5py.File], None]:
    def replace(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, **options)

    return replace


def link(name: str, target: Any) -> Callable[[h5py.File], None]:
    def replace(file: h5py.File) -> None:
        del file[name]
        file[name] = target

    return replace


def external(file: h5py.File) -> None:
    del file["rewards"]
    file.create_dataset("rewards", (40,), "<f8", external=[("/etc/passwd", 0, 320)])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (replace_attribute("format", np.bytes_(b"robomimic")), "no trajectory"),
        (replace_attribute("format", "mjrec trajectory"), "of another type"),
        (replace_attribute("format_version", np.int64(2)), "update mjrec"),
        (replace_attribute("format_version", np.ones(3, int)), "of another type"),
        (replace_attribute("facts", np.bytes_(b"{}")), "facts or its layout are dam"),
        (replace_attribute("layout", "{}"), "of another type"),
        (replace_dataset("states", data=np.zeros((41, 4))), "have the shape"),
        (replace_dataset("states", data=np.zeros((9, 3))), "9 states for 40 steps"),
        (replace_dataset("states", data=np.zeros((41, 3), "f4")), "of dtype float32"),
        (replace_dataset("rewards", data=["a"] * 40), "of dtype object"),
        (replace_dataset("rewards", data=h5py.Empty("f8")), "no dataset"),
        (replace_dataset("actions", data=np.zeros((3, 3), "f4")), "3 actions, not 40"),
        (replace_dataset("snapshots", data=np.zeros(21)), "snapshots are of dtype"),
        (replace_dataset("frame_steps", data=np.full(21, 99)), "not of its steps"),
        (replace_dataset("frame_steps", data=np.arange(21)[::-1]), "not of its steps"),
        (
            replace_dataset(
                "rewards", data=np.ones(40), chunks=(40,), compression="lzf"
            ),
            "in a way that mjrec does not write",
        ),
        (external, "in a way that mjrec does not write"),
        (link("rewards", h5py.ExternalLink("other.h5", "/x")), "no 'rewards' of its"),
        (link("rewards", h5py.SoftLink("/truncated")), "no 'rewards' of its own"),
        (link("model_changes", np.zeros(3)), "is no group"),
        (lambda file: file.__delitem__("truncated"), "no 'truncated' of its own"),
        (
            lambda file: file["model_changes/0"].create_dataset("x", data=["a"]),
            "no dtype",
        ),
        (
            lambda file: file.move("model_changes/0", "model_changes/9"),
            "no '0' of its own",
        ),
    ],
)
def test_a_file_of_another_making_is_refused(
    path: Path, change: Callable[[h5py.File], None], reason: str
) -> None:
    """One clear error for each thing that is not as mjrec writes it."""
    write(path)
    finish_trajectory(path)
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(UnreadableFile, match=reason) as error:
        read(path)
    assert error.value.path == path


def test_damage_is_noticed(path: Path) -> None:
    """So is a missing end; or it is a byte that nothing depends on."""
    write(path)
    content = dataclasses.replace(read(path), model_changes=())
    finish_trajectory(path)
    data = path.read_bytes()
    for size in [*range(0, 200, 20), len(data) // 2, len(data) - 1]:
        path.write_bytes(data[:size])
        with pytest.raises(UnreadableFile, match=path.name):
            read(path)
    chance = random.Random(1)
    for _ in range(60):
        damaged = bytearray(data)
        damaged[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        path.write_bytes(damaged)
        try:
            again = read(path)
        except UnreadableFile:
            continue
        # Single numbers among the model's fields are stored as they are.
        assert_same(dataclasses.replace(again, model_changes=()), content)


def test_rewards_are_added_up_one_after_the_other() -> None:
    """As a monitor does at each step, on every version of Python."""
    assert added_up([1e16, 1.0, -1e16]) == 0.0
    assert math.copysign(1, added_up([-0.0])) == 1
    assert added_up([]) == 0.0
