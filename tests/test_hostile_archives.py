# SPDX-License-Identifier: Apache-2.0
"""Archives that are made to do harm to whoever verifies them."""

from __future__ import annotations

import os
import stat
import struct
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import mjrec

GOOD = "run/data/recordings/openaigym.episodes.0.7.jsonl"


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary folders are made."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def refused(tmp_path: Path, temporary: Path) -> Iterator[Callable[[Path], str]]:
    """Return a function that verifies an archive, and the reason why it is refused.

    Nothing is there afterwards that was not there before.
    """

    def verify(archive: Path) -> str:
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(mjrec.UnreadableFile) as raised:
            mjrec.verify(archive, level="files")
        assert sorted(tmp_path.rglob("*")) == before
        assert list(temporary.iterdir()) == []
        return raised.value.reason

    yield verify
    assert not Path("/tmp/evil-of-mjrec-tests").exists()


def write(path: Path, *entries: tuple[str | zipfile.ZipInfo, bytes]) -> Path:
    """Write a zip file as it would never come from us."""
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w") as file:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, content in entries:
            file.writestr(name, content)
    return path


def entry(name: str, mode: int = 0, **more: int) -> zipfile.ZipInfo:
    """Return an entry whose name is taken as it is."""
    info = zipfile.ZipInfo("x")
    info.filename = name
    info.external_attr = mode << 16
    for key, value in more.items():
        setattr(info, key, value)
    return info


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("../evil", "leads out"),
        ("run/../../evil", "leads out"),
        ("run/..", "leads out"),
        ("/tmp/evil-of-mjrec-tests", "absolute"),
        ("C:/evil", "absolute"),
        ("run\\..\\..\\evil", "backslash"),
        ("run/a\0b", "cannot be seen"),
        ("run/a\nb", "cannot be seen"),
        ("run//evil", "empty part"),
        ("run/./evil", "empty part"),
        (f"run/{'e' * 300}", "too long"),
        (f"run/{'e/' * 600}e", "too long"),
        (f"run/{'e/' * 20}e", "folders deep"),
    ],
)
def test_names_that_lead_elsewhere_are_refused(
    name: str, reason: str, tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """Whatever system they would lead elsewhere on."""
    archive = write(tmp_path / "run.zip", (GOOD, b""), (entry(name), b"evil"))
    assert reason in refused(archive)


@pytest.mark.parametrize(
    "mode",
    [stat.S_IFLNK | 0o777, stat.S_IFCHR | 0o666, stat.S_IFIFO, stat.S_IFSOCK],
    ids=["link", "device", "pipe", "socket"],
)
def test_what_is_no_file_is_refused(
    mode: int, tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """A link could be written through, and a device opened."""
    link = entry("run/data/link", mode)
    archive = write(tmp_path / "run.zip", (GOOD, b""), (link, b"/etc/passwd"))
    assert "neither a file nor a folder" in refused(archive)


@pytest.mark.parametrize(
    ("first", "second", "reason"),
    [
        ("run/data/a", "run/data/a", "one file"),
        ("run/data/a", "run/data/A", "one file"),
        ("run/data/\u00e4", "run/data/a\u0308", "one file"),
        ("run/data/a", "run/data/a/b", "a folder"),
        ("run/data/a", "other/a", "one folder"),
        ("run/data/a", "a", "one folder"),
    ],
)
def test_names_that_do_not_go_together_are_refused(
    first: str, second: str, reason: str, tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """Two files of one name, on any system, or more than one folder."""
    archive = write(tmp_path / "run.zip", (first, b"1"), (second, b"2"))
    assert reason in refused(archive)


def test_bomb_is_refused_by_what_it_states(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """Before a byte of it is unpacked."""
    path = tmp_path / "run.zip"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file,
        file.open(GOOD, "w") as output,
    ):
        for _ in range(80):
            output.write(bytes(1 << 20))
    assert "made to fill a disk" in refused(path)


@pytest.mark.parametrize("stated", [5, 5000])
def test_sizes_that_are_not_true_are_refused(
    stated: int, tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """What is said to be small is counted while it is unpacked."""
    path = tmp_path / "run.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(GOOD, os.urandom(1000))
    data = bytearray(path.read_bytes())
    for place in (22, data.index(b"PK\x01\x02") + 24):
        struct.pack_into("<L", data, place, stated)
    path.write_bytes(data)
    assert "CRC" in refused(path) or "another size" in refused(path)


def test_huge_number_of_files_is_refused(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """By the number that the archive states, before they are listed."""
    path = write(tmp_path / "run.zip", (GOOD, b""))
    with zipfile.ZipFile(path, "w") as file:
        for number in range(100_001):
            file.writestr(f"r/{number}", b"")
    assert "would be many" in refused(path)


def test_two_entries_over_the_same_bytes_are_refused(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """As in bombs that unpack one content any number of times."""
    path = write(tmp_path / "run.zip", ("run/data/a", b"1"), ("run/data/b", b"2"))
    data = bytearray(path.read_bytes())
    second = data.rindex(b"PK\x01\x02")
    struct.pack_into("<L", data, second + 42, 0)
    path.write_bytes(data)
    assert "overlaps" in refused(path)


@pytest.mark.parametrize(
    ("where", "reason"),
    [
        ("before", "before its first file"),
        ("behind", "at its end"),
        ("between", "hidden bytes"),
        ("comment", "has a comment"),
    ],
)
def test_hidden_bytes_are_refused(
    where: str, reason: str, tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """What some programs see and others do not."""
    path = write(tmp_path / "run.zip", (GOOD, b"1"))
    data = path.read_bytes()
    if where == "before":
        path.write_bytes(b"evil" + data)
    elif where == "behind":
        path.write_bytes(data + b"evil")
    elif where == "comment":
        with zipfile.ZipFile(path, "a") as file:
            file.comment = b"evil"
    else:
        table = data.index(b"PK\x01\x02")
        moved = bytearray(data[:table] + b"evil" + data[table:])
        struct.pack_into("<L", moved, len(moved) - 6, table + 4)
        path.write_bytes(moved)
    assert reason in refused(path)


def test_encrypted_files_are_refused(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """Nobody can check them."""
    path = write(tmp_path / "run.zip", (GOOD, b"1"))
    data = bytearray(path.read_bytes())
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)
    assert "encrypted" in refused(path)


def test_rare_compression_is_refused(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """A reader may not have it."""
    path = tmp_path / "run.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as file:
        file.writestr(GOOD, b"1")
    assert "not everybody can unpack" in refused(path)


@pytest.mark.parametrize("kept", [0, 10, 200])
def test_cut_off_archives_are_refused(
    kept: int, tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """A download that broke off."""
    path = write(tmp_path / "run.zip", (GOOD, bytes(1000)))
    path.write_bytes(path.read_bytes()[:kept])
    assert "no zip file" in refused(path)


def test_damaged_archives_are_refused(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """One bit of one file is enough."""
    path = write(tmp_path / "run.zip", (GOOD, bytes(1000)))
    data = bytearray(path.read_bytes())
    data[500] ^= 1
    path.write_bytes(data)
    assert "CRC" in refused(path)


def test_archives_of_others_are_refused(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """And it is said what is missing."""
    path = write(tmp_path / "run.zip", ("run/readme.txt", b"1"))
    assert "data/recordings" in refused(path)


def test_links_of_an_unpacked_run_are_not_followed(
    tmp_path: Path, refused: Callable[[Path], str]
) -> None:
    """Neither to the recordings nor to the bag."""
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "recordings").mkdir(parents=True)
    bag = tmp_path / "run"
    bag.mkdir()
    (bag / "bagit.txt").write_text("BagIt-Version: 1.0\n")
    (bag / "data").symlink_to(elsewhere)
    assert "data/recordings" in refused(bag)


def test_archive_that_does_not_fit_on_the_disk_is_an_error(
    tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before anything is written, and with the room that it takes."""
    path = write(tmp_path / "run.zip", (GOOD, bytes(1000)))
    usage = type("Usage", (), {"free": 999})
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    with pytest.raises(mjrec.Error, match=r"takes 1000 bytes, and 999 are free"):
        mjrec.verify(path, level="files")
    assert list(temporary.iterdir()) == []


def test_words_about_a_bad_archive_say_what_to_do(tmp_path: Path) -> None:
    """It is one file that somebody has sent."""
    archive = tmp_path / "run.zip"
    archive.write_bytes(b"PK")
    with pytest.raises(mjrec.UnreadableArchive) as raised:
        mjrec.verify(archive)
    assert str(raised.value).startswith(f"Cannot verify {archive}: it is no zip file.")
    assert "ask for the file" in str(raised.value)
    assert "directory" not in str(raised.value)
