# SPDX-License-Identifier: Apache-2.0
"""An archive is reproducible, and is written whole or not at all."""

from __future__ import annotations

import gzip
import io
import json
import os
import tarfile
from pathlib import Path

import pytest

from mjrec.errors import ArchiveError
from mjrec.formats.archive import MAX_VIDEOS, write_archive

Pair = tuple[Path, Path]


def make(directory: Path, name: str, suffix: str = ".mp4") -> Pair:
    """Make a video and its metadata, with a content each."""
    video, metadata = directory / f"{name}{suffix}", directory / f"{name}.meta.json"
    video.write_bytes(b"video " + name.encode())
    metadata.write_bytes(b"metadata " + name.encode())
    return video, metadata


def refusal(videos: list[Pair]) -> str:
    """Return the message with which `videos` are refused, with nothing written."""
    archive = io.BytesIO()
    with pytest.raises(ArchiveError) as caught:
        write_archive(videos, archive, env_id="Hopper-v5")
    assert archive.getvalue() == b""
    message = str(caught.value)
    assert message.startswith("[Hopper-v5] ")
    return message.removeprefix("[Hopper-v5] ")


def test_it_holds_the_files_and_then_their_list(tmp_path: Path) -> None:
    """A tar.gz of the pairs as given; nothing says anything of the machine."""
    first, second = make(tmp_path, "b"), make(tmp_path, "a", ".json")
    archive = io.BytesIO()
    archive.write(b"before")
    # As `load_results` gives them, too.
    write_archive([first, (str(second[0]), str(second[1]))], archive)
    assert not archive.closed
    archive.seek(len(b"before"))
    contents = {}
    with tarfile.open(fileobj=archive, mode="r:gz") as tar:
        for member in tar:
            file = tar.extractfile(member)
            assert file is not None
            contents[member.name] = file.read()
            assert (member.mtime, member.uid, member.gid) == (0, 0, 0)
            assert (member.uname, member.gname, member.mode) == ("", "", 0o644)
    names = ["b.mp4", "b.meta.json", "a.json", "a.meta.json", "manifest.json"]
    assert list(contents) == names
    assert contents["a.json"] == b"video a"
    assert json.loads(contents["manifest.json"]) == {
        "version": 0,
        "videos": [["b.mp4", "b.meta.json"], ["a.json", "a.meta.json"]],
    }


def test_the_same_videos_give_the_same_bytes(tmp_path: Path) -> None:
    """Whatever their times, permissions, directory and the archive's own name."""
    archives = []
    for name, mode in (("first", 0o600), ("second", 0o755)):
        (tmp_path / name).mkdir()
        pair = make(tmp_path / name, "a")
        pair[0].chmod(mode)
        os.utime(pair[0], (mode, mode))
        with (tmp_path / f"{name}.tar.gz").open("wb") as archive:
            write_archive([pair], archive)
        archives.append((tmp_path / f"{name}.tar.gz").read_bytes())
    assert archives[0] == archives[1]
    assert archives[0][4:8] == bytes(4), "gzip's header has a time"
    assert b"first" not in gzip.decompress(archives[0])


def test_a_hundred_videos_fit_and_no_more(tmp_path: Path) -> None:
    """The message has the numbers the right way round, and comes first of all."""
    pairs = [make(tmp_path, f"v{index}") for index in range(MAX_VIDEOS)]
    write_archive(pairs, io.BytesIO())
    missing = (tmp_path / "missing.mp4", tmp_path / "missing.meta.json")
    assert refusal([missing, *pairs]).startswith(
        "101 videos were given, and an archive holds at most 100."
    )


def test_a_name_can_be_there_only_once(tmp_path: Path) -> None:
    """For videos, for metadata, and for a file given as both."""
    (tmp_path / "other").mkdir()
    first, other = make(tmp_path, "a"), make(tmp_path / "other", "a")
    unique = make(tmp_path, "b")
    assert f"'a.mp4' is there twice (the second time as {other[0]})" in refusal(
        [first, other]
    )
    assert f"'a.meta.json' is there twice (the second time as {other[1]})" in refusal(
        [first, (unique[0], other[1])]
    )
    assert "'b.meta.json' is there twice" in refusal([(unique[1], unique[1])])
    assert "'a.meta.json' is there twice" in refusal([first, (first[1], unique[1])])


@pytest.mark.parametrize(
    ("video", "metadata", "reason"),
    [
        *(
            (name, "a.meta.json", f"{name!r} is no name for a video")
            for name in ("a.mp4\n", "a.mkv", "ð.mp4")
        ),
        *(
            ("a.mp4", name, f"{name!r} is no name for metadata")
            for name in ("a.meta.json\n", "a.json", "a b.meta.json", "manifest.json")
        ),
        ("b.meta.json", "a.meta.json", "'b.meta.json' is the name of metadata"),
        ("manifest.json", "a.meta.json", "the archive's own list"),
        ("Manifest.json", "a.meta.json", "the archive's own list"),
    ],
)
def test_names_are_plain_and_say_what_they_are(
    tmp_path: Path, video: str, metadata: str, reason: str
) -> None:
    """ASCII letters, digits and three signs; nothing after the ending."""
    first, second = make(tmp_path, "x")
    pair = first.rename(tmp_path / video), second.rename(tmp_path / metadata)
    assert reason in refusal([pair])


def test_only_regular_files_go_in(tmp_path: Path) -> None:
    """No directory, no link, whole or broken, and no pipe, on either place."""
    video, metadata = make(tmp_path, "a")
    directory, link, broken, pipe = (
        tmp_path / f"{kind}.mp4" for kind in ("directory", "link", "broken", "pipe")
    )
    directory.mkdir()
    link.symlink_to(video)
    broken.symlink_to(tmp_path / "missing")
    os.mkfifo(pipe)
    for path in (directory, link, broken, pipe):
        assert refusal([(path, metadata)]).startswith(f"{path} is a link, a directory")
    (tmp_path / "link.meta.json").symlink_to(metadata)
    assert "link.meta.json is a link" in refusal([(video, tmp_path / "link.meta.json")])


def test_checks_come_in_gyms_order(tmp_path: Path) -> None:
    """Pair by pair, and within a pair presence, then doubles, then names."""
    good, bad = make(tmp_path, "a"), make(tmp_path, "b c")
    missing = (tmp_path / "x.mp4", tmp_path / "x.meta.json")
    assert refusal([missing]).startswith(f"There is no video {missing[0]}.")
    assert "no name for a video" in refusal([bad, missing])
    assert "There is no video" in refusal([missing, bad])
    assert "There is no metadata" in refusal([(bad[0], missing[1])])
    assert "twice" in refusal([good, (good[0], bad[1])])
    assert "no name for a video" in refusal([bad])
