# SPDX-License-Identifier: Apache-2.0
"""Files of somebody who means harm: one error, soon, and nothing else is touched.

Each is read in a fork with a gigabyte of memory (`hostile_reading`).
"""

import contextlib
import gzip
import hashlib
import json
import os
import re
import socket
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest
from hostile_reading import Inspector
from random_rows import DTYPE
from sound_files import (
    FILES,
    SPHERE,
    finished,
    journal_of_killed,
    manifest,
    metadata,
    stored,
)
from trajectories_by_hand import INFIX, add_row, new_logs, write_log

from mjrec import UnreadableFile, load_trajectory
from mjrec.formats.manifest import read_manifest
from mjrec.formats.monitor_directory import (
    clip_part_name,
    episode_of,
    infix_of,
    is_infix,
    journal_name,
    log_name,
    trajectory_prefix,
)
from mjrec.formats.spans import is_in_flight, recordings_in_flight, remove_if_done
from mjrec.formats.trajectory import ModelChange, row_dtype
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.results.manifest_writing import update_manifests
from mjrec.simulation.foreign_files import compile_sources
from mjrec.simulation.model_trust import note_models

NAME = trajectory_prefix(INFIX, 0)

Harm = Callable[[Path], object]


@pytest.fixture(scope="module")
def inspector():
    with Inspector() as one:
        yield one


@pytest.fixture
def directory(tmp_path):
    path = tmp_path / "theirs"
    path.mkdir()
    return path


@pytest.mark.parametrize("kind", FILES)
def test_a_sound_file_is_read(inspector, directory, kind):
    """So that what is refused below is refused for its harm."""
    reader, write = FILES[kind]
    inspector.reads(reader, write(directory))


# --- what is no file at all ----------------------------------------------------------


def listening_socket(path):
    # By a relative name, because those of sockets are short.
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path.name)


PUT = {
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "socket": listening_socket,
    "link to itself": lambda path: path.symlink_to(path.name),
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "link elsewhere": lambda path: path.symlink_to(
        path.parents[1] / "ours" / path.name
    ),
}
FINE = {
    # A file that the user names is the user's, links and all.
    ("mjcf", "link elsewhere"),
    # A directory is an answer that lists what is in it.
    ("h5", "folder"),
}


@pytest.mark.parametrize(
    ("kind", "put"), [(k, p) for k in FILES for p in PUT if (k, p) not in FINE]
)
def test_only_regular_files_of_the_directory_are_opened(
    inspector, directory, kind, put
):
    """No pipe is waited for, no device opened, no link followed, nothing removed."""
    reader, write = FILES[kind]
    path = write(directory)
    outside = directory.with_name("ours") / path.name
    outside.parent.mkdir()
    path.rename(outside)
    os.utime(outside, (0, outside.stat().st_mtime))
    PUT[put](path)
    before = sorted(directory.iterdir())
    inspector.refuses(reader, path)
    assert outside.stat().st_atime == 0
    assert list(outside.parent.iterdir()) == [outside]
    assert sorted(directory.iterdir()) == before


def test_links_within_the_directory_are_followed(directory):
    """As are the user's own, from elsewhere, that bear no monitor file's name."""
    path = finished(directory)
    kept = path.rename(directory / "kept.h5")
    path.symlink_to(kept.name)
    latest = directory.parent / "latest.h5"
    latest.symlink_to(path)
    assert len(load_trajectory(path)) == len(load_trajectory(latest)) == 4


# --- what is not what its name says --------------------------------------------------


def a_hole_of_a_terabyte(path):
    path.write_bytes(path.read_bytes()[:-1])
    os.truncate(path, 1 << 40)


SPOILS = {
    "nothing": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(np.random.default_rng(1).bytes(5000)),
    "a hole of a terabyte": a_hole_of_a_terabyte,
    "half of it": lambda path: os.truncate(path, path.stat().st_size // 2),
}


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("kind", [k for k in FILES if k != "video for an archive"])
def test_other_content_is_refused(inspector, directory, kind, spoil):
    """Of a journal and of logs there is what is whole; the rest is passed over."""
    reader, write = FILES[kind]
    path = write(directory)
    SPOILS[spoil](path)
    if kind == "journal":
        os.truncate(path, min(path.stat().st_size, 1 << 28))
    # MuJoCo reads what the user has named as it likes.
    may_be_read = {"mjcf", "spans"} if "hole" in spoil else set()
    if kind in {"journal", ".log", ".tail", ".looks"} | may_be_read:
        assert inspector.read(reader, path).kind in ("value", "refused")
    else:
        inspector.refuses(reader, path)


# --- JSON ----------------------------------------------------------------------------

JSON = {
    "nested too deeply": b"[" * 10_000_000,
    "nested too deep": b'{"a": %s}' % (b"[" * 900 + b"]" * 900),
    "Exceeds the limit": b'{"a": %s}' % (b"9" * 1_000_000),
    "it must be a string": b'{"stats": 0.%s}' % (b"9" * 10_000_000),
    "more than 16777216 values": b'{"a": [%s0]}' % (b"0," * 20_000_000),
    "the key 'a' twice": b'{"a": 1, "\\u0061": 2}',
    "not UTF-8": b'{"a": "\xff"}',
    "it must be an object": b"[]",
}


# --- trajectories --------------------------------------------------------------------


def in_hdf5(change, path):
    with h5py.File(path, "r+") as file:
        change(file)


def replaced(name, **options):
    def replace(file):
        del file[name]
        file.create_dataset(name, **options)

    return replace


def virtual(file):
    """A dataset put together of files that are counted when its shape is asked for."""
    whole = h5py.h5s.create_simple((4,), (h5py.h5s.UNLIMITED,))
    whole.select_hyperslab((0,), (h5py.h5s.UNLIMITED,), (1,), (1,))
    part = h5py.h5s.create_simple((1,))
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_virtual(whole, b"/etc/%b", b"x", part)
    del file["rewards"]
    h5py.h5d.create(file.id, b"rewards", h5py.h5t.IEEE_F64LE, whole, properties)


def overflowing_frames(file):
    steps = [2**62, 2**63 - 1, -(2**63) + 1, -(2**62), 0]
    replaced("frame_steps", data=np.array(steps))(file)
    replaced("snapshots", data=np.zeros(5, file["snapshots"].dtype))(file)


def change_of(file):
    group = file["model_changes"].create_group("0")
    group.attrs["step"] = np.int64(0)
    return group


def one_change_by_many_names(file):
    zeros, group = np.zeros(4 << 20), change_of(file)
    group.create_dataset("geom_rgba", data=zeros, compression=9, chunks=zeros.shape)
    for index in range(1, 5000):
        file["model_changes"][str(index)] = group


def gigabytes_of_observations(file):
    """Four, out of four megabytes: zeros pack a thousandfold."""
    rows, length = 500, 1 << 20
    for name, kind in [("rewards", "f8"), ("terminated", "?"), ("truncated", "?")]:
        replaced(name, data=np.zeros(rows - 1, kind))(file)
    replaced("states", data=np.zeros((rows, 0)))(file)
    packed = zlib.compress(bytes(8 * length), 9)
    observations = file.create_dataset(
        "observations", (rows, length), "f8", chunks=(1, length), compression=9
    )
    for row in range(rows):
        observations.id.write_direct_chunk((row, 0), packed)


def linked_field(file):
    change_of(file)["geom_rgba"] = h5py.ExternalLink("/etc/passwd", "/x")


def object_field(file):
    texts = {"data": [b"cos\nsystem"], "dtype": h5py.string_dtype()}
    change_of(file).create_dataset("x", **texts)


# Of one the process is ended when it has had its CPU time, which takes a while.
HDF5 = [
    (virtual, "in a way that mjrec does not write"),
    (overflowing_frames, "out of order"),
    (replaced("states", shape=(5, 2**35), dtype="f8"), "C int"),
    (replaced("rewards", shape=(2**40,), dtype="f8"), "more memory"),
    (replaced("rewards", shape=(2**40,), dtype="f8", chunks=(9,)), "more memory"),
    (gigabytes_of_observations, "more memory"),
    (one_change_by_many_names, "SIGXCPU|SIGKILL"),
    (linked_field, "no 'geom_rgba' of its own"),
    (object_field, "not a valid dtype"),
    (lambda file: file.attrs.create("format_version", True), "wrong type"),
]


# --- recordings in flight ------------------------------------------------------------


def head(rows, version=1):
    """Return the first line of somebody else's journal."""
    values = {"number": 0, "version": version, "dtype": rows, "facts": {}}
    return json.dumps({"rows": values}).encode() + b"\n"


def beginning_with(line, path):
    path.write_bytes(line + b"".join(path.read_bytes().splitlines(True)[1:]))


HEAD = DTYPE.descr[:4]
ROWS = {
    "the layout of its rows cannot be read": 5,
    "the state of a row": [*HEAD, ["state", "<f8"]],
    "components that are not float64": [*HEAD, ["state", [["a", "<f4"], ["", "|V4"]]]],
    "is not a valid array name": [*HEAD, ["snapshot", [["a/b", "<f8"]]]],
    "not a valid dtype for a trajectory": [*HEAD, ["action", "|O"]],
    "cannot be read": [*HEAD, ["action", "<f8", [1 << 62]]],
    "unknown parts": [*HEAD, ["action", "|u1"]],
    "parts or gaps": [*HEAD, ["other", "<f8"]],
}
RECORD = "{{'descr': [('a', {})], 'fortran_order': False, 'shape': {}}}"
CHANGES = (
    *("", RECORD.format("'<f8'", "(2,)"), RECORD.format("'|O'", "()")),
    *("[" * 60_000, "__import__('os')"),
)


def with_change(header, path):
    """Put an array with another header where the changes to the model are."""
    start = b"\x93NUMPY\1\0" + struct.pack("<H", len(header))
    payload = start + header.encode() + bytes(8)
    path.write_bytes(struct.pack("<QqQ", 0, 0, len(payload)) + payload)


# --- models --------------------------------------------------------------------------


def put_compiled(content, packed, path, **facts):
    """Put bytes in place of a compiled model, with facts that are true."""
    digest = hashlib.sha256(content).hexdigest()
    facts = {"sha256": digest, "bytes": len(content), "mjb": path.name, **facts}
    facts |= {"mujoco": mujoco.__version__, "xml": None}
    note_models([digest])
    path.write_bytes(packed)
    path.with_name("facts.json").write_text(json.dumps(facts))


CONTENT = bytes(1000)
SOUND = gzip.compress(CONTENT)
NOISE = np.random.default_rng(1).bytes(10_000)
BOMB = gzip.compress(bytes(1 << 28))
GZIP = [
    # No model, a bomb, and one that says how large it is.
    lambda path: put_compiled(NOISE, gzip.compress(NOISE), path),
    partial(put_compiled, CONTENT, BOMB),
    partial(put_compiled, CONTENT, BOMB, bytes=(1 << 31) - 1),
    *(
        partial(put_compiled, CONTENT, packed)
        for packed in (
            SOUND + gzip.compress(b"more"),
            gzip.compress(b"") * 100_000 + SOUND,
            # An endless name.
            SOUND[:10].replace(b"\0", b"\x08", 1) + b"x" * 30_000_000,
            # Cut off, a wrong checksum, bytes at the end.
            *(SOUND[:-1], SOUND[:-8] + bytes(8), SOUND + b"tail"),
        )
    ),
]


def put_zip(members, path, *, again=None):
    contents = b'{"format": 1, "main": "main.xml"}'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {"contents.json": contents, **members}.items():
            archive.writestr(name, content)
        if again is not None:
            with pytest.warns(UserWarning, match="Duplicate"):
                archive.writestr(again, b"other")


def npy(header):
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text + bytes(64)


MAIN = "source/main.xml"
SOUND_ZIP = {MAIN: SPHERE.encode()}
HUGE = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,)}")
ZIP = {
    "more memory than": {"fields/geom_rgba.npy": HUGE},
    "expected 4 bytes": {"fields/geom_rgba.npy": b"\x93NUMPY\x03\0"},
    "a file named": {"source/../../x": b""},
    "not a plain relative path": {"source//tmp/x": b""},
    "nested too deeply": {"contents.json": b"[" * 100_000},
    "other": {"contents.json": b'{"format": 1, "main": "other"}'},
    "dict": {"contents.json": b'{"format": 1, "main": {}}'},
}
INSIDE = "<mujoco><worldbody>%s</worldbody></mujoco>"
# A megabyte of names would be looked at a thousand million times.
MANY = "".join(f'<compiler meshdir="d{i}"/>' for i in range(20_000))
MESHES = "".join(f'<mesh file="{i}"/>' for i in range(20_000))
MJCF = (
    '<mujoco><include file="/etc/passwd"/></mujoco>',
    '<mujoco><include file="../../../../../../../../../../etc/passwd"/></mujoco>',
    '<mujoco><include file="&#47;etc/passwd"/></mujoco>',
    '<mujoco><asset><mesh file="~/x.obj"/></asset></mujoco>',
    '<mujoco><compiler meshdir="/"/><asset><mesh file="x.obj"/></asset></mujoco>',
    '<mujoco><extension><plugin plugin="mujoco.pid"/></extension></mujoco>',
    '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><mujoco>&b;</mujoco>',
    '<mujoco><include file="main.xml"/></mujoco>',
    INSIDE % ("<body>" * 100_000 + "</body>" * 100_000),
    '<mujoco><size nuserdata="2000000000"/></mujoco>',
    '<mujoco><size memory="900P"/></mujoco>',
    f"<mujoco>{MANY}<asset>{MESHES}</asset></mujoco>",
)

# The kind of file, what is done to it, and what is said of it.
HARMS = [
    *(
        ("manifest", partial(Path.write_bytes, data=d), said)
        for said, d in JSON.items()
    ),
    *(("h5", partial(in_hdf5, change), said) for change, said in HDF5),
    *(("spans", partial(beginning_with, head(r)), said) for said, r in ROWS.items()),
    ("spans", partial(beginning_with, b"[" * 10**7 + b"\n"), "does not give"),
    *((".looks", partial(with_change, h), "change to the model") for h in CHANGES),
    *(("mjb.gz", harm, "") for harm in GZIP),
    *(("zip", partial(put_zip, {**SOUND_ZIP, **m}), said) for said, m in ZIP.items()),
    ("zip", partial(put_zip, SOUND_ZIP, again=MAIN), "is not XML"),
    *(("zip", partial(put_zip, {MAIN: xml.encode()}), "") for xml in MJCF),
]


# Takes more than five seconds: one file is given up when it has had its CPU time.
@pytest.mark.parametrize(
    ("kind", "harm", "said"),
    HARMS,
    ids=[f"{number} {kind} {said}" for number, (kind, _, said) in enumerate(HARMS)],
)
def test_harm_is_one_error(inspector, directory, kind, harm, said):
    """Before anything of it is used, within memory and time, and with its reason."""
    reader, write = FILES[kind]
    path = write(directory)
    harm(path)
    assert re.search(said, inspector.refuses(reader, path))


NOTE = b'{"note": {"name": "%s", "facts": {"a": %%s}}}\n' % NAME.encode()


@pytest.mark.parametrize(
    "lines",
    [
        b"[" * 1_000_000,
        NOTE % b'1, "a": 2',
        NOTE % (b'"%s"' % (b"a" * (30 << 20))),
        b"a" * (200 << 20),
        b"{\n" * 50_000,
    ],
    ids=["nested", "a fact twice", "large facts", "an endless line", "no lines"],
)
def test_hostile_lines_about_rows_take_little(inspector, directory, lines):
    """Time and memory; what was said before counts."""
    journal = journal_of_killed(directory)
    with journal.open("ab") as file:
        file.write(lines)
    inspector.reads("finish", journal)


def put_journal(directory, name, version=1):
    """Put a journal of somebody else's there that names a recording."""
    begin = {"name": name, "log": 0, "rows": 0, "row": 0, "look": 0, "facts": {}}
    path, line = directory / journal_name(INFIX), json.dumps({"begin": begin})
    path.write_bytes(head(DTYPE.descr, version) + line.encode() + b"\n")
    (directory / log_name(INFIX, 0)).touch()
    return path


def test_only_names_of_the_monitor_are_believed(directory):
    """No path leads out of the directory, or to another monitor's files."""
    for name in (
        *("../x", "..", "", "a\0b", "\ud800", f"../{NAME}", f"{NAME}.h5", NAME * 9),
        trajectory_prefix("0.2", 27),
        clip_part_name("1.7", 0, 0),
    ):
        put_journal(directory, name)
        assert recordings_in_flight(directory) == [], name
        assert not is_in_flight(directory / f"{NAME}.h5")
    put_journal(directory, NAME)
    assert is_in_flight(directory / f"{NAME}.h5")


def test_a_newer_format_is_refused_with_the_way_out(directory):
    """Nothing of it is guessed at, and it is not removed."""
    journal, log = put_journal(directory, NAME, version=12), log_name(INFIX, 0)
    with pytest.raises(UnreadableFile, match=r"newer mjrec in .* 12.* 1: update mjr"):
        load_trajectory(directory / f"{NAME}.h5")
    remove_if_done(directory / log)
    assert (directory / log).exists()
    # One that was cut within its first line is of nothing.
    for size in (100, 0):
        os.truncate(journal, size)
        assert recordings_in_flight(directory) == []


# --- names, and what a file says -----------------------------------------------------


def test_a_pending_video_elsewhere_is_not_looked_at(directory):
    """Though its name begins as that of a video of the directory does."""
    outside = directory.parent / "openaigym.video.0.7.video000000.mp4"
    outside.write_bytes(b"")
    metadata(directory.parent)
    (directory / "openaigym.video.0.7").mkdir()
    name = f"openaigym.video.0.7/../../{outside.name}"
    path = manifest(directory)
    entry = {"pending": [{"episode_id": 0, "video": name}]}
    path.write_text(json.dumps({**json.loads(path.read_text()), "mjrec": entry}))
    update_manifests(directory)
    assert read_manifest(path).videos == ()
    assert episode_of(name) is None
    # Reading a number takes longer than its digits are many.
    assert episode_of(f"openaigym.video.0.7.video{'1' * 10**6}.mp4") is None
    assert infix_of("openaigym.episodes.0.7/../x.jsonl") is None
    assert not is_infix("1" * 10**6 + ".7")
    assert not is_infix("0.7/../..")


def test_an_environment_in_a_file_is_text(directory):
    """Nothing that a file names is imported or called, or made an environment of."""
    done = directory / "done"
    environment = {
        "framework": "gymnasium",
        "id": "subprocess:check_output",
        "entry_point": "subprocess:check_output",
        "kwargs": {"args": f"touch {done}", "shell": True},
    }
    path = write_log(directory, environment=environment, env_id=environment["id"])
    trajectory = load_trajectory(finish_trajectory(path))
    assert trajectory.env_id == "subprocess:check_output"
    assert trajectory.environment is not None
    assert not done.exists()


@pytest.mark.parametrize("model", [5, "x", [], {"mjb": "../x"}, {"mjb": {}}])
def test_what_a_trajectory_says_of_its_model_is_checked(directory, model):
    """One error, of whatever type it is."""
    trajectory = load_trajectory(write_log(directory, model=model))
    with pytest.raises(UnreadableFile):
        trajectory.model()


def test_a_model_change_that_fits_nothing_names_the_file(directory):
    """And not the field alone."""
    logs = new_logs(directory)
    span = logs.begin(NAME, {"model": stored(directory)}, row_dtype())
    span.log.add_change(ModelChange(step=0, fields={"geom_rgba": np.ones(3)}))
    add_row(span, 0)
    path = logs.path_of(NAME)
    with pytest.raises(UnreadableFile, match="belongs to another model") as error:
        load_trajectory(path).model()
    assert error.value.path == path


def test_a_compiled_model_has_the_name_of_its_content(inspector, directory):
    """So that one file cannot stand for two models."""
    path = FILES["mjb.gz"][1](directory)
    other = path.rename(path.with_name("openaigym.model.0123456789abcdef.mjb.gz"))
    facts = directory / "facts.json"
    facts.write_text(json.dumps({**json.loads(facts.read_text()), "mjb": other.name}))
    assert "not the recorded model" in inspector.refuses("model", other)


FOR_EVER = INSIDE % '<replicate count="100000000"><geom size="1"/></replicate>'
TEN_GIGABYTES = (
    '<mujoco><asset><texture name="t" type="2d" builtin="flat" width="60000" '
    'height="60000"/></asset></mujoco>'
)


@pytest.mark.parametrize(
    ("xml", "seconds", "reason"),
    # mujoco 3.3 knows itself that no texture is so large.
    [(FOR_EVER, 3, "longer than 3 seconds"), (TEN_GIGABYTES, 100, "memory|too large")],
    ids=["for ever", "ten gigabytes"],
)
def test_a_model_that_takes_too_much_is_given_up(directory, xml, seconds, reason):
    """Time or memory; this process goes on."""
    path = FILES["zip"][1](directory)
    put_zip({MAIN: xml.encode()}, path)
    with pytest.raises(UnreadableFile, match=reason):
        compile_sources(path, compiled_size=1, seconds=seconds)
