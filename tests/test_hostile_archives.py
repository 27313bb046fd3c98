# SPDX-License-Identifier: Apache-2.0
"""Malicious archives are refused before they can harm a verifier."""

import os
import stat
import struct
import tempfile
import warnings
import zipfile
import zlib
from functools import partial
from pathlib import Path

import pytest

import mjrec
from mjrec.evidence.archive import bring_in

NAME = "run/data/recordings/openaigym.episodes.0.7.jsonl"
OUTSIDE = Path("/tmp/evil-of-mjrec-tests")
TABLE = b"PK\x01\x02"


def write(path, *entries, comment=b"", **options):
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", **options) as file:
        warnings.simplefilter("ignore")  # of duplicate names
        for name, content in entries:
            file.writestr(name, content)
        file.comment = comment


def writer(*entries, **options):
    return lambda path: write(path, *entries, **options)


def entry(name=NAME, **facts):
    """Return an entry that keeps an invalid name."""
    info = zipfile.ZipInfo("x")
    for key, value in {"filename": name, **facts}.items():
        setattr(info, key, value)
    return info


def write_named(name, path, mode=0):
    write(path, (NAME, b""), (entry(name, external_attr=mode << 16), b"/etc/passwd"))


def damage(change, path):
    write(path, (NAME, os.urandom(1000)), compression=zipfile.ZIP_DEFLATED)
    data = bytearray(path.read_bytes())
    changed = change(data)
    path.write_bytes(data if changed is None else changed)


def declare_size(size, data):
    for offset in (22, data.index(TABLE) + 24):
        struct.pack_into("<L", data, offset, size)


def encrypt(data):
    data[6] |= 1
    data[data.index(TABLE) + 8] |= 1


def flip_bit(data):
    data[500] ^= 1


def insert_bytes(data):
    table = data.index(TABLE)
    moved = bytearray(data[:table] + b"evil" + data[table:])
    struct.pack_into("<L", moved, len(moved) - 6, table + 4)
    return moved


def write_bomb(path):
    write(path, (NAME, bytes(80 << 20)), compression=zipfile.ZIP_DEFLATED)


def write_overlapping(path):
    """Write two entries that share bytes, as zip bombs do."""
    write(path, ("run/data/a", b"1"), ("run/data/b", b"2"))
    data = bytearray(path.read_bytes())
    struct.pack_into("<L", data, data.rindex(TABLE) + 42, 0)
    path.write_bytes(data)


def write_two_tables(path):
    """Write a table for Python and another for other programs."""
    evil = "run/data/evil"
    begin = 30 + len(NAME) + 1  # the second file, which holds the visible table
    table = begin + 30 + len(evil)
    hidden_size = 46 + len(NAME) + 46 + len(evil)
    rest = hidden_size + 56 + 20
    extra = struct.pack("<2H", 0x5455, rest)
    seen = listing(NAME, b"1", 0, len(extra) + rest) + extra
    hidden = listing(NAME, b"1", 0) + listing(evil, seen, begin)
    offset = table + len(seen)
    large = (b"PK\6\6", 44, 45, 45, 0, 0, 2, 2, hidden_size, offset)
    end = (b"PK\5\6", 0, 0, 1, 1, len(seen) + rest, table, 0)
    path.write_bytes(
        stored(NAME, b"1")
        + stored(evil, seen)
        + hidden
        + struct.pack("<4sQ2H2L4Q", *large)
        + struct.pack("<4sLQL", b"PK\6\7", 0, offset + hidden_size, 1)
        + struct.pack("<4s4H2LH", *end)
    )


def stored(name, content):
    facts = (0, 0, 33, zlib.crc32(content), len(content), len(content), len(name), 0)
    head = struct.pack("<4s2H3H3L2H", b"PK\3\4", 20, 0, *facts)
    return head + name.encode() + content


def listing(name, content, offset, extra=0):
    sizes = (zlib.crc32(content), len(content), len(content), len(name), extra)
    facts = (20, 20, 0, 0, 0, 33, *sizes, 0, 0, 0, 0, offset)
    return struct.pack("<4s6H3L5H2L", TABLE, *facts) + name.encode()


def write_second_name(path):
    """Write an entry that Info-ZIP and Python show under different names."""
    called = b"\x01" + struct.pack("<L", zlib.crc32(NAME.encode())) + b"run/data/evil"
    extra = struct.pack("<2H", 0x7075, len(called)) + called
    write(path, (entry(extra=extra), b"1"))


def link_folder(path):
    """Make an unpacked run whose recordings lie elsewhere."""
    elsewhere = path.with_name("elsewhere")
    (elsewhere / "recordings").mkdir(parents=True)
    path.mkdir()
    (path / "bagit.txt").write_text("BagIt-Version: 1.0\n")
    (path / "data").symlink_to(elsewhere)


NAMES = [
    # Paths that lead outside on some system.
    *(("../evil", "leads out"), ("run/../../evil", "leads out")),
    *(("run/..", "leads out"), (str(OUTSIDE), "absolute")),
    *(("C:/evil", "absolute"), ("run\\..\\..\\evil", "backslash")),
    *(("run/a\0b", "invisible character"), ("run/a\nb", "invisible character")),
    *(("run//evil", "empty part"), ("run/./evil", "empty part")),
    *((f"run/{'e' * 300}", "too long"), (f"run/{'e/' * 600}e", "too long")),
    (f"run/{'e/' * 20}e", "folders deep"),
]
PAIRS = [
    # Names of the same file on some system, or several top folders.
    *(("run/data/a", "run/data/a", "same file"), ("run/data/a", "run/data/A", "same")),
    ("run/data/\u00e4", "run/data/a\u0308", "same file"),
    *(("run/data/a", "run/data/a/b", "the folder"), ("run/data/a", "a", "one folder")),
    ("run/data/a", "other/a", "one folder"),
]
DAMAGES = [
    (partial(declare_size, 5), "CRC"),
    (partial(declare_size, 5000), "the declared size"),
    *((encrypt, "encrypted"), (flip_bit, "CRC")),
    # Bytes that only some programs read.
    (insert_bytes, "hidden bytes"),
    (lambda data: b"evil" + data, "before its first file"),
    (lambda data: data + b"evil", "at its end"),
    # An incomplete download.
    *((lambda data, n=n: data[:n], "not a zip file") for n in (0, 10, 200)),
]
MODES = [stat.S_IFLNK | 0o777, stat.S_IFCHR | 0o666, stat.S_IFIFO]
NO_FILE = "neither a file nor a folder"
ATTACKS = [
    *((partial(write_named, name), reason) for name, reason in NAMES),
    *((partial(write_named, "run/data/link", mode=m), NO_FILE) for m in MODES),
    *((writer((a, b"1"), (b, b"2")), reason) for a, b, reason in PAIRS),
    *((partial(damage, change), reason) for change, reason in DAMAGES),
    (writer((NAME, b"1"), comment=b"evil"), "has a comment"),
    (writer((entry(comment=b"evil"), b"1")), "has a comment"),
    (write_second_name, "not all programs read"),
    (writer((NAME, b"1"), ("run/All succeeded/", b"")), "is an empty"),
    (write_bomb, "zip bomb"),
    (writer(*((f"r/{n}", b"") for n in range(100_001))), "more than the limit"),
    (write_overlapping, "overlaps"),
    (write_two_tables, "two tables"),
    (writer((NAME, b"1"), compression=zipfile.ZIP_BZIP2), "unsupported compression"),
    (writer(("run/readme.txt", b"1")), "data/recordings"),
    (link_folder, NO_FILE),
]


@pytest.mark.parametrize(
    ("make", "reason"),
    ATTACKS,
    ids=[f"{n} {why}" for n, (_, why) in enumerate(ATTACKS)],
)
def test_malicious_archive_is_refused(make, reason, tmp_path):
    """It writes nothing outside its folder."""
    archive, folder = tmp_path / "run.zip", tmp_path / "folder"
    make(archive)
    before = sorted(tmp_path.rglob("*"))
    folder.mkdir()
    with pytest.raises(mjrec.UnreadableArchive, match=reason):
        bring_in(archive, folder / "run")
    outside = [path for path in tmp_path.rglob("*") if folder not in path.parents]
    assert sorted(outside) == sorted([*before, folder])
    assert not OUTSIDE.exists()


def test_verification_of_a_malicious_archive_leaves_no_files(tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    archive = tmp_path / "run.zip"
    write_named("../evil", archive)
    with pytest.raises(mjrec.UnreadableArchive, match="leads out"):
        mjrec.verify(archive, level="files")
    assert list(temporary.iterdir()) == []
    archive.write_bytes(b"PK")
    with pytest.raises(mjrec.UnreadableArchive, match="ask for the original file") as e:
        mjrec.verify(archive)
    assert str(e.value).startswith(f"Cannot verify {archive}: it is not a zip file.")
    assert "directory" not in str(e.value)


def test_archive_larger_than_the_free_disk_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "run.zip"
    write(path, (NAME, bytes(1000)))
    usage = type("Usage", (), {"free": 999})
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    with pytest.raises(mjrec.Error, match=r"takes 1000 bytes, but only 999 are free"):
        bring_in(path, tmp_path / "run")
    assert not (tmp_path / "run").exists()
