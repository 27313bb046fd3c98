# SPDX-License-Identifier: Apache-2.0
"""Files of somebody who means harm: one error, soon, and nothing else is touched."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import json
import os
import re
import socket
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np
import pytest
from hostile_reading import SECONDS, Inspector
from sound_files import (
    FILES,
    SPHERE,
    compiled,
    finished,
    killed,
    manifest,
    metadata,
    source,
    stored,
)
from trajectories_by_hand import add_row, new_logs, write_log

from mjrec import UnreadableFile, load_trajectory
from mjrec.formats.manifest import read_manifest
from mjrec.formats.monitor_directory import Infix, episode_of, infix_of
from mjrec.formats.trajectory import ModelChange, row_dtype
from mjrec.formats.trajectory_file import finish_trajectory
from mjrec.results.manifest_writing import update_manifests
from mjrec.simulation.model_sources import compile_sources
from mjrec.simulation.model_trust import note_models


@pytest.fixture(scope="module")
def inspector() -> Iterator[Inspector]:
    with Inspector() as one:
        yield one


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    path = tmp_path / "theirs"
    path.mkdir()
    return path


@pytest.mark.parametrize("kind", FILES)
def test_a_sound_file_is_read(inspector: Inspector, directory: Path, kind: str) -> None:
    """So that what is refused below is refused for its harm."""
    reader, write = FILES[kind]
    inspector.reads(reader, write(directory))


# --- what is no file at all ----------------------------------------------------------


def listening_socket(path: Path) -> None:
    # By a relative name, because those of sockets are short.
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path.name)


def outside_of(path: Path) -> Path:
    return path.parents[1] / "ours" / path.name


PUT: dict[str, Callable[[Path], Any]] = {
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "socket": listening_socket,
    "link to itself": lambda path: path.symlink_to(path.name),
    "link to a device": lambda path: path.symlink_to("/dev/zero"),
    "link elsewhere": lambda path: path.symlink_to(
        path.parents[1] / "ours" / path.name
    ),
    "link with dots": lambda path: path.symlink_to(Path("../ours") / path.name),
}
FINE = {
    # A file that the user names is the user's, links and all.
    *(("mjcf", "link elsewhere"), ("mjcf", "link with dots")),
    # A directory is an answer that lists what is in it.
    ("h5", "folder"),
}


@pytest.mark.parametrize(
    ("kind", "put"), [(k, p) for k in FILES for p in PUT if (k, p) not in FINE]
)
def test_only_regular_files_of_the_directory_are_opened(
    inspector: Inspector,
    directory: Path,
    kind: str,
    put: str,
) -> None:
    """No pipe is waited for, no device opened, no link followed, nothing removed."""
    reader, write = FILES[kind]
    path = write(directory)
    outside = outside_of(path)
    outside.parent.mkdir()
    path.rename(outside)
    os.utime(outside, (0, outside.stat().st_mtime))
    PUT[put](path)
    before = sorted(directory.iterdir())
    inspector.refuses(reader, path)
    assert outside.stat().st_atime == 0
    assert list(outside.parent.iterdir()) == [outside]
    assert sorted(directory.iterdir()) == before


def test_links_within_the_directory_are_followed(directory: Path) -> None:
    """As are the user's own, from elsewhere, that bear no monitor file's name."""
    path = finished(directory)
    kept = path.rename(directory / "kept.h5")
    path.symlink_to(kept.name)
    latest = directory.parent / "latest.h5"
    latest.symlink_to(path)
    assert len(load_trajectory(path)) == len(load_trajectory(latest)) == 4


# --- what is not what its name says --------------------------------------------------


def nothing(path: Path) -> None:
    path.write_bytes(b"")


def noise(path: Path) -> None:
    path.write_bytes(np.random.default_rng(1).bytes(5000))


def a_hole_of_a_terabyte(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])
    os.truncate(path, 1 << 40)


def half_of_it(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


SPOILS = (nothing, noise, a_hole_of_a_terabyte, half_of_it)


@pytest.mark.parametrize("spoil", SPOILS)
@pytest.mark.parametrize("kind", [k for k in FILES if k != "video for an archive"])
def test_other_content_is_refused(
    inspector: Inspector, directory: Path, kind: str, spoil: Callable[[Path], None]
) -> None:
    """Of a journal and of logs there is what is whole; the rest is passed over."""
    reader, write = FILES[kind]
    path = write(directory)
    spoil(path)
    if kind == "journal":
        os.truncate(path, min(path.stat().st_size, 1 << 28))
    # MuJoCo reads what the user has named as it likes.
    may_be_read = {"mjcf", ".spans"} if spoil is a_hole_of_a_terabyte else set()
    if kind in {"journal", ".log", ".tail", ".looks"} | may_be_read:
        outcome = inspector.read(reader, path)
        assert outcome.kind in ("value", "refused"), outcome
        assert outcome.seconds < SECONDS / 2, outcome
    else:
        inspector.refuses(reader, path)


# --- JSON ----------------------------------------------------------------------------

BOMBS = {
    "nested lists": b"[" * 10_000_000,
    "nested objects": b'{"a":' * 2_000_000,
    "nested just within the parser's own limit": b'{"a": %s}'
    % (b"[" * 900 + b"]" * 900),
    "a number of a million digits": b'{"a": %s}' % (b"9" * 1_000_000),
    "a fraction of ten million digits": b'{"stats": 0.%s}' % (b"9" * 10_000_000),
    "twenty million values": b'{"a": [%s0]}' % (b"0," * 20_000_000),
    "a key twice": b'{"a": 1, "a": 2}',
    "the same key in two spellings": b'{"a": 1, "\\u0061": 2}',
    "another encoding": '{"a": 1}'.encode("utf-16"),
    "no text": b'{"a": "\xff"}',
    "a list": b"[]",
    "a text": b'"{}"',
}


@pytest.mark.parametrize("kind", ["manifest", "stats", "metadata"])
@pytest.mark.parametrize("bomb", BOMBS)
def test_json_bombs_are_refused(
    inspector: Inspector, directory: Path, kind: str, bomb: str
) -> None:
    """Within a gigabyte of memory, and before anything of it is used."""
    path = FILES[kind][1](directory)
    path.write_bytes(BOMBS[bomb])
    if kind == "metadata" and bomb == "a fraction of ten million digits":
        assert inspector.read("metadata", path).kind == "value"
        return
    inspector.refuses(kind, path)


def test_a_pending_video_elsewhere_is_not_looked_at(directory: Path) -> None:
    """Though its name begins as that of a video of the directory does."""
    outside = directory.parent / "openaigym.video.0.7.video000000.mp4"
    outside.write_bytes(b"")
    metadata(directory.parent)
    (directory / "openaigym.video.0.7").mkdir()
    name = f"openaigym.video.0.7/../../{outside.name}"
    assert episode_of(name) is None
    path = manifest(directory)
    entry = {"pending": [{"episode_id": 0, "video": name}]}
    path.write_text(json.dumps({**json.loads(path.read_text()), "mjrec": entry}))
    update_manifests(directory)
    assert read_manifest(path).videos == ()


def test_names_hold_small_numbers_and_no_slash() -> None:
    """Reading a number takes longer than its digits are many."""
    assert episode_of(f"openaigym.video.0.7.video{'1' * 10**6}.mp4") is None
    assert infix_of("openaigym.episodes.0.7/../x.jsonl") is None
    assert Infix.parse("1" * 10**6 + ".7") is None
    assert Infix.parse("0.7/../..") is None


# --- trajectories --------------------------------------------------------------------


def replaced(name: str, **options: Any) -> Callable[[h5py.File], None]:
    def replace(file: h5py.File) -> None:
        del file[name]
        file.create_dataset(name, **options)

    return replace


def virtual(file: h5py.File) -> None:
    """A dataset put together of files that are counted when its shape is asked for."""
    whole = h5py.h5s.create_simple((4,), (h5py.h5s.UNLIMITED,))
    whole.select_hyperslab((0,), (h5py.h5s.UNLIMITED,), (1,), (1,))
    part = h5py.h5s.create_simple((1,))
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_virtual(whole, b"/etc/%b", b"x", part)
    del file["rewards"]
    h5py.h5d.create(file.id, b"rewards", h5py.h5t.IEEE_F64LE, whole, properties)


def overflowing_frames(file: h5py.File) -> None:
    steps = [2**62, 2**63 - 1, -(2**63) + 1, -(2**62), 0]
    replaced("frame_steps", data=np.array(steps))(file)
    replaced("snapshots", data=np.zeros(5, file["snapshots"].dtype))(file)


def change_of(file: h5py.File, name: str, **options: Any) -> h5py.Group:
    group = file["model_changes"].create_group("0")
    group.attrs["step"] = np.int64(0)
    if options:
        group.create_dataset(name, **options)
    return group


def half_a_billion_steps(file: h5py.File) -> None:
    """Zeros, which pack a thousandfold."""
    shape = (1 << 29,)
    space = h5py.h5s.create_simple(shape)
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((1 << 24,))
    properties.set_deflate(9)
    del file["rewards"]
    dataset = h5py.h5d.create(
        file.id, b"rewards", h5py.h5t.IEEE_F64LE, space, properties
    )
    packed = zlib.compress(bytes(8 << 24), 9)
    for index in range(32):
        dataset.write_direct_chunk((index << 24,), packed)


ZEROS = {"data": np.zeros(4 << 20), "compression": 9, "chunks": (4 << 20,)}


def one_change_by_many_names(file: h5py.File) -> None:
    group = change_of(file, "geom_rgba", **ZEROS)
    for index in range(1, 5000):
        file["model_changes"][str(index)] = group


def gigabytes_of_observations(file: h5py.File) -> None:
    """Four, out of four megabytes."""
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


def linked_field(file: h5py.File) -> None:
    change_of(file, "")["geom_rgba"] = h5py.ExternalLink("/etc/passwd", "/x")


def object_field(file: h5py.File) -> None:
    change_of(file, "x", data=[b"cos\nsystem"], dtype=h5py.string_dtype())


# Takes more than five seconds: one file is given up when it has had its CPU time.
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (virtual, "in a way that mjrec does not write"),
        (overflowing_frames, "not of its steps"),
        (replaced("states", shape=(5, 2**35), dtype="f8"), "C int"),
        (replaced("rewards", shape=(2**40,), dtype="f8"), "more memory"),
        (replaced("rewards", shape=(2**40,), dtype="f8", chunks=(9,)), "more memory"),
        (half_a_billion_steps, "more memory"),
        (gigabytes_of_observations, "more memory"),
        (one_change_by_many_names, "SIGXCPU|SIGKILL"),
        (linked_field, "no 'geom_rgba' of its own"),
        (object_field, "no dtype"),
        (lambda file: file.attrs.create("format_version", True), "another type"),
    ],
)
def test_hostile_hdf5_is_refused(
    inspector: Inspector,
    directory: Path,
    change: Callable[[h5py.File], None],
    reason: str,
) -> None:
    """Within a gigabyte of memory here, and limits in the sandbox that reads it."""
    path = finished(directory)
    with h5py.File(path, "r+") as file:
        change(file)
    assert re.search(reason, inspector.refuses("trajectory", path))


# --- recordings in flight ------------------------------------------------------------

NAME = "openaigym.trajectory.0.7.episode000000"


@pytest.mark.parametrize("bomb", BOMBS)
def test_json_bombs_in_a_list_are_refused_or_passed_over(
    inspector: Inspector, directory: Path, bomb: str
) -> None:
    """One that begins it is refused; behind the beginning it says nothing."""
    spans = killed(directory)
    sound = spans.read_bytes()
    spans.write_bytes(BOMBS[bomb] + b"\n" + sound)
    inspector.refuses("finish", spans)
    spans.write_bytes(sound + BOMBS[bomb] + b"\n")
    inspector.reads("finish", spans)


def note(facts: str) -> bytes:
    return f'{{"note": "{NAME}", "facts": {facts}}}\n'.encode()


@pytest.mark.parametrize(
    "lines",
    [
        note("[" * 1_000_000),
        note('{"complete": true, "complete": false}'),
        note('{"a": "%s"}' % ("a" * (30 << 20))) * 3,
        b"a" * (200 << 20),
        b"{\n" * 50_000,
    ],
    ids=["nested", "a fact twice", "large facts", "an endless line", "no lines"],
)
def test_hostile_lines_of_a_list_take_little(
    inspector: Inspector, directory: Path, lines: bytes
) -> None:
    """Time and memory; what was said before counts."""
    spans = killed(directory)
    with spans.open("ab") as file:
        file.write(lines)
    inspector.reads("finish", spans)


# --- what trajectories say -----------------------------------------------------------


def test_an_environment_in_a_file_is_text(directory: Path) -> None:
    """Nothing that a file names is imported or called, or made an environment of."""
    done = directory / "done"
    command = f"touch {done}"
    path = write_log(
        directory,
        environment={
            "framework": "gymnasium",
            "id": "subprocess:check_output",
            "entry_point": "subprocess:check_output",
            "kwargs": {"args": command, "shell": True},
        },
        env_id="subprocess:check_output",
    )
    trajectory = load_trajectory(finish_trajectory(path))
    assert trajectory.env_id == "subprocess:check_output"
    assert trajectory.environment is not None
    assert not done.exists()


@pytest.mark.parametrize("model", [5, "x", [], {"mjb": "../x"}, {"mjb": {}}])
def test_what_a_trajectory_says_of_its_model_is_checked(
    directory: Path, model: Any
) -> None:
    """One error, of whatever type it is."""
    trajectory = load_trajectory(write_log(directory, model=model))
    with pytest.raises(UnreadableFile):
        trajectory.model()


def test_a_model_change_that_fits_nothing_names_the_file(directory: Path) -> None:
    """And not the field alone."""
    facts = {"model": {**stored(directory)}}
    logs = new_logs(directory)
    span = logs.begin(NAME, facts, row_dtype())
    span.log.add_change(ModelChange(step=0, fields={"geom_rgba": np.ones(3)}))
    add_row(span, 0)
    path = logs.path_of(NAME)
    with pytest.raises(UnreadableFile, match="belongs to another model") as error:
        load_trajectory(path).model()
    assert error.value.path == path


# --- models --------------------------------------------------------------------------


def facts_of(directory: Path) -> dict[str, Any]:
    facts: dict[str, Any] = json.loads((directory / "facts.json").read_text())
    return facts


def put_compiled(directory: Path, content: bytes, packed: bytes | None = None) -> Path:
    """Store bytes as a compiled model of this user's, with facts that are true."""
    digest = hashlib.sha256(content).hexdigest()
    path = directory / f"openaigym.model.{digest[:16]}.mjb.gz"
    path.write_bytes(gzip.compress(content) if packed is None else packed)
    facts = {"sha256": digest, "bytes": len(content), "mjb": path.name, "xml": None}
    facts |= {"mujoco": mujoco.__version__}
    note_models([digest])
    (directory / "facts.json").write_text(json.dumps(facts))
    return path


def test_bytes_that_are_no_model_are_refused(
    inspector: Inspector, directory: Path
) -> None:
    """Though their hash is the recorded one."""
    path = put_compiled(directory, np.random.default_rng(1).bytes(10_000))
    inspector.refuses("model", path)


def test_a_compiled_model_has_the_name_of_its_content(
    inspector: Inspector, directory: Path
) -> None:
    """So that one file cannot stand for two models."""
    path = compiled(directory)
    other = path.rename(path.with_name("openaigym.model.0123456789abcdef.mjb.gz"))
    facts = {**facts_of(directory), "mjb": other.name}
    (directory / "facts.json").write_text(json.dumps(facts))
    assert "not what was recorded" in inspector.refuses("model", other)


CONTENT = bytes(1000)


@pytest.mark.parametrize(
    "packed",
    [
        gzip.compress(CONTENT) + gzip.compress(b"more"),
        gzip.compress(b"") * 100_000 + gzip.compress(CONTENT),
        gzip.compress(CONTENT)[:10].replace(b"\0", b"\x08", 1) + b"x" * 30_000_000,
        gzip.compress(CONTENT)[:-1],
        gzip.compress(CONTENT)[:-8] + bytes(8),
        gzip.compress(CONTENT) + b"tail",
    ],
    ids=["two", "many", "endless name", "cut off", "wrong checksum", "tail"],
)
def test_gzip_of_another_making_is_refused(
    inspector: Inspector, directory: Path, packed: bytes
) -> None:
    """What is packed is one stream, and nothing else is there."""
    inspector.refuses("model", put_compiled(directory, CONTENT, packed))


def test_a_gzip_bomb_is_not_unpacked(inspector: Inspector, directory: Path) -> None:
    """Whatever size the facts give."""
    path = put_compiled(directory, CONTENT, gzip.compress(bytes(1 << 28)))
    assert "it holds more" in inspector.refuses("model", path)
    facts = {**facts_of(directory), "bytes": (1 << 31) - 1}
    (directory / "facts.json").write_text(json.dumps(facts))
    assert "memory" in inspector.refuses("model", path)


def put_zip(
    directory: Path,
    members: dict[str, bytes],
    *,
    method: int = zipfile.ZIP_DEFLATED,
    again: tuple[str, ...] = (),
) -> Path:
    path = source(directory)
    contents = b'{"format": 1, "main": "main.xml"}'
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in {"contents.json": contents, **members}.items():
            archive.writestr(name, content)
        for name in again:
            with pytest.warns(UserWarning, match="Duplicate"):
                archive.writestr(name, b"other")
    return path


MAIN = {"source/main.xml": SPHERE.encode()}


def npy(header: str) -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text + bytes(64)


HUGE = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,)}")


@pytest.mark.parametrize(
    ("members", "options", "reason"),
    [
        (MAIN, {"again": ("source/main.xml",)}, "is no XML"),
        ({**MAIN, "fields/geom_rgba.npy": HUGE}, {}, "more memory than"),
        ({**MAIN, "fields/geom_rgba.npy": b"\x93NUMPY\x03\0"}, {}, "expected 4 bytes"),
        ({**MAIN, "source/../../x": b""}, {}, "a file called"),
        ({**MAIN, "source//tmp/x": b""}, {}, "no plain relative path"),
        ({**MAIN, "contents.json": b"[" * 100_000}, {}, "nested too deeply"),
        ({**MAIN, "contents.json": b'{"format": 1, "main": "other"}'}, {}, "other"),
        ({**MAIN, "contents.json": b'{"format": 1, "main": {}}'}, {}, "dict"),
    ],
)
def test_hostile_zips_are_refused(
    inspector: Inspector,
    directory: Path,
    members: dict[str, bytes],
    options: dict[str, Any],
    reason: str,
) -> None:
    """Before anything is unpacked that need not be."""
    path = put_zip(directory, members, **options)
    assert reason in inspector.refuses("model", path)


INSIDE = "<mujoco><worldbody>%s</worldbody></mujoco>"


@pytest.mark.parametrize(
    "xml",
    [
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
    ],
)
def test_hostile_mjcf_is_refused(
    inspector: Inspector, directory: Path, xml: str
) -> None:
    """Nothing but the files of the zip is read."""
    inspector.refuses("model", put_zip(directory, {"source/main.xml": xml.encode()}))


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
def test_a_model_that_takes_too_much_is_given_up(
    directory: Path, xml: str, seconds: int, reason: str
) -> None:
    """Time or memory; this process goes on."""
    path = put_zip(directory, {"source/main.xml": xml.encode()})
    with pytest.raises(UnreadableFile, match=reason):
        compile_sources(path, compiled_size=1, seconds=seconds)


def test_files_and_directories_are_not_multiplied(
    inspector: Inspector, directory: Path
) -> None:
    """A megabyte of names would be looked at a thousand million times."""
    compilers = "".join(f'<compiler meshdir="d{i}"/>' for i in range(20_000))
    meshes = "".join(f'<mesh file="{i}"/>' for i in range(20_000))
    xml = f"<mujoco>{compilers}<asset>{meshes}</asset></mujoco>"
    path = put_zip(directory, {"source/main.xml": xml.encode()})
    assert "opening file" in inspector.refuses("model", path)
