# SPDX-License-Identifier: Apache-2.0
"""Test that `pack` rejects what it cannot pack and then leaves no files."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from full_disk import file_size_limit
from packed_runs import the, unpacked
from parts import parametrize
from trajectories_by_hand import write_log

import honest_runs
import mjrec
from mjrec.evidence.bag import make_bag
from mjrec.evidence.size_limit import byte_count
from mjrec.evidence.statements import state


@pytest.fixture(scope="module")
def recorded(pendulums):
    return pendulums(2, longest=3)


@pytest.fixture
def directory(recorded, tmp_path):
    """Return a copy of the recordings that tests may damage."""
    return shutil.copytree(recorded, tmp_path / "runs")


@pytest.fixture
def place(tmp_path):
    """Return a path for an archive; its folder must be empty after the test."""
    folder = tmp_path / "place"
    folder.mkdir()
    yield folder / "run.zip"
    assert list(folder.iterdir()) == []


@pytest.fixture
def live(tmp_path, make_corridor, play):
    """Return the recording of one episode with a live video."""
    with mjrec.Monitor(make_corridor(), tmp_path / "runs") as env:
        play(env, 1)
    return tmp_path / "runs"


def refusal(kind, directory, path, **options):
    """Check that packing raises exactly this error, and return its message."""
    with pytest.raises(kind) as caught:
        mjrec.pack(directory, path, **options)
    assert type(caught.value) is kind
    return str(caught.value)


def test_open_monitor_is_named(tmp_path, place, make_corridor):
    with mjrec.Monitor(make_corridor(), tmp_path / "runs") as env:
        env.reset()
        message = refusal(mjrec.DirectoryInUse, tmp_path / "runs", place)
        assert the(tmp_path / "runs", ".*.lock").name in message
        assert "Close the monitor" in message


def test_unfinished_recordings_are_rejected_with_the_command(tmp_path, place):
    pending, killed = tmp_path / "pending", tmp_path / "killed"
    honest_runs.pendulum(pending, episodes=1, workers=0)
    killed.mkdir()
    write_log(killed, ended=False)
    for runs, command in ((pending, "render"), (killed, "recover")):
        message = refusal(mjrec.UnfinishedRecordings, runs, place)
        assert f"mjrec {command} {runs}" in message


def remove(pattern):
    return lambda directory: the(directory, pattern).unlink()


def add_a_stray_video(directory):
    video = the(directory, "*000000.mp4")
    shutil.copy(video, video.with_name("openaigym.video.9.x.video000000.mp4"))


def damage_a_trajectory(directory):
    path = the(directory, "*000001.h5")
    path.write_bytes(path.read_bytes()[:1000])


def lead_out(directory):
    video = the(directory, "*000000.mp4")
    video.rename(directory.with_name("secret"))
    video.symlink_to(directory.with_name("secret"))


@pytest.mark.parametrize(
    ("spoil", "kind", "part"),
    [
        (add_a_stray_video, mjrec.UnfinishedRecordings, "openaigym.video.9.x.*manifes"),
        # A missing deferred video counts as pending.
        (remove("*000000.mp4"), mjrec.UnfinishedRecordings, "mjrec render .*runs"),
        (remove("*.stats.json"), mjrec.UnfinishedRecordings, "results are missing"),
        (damage_a_trajectory, mjrec.UnreadableFile, "000001.h5"),
        (lead_out, mjrec.UnreadableFile, "leads out of its directory"),
    ],
)
def test_damaged_recordings_are_rejected(directory, place, spoil, kind, part):
    spoil(directory)
    with pytest.raises(kind, match=f"(?s){part}"):
        mjrec.pack(directory, place)


def test_live_videos_must_exist_and_are_never_encoded_again(live, place):
    """No states were recorded from which to render a live video again."""
    video = the(live, "*.mp4")
    content = video.read_bytes()
    message = refusal(mjrec.ArchiveTooLarge, live, place, max_size=1000)
    assert "never re-encoded" in message
    assert video.read_bytes() == content
    video.unlink()
    message = refusal(mjrec.PackError, live, place)
    assert f"names {video.name}, which is missing" in message


def test_links_within_the_directory_are_packed_as_files(directory, tmp_path):
    video = the(directory, "*000000.mp4")
    video.rename(directory / "elsewhere")
    video.symlink_to("elsewhere")
    folder = unpacked(mjrec.pack(directory, tmp_path / "a.zip"), tmp_path / "x")
    packed = the(folder, video.name)
    assert packed.is_file()
    assert not packed.is_symlink()


def test_existing_archive_or_broken_link_is_never_replaced(recorded, tmp_path):
    path = tmp_path / "run.zip"
    path.symlink_to("nowhere")
    assert "already exists" in refusal(mjrec.InvalidArgument, recorded, path)
    assert [p.name for p in tmp_path.iterdir()] == ["run.zip"]


@pytest.mark.parametrize("name", ["run.tar", ".run.zip", "openaigym.zip", "\n.zip"])
def test_archive_names_must_end_in_zip_and_be_no_monitor_file(name, recorded, place):
    refusal(mjrec.InvalidArgument, recorded, place.with_name(name))


def test_directories_without_recordings_are_errors(tmp_path, place):
    message = refusal(mjrec.InvalidArgument, tmp_path / "nothing", place)
    assert "does not exist" in message
    assert "mjrec record" in refusal(mjrec.InvalidArgument, tmp_path, place)


@pytest.mark.parametrize(
    ("options", "part"),
    [
        *(({"episodes": bad}, "episodes") for bad in ([], [True], ["0"], [0.0])),
        ({"authors": ["Ada <0000-0002-1825-0098>"]}, "An author must be"),
        ({"authors": ["Ada <not an address>"]}, "An author must be"),
        ({"authors": "Ada"}, "a list of strings"),
        ({"authors": ["A\nB"]}, "one line"),
        ({"license": "my own"}, "SPDX"),
        ({"title": " "}, "title"),
        ({"max_size": "much"}, "max_size"),
        ({"max_size": 0}, "max_size"),
    ],
)
def test_invalid_options_are_rejected(options, part, recorded, place):
    assert part in refusal(mjrec.InvalidArgument, recorded, place, **options)


def test_error_for_unknown_episodes_lists_the_valid_ones(recorded, place):
    message = refusal(mjrec.UnknownName, recorded, place, episodes=[0, 9])
    assert message.endswith("with the number 9. Available: 0, 1.")


def test_authors_licenses_and_sizes_are_parsed():
    """Names may have either order, licenses may be URLs, and sizes may have units."""
    authors = ["Plato", "Ludwig van Beethoven <L@b.de>", "van Beethoven, Ludwig"]
    stated = state(title="t", authors=authors, license="https://x.y/l")
    assert [(a.given, a.family, a.email) for a in stated.authors] == [
        ("", "Plato", None),
        ("Ludwig van", "Beethoven", "L@b.de"),
        ("Ludwig", "van Beethoven", None),
    ]
    assert (stated.license.url, stated.license.spdx) == ("https://x.y/l", None)
    sizes = {"50M": 50_000_000, "5MB": 5_000_000, "1.5Gi": 3 << 29, "7": 7, "9k": 9000}
    assert {text: byte_count(text) for text in sizes} == sizes


def test_missing_jinja_is_an_error_with_the_fix(recorded, place, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    install = 'pip install "mjrec[evidence]"'
    assert install in refusal(mjrec.MissingDependency, recorded, place)


def test_full_disk_is_an_error_and_leaves_nothing(recorded, place):
    with file_size_limit(2000):
        assert "pack again" in refusal(mjrec.FileNotWritten, recorded, place)


@pytest.mark.usefixtures("no_process_is_left")
def test_ctrl_c_leaves_no_file_and_no_process(recorded, tmp_path, place):
    """The interruption comes while `pack` renders smaller videos."""
    size = mjrec.pack(recorded, tmp_path / "run.zip").stat().st_size

    def interrupt(progress):
        if progress.frames_done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mjrec.pack(recorded, place, max_size=size - 500, on_progress=interrupt)


def test_too_large_archives_are_rejected_with_the_largest_files(recorded, place):
    """Nothing is rendered if the archive would be too large even without videos."""
    reports = []
    with pytest.raises(mjrec.ArchiveTooLarge) as caught:
        mjrec.pack(recorded, place, max_size=1000, on_progress=reports.append)
    error = caught.value
    assert error.limit == 1000 < error.size
    sizes = [size for _, size in error.largest]
    assert sizes == sorted(sizes, reverse=True)
    assert error.largest[0][0] in str(error)
    assert "--episodes" in str(error)
    assert reports == []


@parametrize("case", ["0.7.4/plain", "0.21.0/two_monitors", "0.12.1/text"])
def test_recordings_of_gym_are_packed_and_verified(case, tmp_path):
    """Selecting episodes of gym's recordings is an error."""
    directory = Path(__file__).parent / "data/gym" / case
    archive = mjrec.pack(directory, tmp_path / "run.zip")
    assert mjrec.verify(archive, level="files").failures == ()
    other = tmp_path / "b.zip"
    assert "gym's own" in refusal(mjrec.InvalidArgument, directory, other, episodes=[0])


def test_names_with_a_percent_sign_use_an_older_bagit_version(tmp_path):
    """Version 1.0 would write %25, which `bagit` and `sha512sum` do not decode."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data/video.front%2Fleft.mp4").write_bytes(b"1")
    make_bag(tmp_path, date="2026-11-24", title="Recordings")
    assert (tmp_path / "bagit.txt").read_text().startswith("BagIt-Version: 0.97\n")
    listed = (tmp_path / "manifest-sha512.txt").read_text()
    assert "data/video.front%2Fleft.mp4\n" in listed


def test_anonymous_archives_name_no_author(recorded, tmp_path):
    """If the title names an author, packing fails."""
    options = {"anonymous": True, "authors": ["Zebulon Quackenbush"]}
    archive = mjrec.pack(recorded, tmp_path / "a.zip", **options)
    folder = unpacked(archive, tmp_path / "x")
    held = b"".join(p.read_bytes() for p in folder.rglob("*") if p.is_file())
    assert b"uackenbush" not in held
    assert "withheld" in (folder / "data/README.md").read_text()
    crate = json.loads((folder / "data/ro-crate-metadata.json").read_text())
    assert not [e for e in crate["@graph"] if e["@type"] == "Person"]
    options["title"] = "By Zebulon Quackenbush"
    message = refusal(mjrec.IdentityLeft, recorded, tmp_path / "b.zip", **options)
    assert "README.md" in message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "x"]
