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
    """A tar.gz with the pairs in the order given and `manifest.json` last."""
    pairs = [make(tmp_path, "b"), make(tmp_path, "a", ".json")]
    archive = io.BytesIO()
    write_archive(pairs, archive, env_id="Hopper-v5")
    assert not archive.closed
    archive.seek(0)
    with tarfile.open(fileobj=archive, mode="r:gz") as tar:
        contents = {}
        for member in tar:
            file = tar.extractfile(member)
            assert file is not None
            contents[member.name] = file.read()
    names = ["b.mp4", "b.meta.json", "a.json", "a.meta.json", "manifest.json"]
    assert list(contents) == names
    assert contents["a.json"] == b"video a"
    assert json.loads(contents["manifest.json"]) == {
        "version": 0,
        "videos": [["b.mp4", "b.meta.json"], ["a.json", "a.meta.json"]],
    }


def test_no_videos_give_an_archive_with_an_empty_list(tmp_path: Path) -> None:
    """As gym did."""
    archive = io.BytesIO()
    write_archive([], archive)
    archive.seek(0)
    with tarfile.open(fileobj=archive, mode="r:gz") as tar:
        assert tar.getnames() == ["manifest.json"]


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


def test_members_say_nothing_about_the_machine(tmp_path: Path) -> None:
    """No time, no owner, one mode."""
    archive = io.BytesIO()
    write_archive([make(tmp_path, "a")], archive)
    archive.seek(0)
    with tarfile.open(fileobj=archive, mode="r:gz") as tar:
        for member in tar:
            assert member.isreg()
            assert (member.mtime, member.uid, member.gid) == (0, 0, 0)
            assert (member.uname, member.gname, member.mode) == ("", "", 0o644)


def test_it_goes_where_the_file_stands(tmp_path: Path) -> None:
    """What was in the file before stays."""
    archive = io.BytesIO()
    archive.write(b"before")
    write_archive([make(tmp_path, "a")], archive)
    assert archive.getvalue().startswith(b"before\x1f\x8b")


def test_names_may_be_given_as_text(tmp_path: Path) -> None:
    """As `load_results` gives them."""
    archive = io.BytesIO()
    video, metadata = make(tmp_path, "a")
    write_archive([(str(video), str(metadata))], archive)
    assert archive.getvalue()


def test_a_hundred_videos_fit_and_no_more(tmp_path: Path) -> None:
    """The message has the numbers the right way round, and comes first of all."""
    pairs = [make(tmp_path, f"v{index}") for index in range(MAX_VIDEOS)]
    write_archive(pairs, io.BytesIO())
    missing = (tmp_path / "missing.mp4", tmp_path / "missing.meta.json")
    assert refusal([missing, *pairs]).startswith(
        "101 videos were given, and an archive holds at most 100."
    )


def test_without_an_environment_the_message_says_none(tmp_path: Path) -> None:
    """As gym's did."""
    with pytest.raises(ArchiveError, match=r"^\[None\] There is no video "):
        write_archive([(tmp_path / "a.mp4", tmp_path / "b")], io.BytesIO())


def test_a_missing_video_is_named(tmp_path: Path) -> None:
    """Before its missing metadata."""
    video, metadata = tmp_path / "a.mp4", tmp_path / "a.meta.json"
    assert refusal([(video, metadata)]).startswith(f"There is no video {video}.")


def test_missing_metadata_is_named(tmp_path: Path) -> None:
    """By its own path, which gym's message did not have."""
    video, metadata = make(tmp_path, "a")
    metadata.unlink()
    message = refusal([(video, metadata)])
    assert message.startswith(f"There is no metadata {metadata} for the video {video}")


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
    "name",
    ["a.mp4\n", "a.mkv", "a b.mp4", "\N{LATIN SMALL LETTER E WITH ACUTE}.mp4", ".mp"],
)
def test_a_video_needs_a_plain_name(tmp_path: Path, name: str) -> None:
    """ASCII letters, digits and three signs; nothing after the ending."""
    video, metadata = make(tmp_path, "a")
    video = video.rename(tmp_path / name)
    assert f"{name!r} is no name for a video" in refusal([(video, metadata)])


@pytest.mark.parametrize("name", ["a.meta.json\n", "a.json", "a b.meta.json", "a"])
def test_metadata_needs_a_plain_name(tmp_path: Path, name: str) -> None:
    """The same for metadata."""
    video, metadata = make(tmp_path, "a")
    metadata = metadata.rename(tmp_path / name)
    assert f"{name!r} is no name for metadata" in refusal([(video, metadata)])


def test_metadata_is_no_video(tmp_path: Path) -> None:
    """Though its name ends in .json."""
    first, second = make(tmp_path, "a"), make(tmp_path, "b")
    message = refusal([(first[1], second[1])])
    assert "'a.meta.json' is the name of metadata" in message


@pytest.mark.parametrize("name", ["manifest.json", "Manifest.json"])
def test_nothing_can_be_called_like_the_list(tmp_path: Path, name: str) -> None:
    """It would collide with the archive's own, on some systems in any case."""
    video, metadata = make(tmp_path, "a", ".json")
    video = video.rename(tmp_path / name)
    assert "the archive's own list" in refusal([(video, metadata)])
    metadata = metadata.rename(tmp_path / "b.meta.json")
    other, _ = make(tmp_path, "c")
    assert "no name for metadata" in refusal([(other, video)])


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
    assert "no name for a video" in refusal([bad, missing])
    assert "There is no video" in refusal([missing, bad])
    assert "There is no metadata" in refusal([(bad[0], missing[1])])
    assert "twice" in refusal([good, (good[0], bad[1])])
    assert "no name for a video" in refusal([bad])


def test_a_file_that_cannot_be_read_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where that shows only after the checks, and after other files."""
    first, second = make(tmp_path, "a"), make(tmp_path, "b")
    opened = os.open

    def vanishing(path: Path, flags: int, *rest: int) -> int:
        if path == second[1]:
            second[1].unlink(missing_ok=True)
        return opened(path, flags, *rest)

    monkeypatch.setattr(os, "open", vanishing)
    assert refusal([first, second]).startswith(f"Cannot read {second[1]}: No such file")
