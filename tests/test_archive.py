# SPDX-License-Identifier: Apache-2.0
"""Archives of videos are reproducible and written completely or not at all."""

import gzip
import io
import json
import os
import tarfile
from pathlib import Path

import pytest

from mjrec.errors import ArchiveError
from mjrec.formats.archive import MAX_VIDEOS, write_archive


def make(directory, name, suffix=".mp4"):
    video, metadata = directory / f"{name}{suffix}", directory / f"{name}.meta.json"
    video.write_bytes(b"video " + name.encode())
    metadata.write_bytes(b"metadata " + name.encode())
    return video, metadata


def refusal(videos):
    """Return the error for `videos`, and check that the archive is empty."""
    archive = io.BytesIO()
    with pytest.raises(ArchiveError, match=r"^\[Hopper-v5\] ") as caught:
        write_archive(videos, archive, env_id="Hopper-v5")
    assert archive.getvalue() == b""
    return str(caught.value).removeprefix("[Hopper-v5] ")


def test_archive_contains_files_then_their_list(tmp_path):
    """The archive contains no times, users or groups of the machine."""
    first, second = make(tmp_path, "b"), make(tmp_path, "a", ".json")
    archive = io.BytesIO()
    archive.write(b"before")
    # `load_results` returns strings, so strings must be accepted like paths.
    write_archive([first, tuple(map(str, second))], archive)
    archive.seek(len(b"before"))
    contents = {}
    with tarfile.open(fileobj=archive, mode="r:gz") as tar:
        for member in tar:
            contents[member.name] = tar.extractfile(member).read()
            assert (member.mtime, member.uid, member.gid) == (0, 0, 0)
            assert (member.uname, member.gname, member.mode) == ("", "", 0o644)
    names = ["b.mp4", "b.meta.json", "a.json", "a.meta.json"]
    assert list(contents) == [*names, "manifest.json"]
    assert contents["a.json"] == b"video a"
    videos = [names[:2], names[2:]]
    assert json.loads(contents["manifest.json"]) == {"version": 0, "videos": videos}


def test_equal_videos_give_equal_archives(tmp_path):
    """Times, modes, the directory and the archive's name make no difference."""
    for name, mode in (("first", 0o600), ("second", 0o755)):
        (tmp_path / name).mkdir()
        pair = make(tmp_path / name, "a")
        pair[0].chmod(mode)
        os.utime(pair[0], (mode, mode))
        with (tmp_path / f"{name}.tar.gz").open("wb") as archive:
            write_archive([pair], archive)
    first, second = (path.read_bytes() for path in tmp_path.glob("*.tar.gz"))
    assert first == second
    assert first[4:8] == bytes(4), "gzip's header has a time"
    assert b"first" not in gzip.decompress(first)


def test_archive_holds_at_most_100_videos(tmp_path):
    pairs = [make(tmp_path, f"v{index}") for index in range(MAX_VIDEOS)]
    write_archive(pairs, io.BytesIO())
    missing = (tmp_path / "missing.mp4", tmp_path / "missing.meta.json")
    assert refusal([missing, *pairs]).startswith(
        "101 videos were given, but an archive holds at most 100."
    )


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (["a.mp4\n"], "'a.mp4\\n' is not a video name"),
        (["a.mkv"], "'a.mkv' is no"),
        (["ð.mp4"], "'ð.mp4' is not a video name"),
        (["a.mp4 a.json"], "'a.json' is not a metadata file name"),
        (["b.meta.json a.meta.json"], "'b.meta.json' is a metadata file's name"),
        (["Manifest.json"], "the archive's manifest"),
        # As in gym, missing files are reported first, then duplicates, then bad names.
        (["a.mp4 -"], "the metadata of the video"),
        (["b+c.mp4", "-"], "not a video name"),
        (["-", "b+c.mp4"], "The video "),
        (["a.mp4", "other/a.mp4"], "'a.mp4' occurs twice (the second time as "),
        (["a.mp4", "b.mp4 other/a.meta.json"], "'a.meta.json' occurs twice"),
        (["b.meta.json b.meta.json"], "'b.meta.json' occurs twice"),
    ],
)
def test_names_must_be_plain_distinct_and_of_known_types(tmp_path, names, reason):
    (tmp_path / "other").mkdir()
    pairs = []
    for each in names:
        video, _, metadata = each.partition(" ")
        pairs.append((tmp_path / video, tmp_path / (metadata or "a.meta.json")))
        for path in pairs[-1]:
            if path.name != "-":
                path.touch()
    assert reason in refusal(pairs)


@pytest.mark.parametrize(
    "put",
    [
        Path.mkdir,
        os.mkfifo,
        lambda path: path.symlink_to("a.mp4"),
        lambda path: path.symlink_to("missing"),
    ],
)
@pytest.mark.parametrize("name", ["x.mp4", "x.meta.json"])
def test_only_regular_files_are_accepted(tmp_path, put, name):
    video, metadata = make(tmp_path, "a")
    put(tmp_path / name)
    pair = (tmp_path / name, metadata) if "mp4" in name else (video, tmp_path / name)
    assert refusal([pair]).startswith(f"{tmp_path / name} is a link, a directory")
