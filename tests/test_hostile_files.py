# SPDX-License-Identifier: Apache-2.0
"""Each malicious file causes one quick error and touches nothing else.

The files are read in a fork with a gigabyte of memory (`hostile_reading`).
"""

import contextlib
import gzip
import hashlib
import io
import json
import os
import re
import socket
import struct
import zipfile
import zlib
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
    store_model,
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


@pytest.fixture(scope="module")
def inspector():
    with Inspector() as inspector:
        yield inspector


@pytest.fixture
def directory(tmp_path):
    path = tmp_path / "theirs"
    path.mkdir()
    return path


@pytest.mark.parametrize("kind", FILES)
def test_valid_file_is_read(inspector, directory, kind):
    """Damage is then the only reason for the refusals below."""
    reader, write = FILES[kind]
    inspector.reads(reader, write(directory))


def listening_socket(path):
    # The path of a socket must be short.
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path.name)


PATHS = {
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "socket": listening_socket,
    "link to itself": lambda path: path.symlink_to(path.name),
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "link elsewhere": lambda path: path.symlink_to(
        path.parents[1] / "ours" / path.name
    ),
}
ALLOWED = {
    ("mjcf", "link elsewhere"),  # The user named this path.
    ("h5", "folder"),  # The files of a folder are listed.
}


@pytest.mark.parametrize(
    ("kind", "put"), [(k, p) for k in FILES for p in PATHS if (k, p) not in ALLOWED]
)
def test_only_regular_files_in_the_directory_are_opened(
    inspector, directory, kind, put
):
    """Readers wait for no pipe, open no device, follow no link and remove nothing."""
    reader, write = FILES[kind]
    path = write(directory)
    outside = directory.with_name("ours") / path.name
    outside.parent.mkdir()
    path.rename(outside)
    os.utime(outside, (0, outside.stat().st_mtime))
    PATHS[put](path)
    before = sorted(directory.iterdir())
    inspector.refuses(reader, path)
    assert outside.stat().st_atime == 0
    assert list(outside.parent.iterdir()) == [outside]
    assert sorted(directory.iterdir()) == before


def test_links_within_the_directory_are_followed(directory):
    path = finished(directory)
    kept = path.rename(directory / "kept.h5")
    path.symlink_to(kept.name)
    latest = directory.parent / "latest.h5"
    latest.symlink_to(path)
    assert len(load_trajectory(path)) == len(load_trajectory(latest)) == 4


def grow_to_terabyte(path):
    path.write_bytes(path.read_bytes()[:-1])
    os.truncate(path, 1 << 40)


CORRUPTIONS = {
    "empty": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(np.random.default_rng(1).bytes(5000)),
    "sparse terabyte": grow_to_terabyte,
    "cut in half": lambda path: os.truncate(path, path.stat().st_size // 2),
}


@pytest.mark.parametrize("corruption", CORRUPTIONS)
@pytest.mark.parametrize("kind", [k for k in FILES if k != "video for an archive"])
def test_corrupt_content_is_refused(inspector, directory, kind, corruption):
    """Journals and logs may be read up to the damage."""
    reader, write = FILES[kind]
    path = write(directory)
    CORRUPTIONS[corruption](path)
    if kind == "journal":
        os.truncate(path, min(path.stat().st_size, 1 << 28))
    # MuJoCo itself reads files that the user names.
    may_be_read = {"mjcf", "spans"} if corruption == "sparse terabyte" else set()
    if kind in {"journal", ".log", ".tail", ".looks"} | may_be_read:
        assert inspector.read(reader, path).kind in ("value", "refused")
    else:
        inspector.refuses(reader, path)


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


def edit_hdf5(change, path):
    with h5py.File(path, "r+") as file:
        change(file)


def replaced(name, **options):
    def replace(file):
        del file[name]
        file.create_dataset(name, **options)

    return replace


def virtual_dataset(file):
    """Make a dataset whose shape depends on the number of existing files."""
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


def add_change(file):
    group = file["model_changes"].create_group("0")
    group.attrs["step"] = np.int64(0)
    return group


def thousands_of_links_to_one_change(file):
    zeros, group = np.zeros(4 << 20), add_change(file)
    group.create_dataset("geom_rgba", data=zeros, compression=9, chunks=zeros.shape)
    for index in range(1, 5000):
        file["model_changes"][str(index)] = group


def gigabytes_of_observations(file):
    """Compress four gigabytes of zeros to four megabytes."""
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
    add_change(file)["geom_rgba"] = h5py.ExternalLink("/etc/passwd", "/x")


def linked_rewards(file):
    del file["rewards"]
    file["rewards"] = h5py.ExternalLink("other.h5", "/x")


def object_field(file):
    group, kind = add_change(file), h5py.string_dtype()
    group.create_dataset("x", data=[b"cos\nsystem"], dtype=kind)


HDF5 = [
    (virtual_dataset, "in a way that mjrec does not write"),
    (overflowing_frames, "out of order"),
    (replaced("states", shape=(5, 2**35), dtype="f8"), "C int"),
    (replaced("rewards", shape=(2**40,), dtype="f8"), "more memory"),
    (replaced("rewards", shape=(2**40,), dtype="f8", chunks=(9,)), "more memory"),
    (gigabytes_of_observations, "more memory"),
    (thousands_of_links_to_one_change, "SIGXCPU|SIGKILL"),
    (linked_field, "no 'geom_rgba' of its own"),
    (object_field, "not a valid dtype"),
    (lambda file: file.attrs.create("format_version", True), "wrong type"),
    (lambda file: file.attrs.update(format="mjrec trajectory"), "has the wrong type"),
    (lambda file: file.attrs.update(format=np.bytes_(b"hdf5")), "not a trajectory"),
    (lambda file: file.attrs.update(format_version=np.int64(2)), "update mjrec"),
    (lambda file: file.attrs.update(facts=np.bytes_(b"{}")), "its facts are damaged"),
    (
        lambda file: file.create_dataset("actions", data=np.zeros((3, 3))),
        "the same number of steps",
    ),
    (replaced("states", data=np.zeros(5, "f4,f4")), "components that are not float64"),
    (replaced("rewards", data=["a"] * 4), "not a valid dtype"),
    (replaced("rewards", data=np.zeros((4, 2))), "rewards have"),
    (replaced("snapshots", data=np.zeros(5)), "the snapshot of a row"),
    (replaced("frame_steps", data=np.arange(5)[::-1]), "frame steps are out of order"),
    (
        replaced("rewards", shape=4, dtype="<f8", external=[("/etc/passwd", 0, 32)]),
        "in a way that mjrec does not write",
    ),
    (
        replaced("rewards", data=np.ones(4), chunks=(4,), compression="lzf"),
        "rewards is stored in a way",
    ),
    (linked_rewards, "no 'rewards' of its"),
    (replaced("model_changes", data=np.zeros(3)), "is not a group"),
    (lambda file: file.__delitem__("truncated"), "no 'truncated' of its own"),
    (lambda file: file.create_group("model_changes/9"), "no '0' of its"),
]


def first_line(rows, version=1):
    """Return the first line of another journal."""
    values = {"number": 0, "version": version, "dtype": rows, "facts": {}}
    return json.dumps({"rows": values}).encode() + b"\n"


def replace_first_line(line, path):
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


def write_change(header, path):
    """Write a model change whose array has this header."""
    start = b"\x93NUMPY\1\0" + struct.pack("<H", len(header))
    payload = start + header.encode() + bytes(8)
    path.write_bytes(struct.pack("<QqQ", 0, 0, len(payload)) + payload)


def replace_compiled_model(content, packed, path, **facts):
    """Replace a compiled model with other bytes and matching facts."""
    digest = hashlib.sha256(content).hexdigest()
    facts = {"sha256": digest, "bytes": len(content), "mjb": path.name, **facts}
    facts |= {"mujoco": mujoco.__version__, "xml": None}
    note_models([digest])
    path.write_bytes(packed)
    path.with_name("facts.json").write_text(json.dumps(facts))


CONTENT = bytes(1000)
VALID = gzip.compress(CONTENT)
NOISE = np.random.default_rng(1).bytes(10_000)
BOMB = gzip.compress(bytes(1 << 28))
GZIP = [
    partial(replace_compiled_model, NOISE, gzip.compress(NOISE)),
    partial(replace_compiled_model, CONTENT, BOMB, bytes=(1 << 31) - 1),
    *(
        partial(replace_compiled_model, CONTENT, packed)
        for packed in (
            VALID + gzip.compress(b"more"),
            gzip.compress(b"") * 100_000 + VALID,
            # The name in this header never ends.
            VALID[:10].replace(b"\0", b"\x08", 1) + b"x" * 30_000_000,
            # These streams are cut off, have a wrong checksum, or have trailing bytes.
            *(VALID[:-1], VALID[:-8] + bytes(8), VALID + b"tail"),
        )
    ),
]


def write_zip(members, path, *, duplicate=None):
    contents = b'{"format": 1, "main": "main.xml"}'
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {"contents.json": contents, **members}.items():
            archive.writestr(name, content)
        if duplicate is not None:
            with pytest.warns(UserWarning, match="Duplicate"):
                archive.writestr(duplicate, b"other")


def npy(header):
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text + bytes(64)


def field(name, value):
    buffer = io.BytesIO()
    np.save(buffer, value)
    return {f"fields/{name}.npy": buffer.getvalue()}


MAIN = "source/main.xml"
VALID_ZIP = {MAIN: SPHERE.encode()}
HUGE = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,)}")
ZIP = {
    "more memory than": {"fields/geom_rgba.npy": HUGE},
    "expected 4 bytes": {"fields/geom_rgba.npy": b"\x93NUMPY\x03\0"},
    "a file named": {"source/../../x": b""},
    "not a plain relative path": {"source//tmp/x": b""},
    "nested too deeply": {"contents.json": b"[" * 100_000},
    "other": {"contents.json": b'{"format": 1, "main": "other"}'},
    "dict": {"contents.json": b'{"format": 1, "main": {}}'},
    # These fields hold an index that MuJoCo would trust, objects, or foreign names.
    "set from": field("geom_bodyid", np.array([10**6], np.int32)),
    "no model field .opt": field("opt.__class__", np.zeros(())),
    "Object arrays cannot be loaded": field("geom_rgba", np.array([[None] * 4])),
    "another model": field("geom_rgba", np.zeros((9, 4), np.float32)),
    "no model field .aura": field("aura", np.zeros(1)),
}
INSIDE = "<mujoco><worldbody>%s</worldbody></mujoco>"
# A megabyte of names would take 400 million searches.
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

# Each entry has the kind of file, the attack, and the error.
ATTACKS = [
    *(("manifest", partial(Path.write_bytes, data=d), e) for e, d in JSON.items()),
    *(("h5", partial(edit_hdf5, change), e) for change, e in HDF5),
    *(
        ("spans", partial(replace_first_line, first_line(rows)), e)
        for e, rows in ROWS.items()
    ),
    ("spans", partial(replace_first_line, b"[" * 10**7 + b"\n"), "does not give"),
    *((".looks", partial(write_change, h), "change to the model") for h in CHANGES),
    *(("mjb.gz", attack, "") for attack in GZIP),
    ("mjb.gz", partial(replace_compiled_model, CONTENT, BOMB), "more than the record"),
    (
        *("mjb.gz", partial(replace_compiled_model, CONTENT, BOMB, bytes=1 << 50)),
        "recorded size is",
    ),
    *(("zip", partial(write_zip, {**VALID_ZIP, **m}), e) for e, m in ZIP.items()),
    ("zip", partial(write_zip, VALID_ZIP, duplicate=MAIN), "is not XML"),
    *(("zip", partial(write_zip, {MAIN: xml.encode()}), "") for xml in MJCF),
]


# Takes more than five seconds: one file reaches its limit of CPU time.
@pytest.mark.parametrize(
    ("kind", "attack", "error"),
    ATTACKS,
    ids=[f"{number} {kind} {error}" for number, (kind, _, error) in enumerate(ATTACKS)],
)
def test_attack_gives_one_error(inspector, directory, kind, attack, error):
    """The error gives the reason, within limits of memory and time."""
    reader, write = FILES[kind]
    path = write(directory)
    attack(path)
    assert re.search(error, inspector.refuses(reader, path))


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
    ids=["nested", "duplicate fact", "large facts", "endless line", "no objects"],
)
def test_hostile_journal_lines_take_little_time_and_memory(inspector, directory, lines):
    """The valid lines before the hostile ones still count."""
    journal = journal_of_killed(directory)
    with journal.open("ab") as file:
        file.write(lines)
    inspector.reads("finish", journal)


def write_foreign_journal(directory, name, version=1):
    begin = {"name": name, "log": 0, "rows": 0, "row": 0, "look": 0, "facts": {}}
    path, line = directory / journal_name(INFIX), json.dumps({"begin": begin})
    path.write_bytes(first_line(DTYPE.descr, version) + line.encode() + b"\n")
    (directory / log_name(INFIX, 0)).touch()
    return path


def test_journal_names_only_its_own_recordings(directory):
    """No path leads outside the directory or to another monitor's files."""
    for name in (
        *("../x", "..", "", "a\0b", "\ud800", f"../{NAME}", f"{NAME}.h5", NAME * 9),
        trajectory_prefix("0.2", 27),
        clip_part_name("1.7", 0, 0),
    ):
        write_foreign_journal(directory, name)
        assert recordings_in_flight(directory) == [], name
        assert not is_in_flight(directory / f"{NAME}.h5")
    write_foreign_journal(directory, NAME)
    assert is_in_flight(directory / f"{NAME}.h5")


def test_newer_format_asks_for_an_update(directory):
    """A log in a newer format is neither guessed at nor removed."""
    journal = write_foreign_journal(directory, NAME, version=12)
    with pytest.raises(UnreadableFile, match=r"newer mjrec in .* 12.* 1: update mjr"):
        load_trajectory(directory / f"{NAME}.h5")
    log = directory / log_name(INFIX, 0)
    remove_if_done(log)
    assert log.exists()
    for size in (100, 0):  # This cuts the journal within its first line.
        os.truncate(journal, size)
        assert recordings_in_flight(directory) == []


def test_names_that_lead_elsewhere_are_ignored(directory):
    """The path of a pending video may start like a name in the directory."""
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
    # Parsing such a long number would take minutes.
    assert episode_of(f"openaigym.video.0.7.video{'1' * 10**6}.mp4") is None
    assert infix_of("openaigym.episodes.0.7/../x.jsonl") is None
    assert not is_infix("1" * 10**6 + ".7")
    assert not is_infix("0.7/../..")


def test_environment_in_a_file_is_text(directory):
    """Names in files are never imported, called or turned into environments."""
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
def test_invalid_model_facts_are_refused(directory, model):
    trajectory = load_trajectory(write_log(directory, model=model))
    with pytest.raises(UnreadableFile):
        trajectory.model()


def test_mismatched_model_change_names_the_file(directory):
    logs = new_logs(directory)
    span = logs.begin(NAME, {"model": store_model(directory)}, row_dtype())
    span.log.add_change(ModelChange(step=0, fields={"geom_rgba": np.ones(3)}))
    add_row(span, 0)
    path = logs.path_of(NAME)
    with pytest.raises(UnreadableFile, match="belongs to another model") as error:
        load_trajectory(path).model()
    assert error.value.path == path


def test_compiled_model_is_named_after_its_content(inspector, directory):
    path = FILES["mjb.gz"][1](directory)
    other = path.rename(path.with_name("openaigym.model.0123456789abcdef.mjb.gz"))
    facts = directory / "facts.json"
    facts.write_text(json.dumps({**json.loads(facts.read_text()), "mjb": other.name}))
    assert "not the recorded model" in inspector.refuses("model", other)


ENDLESS = INSIDE % '<replicate count="100000000"><geom size="1"/></replicate>'
TEN_GIGABYTES = (
    '<mujoco><asset><texture name="t" type="2d" builtin="flat" width="60000" '
    'height="60000"/></asset></mujoco>'
)


@pytest.mark.parametrize(
    ("xml", "seconds", "reason"),
    # MuJoCo 3.3 refuses such a texture itself.
    [(ENDLESS, 3, "longer than 3 seconds"), (TEN_GIGABYTES, 100, "memory|too large")],
    ids=["endless", "ten gigabytes"],
)
def test_compiling_stops_at_its_limits(directory, xml, seconds, reason):
    """The compiler exceeds its time or memory, and this process continues."""
    path = FILES["zip"][1](directory)
    write_zip({MAIN: xml.encode()}, path)
    with pytest.raises(UnreadableFile, match=reason):
        compile_sources(path, compiled_size=1, seconds=seconds)
